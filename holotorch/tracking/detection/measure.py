"""Bands and their edges along a line on a frame: bands from colour labels, edges from fits to windows of samples."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import ndtr

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.bands import Stretches, find_axis, find_stretches
from holotorch.tracking.detection.colours import ALIKE, ColourTable
from holotorch.tracking.detection.fits import EdgeFit, fit_edges, median
from holotorch.tracking.detection.footprint import Front
from holotorch.tracking.detection.luma import coarse_colours, fit_luma
from holotorch.tracking.detection.stations import Axis, variance_of
from holotorch.tracking.pose.status import Refusal, Status


@dataclass(frozen=True)
class StripSearch:
    """Parameters of the search for the tube and its bands in a strip of the frame. A column is a position along it."""

    columns: int = 40  # least number of columns in half of the strip that are classified; 2 to 6 pixels apart
    columns_cold: int = 280  # the same number without a previous pose
    similar: float = 0.2  # largest difference of equal colours, as a fraction of the brightest channel
    same_hue: float = math.cos(math.radians(12))  # least cosine between the chromas of two colours of the same hue
    pale: float = 1.05  # largest chroma of a clear tube over that of the background beside it
    beside: float = 14.0  # distance from the axis at which the background is read, in pixels; beside the widest tubes
    averaged: int = 2  # pixels on either side of that distance whose mean is the background
    halfway: int = 6  # samples on either side of a change of labels
    halfway_ends: int = 3  # outermost samples on either side that surely show one colour


@dataclass(frozen=True)
class EdgeWindow:
    """Samples around an edge, and their weights; in pixels unless stated otherwise."""

    half: int = 20  # half-width of the window along the tube, of which every second pixel is read
    dense: int = 5  # distance from the edge, plus two blurs, up to which every pixel is read
    close: int = 7  # the same for edges that cannot be measured in the whole window
    outside: int = 10  # distance beyond an outermost edge, plus two blurs, up to which samples have weight
    aside: float = 0.9  # distance outside the side of the tube from which on a row of samples has no weight
    leak: float = 0.75  # distance outside the side at which the background is read that leaks into the rows of the tube
    leaking: float = 0.3  # standard deviation of the fraction of the background that leaks into a row
    white: int = 252  # highest 8-bit level that is surely not saturated
    saturated: float = 0.1  # fraction of saturated samples from which on a row has no weight


@dataclass(frozen=True)
class EdgeLimits:
    """Limits for measuring an edge again or refusing it, in pixels unless stated otherwise; from synthetic frames."""

    far: float = 2.0  # distance from the expected position from which on an edge is measured again
    margin: float = 8.0  # least distance of an edge to the border of the frame, in addition to two blurs
    smeared: float = 4.0  # blur above which the tube must have moved during the exposure
    unsure: float = 0.1  # deviation above which an edge is measured again in the middle rows alone
    vague: float = 0.3  # deviation from which on an edge is not clear
    lost: float = 3.0  # deviation from which on there is no edge
    across: float = 0.25  # ratio of light's change beside and on an edge above which an object crosses the tube
    same: float = 0.15  # the same ratio above which the bands continue beside the tube
    differs: float = 0.1  # least difference of the tube from both sides, as a fraction of the brighter light
    mostly: float = 0.8  # least fraction of the samples along an edge's window that differ where the tube is visible
    moving: float = 3.0  # ratio of the blurs across and along the tube from which on it must have moved across
    clear: float = 4.0  # least change of the background in standard deviations for the change to be significant


_SEARCH, _WINDOW, _LIMITS = StripSearch(), EdgeWindow(), EdgeLimits()
BLURRED = 0.6  # pixels: difference of the measured from the expected blur above which edges are measured again
_SIGNS, _ROWS = np.repeat([-1.0, 1.0], 3), np.tile([1.0, 2.0, 3.0], 2)  # three background rows on each side of the tube


@dataclass(frozen=True, eq=False)
class Edges:
    """Measured band edges [N] on a line, in pixels.

    Attributes:
        t: [N] positions along the line; NaN where not measured.
        deviation: [N] standard deviations of ``t``.
        blur: Median blur of the edges.
        expected: Blur for which the windows were chosen.
        bulge: Largest bulge of a ring's front along the line.
        coarse: Whether chroma has fewer pixels than luma.
        texture: [N] variation of the background beside each edge, as a fraction of the step of light at the edge.
        hidden, outside: Indices of the edges that are hidden and of those that are too close to the frame's border.
        absent: Indices of the edges that are not there, although the tube is visible on both of their sides.
    """

    t: np.ndarray
    deviation: np.ndarray
    blur: float
    expected: float
    bulge: float
    coarse: bool
    texture: np.ndarray
    hidden: tuple[int, ...]
    outside: tuple[int, ...]
    absent: tuple[int, ...]


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
    thin: bool = False,
) -> tuple[Line, Stretches]:
    """Search a strip around ``line`` for the tube, and the line of the tube for its bands.

    The strip extends ``half`` pixels from t = 0 in both directions along the line, and ``aside`` pixels to both sides.
    ``reach`` is the largest slope of the tube relative to the line. ``onward`` states that t on the line is known to
    rise from the tip to the rear. ``thin`` leaves out all pixels that do not differ from what is on both of their sides
    in the strip, since surroundings may have the hue of a band.

    Returns:
        Line along the tube, on which t rises from the tip to the rear, and the bands on this line.

    Raises:
        Refusal: NO_AXIS if nothing thin has the bands' colours, BANDS_MISSING if the colours are not in their order.
    """
    end = math.ceil(half)
    t = np.arange(-end, end + 1.0)
    u = np.arange(-math.ceil(aside), aside + 1.0)
    every = min(6, max(2, end // (_SEARCH.columns if onward else _SEARCH.columns_cold)))
    some = t[end % every :: every]
    labels = table.labels(sampler.nearest(line.pixels(lens, some, u)))
    if thin:
        labels *= _thin(sampler, lens, line, some, u)
    found = find_axis(labels, some, u, reach)
    if found is None:
        raise Refusal(Status.NO_AXIS, "nothing thin and straight with the bands' colours")
    line = line.moved(*found)
    rows = np.array([-1.0, 0.0, 1.0, -_SEARCH.beside, _SEARCH.beside])
    levels = sampler.nearest(line.pixels(lens, t, rows))
    near = table.labels(levels)
    # If the line and both sides have the same colour, the tube may lie on a drape in the colour of a band.
    shown = levels[:, [1, 3, 4]].transpose(2, 0, 1).astype(np.float32, order="C")
    most = shown.max(0)
    gap = np.abs(shown[..., 1:] - shown[..., :1]).max(0)
    alike = near[:, 3:] == near[:, 1:2]
    drape = alike[:, 0] & alike[:, 1] & (np.maximum(gap[:, 0], gap[:, 1]) < _SEARCH.similar * most[:, 0])
    # A transparent tube has the hue of what is behind it, and no more chroma.
    light = sampler.light[levels[:, [1, 3, 4]]]
    chroma = light - light.mean(-1, keepdims=True)
    size = np.sqrt((chroma * chroma).sum(-1))
    like = (chroma[:, 1:] * chroma[:, :1]).sum(-1) > _SEARCH.same_hue * size[:, 1:] * size[:, :1]
    through = ~drape & (near[:, 1] > 0) & (alike & like & (size[:, :1] < _SEARCH.pale * size[:, 1:])).all(-1)
    drape |= through
    stretches = find_stretches(near[:, :3], drape, through, table, float(end), onward=onward)
    if stretches is None:
        why = "no stretch of line shows the bands in their order, or it shows them both ways"
        raise Refusal(Status.BANDS_MISSING, why, turned=onward)
    if stretches.flipped:  # from here on t rises from the tip to the rear
        turned = Line(line.origin, -line.along, line.scale)
        return turned, dataclasses.replace(stretches, edges=-stretches.edges, cuts=-stretches.cuts, flipped=False)
    return line, stretches


def _thin(sampler: Sampler, lens: Lens, line: Line, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Whether the pixels [T, U] differ from the means of a few pixels at a distance on both sides of them."""
    side = int(_SEARCH.beside)
    wide = np.arange(u[0] - side - _SEARCH.averaged, u[-1] + side + _SEARCH.averaged + 1)
    levels = sampler.nearest(line.pixels(lens, t, wide)).astype(np.float32)
    sums = np.cumsum(np.pad(levels, ((0, 0), (1, 0), (0, 0))), 1)
    width, count = 2 * _SEARCH.averaged + 1, len(u)
    means = (sums[:, width:] - sums[:, :-width]) / width  # around u[0] - side to u[-1] + side
    own = levels[:, side + _SEARCH.averaged :][:, :count]
    gaps = [np.abs(own - mean).max(-1) for mean in (means[:, :count], means[:, 2 * side :])]
    return np.minimum(*gaps) > ALIKE


def halfway(sampler: Sampler, lens: Lens, line: Line, edges: np.ndarray) -> np.ndarray:
    """Refine ``edges`` [N] from labels to the positions where the light is the mean of the light on both sides.

    For a step from 0 to 1 at x, sampled at -n to n, the sum of 1 - step is x + n + 1/2 for any symmetric blur. An edge
    that would move by three pixels or more is not refined.
    """
    k = np.arange(-_SEARCH.halfway, _SEARCH.halfway + 1.0)
    around = lens.distort(line.plane((edges[:, None] + k)[..., None], np.array([-1.0, 0.0, 1.0])))
    light = sampler(around).sum(-1)  # [3, N, K]
    before, after = (
        part.sum(-1, keepdims=True) / _SEARCH.halfway_ends
        for part in (light[..., : _SEARCH.halfway_ends], light[..., -_SEARCH.halfway_ends :])
    )
    step = after - before
    share = ((light - before) * step).sum(0) / np.maximum((step * step).sum(0), 1e-9)
    found = (1 - share).sum(-1) - light.shape[-1] / 2
    return edges + np.where(np.abs(found) < _SEARCH.halfway_ends, found, 0.0)


def measure_edges(
    sampler: Sampler,
    lens: Lens,
    axis: Axis,
    guess: np.ndarray,
    doubtful: tuple[bool, ...],
    blur: float,
    curve: np.ndarray,
) -> Edges:
    """Measure the positions of the band edges along the axis.

    An edge is omitted if it is hidden (the background beside it changes, too), unclear, or close to the frame's border.
    ``guess`` [N] are the expected positions in pixels, NaN for edges to omit; ``doubtful`` whether each edge may belong
    to an object that lies across the tube; ``blur`` the expected blur in pixels; and ``curve`` [N] the bulge of each
    ring's front along t, in pixels.

    Raises:
        Refusal: INCONSISTENT if all edges continue beside the tube.
    """
    line = axis.line
    chosen = np.isfinite(guess).nonzero()[0]
    t, deviation = np.full(len(guess), np.nan), np.full(len(guess), np.inf)
    if not len(chosen):
        return Edges(t, deviation, blur, blur, 0.0, False, np.zeros(len(guess)), (), (), ())
    near = guess[chosen]
    along, window = _positions_along(near, blur)
    widths, bulge = axis.width_at(near), curve[chosen]
    half = math.ceil(float(widths.max()) / 2 + _WINDOW.aside) - 1
    u = np.arange(-half, half + 1.0)
    front = Front.of(u, widths, axis.blur)
    rows, farther, row = _rows_across(u, widths, blur, bulge[:, None] * front.mean)
    kept = _kept_along(along, blur, chosen, len(guess))
    looks = 2
    while True:
        every = lens.distort(line.plane(near[:, None, None] + along[:, None] + farther[:, None], rows[:, None]))
        pixels = every[..., : len(u)]
        light = sampler.sharp(pixels).transpose(1, 2, 3, 0)  # [E, T, U, C]
        inside = sampler.inside(pixels)
        shown = kept[..., None] * row[:, None] * inside
        weight = _weights(light, shown, sampler.light[_WINDOW.white])
        fit = fit_edges(light, weight, blur, t=along)
        known = np.isfinite(fit.deviation)
        if np.count_nonzero(known) > 1 and median(fit.blur[known]) > _LIMITS.smeared > blur:
            t[chosen] = near + fit.place  # the tube moved along itself: the window is too short for this blur
            return measure_edges(sampler, lens, axis, t, doubtful, median(fit.blur[known]), curve)
        coarse = coarse_colours(sampler, pixels[[0, len(pixels) // 2, -1], len(along) // 2, half])
        shading, looks = fit, looks - 1
        closer = partial(_refitted, weight=weight, blur=blur, along=along, u=u, widths=widths)
        if coarse:
            closer = partial(_refitted_luma, weight=weight, blur=blur, along=along, shown=shown, curve=sampler.light)
        if coarse or not _astray(fit, looks):
            fit, shading = closer(fit, light)
        if _unsure(fit) and not _astray(fit, looks):
            sides = lens.distort(line.plane((near[:, None] + along)[..., None], _leaking(widths)))
            light = _without_background(light, weight, fit, along, sampler.sharp(sides).transpose(1, 2, 3, 0))
            other, other_shading = closer(fit_edges(light, weight, blur, t=along), light)
            fit, shading = fit.or_better(other), shading.or_better(other_shading)
        near = near + fit.place
        if not _astray(fit, looks):
            break
    near = near - bulge * front.shift(shading.steps, shading.told, row)
    beside = sampler.light.take(sampler.nearest(every[..., len(u) :].reshape(-1, 6))).reshape(*every.shape[:2], 6, 3)
    texture = np.zeros(len(guess))
    covered, texture[chosen] = _covered(beside, along - fit.place[:, None], fit, blur, axis.blur)
    within = _within_frame(sampler, lens, line, near, fit, window if inside.all() else 0)
    clear = (fit.deviation < _LIMITS.vague) & (np.abs(fit.place) < window / 2) & (fit.blur < 0.55 * window)
    hidden, outside, absent = list[int](), list[int](), list[int]()
    for j, index in enumerate(chosen.tolist()):
        if not within[j]:
            outside.append(index)
        elif doubtful[index] and covered[j]:
            hidden.append(index)  # an edge between two bands is not doubtful, since both colours identify it
        elif clear[j]:
            t[index], deviation[index] = near[j], fit.deviation[j]
        elif _shows_tube(light[j, ..., half - 1 : half + 2, :].mean(1), beside[j]):
            absent.append(index)
    soft = median(fit.blur[known]) if (known := np.isfinite(fit.deviation)).any() else blur
    return Edges(
        t, deviation, soft, blur, float(np.abs(bulge).max()), coarse, texture, *map(tuple, (hidden, outside, absent))
    )


def _without_background(
    light: np.ndarray, weight: np.ndarray, fit: EdgeFit, along: np.ndarray, behind: np.ndarray
) -> np.ndarray:
    """Light [E, T, U, C] minus what leaks into its rows from the background ``behind`` [E, T, 2, C] on both sides.

    The blur of the frame and the sampling between pixels mix the background into the rows of a thin tube. The fraction
    of each side in each row, the same in all channels, is fitted by least squares together with the levels and the step
    of the ``fit``, whose other arguments are ``light``, ``weight`` and ``along``. A background that is even, or changes
    only where the edge is, does not tell the fraction, which then is about 0.
    """
    light, weight = light.astype(np.float64), weight.astype(np.float64)
    total = np.maximum(weight.sum(1, keepdims=True), 1e-30)
    rise = np.broadcast_to(ndtr((along - fit.place[:, None]) / fit.blur[:, None])[..., None, None], light.shape)
    rise = rise - (weight * rise).sum(1, keepdims=True) / total
    power = np.maximum((weight * rise * rise).sum(1, keepdims=True), 1e-30)

    def unexplained(values: np.ndarray) -> np.ndarray:
        """Part of ``values`` [E, T, U, C] that is neither constant along the tube nor like the step."""
        values = values - (weight * values).sum(1, keepdims=True) / total
        return values - rise * ((weight * rise * values).sum(1, keepdims=True) / power)

    behind = behind.astype(np.float64) - behind.mean(1, keepdims=True)
    sides = np.stack([unexplained(behind[:, :, side, None]) for side in range(2)], -1)  # [E, T, U, C, 2]
    weighed = weight[..., None] * sides
    normal = np.einsum("etuci,etucj->euij", weighed, sides) + np.eye(2) / _WINDOW.leaking**2
    leak = np.linalg.solve(normal, np.einsum("etuci,etuc->eui", weighed, unexplained(light))[..., None])
    return light - np.einsum("eui,etic->etuc", leak[..., 0], behind)


def _refitted(
    fit: EdgeFit,
    light: np.ndarray,
    weight: np.ndarray,
    blur: float,
    along: np.ndarray,
    u: np.ndarray,
    widths: np.ndarray,
) -> tuple[EdgeFit, EdgeFit]:
    """The ``fit`` or, if some edges are unsure, for each the best of it and of fits to few rows or samples; twice.

    Arguments as for :func:`fit_edges`; ``u`` [U] are the positions of the rows across tubes of ``widths`` [E].
    """
    if _unsure(fit):  # light of an uneven background leaks into the outer rows
        core = (widths[:, None] / 2 - 0.5 - np.abs(u)).clip(0, 1)
        fit = fit.or_better(fit_edges(light, weight * core[:, None, :, None], blur, t=along))
    if _unsure(fit):
        # A stain or a shadow on the tube is a second edge in the window of an edge beside it.
        close = (np.abs(along) <= _WINDOW.close + 2 * blur)[:, None, None]
        fit = fit.or_better(fit_edges(light, weight * close, blur, t=along))
    return fit, fit


def _refitted_luma(
    fit: EdgeFit,
    light: np.ndarray,
    weight: np.ndarray,
    blur: float,
    along: np.ndarray,
    shown: np.ndarray,
    curve: np.ndarray,
) -> tuple[EdgeFit, EdgeFit]:
    """The results of :func:`fit_luma` or, for unsure edges, those of a shorter window if they are better."""
    fit, luma = fit_luma(fit, light, shown, curve, along)
    if not (fit.deviation < _LIMITS.vague).all():
        # An object that lies across the tube beside an edge is another edge in its window.
        close = np.abs(along) <= _WINDOW.close + 2 * blur
        near = fit_edges(light, weight * close[:, None, None], blur, t=along)
        other, other_luma = fit_luma(near, light, shown * close[:, None], curve, along)
        fit, luma = fit.or_better(other), luma.or_better(other_luma)
    return fit, luma


def _unsure(fit: EdgeFit) -> bool:
    return bool((fit.deviation > _LIMITS.unsure).any())


def _shows_tube(tube: np.ndarray, beside: np.ndarray) -> bool:
    """Whether the light of the tube's middle [T, C] differs from the light [T, 6, C] on both sides of the tube."""
    sides = beside.reshape(len(beside), 2, 3, -1).mean(2)
    gap = np.abs(sides - tube[:, None]).max(-1) / np.maximum(sides, tube[:, None]).max(-1)
    return float((gap.min(-1) > _LIMITS.differs).mean()) > _LIMITS.mostly


def _positions_along(near: np.ndarray, blur: float) -> tuple[np.ndarray, int]:
    """Positions [T] of the samples in a window relative to its edge, and the half-width of the window, in pixels.

    The windows of neighbouring edges ``near`` do not overlap. Samples far from an edge are two pixels apart.
    """
    gap = min((abs(b - a) for a, b in itertools.pairwise(near.tolist())), default=math.inf)
    window = int(min(_WINDOW.half + 2 * blur, max(4.0, 0.45 * gap)))
    along = np.arange(-window, window + 1.0)
    return along[(np.abs(along) <= _WINDOW.dense + 2 * blur) | (along % 2 == window % 2)], window


def _rows_across(
    u: np.ndarray, widths: np.ndarray, blur: float, bulge: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions of rows across the tube [E, U + 6], their shifts along the tube [E, U + 6], and weights [E, U].

    Besides the rows ``u`` [U] on the tube, which are shifted by ``bulge`` [E, U], there are three background rows on
    each side, which show whether something lies across the tube. A row that is mostly background has little weight: it
    carries little information on the edge, and may show an edge of something else.
    """
    rows = np.empty((len(widths), len(u) + 6))
    rows[:, : len(u)], rows[:, len(u) :] = u, _sides(widths, blur)
    farther = np.zeros_like(rows)
    farther[:, : len(u)] = bulge
    return rows, farther, np.minimum(np.maximum(widths[:, None] / 2 + _WINDOW.aside - np.abs(u), 0), 1)


def _weights(light: np.ndarray, shown: np.ndarray, most: float) -> np.ndarray:
    """Weights [E, T, U, C] of samples: ``shown`` [E, T, U] over their variance; light above ``most`` is saturated.

    Saturated rows have no weight, because the midpoint of the light is not at the edge if one side is saturated.
    """
    weight = shown[..., None] / variance_of(light)
    if light.max() > most:
        weight *= (light > most).mean(1, keepdims=True) < _WINDOW.saturated
    return weight


def _kept_along(along: np.ndarray, blur: float, chosen: np.ndarray, edges: int) -> np.ndarray:
    """[E, T] 1, or 0 for samples far outside the first or the last of all ``edges``.

    There the texture of the background is visible through the tube, and its gradients would bias the fit.
    """
    outside = _WINDOW.outside + 2 * blur
    kept = np.ones((len(chosen), len(along)), dtype=np.float32)
    if chosen[0] == 0:
        kept[0] *= along >= -outside
    if chosen[-1] == edges - 1:
        kept[-1] *= along <= outside
    return kept


def _within_frame(
    sampler: Sampler, lens: Lens, line: Line, near: np.ndarray, fit: EdgeFit, window: int
) -> Sequence[bool] | np.ndarray:
    """[E] whether the surroundings of each edge lie on the frame; ``window`` pixels around it are known to do so."""
    margin = _LIMITS.margin + 2 * median(fit.blur)
    if window >= margin + np.abs(fit.place).max():
        return [True] * len(near)
    return np.all(sampler.inside(lens.distort(line.plane(near[:, None] + margin * np.array([-1, 1])))), -1)


def _astray(fit: EdgeFit, looks: int) -> bool:
    """Whether to measure again: an edge is far from its expected position, and ``looks`` > 0 measurements are left."""
    distance = float(np.abs(fit.place).max())
    return looks > 0 and distance >= _LIMITS.far and int(np.count_nonzero(fit.deviation < _LIMITS.lost)) >= 2


def _sides(widths: np.ndarray, blur: float) -> np.ndarray:
    """Positions [E, 6] across tubes of ``widths`` [E], of three rows beyond either blurred side."""
    return _SIGNS * (_ROWS + 2 * blur + widths[:, None] / 2)


def _leaking(widths: np.ndarray) -> np.ndarray:
    """Positions [E, 1, 2] across tubes of ``widths`` [E] at which the background is read that leaks into their rows."""
    return np.array([-1.0, 1.0]) * (widths[:, None, None] / 2 + _WINDOW.leak)


def _covered(
    light: np.ndarray, along: np.ndarray, fit: EdgeFit, blur: float, across: float
) -> tuple[np.ndarray, np.ndarray]:
    """First and last result of :func:`_across`; a Refusal if all edges continue beside the tube.

    They do so, too, where a focused tube moved across: its sides are less sharp (``across``) than its edges, which have
    the expected ``blur``. Then the check of the width decides.
    """
    covered, beyond, texture = _across(light, along, fit)
    if beyond and len(light) > 2 and median(fit.blur) < blur + BLURRED and across < _LIMITS.moving * blur:
        text = "all bands continue beside the tube: the object is thicker than the catheter"
        raise Refusal(Status.INCONSISTENT, text, final=True)
    return covered, texture


def _across(light: np.ndarray, along: np.ndarray, fit: EdgeFit) -> tuple[np.ndarray, bool, np.ndarray]:
    """Whether the background changes at the edges, from ``fit`` and the background rows ``light`` [E, T, 6, C].

    ``along`` [E, T] are the positions of the samples relative to the edges. Returns [E] whether the background changes
    on both sides, so that something lies across the tube; whether the background on one side, even a few pixels away,
    changes like the tube at all edges; and [E] the rms variation of the background along the tube, as a
    fraction of the tube's change.
    """
    count, samples, _, colours = light.shape
    light = light.reshape(count, samples, 2, 3, colours).astype(np.float64)
    up = ndtr(along / fit.blur[:, None])
    up -= up.sum(1, keepdims=True) / samples
    power = np.maximum((up * up).sum(1), 1e-30)[:, None, None]
    rows = (up[:, None] @ light.reshape(count, samples, -1)).reshape(count, 2, 3, colours) / power[..., None]
    step = rows.sum(2) / 3  # [E, 2, C]
    size = np.sqrt((step * step).sum(-1))
    middle = fit.steps.shape[1] // 2
    own = fit.steps[:, middle - 1 : middle + 2].sum(1)
    own = np.sqrt((own * own).sum(-1, keepdims=True)) / 3
    side = light.sum(3) / 3
    side -= side.sum(1, keepdims=True) / samples
    texture = np.sqrt(np.square(side).sum((1, 2, 3)) / (2 * samples)) / np.maximum(own[:, 0], 1e-9)
    large = size > _LIMITS.across * own
    # A tube that moved across during the exposure fades away from its path within its width, so the last row counts.
    last = np.sqrt(np.square(rows[:, :, 2]).sum(-1))
    each = last > _LIMITS.same * own
    if not (large | each).any():  # the usual case, which needs no estimate of the noise
        return large[:, 0], False, texture
    left = side - step[:, None] * up[:, :, None, None]
    clear = _LIMITS.clear * np.sqrt((left * left).sum((1, 3)) / (samples * power[..., 0]))
    large &= size > clear
    each &= last > math.sqrt(3) * clear
    return large.all(1), bool(each.all(0).any()), texture
