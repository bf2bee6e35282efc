"""Lateral spread of light between two planes and the padding that it needs. Lengths are numbers in metres."""

import math

from holotorch.core import checks
from holotorch.core.grid import Grid, Pair
from holotorch.core.quantities import DISTANCE, WAVELENGTH


def diffraction_angle(grid: Grid, wavelength: float) -> Pair:
    """Largest angle (y, x) from the axis, in radians, that the pitch can sample: its sine is wavelength / (2 pitch).

    It is pi / 2 if the pitch is at most half a wavelength.
    """
    wavelength = checks.quantity(WAVELENGTH, wavelength)
    y, x = (math.asin(min(1.0, wavelength / (2 * pitch))) for pitch in grid.pitch)
    return y, x


def lateral_spread(grid: Grid, wavelength: float, distance: float, *, paraxial: bool = False) -> Pair:
    """Lateral shift (y, x) in metres of light at the angle of :func:`diffraction_angle`: abs(distance) tan(angle).

    It is infinite if the pitch is at most half a wavelength. With ``paraxial`` it is abs(distance) sin(angle), the
    shift by a Fresnel kernel.
    """
    wavelength, distance = checks.quantity(WAVELENGTH, wavelength), checks.quantity(DISTANCE, distance)
    if distance == 0:
        return 0.0, 0.0
    sines = [wavelength / (2 * pitch) for pitch in grid.pitch]
    slopes = sines if paraxial else [math.tan(math.asin(sine)) if sine < 1 else math.inf for sine in sines]
    y, x = (abs(distance) * slope for slope in slopes)
    return y, x


def least_padding(grid: Grid, wavelength: float, distance: float, *, paraxial: bool = False) -> Pair:
    """Least padding factor (y, x) for which light of any frequency of the grid does not wrap around into the window.

    Padding by P leaves (P - 1) times the extent for light that leaves the window. So P = 1 + shift / extent, where the
    shift is :func:`lateral_spread` plus 3 sqrt(wavelength distance) for diffraction at the edges of the window. The
    phase of the kernel is sampled finely enough where shift <= P extent / 2; light that moves farther leaves the window
    if P >= 2. About 1 % of a field that contains all frequencies still wraps around, in the sinc tails of its samples;
    ``CroppedKernel`` avoids that. P is infinite if the pitch is at most half a wavelength, and 1 at distance 0.
    """
    spread = lateral_spread(grid, wavelength, distance, paraxial=paraxial)
    edge = 3 * math.sqrt(wavelength * abs(distance))
    y, x = (1 + (shift + edge) / extent for shift, extent in zip(spread, grid.extent, strict=True))
    return y, x


def unaliased_distance(grid: Grid, wavelength: float, pad: float) -> float:
    """Largest distance in metres at which padding by ``pad`` suffices for all frequencies of both axes (paraxial).

    With the extent L it is 2 (pad - 1) L pitch / wavelength, up to which no light wraps around. For ``pad`` = 1, the
    periodic model, it is L pitch / wavelength, up to which the phase of the kernel is sampled without aliasing.
    """
    wavelength = checks.quantity(WAVELENGTH, wavelength)
    windows = 1 if pad == 1 else 2 * (pad - 1)
    return windows * min(extent * pitch for extent, pitch in zip(grid.extent, grid.pitch, strict=True)) / wavelength
