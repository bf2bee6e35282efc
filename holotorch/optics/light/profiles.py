"""Fields and phases that experiments start from: beams, gratings, vortices, cylindrical lenses and test patterns."""

import math

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE, FOCAL_LENGTH, WAVELENGTH, WIDTH


def gaussian_beam(grid: Grid, wavelength: float, waist: float, distance: float = 0.0) -> Tensor:
    """Field of a Gaussian beam ``distance`` metres behind its waist, with the carrier exp(ikz), complex128 [H, W].

    ``waist`` is the radius in metres at which the amplitude of the waist is 1 / e; the amplitude on its axis is 1. The
    beam is paraxial: its divergence wavelength / (pi waist) is small. Source: Saleh and Teich, Eq. 3.1-7.

    Raises ValueError for a length outside its range.
    """
    wavelength, waist = checks.quantity(WAVELENGTH, wavelength), checks.quantity(WIDTH, waist, "waist")
    distance = checks.quantity(DISTANCE, distance)
    rayleigh = math.pi * waist**2 / wavelength
    y, x = grid.coordinates()
    square = y.square() + x.square()
    ratio = distance / rayleigh
    width2 = waist**2 * (1 + ratio**2)
    # 1 / R(z) = z / (z^2 + z_R^2) is 0 at the waist.
    curvature = math.pi / wavelength * distance / (distance**2 + rayleigh**2) * square
    carrier = 2 * math.pi * math.fmod(distance / wavelength, 1.0)
    amplitude = torch.exp(-square / width2) / math.sqrt(1 + ratio**2)
    return torch.polar(amplitude, carrier + curvature - math.atan(ratio))


def blazed_grating(grid: Grid, period: tuple[float, float]) -> Tensor:
    """Phase in rad in [0, 2 pi), float64 [H, W], that rises by 2 pi per ``period`` (y, x) in metres, infinite for none.

    It deflects light to the sines wavelength / period. Raises ValueError for a period below two pixels.
    """
    return 2 * math.pi * torch.remainder(_cycles(grid, period), 1.0)


def binary_grating(grid: Grid, period: tuple[float, float], depth: float = math.pi) -> Tensor:
    """Phase in rad, 0 or ``depth``, float64 [H, W]: the first half of each period of :func:`blazed_grating` is 0."""
    # The addend keeps samples on the edge of a half period in their half, whatever the rounding.
    second_half = torch.remainder(_cycles(grid, period) + 1e-9, 1.0) >= 0.5
    return checks.finite("depth", depth, "rad") * second_half.double()


def vortex_phase(grid: Grid, charge: int) -> Tensor:
    """Phase ``charge`` times the angle about the axis, in rad, float64 [H, W]; 0 on the axis itself."""
    if isinstance(charge, bool) or not isinstance(charge, int):
        raise TypeError(f"charge must be a whole number, got {charge!r}")
    y, x = grid.coordinates()
    return charge * torch.atan2(y.expand(grid.shape), x.expand(grid.shape))


def cylindrical_phase(grid: Grid, wavelength: float, focal_length: float, axis: int) -> Tensor:
    """Phase -k u^2 / (2 f) of a thin cylindrical lens, float64 [H, W] in rad, where u is y for ``axis`` 0 and x for 1.

    Two lenses of the same focal length across each other are a paraxial ``Lens``. Source: Goodman, Sec. 5.1.
    """
    if axis not in (0, 1):
        raise ValueError(f"axis must be 0 to focus along y or 1 to focus along x, got {axis!r}")
    length = checks.quantity(FOCAL_LENGTH, focal_length)
    u = grid.coordinates()[axis]
    return (-math.pi / (checks.quantity(WAVELENGTH, wavelength) * length) * u.square()).expand(grid.shape)


def checkerboard(grid: Grid, pixels: int) -> Tensor:
    """Squares of ``pixels`` pixels, 0 and 1 in turn, float64 [H, W]."""
    side = checks.whole("pixels", pixels, 1)
    rows, columns = (torch.arange(n) // side for n in grid.shape)
    return ((rows[:, None] + columns) % 2).double()


def siemens_star(grid: Grid, spokes: int) -> Tensor:
    """``spokes`` bright sectors about the axis, 1 on 0, float64 [H, W]; resolution is read off as a radius."""
    angle = vortex_phase(grid, checks.whole("spokes", spokes, 1))
    return (torch.cos(angle) > 0).double()


def bars(grid: Grid, pixels: tuple[int, ...] = (1, 2, 3, 4, 6, 8)) -> Tensor:
    """Groups of three bars, 1 on 0, upright in the upper half and lying in the lower one, float64 [H, W].

    The widths of the bars are ``pixels``; groups that no longer fit to the right are left out.
    """
    picture = torch.zeros(grid.shape, dtype=torch.float64)
    height, width = grid.shape
    left = 2
    for size in pixels:
        extent = 5 * checks.whole("pixels", size, 1)
        if left + extent > width - 1 or extent > height // 2 - 2:
            break
        for k in (0, 2, 4):
            start = left + k * size
            picture[1 : 1 + extent, start : start + size] = 1
            top = height // 2 + 1 + k * size
            picture[top : top + size, left : left + extent] = 1
        left += extent + 2 * size
    return picture


def _cycles(grid: Grid, period: tuple[float, float]) -> Tensor:
    """Phase of a grating in cycles, float64 [H, W]; TypeError unless ``period`` is a pair (y, x)."""
    if not isinstance(period, tuple | list) or len(period) != 2:
        raise TypeError(f"period must be two numbers (y, x) in metres, infinite for none, got {period!r}")
    slopes = [_frequency(length, pitch) for length, pitch in zip(period, grid.pitch, strict=True)]
    y, x = grid.coordinates()
    return slopes[0] * y + slopes[1] * x


def _frequency(period: float, pitch: float) -> float:
    """Cycles per metre of a ``period`` in metres."""
    if math.isinf(period):
        return 0.0
    length = checks.finite("period", period, "metres")
    if abs(length) < 2 * pitch:
        raise ValueError(f"period must be at least two pixels, {2 * pitch:g} m, or infinite, got {length:g} m")
    return 1 / length
