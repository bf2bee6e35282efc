"""From a line on a frame to the places of the band edges on it: bands from labels, edges from whole windows."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.tracking.bands import Stretches, find_axis, find_stretches
from holotorch.tracking.camera import Camera
from holotorch.tracking.colours import ColourTable
from holotorch.tracking.fits import EdgeFit, fit_edges
from holotorch.tracking.stations import Axis, variance_of
from holotorch.tracking.status import Refusal, Status
from holotorch.tracking.strips import Line, Sampler

_WINDOW = 11  # samples to either side of an edge
_HALFWAY, _SURE = 6, 3  # samples to either side of where labels change; the outermost of them that show one colour
_AWAY = 1.0  # pixels from where it was expected at which an edge is looked at once more
_UNSURE = 0.1  # pixels: a clear edge is known to a few hundredths
_ALIKE = 0.2  # of the brightest channel: colours nearer than this are one
_BESIDE = 14.0  # pixels from the mid-line, beside the widest catheters
_SIDE_STEP = 0.25  # light that changes beside an edge, over what changes on it: something lies across the tube
_SAME_STEP = 0.6  # the same, where the bands themselves go on there
_CLEAR = 4.0  # standard deviations of that change


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
) -> tuple[Line, Stretches, Tensor]:
    """Line, stretches and edges' places in a strip around a first line, ``half`` its length, ``aside`` half its width.

    All in pixels. The places [N] are better known than the stretches' own, and NaN where those are.
    """
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
    near = table.labels(*levels) * inside
    # What looks the same on both sides of the line is a drape, or cannot be told from one.
    shown = levels.to(torch.float32)
    gap = (shown[..., 3:] - shown[..., 1:2]).abs().amax(0)
    same = (near[:, 3:] == near[:, 1:2]) & (gap < _ALIKE * shown[..., 1:2].amax(0))
    stretches = find_stretches(near[:, :3], same.all(-1), table, (count - 1) / 2)
    if stretches is None:
        raise Refusal(Status.BANDS_MISSING, "no stretch of line shows the bands in their order")
    k = torch.arange(-_HALFWAY, _HALFWAY + 1, dtype=torch.float64, device=device)
    around = (stretches.edges[:, None] + k)[..., None]
    light = sampler(camera.distort(line.plane(around, rows[:3]))).mean(-1)
    edges = stretches.edges + _halfway(light)
    if stretches.flipped:  # from here on t rises from the tip to the rear
        turned = Line(line.origin, -line.along, line.scale)
        stretches = dataclasses.replace(stretches, edges=-stretches.edges, flipped=False)
        return turned, stretches, -edges
    return line, stretches, edges


def _halfway(light: Tensor) -> Tensor:
    """Where light [3, N, K] is halfway between its ends, from the middle of its samples: [N]; 0 where that is not near.

    Of a step at x among samples k from -n to n, from 0 to 1, the sum of 1 - step is x + n + 1/2, however blurred.
    """
    before, after = light[..., :_SURE].mean(-1, keepdim=True), light[..., -_SURE:].mean(-1, keepdim=True)
    step = after - before
    share = ((light - before) * step).sum(0) / step.square().sum(0).clamp(min=1e-9)
    found = (1 - share).sum(-1) - light.shape[-1] / 2
    return torch.where(found.abs() < _SURE, found, 0.0)


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
        weight = row[:, None, :, None] / variance_of(light)
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
    within = inside.flatten(1).all(-1)
    if margin + _AWAY > window:  # else what was looked at reaches farther
        reached = near[:, None] + torch.tensor([-margin, margin], dtype=torch.float64, device=device)
        within &= sampler.inside(camera.distort(line.plane(reached))).all(-1)
    clear = (fit.deviation < 0.6) & (fit.place.abs() < window / 2) & (fit.blur < 5.5)
    found = torch.stack([within, covered, clear], -1).tolist()
    for j, (index, (whole, hides, sure)) in enumerate(zip(chosen.tolist(), found, strict=True)):
        if not whole:
            outside.append(index)
        elif doubtful[index] and hides:
            hidden.append(index)  # an edge between two bands shows by its colours what it is; an outer one does not
        elif sure:
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
    step = ((rise[:, None] @ rest.flatten(2)) / power[:, None, None]).view(len(near), 2, -1)
    left = rest - step[:, None] * rise[:, :, None, None]
    sd = (left.square().mean(1) / power[:, None, None]).sqrt()
    size = step.norm(dim=-1)
    middle = fit.steps.shape[1] // 2
    own = fit.steps[:, middle - 1 : middle + 2].mean(1).norm(dim=-1)
    clear = size > _CLEAR * sd.norm(dim=-1)
    across, beyond = (clear & (size > least * own[:, None]) for least in (_SIDE_STEP, _SAME_STEP))
    return across.all(-1), bool(beyond.all(0).any())
