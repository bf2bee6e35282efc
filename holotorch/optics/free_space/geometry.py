"""How far light spreads, and how much padding that asks for. Plain numbers, no tensors."""

import math

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE, WAVELENGTH


def diffraction_angle(grid: Grid, wavelength: float) -> tuple[float, float]:
    """Largest angle (y, x) from the axis, in radians, that the pitch can carry: sin = wavelength / (2 pitch).

    pi / 2 where the pitch is at or below half a wavelength: light then leaves in every direction.
    """
    wavelength = checks.quantity(WAVELENGTH, wavelength)
    y, x = (math.asin(min(1.0, wavelength / (2 * pitch))) for pitch in grid.pitch)
    return y, x


def lateral_spread(grid: Grid, wavelength: float, distance: float, *, paraxial: bool = False) -> tuple[float, float]:
    """Sideways travel (y, x) in metres of the steepest light that the grid carries: z tan(angle).

    Infinite where the pitch is at or below half a wavelength. ``paraxial`` gives z sin(angle), which is what a Fresnel
    kernel does with that light.
    """
    wavelength, distance = checks.quantity(WAVELENGTH, wavelength), checks.quantity(DISTANCE, distance)
    if distance == 0:
        return 0.0, 0.0
    sines = [wavelength / (2 * pitch) for pitch in grid.pitch]
    slopes = sines if paraxial else [math.tan(math.asin(sine)) if sine < 1 else math.inf for sine in sines]
    y, x = (abs(distance) * slope for slope in slopes)
    return y, x


def least_padding(grid: Grid, wavelength: float, distance: float, *, paraxial: bool = False) -> tuple[float, float]:
    """Least padding factor (y, x) for which no light of the grid's full band wraps around into the kept window.

    Padding by P leaves (P - 1) times the extent for light to leave through, so P = 1 + reach / extent, where reach is
    the geometric spread plus 3 sqrt(wavelength z) for the diffraction at the edges of the window. Where P >= 2 the
    kernel's phase is then sampled finely enough as well, since that needs reach <= P extent / 2. About 1 % of a
    full-band field still wraps, in the tails of its samples; ``CroppedKernel`` has none of that. Infinite where light
    can travel at 90 degrees (a pitch of half a wavelength or less); 1 at distance 0.
    """
    spread = lateral_spread(grid, wavelength, distance, paraxial=paraxial)
    edge = 3 * math.sqrt(wavelength * abs(distance))
    y, x = (1 + (sideways + edge) / extent for sideways, extent in zip(spread, grid.extent, strict=True))
    return y, x


def unaliased_distance(grid: Grid, wavelength: float, pad: float) -> float:
    """Largest distance in metres up to which padding by ``pad`` serves the full band (paraxial) on both axes.

    It is 2 (pad - 1) L pitch / wavelength for isolated light, and for ``pad`` = 1, the periodic model, the distance
    L pitch / wavelength up to which the kernel's phase is sampled.
    """
    wavelength = checks.quantity(WAVELENGTH, wavelength)
    windows = 1 if pad == 1 else 2 * (pad - 1)
    return windows * min(extent * pitch for extent, pitch in zip(grid.extent, grid.pitch, strict=True)) / wavelength
