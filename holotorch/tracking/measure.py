"""From a line on a frame to the places of the band edges on it: axis from many stations, edges from whole windows."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.tracking.bands import Stretches, find_axis, find_stretches
from holotorch.tracking.camera import Camera
from holotorch.tracking.colours import ColourTable
from holotorch.tracking.fits import EdgeFit, fit_axis, fit_edges
from holotorch.tracking.status import Status
from holotorch.tracking.strips import Line, Sampler

_LEVEL_SD = 2.5 / 255  # of a pixel's level; fits correct it by what they leave
_ONE_SIDED = 0.15  # contrast to one side over that to the other
_NARROWEST = 2.4  # pixels: below it no pixel shows one band alone
_WINDOW = 11  # samples to either side of an edge
_STATIONS = 40
_SAMPLES = 4  # for each station
_LINE_FLOOR = 0.008  # of the width: what gloss and shadow, which repeat along the tube, may move its middle
_AWAY = 2.0  # pixels from where it was expected at which an edge is looked at once more
_UNSURE = 0.1  # pixels: a clear edge is known to a few hundredths
_ALIKE = 0.2  # of the brightest channel: colours nearer than this are one
_BESIDE = 14.0  # pixels from the mid-line, beside the widest catheters
_SIDE_STEP = 0.25  # light that changes beside an edge, over what changes on it: something lies across the tube
_SAME_STEP = 0.6  # the same, where the bands themselves go on there
_CLEAR = 4.0  # standard deviations of that change


class Refusal(Exception):
    """A stage that could not go on."""

    def __init__(self, status: Status, reason: str):
        super().__init__(reason)
        self.status, self.reason = status, reason


@dataclass(frozen=True, eq=False)
class Axis:
    """Mid-line of the tube's image and its width.

    Attributes:
        line: On the plane z = 1; the bands lie around t = 0.
        width, taper: Of the strip at t = 0 in pixels, and its change per pixel.
        width_sd: Standard deviation of the width.
        offset_sd, slope_sd: Of the line, in pixels and pixels per pixel, at ``centre``.
        centre: Where the two are independent, t in pixels.
    """

    line: Line
    width: float
    taper: float
    width_sd: float
    offset_sd: float
    slope_sd: float
    centre: float

    def width_at(self, t: float) -> float:
        """Pixels."""
        return self.width + self.taper * t


@dataclass(frozen=True, eq=False)
class Edges:
    """Of the band edges [N] on a line, in pixels: t (NaN where not seen), its deviation, blur, bulge, and failures."""

    t: Tensor
    deviation: Tensor
    blur: float
    bulge: float
    hidden: tuple[int, ...]
    outside: tuple[int, ...]


def find_bands(
    sampler: Sampler, camera: Camera, line: Line, table: ColourTable, half: float, aside: float, reach: float
) -> tuple[Line, Stretches]:
    """Line and stretches in a strip around a first line; ``half`` its length, ``aside`` half its width, in pixels."""
    count = 2 * math.ceil(half) + 1
    device = sampler.frame.device
    t = torch.arange(count, dtype=torch.float64, device=device) - (count - 1) / 2
    u = torch.arange(2 * math.ceil(aside) + 1, dtype=torch.float64, device=device) - math.ceil(aside)
    levels, inside = sampler.nearest(line.pixels(camera, t, u))
    labels = table.labels(*levels) * inside
    found = find_axis(labels, u, reach)
    if found is None:
        raise Refusal(Status.NO_AXIS, "nothing thin and straight with the bands' colours")
    offset, slope = torch.tensor(found, dtype=torch.float64, device=device)
    line = line.moved(offset, slope)
    rows = torch.tensor([-1.0, 0.0, 1.0, -_BESIDE, _BESIDE], dtype=torch.float64, device=device)
    levels, inside = sampler.nearest(line.pixels(camera, t, rows))
    near, levels = table.labels(*levels) * inside, levels.to(torch.float32)
    # What looks the same on both sides of the line is a drape, or cannot be told from one.
    gap = (levels[..., 3:] - levels[..., 1:2]).abs().amax(0)
    same = (near[:, 3:] == near[:, 1:2]) & (gap < _ALIKE * levels[..., 1:2].amax(0))
    stretches = find_stretches(near[:, :3], same.all(-1), table, (count - 1) / 2)
    if stretches is None:
        raise Refusal(Status.BANDS_MISSING, "no stretch of line shows the bands in their order")
    if stretches.flipped:  # from here on t rises from the tip to the rear
        turned = Line(line.origin, -line.along, line.scale)
        stretches = dataclasses.replace(stretches, edges=-stretches.edges, flipped=False)
        return turned, stretches
    return line, stretches


def measure_axis(
    sampler: Sampler,
    camera: Camera,
    line: Line,
    stretches: Stretches,
    width: tuple[float, float],
    known: float,
    blur: float,
) -> Axis:
    """Mid-line and width from stations within the bands that are seen; ``width`` and ``known`` as for ``fit_axis``."""
    guess = width[0]
    edges = stretches.edges.tolist()
    spans = [
        (a + 3, b - 3, j)
        for j, (a, b, shown, whole) in enumerate(
            zip(edges, edges[1:], stretches.shown.tolist(), stretches.whole.tolist(), strict=False)
        )
        if math.isfinite(a) and math.isfinite(b) and b - a > 10 and shown > 0.3 * whole
    ]
    if not spans:
        raise Refusal(Status.BANDS_MISSING, "no band is seen from one end to the other")
    device = sampler.frame.device
    every = max(1.0, sum(b - a for a, b, _ in spans) / (_SAMPLES * _STATIONS))
    # Several samples for each station: along the tube neighbours differ in nothing but noise.
    parts = [
        torch.arange(a, max(a, b - (_SAMPLES - 1) * every), _SAMPLES * every, dtype=torch.float64) for a, b, _ in spans
    ]
    band = torch.cat([torch.full((len(part),), k) for k, part in enumerate(parts)]).to(device)
    t = (torch.cat(parts)[:, None] + every * torch.arange(_SAMPLES)).to(device)
    if len(t) < 6:
        raise Refusal(Status.TOO_NARROW, "the bands are a few pixels long")
    half = math.ceil(0.6 * guess + 4 + 2 * blur)
    u = torch.arange(2 * half + 1, dtype=torch.float64, device=device) - half
    light = sampler(camera.distort(line.plane(t[..., None], u))).mean(2)
    signal, weight, level = _contrast(light, u, guess, band, len(spans))
    fit = fit_axis(signal, weight, t.mean(-1), band, level, width, blur, known)
    offset, slope, wide, taper = fit.sides
    if not bool(torch.isfinite(fit.covariance).all()) or float(wide) > 2 * guess + 3:
        raise Refusal(Status.NO_AXIS, "the bands have no clear sides")
    if float(fit.contrast.min()) < _ONE_SIDED:
        raise Refusal(Status.NO_AXIS, "the bands' colours go on beside the line: too wide for the catheter")
    if float((fit.weight > 0.2).double().mean()) < 0.5:
        raise Refusal(Status.NO_AXIS, "the bands do not lie on one straight line: bent, or not a catheter")
    width_sd = float(fit.covariance[2, 2].clamp(min=0).sqrt())
    if float(wide) < _NARROWEST:
        raise Refusal(Status.TOO_NARROW, f"the catheter is {float(wide):.1f} px wide; {_NARROWEST:g} px are needed")
    variance, cross, other = fit.covariance[0, 0], fit.covariance[0, 1], fit.covariance[1, 1].clamp(min=1e-18)
    centre = -cross / other
    floor = _LINE_FLOOR * float(wide)
    extent = max(20.0, float(t.max() - t.min()))
    return Axis(
        line.moved(offset, slope),
        float(wide),
        float(taper),
        width_sd,
        math.hypot(float((variance - cross * cross / other).clamp(min=0).sqrt()), floor),
        math.hypot(float(other.sqrt()), 2 * floor / extent),
        float(centre),
    )


def _contrast(light: Tensor, u: Tensor, width: float, band: Tensor, bands: int) -> tuple[Tensor, Tensor, Tensor]:
    """Light [3, S, U] as one signal [S, U], its inverse variances, and each band's own level in it [bands].

    The signal is the mix of channels, one for each band, in which tube and surroundings differ most over the noise.
    """
    inner = (u.abs() <= max(0.6, 0.3 * width)).to(light.dtype)
    outer = (u.abs() >= 0.5 * width + 1.5).to(light.dtype)
    inside = (light * inner).sum(-1) / inner.sum()
    beside = (light * outer).sum(-1) / outer.sum()
    mean = torch.nn.functional.one_hot(band, bands).to(light.dtype)
    mean = mean / mean.sum(0)
    own, around = inside @ mean, beside @ mean  # [3, bands]
    mixes = (own - around) / (_variance(own) + _variance(around))
    mixes = mixes / mixes.norm(dim=0).clamp(min=1e-12)
    mix = mixes[:, band]  # [3, S]
    signal = (light * mix[..., None]).sum(0)
    variance = (mix.square()[..., None] * _variance(light)).sum(0) / _SAMPLES
    return signal, 1 / variance.clamp(min=1e-30), (mixes * own).sum(0).to(torch.float64)


def _variance(light: Tensor) -> Tensor:
    """Of light, from the noise of levels: the slope of the sRGB curve's inverse, which rises about as light^0.58."""
    return (_LEVEL_SD * (2.4 / 1.055) * (light.clamp(min=0.002) ** (1.4 / 2.4))).square()


def measure_edges(
    sampler: Sampler,
    camera: Camera,
    axis: Axis,
    guess: Tensor,
    doubtful: tuple[bool, ...],
    blur: float,
    curve: Tensor | None = None,
) -> Edges:
    """Places of the edges near ``guess`` [N] (NaN: not looked for); ``curve`` [N]: how far a ring's front bulges in t.

    An edge fails that is hidden (the surroundings change where it does), unclear, or too near the frame's border. With
    ``curve``, a Refusal where all of them go on beside the tube.
    """
    device = sampler.frame.device
    line = axis.line
    chosen = torch.isfinite(guess).nonzero()[:, 0]
    t, deviation = torch.full_like(guess, torch.nan), torch.full_like(guess, torch.inf)
    hidden, outside = [], []
    if not len(chosen):
        return Edges(t, deviation, blur, 0.0, (), ())
    near = guess[chosen]
    gaps = guess[torch.isfinite(guess)].diff().abs()
    window = int(min(_WINDOW + 2 * blur, max(4.0, 0.45 * float(gaps.min()) if len(gaps) else _WINDOW)))
    along = torch.arange(2 * window + 1, dtype=torch.float64, device=device) - window
    widths = torch.tensor([axis.width_at(float(value)) for value in near], dtype=torch.float64, device=device)
    half = math.ceil(float(widths.max()) / 2 + 0.5)
    u = torch.arange(2 * half + 1, dtype=torch.float64, device=device) - half
    bulge = torch.zeros_like(near) if curve is None else curve[chosen]
    round_ = (1 - (2 * u / widths[:, None]).square()).clamp(min=0).sqrt()  # [E, U]
    fit = inside = None
    for _ in range(2):
        place = near[:, None, None] + along[:, None] + (bulge[:, None] * round_)[:, None]
        pixels = camera.distort(line.plane(place, u))
        light = sampler(pixels).permute(1, 2, 3, 0)  # [E, T, U, C]
        inside = sampler.inside(pixels)
        # A row that is mostly surroundings tells little of the edge, and what it tells may be of something else.
        row = (widths[:, None] / 2 + 1.2 - u.abs()).clamp(0, 1)
        weight = row[:, None, :, None] / _variance(light)
        fit = fit_edges(light, weight, blur)
        if bool((fit.deviation > _UNSURE).any()):
            # Surroundings that are not even leak into the outer rows; those in the middle may tell all the same.
            core = (widths[:, None] / 2 - 0.5 - u.abs()).clamp(0, 1)
            fit = fit.or_better(fit_edges(light, weight * core[:, None, :, None], blur))
        near = near + fit.place
        if float(fit.place.abs().max()) < _AWAY:
            break
    assert fit is not None and inside is not None
    blurs = fit.blur[torch.isfinite(fit.deviation)]
    covered, beyond = _across(sampler, camera, line, near, along, widths, fit)
    if beyond and curve is not None and len(near) > 2:
        raise Refusal(Status.INCONSISTENT, "all bands go on beside the tube: this is thicker, seen in one part of it")
    margin = 2 + 2 * float(fit.blur.median())
    reached = near[:, None] + torch.tensor([-margin, margin], dtype=torch.float64, device=device)
    far = sampler.inside(camera.distort(line.plane(reached))).all(-1)
    within = (far & inside.flatten(1).all(-1)).tolist()
    clear = ((fit.deviation < 0.6) & (fit.place.abs() < window / 2) & (fit.blur < 5.5)).tolist()
    for j, (index, hides) in enumerate(zip(chosen.tolist(), covered.tolist(), strict=True)):
        if not within[j]:
            outside.append(index)
        elif doubtful[index] and hides:
            hidden.append(index)  # an edge between two bands shows by its colours what it is; an outer one does not
        elif clear[j]:
            t[index], deviation[index] = near[j], fit.deviation[j]
    return Edges(
        t,
        deviation,
        float(blurs.median()) if len(blurs) else blur,
        float(bulge.abs().max()),
        tuple(hidden),
        tuple(outside),
    )


def _across(
    sampler: Sampler, camera: Camera, line: Line, near: Tensor, along: Tensor, widths: Tensor, fit: EdgeFit
) -> tuple[Tensor, bool]:
    """Whether the surroundings change where the edges are.

    [E], on both sides of each: something lies across the tube there. And on one side of all, as much as on the tube.
    """
    aside = torch.arange(3, dtype=torch.float64, device=near.device) + 2.0 + 2 * float(fit.blur.median())
    u = torch.cat([-aside, aside])
    across = torch.sign(u) * (widths[:, None] / 2) + u  # [E, 6]
    place = near[:, None, None] + along[:, None]
    light = sampler(camera.distort(line.plane(place, across[:, None]))).permute(1, 2, 3, 0).double()
    rise = 0.5 * torch.erfc(-along / fit.blur[:, None] / math.sqrt(2))
    rise = rise - rise.mean(1, keepdim=True)
    side = light.unflatten(2, (2, 3)).mean(3)  # [E, T, 2, C]
    rest = side - side.mean(1, keepdim=True)
    power = rise.square().sum(1)
    step = torch.einsum("et,etsc->esc", rise, rest) / power[:, None, None]
    left = rest - step[:, None] * rise[:, :, None, None]
    sd = (left.square().mean(1) / power[:, None, None]).sqrt()
    size = step.norm(dim=-1)
    middle = fit.steps.shape[1] // 2
    own = fit.steps[:, middle - 1 : middle + 2].mean(1).norm(dim=-1)
    clear = size > _CLEAR * sd.norm(dim=-1)
    across, beyond = (clear & (size > least * own[:, None]) for least in (_SIDE_STEP, _SAME_STEP))
    return across.all(-1), bool(beyond.all(0).any())
