"""Reconstruction of holograms: fields and intensities at a depth, and views through an off-axis pupil."""

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.fourier import fft2, ifft2
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH
from holotorch.hologram.cone import taper
from holotorch.optics.planning.propagate import propagate


def refocused(hologram: Tensor, grid: Grid, wavelength: float, depth: float, *, tolerance: float = 1e-3) -> Tensor:
    """Field [..., H, W] of a hologram [..., H, W] at ``depth`` metres from it, on the side of its sources.

    The hologram holds spherical waves exp(+ikr) from its sources, so it is propagated by -``depth`` (Sec. 5.5.1). The
    field is not normalised: a source of amplitude A in focus has an amplitude of about A times a constant of the grid.
    """
    return propagate(hologram, grid, wavelength, -checks.quantity(DEPTH, depth), tolerance=tolerance)


def focal_stack(
    hologram: Tensor, grid: Grid, wavelength: float, depths: Iterable[float], *, tolerance: float = 1e-3
) -> Iterator[Tensor]:
    """Yield the intensity [..., H, W] of a hologram at each depth in metres, see :func:`refocused`."""
    for depth in depths:
        yield intensity(refocused(hologram, grid, wavelength, depth, tolerance=tolerance))


def perspective(
    hologram: Tensor, grid: Grid, wavelength: float, *, direction: tuple[float, float], aperture: float
) -> Tensor:
    """The part of a hologram [..., H, W] whose light reaches a distant pupil, that is within a cone of directions.

    Args:
        hologram: Complex field.
        grid: Pixels of the hologram.
        wavelength: In metres.
        direction: Sines (y, x) of the direction from the hologram to the centre of the pupil.
        aperture: Sine of the half angle of the pupil, above 0; its edge is tapered over the last 30 %.

    Raises:
        ValueError: The pupil lies outside the directions that the grid samples.
    """
    y, x = checks.pair("direction", direction, "sines")
    aperture = checks.positive("aperture", aperture)
    for sine, pitch in zip((y, x), grid.pitch, strict=True):
        if abs(sine) - aperture > wavelength / (2 * pitch):
            raise ValueError(
                f"direction {sine:g} with aperture {aperture:g} lies outside the hologram's band of sines up to "
                f"{wavelength / (2 * pitch):.3g}"
            )
    fy, fx = grid.frequencies(hologram.device)
    radius = torch.sqrt((fy * wavelength - y).square() + (fx * wavelength - x).square()) / aperture
    return ifft2(fft2(hologram) * taper(radius).to(hologram.real.dtype))
