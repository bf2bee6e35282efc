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
    """Field [..., H, W] of a hologram [..., H, W] in the plane ``depth`` metres in front of it, where its sources are.

    The hologram is a sum of waves exp(+ikr) from its sources, so it is propagated by -``depth`` (Sec. 5.5.1). The field
    is not normalised: in focus, a source of amplitude A appears with A times a factor common to all sources.
    """
    return propagate(hologram, grid, wavelength, -checks.quantity(DEPTH, depth), tolerance=tolerance)


def focal_stack(
    hologram: Tensor, grid: Grid, wavelength: float, depths: Iterable[float], *, tolerance: float = 1e-3
) -> Iterator[Tensor]:
    """Yield the intensity [..., H, W] of the refocused hologram for each depth in metres, see :func:`refocused`."""
    for depth in depths:
        yield intensity(refocused(hologram, grid, wavelength, depth, tolerance=tolerance))


def perspective(
    hologram: Tensor, grid: Grid, wavelength: float, *, direction: tuple[float, float], aperture: float
) -> Tensor:
    """The part of a hologram [..., H, W] whose light reaches a distant pupil, selected by its direction.

    Args:
        hologram: Complex field [..., H, W].
        grid: Pixels of the hologram.
        wavelength: In metres.
        direction: Sines (y, x) of the direction from the hologram to the centre of the pupil.
        aperture: Sine of the half angle of the pupil, above 0; transmission falls to 0 over its outer 30 %.

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
