"""Transfer functions in two factors: one exponential or set of taps per axis, and what lies beyond Fresnel."""

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.optics.kernels import angular_spectrum_kernel, carrier, turns_phasor
from holotorch.optics.taps import fft_indices, fresnel_taps, remainder_kernel


def transfer_function(
    padded: Grid,
    wavelength: Tensor,
    distance: Tensor,
    *,
    sampled: tuple[bool, bool],
    paraxial: bool,
    offset: tuple[float, float] = (0.0, 0.0),
    dtype: torch.dtype = torch.complex128,
) -> Tensor:
    """Kernel of a linear convolution on the padded grid, carrier included, differentiable in both tensors.

    Args:
        padded: Grid of the transforms.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...] that broadcasts; zeros give the identity.
        sampled: Per axis (y, x), whether the paraxial factor is sampled in frequency, or its exact taps are cropped to
            the transform's length and transformed.
        paraxial: Leave out the factor beyond Fresnel.
        offset: Where (y, x) in metres the axis of the result lies on that of the field; only with taps.
        dtype: Of the result. Phases are reduced in float64 and cast last.

    Returns:
        Shape [..., H, W], frequencies in FFT order.
    """
    wavelength, distance = torch.broadcast_tensors(wavelength, distance)
    columns, rows = (
        _axis_factor(size, pitch, wavelength, distance, shift / pitch, sampled=keep).to(dtype)
        for size, pitch, shift, keep in zip(padded.shape, padded.pitch, offset, sampled, strict=True)
    )
    rows = rows * carrier(wavelength, distance).to(dtype)[..., None]
    kernel = columns[..., :, None] * rows[..., None, :]
    if paraxial:
        return kernel
    # The factor beyond Fresnel is even in both frequencies: one quadrant is computed and mirrored.
    (height, width), (py, px) = padded.shape, padded.pitch
    fy = torch.arange(height // 2 + 1, dtype=torch.float64, device=distance.device)[:, None] / (height * py)
    fx = torch.arange(width // 2 + 1, dtype=torch.float64, device=distance.device)[None, :] / (width * px)
    quadrant = remainder_kernel(fy, fx, wavelength[..., None, None], distance[..., None, None]).to(dtype)
    half = torch.cat([quadrant, quadrant[..., 1 : (width + 1) // 2].flip(-1)], -1)
    return kernel * torch.cat([half, half[..., 1 : (height + 1) // 2, :].flip(-2)], -2)


def wide_transfer_function(padded: Grid, wavelength: Tensor, distance: Tensor, *, dtype: torch.dtype) -> Tensor:
    """Band-limited angular spectrum with its carrier, for pitches too fine for :func:`transfer_function`."""
    kernel = angular_spectrum_kernel(padded, wavelength, distance)
    return (kernel * carrier(wavelength, distance)[..., None, None]).to(dtype)


def _axis_factor(
    size: int, pitch: float, wavelength: Tensor, distance: Tensor, shift: float, *, sampled: bool
) -> Tensor:
    """Paraxial factor of one axis in frequency, complex128 [..., size]."""
    index = fft_indices(size).to(distance.device)
    if sampled:
        frequency = index.to(torch.float64) / (size * pitch)
        return turns_phasor(-(wavelength * distance)[..., None] / 2 * frequency.square())
    here = (distance == 0)[..., None]
    place = index.to(torch.float64) + shift
    taps = fresnel_taps(place, pitch, wavelength, torch.where(distance == 0, pitch, distance))
    still = torch.sinc(place) if shift else (index == 0).to(torch.float64)
    return torch.fft.fft(torch.where(here, still.to(taps.dtype), taps))
