"""From a line on a frame to the places of the band edges on it: bands from labels, edges from whole windows."""

import dataclasses
import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from holotorch.tracking.camera.lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.bands import Stretches, find_axis, find_stretches
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.detection.fits import EdgeFit, fit_edges, median
from holotorch.tracking.detection.footprint import Front
from holotorch.tracking.detection.luma import coarse_colours, fit_luma
from holotorch.tracking.detection.stations import Axis, variance_of
from holotorch.tracking.pose.status import Refusal, Status

_COLUMNS = 40  # and more, along half a line: of every second to sixth pixel, whose colours say where it lies,
_CERTAIN = 280  # or this many, where only coarse colours have said that it is there
_WINDOW = 20  # pixels to either side of an edge, of which every second one is read,
_CLOSE = 5  # but each as near as this, and two blurs farther
_OUTSIDE = 10  # pixels beyond the outermost edges
_ASIDE = 0.9  # pixels beyond the tube's sides, from which on a row tells nothing
_HALFWAY, _SURE = 6, 3  # samples to either side of where labels change; the outermost of them that show one colour
_AWAY = 2.0  # pixels from where it was expected at which an edge is looked at once more
_MARGIN = 8.0  # pixels, and two blurs: what must be seen to either side of an edge
_WHITE, _CUT = 252, 0.1  # a level that may be more light than it says, and the share of such in a row that spoils it
_SMEARED = 4.0  # pixels of blur that no lens makes
BLURRED = 0.6  # pixels from the blur that was expected, beyond which edges want another look
_UNSURE, _LOST = 0.1, 3.0  # pixels: a clear edge is known to a few hundredths, and what may become one to a few
_ALIKE = 0.2  # of the brightest channel: colours nearer than this are one
_PALE = 0.5  # of the purity of what lies beside it
_BESIDE = 14.0  # pixels from the mid-line, beside the widest catheters
_SIGNS, _ROWS = np.repeat([-1.0, 1.0], 3), np.tile([2.0, 3.0, 4.0], 2)  # three rows to either side, pixels beyond it
_SIDE_STEP = 0.25  # light that changes beside an edge, over what changes on it: something lies across the tube
_SAME_STEP = 0.6  # the same, where the bands themselves go on there
_CLEAR = 4.0  # standard deviations of that change


@dataclass(frozen=True, eq=False)
class Edges:
    """Of the band edges [N] on a line, in pixels: t (NaN where not seen), its deviation, blur, bulge, and failures.

    ``expected`` is the blur for which the windows were made; ``coarse`` says that colours have fewer pixels than luma.
    """

    t: np.ndarray
    deviation: np.ndarray
    blur: float
    expected: float
    bulge: float
    coarse: bool
    hidden: tuple[int, ...]
    outside: tuple[int, ...]


def find_bands(
    sampler: Sampler,
    lens: Lens,
    line: Line,
    table: ColourTable,
    half: float,
    aside: float,
    reach: float,
    *,
    onward: bool,
) -> tuple[Line, Stretches]:
    """Line, and stretches on it, in a strip around a first line, ``half`` its length, ``aside`` half its width.

    All in pixels; t rises from the tip to the rear, as on the first line where that is ``onward``. A Refusal (NO_AXIS,
    BANDS_MISSING) where nothing thin has the bands' colours, or not in their order.
    """
    end = math.ceil(half)
    t = np.arange(-end, end + 1.0)
    u = np.arange(-math.ceil(aside), aside + 1.0)
    every = min(6, max(2, end // (_COLUMNS if onward else _CERTAIN)))
    some = t[end % every :: every]
    found = find_axis(table.labels(sampler.nearest(line.pixels(lens, some, u))), some, u, reach)
    if found is None:
        raise Refusal(Status.NO_AXIS, "nothing thin and straight with the bands' colours")
    line = line.moved(*found)
    rows = np.array([-1.0, 0.0, 1.0, -_BESIDE, _BESIDE])
    levels = sampler.nearest(line.pixels(lens, t, rows))
    near = table.labels(levels)
    # What looks the same on both sides of the line is a drape, or cannot be told from one.
    shown = levels[:, [1, 3, 4]].transpose(2, 0, 1).astype(np.float32, order="C")
    most = shown.max(0)
    gap = np.abs(shown[..., 1:] - shown[..., :1]).max(0)
    alike = near[:, 3:] == near[:, 1:2]
    drape = alike[:, 0] & alike[:, 1] & (np.maximum(gap[:, 0], gap[:, 1]) < _ALIKE * most[:, 0])
    # A tube that lets cloth shine through has the cloth's hue, but is paler than any band on it.
    pure = 1 - shown.min(0) / np.maximum(most, 1.0)
    through = alike[:, 0] & alike[:, 1] & (pure[:, 0] < _PALE * np.minimum(pure[:, 1], pure[:, 2]))
    stretches = find_stretches(near[:, :3], drape, through, table, float(end), onward=onward)
    if stretches is None:
        why = "no stretch of line shows the bands in their order, or it shows them both ways"
        raise Refusal(Status.BANDS_MISSING, why, turned=onward)
    if stretches.flipped:  # from here on t rises from the tip to the rear
        turned = Line(line.origin, -line.along, line.scale)
        return turned, dataclasses.replace(stretches, edges=-stretches.edges, flipped=False)
    return line, stretches


def halfway(sampler: Sampler, lens: Lens, line: Line, edges: np.ndarray) -> np.ndarray:
    """Where light is halfway between that on both sides of ``edges`` [N], which a few pixels' labels gave.

    Of a step at x among samples k from -n to n, from 0 to 1, the sum of 1 - step is x + n + 1/2, however blurred. As
    they were where that is not near.
    """
    k = np.arange(-_HALFWAY, _HALFWAY + 1.0)
    around = lens.distort(line.plane((edges[:, None] + k)[..., None], np.array([-1.0, 0.0, 1.0])))
    light = sampler(around).sum(-1)  # [3, N, K]
    before, after = (part.sum(-1, keepdims=True) / _SURE for part in (light[..., :_SURE], light[..., -_SURE:]))
    step = after - before
    share = ((light - before) * step).sum(0) / np.maximum((step * step).sum(0), 1e-9)
    found = (1 - share).sum(-1) - light.shape[-1] / 2
    return edges + np.where(np.abs(found) < _SURE, found, 0.0)


def measure_edges(
    sampler: Sampler,
    lens: Lens,
    axis: Axis,
    guess: np.ndarray,
    doubtful: tuple[bool, ...],
    blur: float,
    curve: np.ndarray,
) -> Edges:
    """Places of the edges near ``guess`` [N] (NaN: not looked for); ``curve`` [N]: how far a ring's front bulges in t.

    An edge fails that is hidden (the surroundings change where it does), unclear, or too near the frame's border. A
    Refusal (INCONSISTENT) where all of them go on beside the tube.
    """
    line = axis.line
    chosen = np.isfinite(guess).nonzero()[0]
    t, deviation = np.full(len(guess), np.nan), np.full(len(guess), np.inf)
    if not len(chosen):
        return Edges(t, deviation, blur, blur, 0.0, False, (), ())
    near, bulge = guess[chosen], curve[chosen]
    window, along = _along(near, blur)
    widths = axis.width_at(near)
    half = math.ceil(float(widths.max()) / 2 + _ASIDE) - 1
    u = np.arange(-half, half + 1.0)
    front = Front.of(u, widths, axis.blur)
    # Rows on the tube, and three to either side of it, which tell whether something lies across.
    rows = np.empty((len(near), len(u) + 6))
    rows[:, : len(u)], rows[:, len(u) :] = u, _sides(widths, blur)
    farther = np.zeros_like(rows)
    farther[:, : len(u)] = bulge[:, None] * front.mean
    # A row that is mostly surroundings tells little of the edge, and what it tells may be of something else.
    row = np.minimum(np.maximum(widths[:, None] / 2 + _ASIDE - np.abs(u), 0), 1)
    kept = _between(along, len(near), chosen[0] == 0, chosen[-1] == len(guess) - 1, blur)
    looks = 2
    while True:
        place = near[:, None, None] + along[:, None] + farther[:, None]
        every = lens.distort(line.plane(place, rows[:, None]))
        pixels = every[..., : len(u)]
        light = sampler.sharp(pixels).transpose(1, 2, 3, 0)  # [E, T, U, C]
        inside = sampler.inside(pixels)
        shown = kept[..., None] * row[:, None] * inside
        weight = shown[..., None] / variance_of(light)
        most = sampler.light[_WHITE]
        if light.max() > most:  # where light is cut off on one side, halfway is no longer where the edge is
            weight *= (light > most).mean(1, keepdims=True) < _CUT
        fit = fit_edges(light, weight, blur, t=along)
        known = np.isfinite(fit.deviation)
        if np.count_nonzero(known) > 1 and median(fit.blur[known]) > _SMEARED > blur:
            # It moved along itself, farther than what was looked at.
            t[chosen] = near + fit.place
            return measure_edges(sampler, lens, axis, t, doubtful, median(fit.blur[known]), curve)
        shading, looks = fit, looks - 1
        if coarse := bool(np.any(coarse_colours(sampler, pixels[[0, -1], len(along) // 2, half]))):
            fit, shading = fit_luma(fit, light, shown, sampler.light, along)
        elif bool((fit.deviation > _UNSURE).any()) and not _astray(fit, looks):
            # Surroundings that are not even leak into the outer rows; those in the middle may tell all the same.
            core = (widths[:, None] / 2 - 0.5 - np.abs(u)).clip(0, 1)
            fit = shading = fit.or_better(fit_edges(light, weight * core[:, None, :, None], blur, t=along))
        near = near + fit.place
        if not _astray(fit, looks):
            break
    near = near - bulge * front.shift(shading.steps, shading.told, row)
    blurs = fit.blur[np.isfinite(fit.deviation)]
    soft = median(fit.blur)
    beside = sampler.light.take(sampler.nearest(every[..., len(u) :].reshape(-1, 6)))
    covered, beyond = _across(beside.reshape(*every.shape[:2], 6, 3), along - fit.place[:, None], fit)
    if beyond and len(near) > 2 and soft < blur + BLURRED:
        raise Refusal(Status.INCONSISTENT, "all bands go on beside the tube: this is thicker, seen in one part of it")
    margin, moved = _MARGIN + 2 * soft, np.abs(fit.place)
    within = np.ones(len(near), dtype=bool)
    if not inside.all() or window < margin + moved.max():
        within = np.all(sampler.inside(lens.distort(line.plane(near[:, None] + margin * np.array([-1, 1])))), -1)
    clear = (fit.deviation < 0.6) & (moved < window / 2) & (fit.blur < 0.55 * window)
    # An edge between two bands shows by its colours what it is; an outer one does not.
    hides = covered & np.array(doubtful)[chosen]
    outside, hidden = chosen[~within].tolist(), chosen[within & hides].tolist()
    measured = within & ~hides & clear
    t[chosen[measured]], deviation[chosen[measured]] = near[measured], fit.deviation[measured]
    soft, most = median(blurs) if len(blurs) else blur, float(np.abs(bulge).max())
    return Edges(t, deviation, soft, blur, most, coarse, tuple(hidden), tuple(outside))


def _along(near: np.ndarray, blur: float) -> tuple[int, np.ndarray]:
    """Half the length of the windows around edges at ``near`` [E], in pixels, and the samples along a window [T]."""
    gap = min((abs(b - a) for a, b in itertools.pairwise(near.tolist())), default=math.inf)
    window = int(min(_WINDOW + 2 * blur, max(4.0, 0.45 * gap)))
    along = np.arange(-window, window + 1.0)
    return window, along[(np.abs(along) <= _CLOSE + 2 * blur) | (along % 2 == window % 2)]


def _between(along: np.ndarray, edges: int, first: bool, last: bool, blur: float) -> np.ndarray:
    """[E, T] 1 for samples that count, 0 far beyond the ``first`` and the ``last`` edge, where these are outermost.

    There a table's grain shines through the tube, and light that drifts draws an edge to where it grows.
    """
    outside = _OUTSIDE + 2 * blur
    kept = np.ones((edges, len(along)), dtype=np.float32)
    if first:
        kept[0] *= along >= -outside
    if last:
        kept[-1] *= along <= outside
    return kept


def _astray(fit: EdgeFit, looks: int) -> bool:
    """Whether an edge is 2 px and more from where it was looked for, with ``looks`` left and two edges to look at."""
    far = float(np.abs(fit.place).max())
    return looks > 0 and far >= _AWAY and int(np.count_nonzero(fit.deviation < _LOST)) >= 2


def _sides(widths: np.ndarray, blur: float) -> np.ndarray:
    """Three rows to either side of tubes so wide [E], beyond what blur makes of their sides: [E, 6] across."""
    return _SIGNS * (_ROWS + 2 * blur + widths[:, None] / 2)


def _across(light: np.ndarray, along: np.ndarray, fit: EdgeFit) -> tuple[np.ndarray, bool]:
    """Whether the surroundings change where the edges are: light [E, T, 6, C] at places [E, T] along from them.

    [E], on both sides of each: something lies across the tube there. And on one side of all, as much as on the tube.
    """
    count, samples, _, colours = light.shape
    light = light.reshape(count, samples, -1).astype(np.float64)
    up = ndtr(along / fit.blur[:, None])
    up -= up.sum(1, keepdims=True) / samples
    power = np.maximum((up * up).sum(1), 1e-30)[:, None, None]
    step = (up[:, None] @ light).reshape(count, 2, 3, colours).sum(2) / (3 * power)  # [E, 2, C]
    size = np.sqrt((step * step).sum(-1))
    middle = fit.steps.shape[1] // 2
    own = fit.steps[:, middle - 1 : middle + 2].sum(1)
    own = np.sqrt((own * own).sum(-1, keepdims=True)) / 3
    large = size > _SIDE_STEP * own
    if not large.any():  # as mostly: what noise may do need not be known
        return large[:, 0], False
    side = light.reshape(count, samples, 2, 3, colours).sum(3) / 3
    left = side - side.sum(1, keepdims=True) / samples - step[:, None] * up[:, :, None, None]
    large &= size > _CLEAR * np.sqrt((left * left).sum((1, 3)) / (samples * power[..., 0]))
    return large.all(1), bool((large & (size > _SAME_STEP * own)).all(0).any())
