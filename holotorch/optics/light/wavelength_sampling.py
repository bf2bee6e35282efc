"""Selection of the wavelengths to propagate; images at the other wavelengths are derived from their images."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.optics.viewing.display import Display, number
from holotorch.optics.viewing.eye import Eye

_POINTS, _RINGS, _RAYS = 9, 16, 64  # points per axis of the scene; rings of the pupil; rays per ring


@dataclass(frozen=True)
class PupilIllumination:
    """Light of a hologram that enters an eye, from geometrical optics and the diffraction at the edge of the window.

    Attributes:
        edge: Fraction of the edge of the pupil that is illuminated, 0 to 1; 0 if only the window or the highest
            frequency of the hologram limits the light.
        path_difference: As in ``coherence.path_difference``, in metres; the maximum over points on and off the axis.
        fourth_order: Standard deviation in metres, over the rays of a point, of the part z slope^4 / 8 of their paths,
            which the Fresnel model neglects.
        diffracted: Share of the light that the edges of the window diffract to the edge of the pupil if ``edge`` is 0.
    """

    edge: float
    path_difference: float
    fourth_order: float
    diffracted: float = 0.0


def pupil_illumination(
    grid: Grid, wavelength: float, display: Display, eye: Eye, *, reach: float | None = None
) -> PupilIllumination:
    """The light that enters an eye, from rays traced from the plane in focus to the pupil and to the hologram.

    Args:
        grid: Sampling of the hologram.
        wavelength: In metres.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil and accommodation.
        reach: Half width in metres of the scene; that of the hologram on each axis by default.
    """
    centre, plane = checks.wavelengths(wavelength)[0], number(display.focus_plane(eye.accommodation))
    first, second, _, _ = (number(value) for value in display.matrix(plane))
    sides = [n * p / 2 if n > 1 else 0.0 for n, p in zip(grid.shape, grid.pitch, strict=True)]
    ends = sides if reach is None else [checks.positive("reach", reach, "metres") * (side > 0) for side in sides]
    # The rings cover only the part of the pupil that can be illuminated.
    steepest = [
        min(centre / (2 * p), (s + e) / max(abs(plane), 1e-30)) for p, s, e in zip(grid.pitch, sides, ends, strict=True)
    ]
    illuminated = math.hypot(
        *(abs(first) * end + abs(second) * slope for end, slope in zip(ends, steepest, strict=True))
    )
    radius = number(eye.pupil_radius)
    radii = torch.linspace(0, 1, _RINGS + 1, dtype=torch.float64)[1:] * min(radius, illuminated)
    angle = torch.arange(_RAYS, dtype=torch.float64) * (2 * math.pi / _RAYS)
    along = torch.linspace(-1, 1, _POINTS, dtype=torch.float64)
    inside = torch.ones(_POINTS, _POINTS, _RINGS, _RAYS, dtype=torch.bool)
    path = torch.zeros(inside.shape, dtype=torch.float64)
    for axis, direction in enumerate((torch.sin(angle), torch.cos(angle))):
        if sides[axis] == 0:
            continue
        shape = (-1, 1, 1, 1) if axis == 0 else (1, -1, 1, 1)
        point = (ends[axis] * along).reshape(shape)
        slope = (radii[:, None] * direction - first * point) / second
        inside = inside & (slope.abs() <= centre / (2 * grid.pitch[axis]))
        inside = inside & ((point - plane * slope).abs() <= sides[axis])
        path = path + abs(plane) / 2 * slope.square()
    spread = (path.where(inside, -math.inf).amax((-2, -1)) - path.where(inside, math.inf).amin((-2, -1))).clamp_min(0)
    shares = inside * radii[:, None]  # weight of each ring: its area
    neglected = path.square() / max(2 * abs(plane), 1e-30)  # z s^4 / 8 = (z s^2 / 2)^2 / (2 z)
    mean = (shares * neglected).sum((-2, -1), keepdim=True) / shares.sum((-2, -1), keepdim=True).clamp_min(1e-30)
    fourth_order = ((shares * (neglected - mean).square()).sum() / shares.sum().clamp_min(1e-30)).sqrt().item()
    edge = inside[..., -1, :].double().mean().item() if radius <= illuminated else 0.0
    diffracted = 0.0
    if edge == 0:  # beyond the lit part the power falls as width / (pi^2 distance), from the edges of a window
        width = max(centre * abs(second) / (2 * side) for side in sides if side > 0)
        diffracted = width / (math.pi**2 * max(radius - illuminated, width))
    return PupilIllumination(edge, spread.max().item(), fourth_order, diffracted)


def select_wavelengths(wavelengths: Tensor, weights: Tensor, count: int) -> tuple[list[int], list[int]]:
    """Select ``count`` wavelengths with equal shares of the power, and assign every wavelength to the nearest of them.

    Args:
        wavelengths: Wavelengths [K] in metres, increasing.
        weights: Power at these wavelengths, positive, [K].
        count: Between 1 and K.

    Returns:
        Indices of the selected wavelengths, and for each of ``wavelengths`` the index into that list of the nearest
        selected one. If few wavelengths contain most of the power, fewer than ``count`` are selected.
    """
    if not 1 <= checks.whole("count", count, 1) <= len(wavelengths):
        raise ValueError(f"count must be at most {len(wavelengths)}, the number of wavelengths given, got {count}")
    cumulative = weights.cumsum(0) / weights.sum()
    targets = (torch.arange(count, dtype=cumulative.dtype) + 0.5) / count
    nodes = (
        list(range(count)) if count == len(wavelengths) else torch.searchsorted(cumulative, targets).unique().tolist()
    )
    return nodes, (wavelengths - wavelengths[nodes][:, None]).abs().argmin(0).tolist()


def neighbour_error(wavelengths: Tensor, weights: Tensor, count: int, light: PupilIllumination) -> float:
    """Expected error of ``spectral_image`` that propagates ``count`` of ``wavelengths``, relative to the mean image.

    The error has two parts. First, the light at the edge of the pupil changes with wavelength like a random walk, by a
    fraction 2 edge / wavelength of the power per metre of wavelength (``edge`` or ``diffracted`` of ``light``). Every
    step of the walk is weighted with the power of the wavelengths beyond it that are derived from the same propagated
    wavelength. Second, the Fresnel model between neighbours neglects the fourth order of the slopes (``fourth_order``
    of ``light``). If the light illuminates only small parts of the edge, the true error is only 0.1 to 0.5 times the
    result.
    """
    nodes, nearest = select_wavelengths(wavelengths, weights, count)
    share = weights / weights.sum()
    offsets = wavelengths - wavelengths[nodes][nearest]
    walk = 0.0
    for node in range(len(nodes)):
        derived = torch.tensor(nearest) == node
        for side in (derived & (offsets >= 0), derived & (offsets <= 0)):
            distances, order = offsets[side].abs().sort()
            beyond = share[side][order].flip(0).cumsum(0).flip(0)
            walk += (beyond[1:].square() * distances.diff()).sum().item()
    middle = wavelengths.mean().item()
    # The fourth-order phase is proportional to wavelength^3, so its relative change is 3 times that of the wavelength.
    neglected = (
        math.sqrt(2) * 2 * math.pi * 3 * light.fourth_order / middle * (share * offsets.abs()).sum().item() / middle
    )
    return math.hypot(math.sqrt(4 * max(light.edge, light.diffracted) * walk / middle), neglected)


def least_count(
    wavelengths: Tensor,
    weights: Tensor,
    tolerance: float,
    grid: Grid,
    display: Display,
    eye: Eye,
    *,
    reach: float | None = None,
) -> int:
    """Smallest ``count`` for ``spectral_image`` whose :func:`neighbour_error` is within ``tolerance``, above 0.

    The result is the number of all wavelengths if the eye is one for which ``neighbours`` raises ValueError.
    """
    tolerance = checks.positive("tolerance", tolerance)
    light = pupil_illumination(grid, wavelengths.mean().item(), display, eye, reach=reach)
    if pupil_exceeds_band(grid, wavelengths.min().item(), display, eye):
        return len(wavelengths)
    counts = range(1, len(wavelengths))
    return next((n for n in counts if neighbour_error(wavelengths, weights, n, light) <= tolerance), len(wavelengths))


def error_free(eye: Eye) -> bool:
    """Whether an eye has neither aberrations nor colour error."""
    return not eye.aberrations and eye.chromatic_reference is None


def pupil_exceeds_band(grid: Grid, centre: float, display: Display, eye: Eye) -> bool:
    """Whether the pupil of an eye with errors exceeds the band of ``grid``, so that they cannot be removed."""
    if error_free(eye):
        return False
    second = number(display.matrix(number(display.focus_plane(eye.accommodation)))[1])
    highest = (number(eye.pupil_radius) + 8 * eye.softness) / (centre * abs(second))
    return any(highest > 1 / (2 * p) for n, p in zip(grid.shape, grid.pitch, strict=True) if n > 1)
