"""Which wavelengths of a spectrum to follow through the optics, for the error that making the others may cost."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.optics.viewing.display import Display, number
from holotorch.optics.viewing.eye import Eye

_POINTS, _RINGS, _SPOKES = 9, 16, 64


@dataclass(frozen=True)
class SeenLight:
    """What of a hologram's light an eye takes in, by rays.

    Attributes:
        rim: Share of the pupil's rim that the light reaches, 0 to 1: 0 where the hologram's window or band limits it.
        path_difference: Greatest difference in metres between paths from the hologram to one point of the scene, as
            ``coherence.path_difference`` has it, points off the axis included.
        bend: What Fresnel's model leaves out of these paths, z (slope)^4 / 8: its rms in metres over the light of a
            point, its mean taken off.
    """

    rim: float
    path_difference: float
    bend: float


def seen_light(grid: Grid, wavelength: float, display: Display, eye: Eye, *, reach: float | None = None) -> SeenLight:
    """Follow rays from points of the plane in focus forward to the pupil and back to the hologram.

    Args:
        grid: Sampling of the hologram: its extent is the window, its pitch the band.
        wavelength: In metres.
        display: Where everything stands.
        eye: Pupil and accommodation.
        reach: Half width in metres of the scene, by default the hologram's, per axis.
    """
    wave, plane = checks.wavelengths(wavelength)[0], number(display.focus_plane(eye.accommodation))
    first, second, _, _ = (number(value) for value in display.matrix(plane))
    sides = [n * p / 2 if n > 1 else 0.0 for n, p in zip(grid.shape, grid.pitch, strict=True)]
    ends = sides if reach is None else [checks.positive("reach", reach, "metres") * (side > 0) for side in sides]
    # Rings lie where light may arrive: of a pupil far wider than that, rings of its own would all be dark.
    steepest = [
        min(wave / (2 * p), (s + e) / max(abs(plane), 1e-30)) for p, s, e in zip(grid.pitch, sides, ends, strict=True)
    ]
    lit = math.hypot(*(abs(first) * end + abs(second) * slope for end, slope in zip(ends, steepest, strict=True)))
    radius = number(eye.pupil_radius)
    radii = torch.linspace(0, 1, _RINGS + 1, dtype=torch.float64)[1:] * min(radius, lit)
    turn = torch.arange(_SPOKES, dtype=torch.float64) * (2 * math.pi / _SPOKES)
    along = torch.linspace(-1, 1, _POINTS, dtype=torch.float64)
    inside = torch.ones(_POINTS, _POINTS, _RINGS, _SPOKES, dtype=torch.bool)
    path = torch.zeros(inside.shape, dtype=torch.float64)
    for axis, spoke in enumerate((torch.sin(turn), torch.cos(turn))):
        if sides[axis] == 0:
            continue
        shape = (-1, 1, 1, 1) if axis == 0 else (1, -1, 1, 1)
        point = (ends[axis] * along).reshape(shape)
        slope = (radii[:, None] * spoke - first * point) / second
        inside = inside & (slope.abs() <= wave / (2 * grid.pitch[axis]))
        inside = inside & ((point - plane * slope).abs() <= sides[axis])
        path = path + abs(plane) / 2 * slope.square()
    spread = (path.where(inside, -math.inf).amax((-2, -1)) - path.where(inside, math.inf).amin((-2, -1))).clamp_min(0)
    # Rings stand for their share of the pupil. z s^4 / 8 = (z s^2 / 2)^2 / (2 z).
    shares = inside * radii[:, None]
    left_out = path.square() / max(2 * abs(plane), 1e-30)
    mean = (shares * left_out).sum((-2, -1), keepdim=True) / shares.sum((-2, -1), keepdim=True).clamp_min(1e-30)
    bend = ((shares * (left_out - mean).square()).sum() / shares.sum().clamp_min(1e-30)).sqrt().item()
    rim = inside[..., -1, :].double().mean().item() if radius <= lit else 0.0
    return SeenLight(rim, spread.max().item(), bend)


def followed(places: Tensor, weights: Tensor, count: int) -> tuple[list[int], list[int]]:
    """Which wavelengths to follow, ``count`` with equal shares of the power, and whose neighbour each of all is.

    Args:
        places: Wavelengths [K] in metres, increasing.
        weights: Positive, [K].
        count: Between 1 and K.

    Returns:
        Indices into ``places`` of those followed (fewer where the power is in few wavelengths), and for each of
        ``places`` the number of the nearest among them.
    """
    if not 1 <= checks.whole("count", count, 1) <= len(places):
        raise ValueError(f"count must be at most {len(places)}, the number of wavelengths given, got {count}")
    below = weights.cumsum(0) / weights.sum()
    wanted = (torch.arange(count, dtype=below.dtype) + 0.5) / count
    nodes = list(range(count)) if count == len(places) else torch.searchsorted(below, wanted).unique().tolist()
    return nodes, (places - places[nodes][:, None]).abs().argmin(0).tolist()


def neighbour_error(places: Tensor, weights: Tensor, count: int, light: SeenLight) -> float:
    """Error to expect of ``spectral_image`` when it follows ``count`` of ``places``, relative to the mean picture.

    Light at the rim comes and goes with wavelength as a random walk, 2 rim / wavelength of its power per metre. Every
    step of the walk matters with the power of the wavelengths beyond it that are made from the same one. To it is added
    the fourth order of the slopes, which Fresnel's model leaves out between neighbours. Measured against every
    wavelength followed: a half to a tenth of this, for a rim that light reaches in few places.
    """
    nodes, owners = followed(places, weights, count)
    share = weights / weights.sum()
    away = places - places[nodes][owners]
    walk = 0.0
    for node in range(len(nodes)):
        own = torch.tensor(owners) == node
        for side in (own & (away >= 0), own & (away <= 0)):
            far, order = away[side].abs().sort()
            beyond = share[side][order].flip(0).cumsum(0).flip(0)
            walk += (beyond[1:].square() * far.diff()).sum().item()
    middle = places.mean().item()
    # The fourth order is 3 times as fast a function of wavelength as a path of its own would be.
    bent = math.sqrt(2) * 2 * math.pi * 3 * light.bend / middle * (share * away.abs()).sum().item() / middle
    return math.hypot(math.sqrt(4 * light.rim * walk / middle), bent)


def least_followed(
    places: Tensor,
    weights: Tensor,
    tolerance: float,
    grid: Grid,
    display: Display,
    eye: Eye,
    *,
    reach: float | None = None,
) -> int:
    """Least ``count`` for ``spectral_image`` whose :func:`neighbour_error` is within ``tolerance``.

    All of them where the eye has errors and its pupil takes more than the band of ``grid``: see ``neighbours``.

    Raises:
        ValueError: A tolerance that is not above 0.
    """
    tolerance = checks.positive("tolerance", tolerance)
    light = seen_light(grid, places.mean().item(), display, eye, reach=reach)
    if unseparated(grid, places.min().item(), display, eye):
        return len(places)
    for count in range(1, len(places)):
        if neighbour_error(places, weights, count, light) <= tolerance:
            return count
    return len(places)


def flawless(eye: Eye) -> bool:
    """Whether an eye has no errors beside those of its rim."""
    return not eye.aberrations and eye.chromatic_reference is None


def unseparated(grid: Grid, wave: float, display: Display, eye: Eye) -> bool:
    """Whether the eye's errors, a function of directions, cannot be told from samples of the picture."""
    if flawless(eye):
        return False
    second = number(display.matrix(number(display.focus_plane(eye.accommodation)))[1])
    taken = (number(eye.pupil_radius) + 8 * eye.softness) / (wave * abs(second))
    return any(taken > 1 / (2 * p) for n, p in zip(grid.shape, grid.pitch, strict=True) if n > 1)
