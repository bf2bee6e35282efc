"""CroppedKernel: propagation that neither wraps light around nor cuts its band, at any distance."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.optics.kernels import carrier
from holotorch.optics.propagators import SpectralFilter
from holotorch.optics.taps import fresnel_taps, remainder_kernel


class CroppedKernel(SpectralFilter):
    """Exact scalar propagation of band-limited samples over ``distance``; includes the carrier exp(ikz).

    The kernel in space is known exactly on every sample (:func:`fresnel_taps` per axis); cropped to the displacements
    that occur inside the window and transformed, it is a linear convolution at twice the window, where a sampled
    transfer function would wrap the light beyond the window or lose it. What the exact kernel has on top of the
    paraxial one moves light by z (tan - sin) of its angle only, a few samples; it multiplies in frequency, and the
    padding leaves room for it. For white phases the error is about 2 s^2 / sqrt(N) of the field or less, s the sine of
    the steepest angle (wavelength / 2 pitch) and N the samples of an axis: 1e-4 at 8 um, 5e-4 at 3.74 um for 512 px, at
    every distance. For smooth fields, and with ``paraxial``, it is rounding.

    Args:
        grid: Sampling of the field, which is also that of the result.
        wavelengths: In metres, one per channel.
        distance: In metres, negative to travel back.
        paraxial: Leave out the correction beyond the Fresnel approximation.

    Raises:
        ValueError: A wavelength that is not positive, a distance that is not finite, or a pitch below 0.9 wavelengths,
            where the two factors no longer separate; use ``AngularSpectrum`` there.
    """

    def __init__(self, grid: Grid, wavelengths: float | Sequence[float], distance: float, *, paraxial: bool = False):
        distance = checks.finite("distance", distance, "metres")
        waves = torch.tensor(checks.wavelengths(wavelengths), dtype=torch.float64)
        longest = waves.max().item()
        if min(grid.pitch) < 0.9 * longest and not paraxial:
            raise ValueError(
                f"CroppedKernel needs a pitch of at least 0.9 wavelengths, got {min(grid.pitch):g} m at {longest:g} m; "
                "use AngularSpectrum"
            )
        padded = grid.padded(2.0 if paraxial else _padding(grid, longest, distance))
        super().__init__(grid, wavelengths, _kernel(padded, waves, distance, paraxial))
        self.distance = distance


def _kernel(padded: Grid, waves: Tensor, distance: float, paraxial: bool) -> Tensor:
    far = torch.tensor(distance, dtype=torch.float64)
    kernel = carrier(waves, far)[:, None, None]
    if distance == 0:
        return kernel.expand(-1, *padded.shape)
    columns, rows = (
        torch.fft.fft(fresnel_taps(_indices(size), pitch, waves, far))
        for size, pitch in zip(padded.shape, padded.pitch, strict=True)
    )
    kernel = kernel * columns[:, :, None] * rows[:, None, :]
    if paraxial:
        return kernel
    fy, fx = padded.frequencies()
    return kernel * remainder_kernel(fy, fx, waves[:, None, None], far)


def _indices(size: int) -> Tensor:
    """0, 1, ..., (n-1)//2, -(n//2), ..., -1."""
    index = torch.arange(size)
    return torch.where(index > (size - 1) // 2, index - size, index)


def _padding(grid: Grid, wavelength: float, distance: float) -> tuple[float, float]:
    """2 for the taps, and twice the shift by the remainder plus an eighth of the window for its tails."""
    sines = [wavelength / (2 * pitch) for pitch in grid.pitch]
    corner = min(math.hypot(*sines), 0.99)
    # Light steeper than what lands in the window need not be followed.
    reach = math.hypot(*grid.extent)
    steepest = min(corner, reach / math.hypot(reach, distance))
    shift = abs(distance) * (steepest / math.sqrt(1 - steepest**2) - steepest)
    y, x = (2.25 + 2 * shift / extent for extent in grid.extent)
    return y, x
