"""Transfer functions as products of a paraxial factor per axis and the factor beyond Fresnel.

The factor beyond Fresnel is the exact transfer function divided by the paraxial one.
"""

from functools import partial

import torch
from torch import Tensor

from holotorch.core.fourier import multiplied, multiply_even
from holotorch.core.grid import Grid
from holotorch.core.precision import double
from holotorch.optics.free_space.impulse_response import (
    fresnel_taps,
    levelling_shift,
    remainder_kernel,
    tap_indices,
    tilted_cycles,
)
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, cycles_phasor
from holotorch.optics.free_space.learned_distance import has_closed_form, times_learned
from holotorch.optics.free_space.plane_pair import PlanePair, shifts


def transfer_function(
    planes: PlanePair,
    padded: Grid,
    wavelength: Tensor,
    distance: Tensor,
    *,
    sampled: tuple[bool, bool],
    paraxial: bool,
    tilt: Tensor | None = None,
    dtype: torch.dtype = torch.complex128,
) -> Tensor:
    """Kernel of a linear convolution on the padded grid, with the carrier exp(ikz), differentiable in all tensors.

    Args:
        planes: Samples of source and result, of equal pitch.
        padded: Grid of the FFTs. After the inverse FFT, the first samples are those of ``planes.out``.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...] that broadcasts; 0 gives the identity.
        sampled: Per axis (y, x): True to sample the paraxial factor in frequency, False for the FFT of its exact
            taps, cropped to the length of the FFT.
        paraxial: Leave out the factor beyond Fresnel.
        tilt: Sines (y, x) of the carrier, float64 [2], for gradients; those of ``planes`` by default.
        dtype: Of the result; phases are computed in float64 in any case.

    Returns:
        Shape [..., H, W], frequencies in FFT order.
    """
    wavelength, distance = torch.broadcast_tensors(wavelength, distance)
    tilted = any(planes.tilt)
    if tilt is None:
        tilt = double(planes.tilt, distance.device)
    positions = shifts(planes, distance, tilt)
    cosine2 = 1 - tilt.square().sum()
    carrier_factor = carrier(wavelength, distance * torch.sqrt(cosine2)).to(dtype)
    if tilted and all(sampled):
        fy, fx = padded.frequencies(distance.device)
        cycles = tilted_cycles(fy, fx, wavelength[..., None, None], distance[..., None, None], tilt)
        for frequency, pitch, position in zip((fy, fx), padded.pitch, positions, strict=True):
            cycles = cycles + frequency * pitch * position[..., None, None]
        return cycles_phasor(cycles).to(dtype) * carrier_factor[..., None, None]
    shifts_beyond = []  # of each axis, in samples: the part of the shift that moves into the taps
    if tilted:
        nyquist = 0.5 / padded.pitch[0], 0.5 / padded.pitch[1]
        for axis in (0, 1):
            shift = levelling_shift(nyquist, wavelength, distance, tilt, axis) / padded.pitch[axis]
            shifts_beyond.append(shift)
            positions[axis] = positions[axis] + shift
    equal_axes = planes.straight and sampled[0] == sampled[1]
    equal_axes &= all(len({*zip(grid.shape, grid.pitch, strict=True)}) == 1 for grid in (planes.grid, padded))
    factors = []
    for axis in (0,) if equal_axes else (0, 1):
        curvature_distance = distance * (1 - tilt[1 - axis].square()) / cosine2**1.5
        factors.append(
            _axis_factor(planes, axis, padded, wavelength, curvature_distance, positions[axis], sampled=sampled[axis])
        )
    columns, rows = factors[0].to(dtype), factors[-1].to(dtype)
    kernel = columns[..., :, None] * (rows * carrier_factor[..., None])[..., None, :]
    if paraxial:
        return kernel
    wavelength, distance = wavelength[..., None, None], distance[..., None, None]
    if tilted:
        fy, fx = padded.frequencies(distance.device)
        cycles = tilted_cycles(fy, fx, wavelength, distance, tilt, squares=False)
        for frequency, pitch, shift in zip((fy, fx), padded.pitch, shifts_beyond, strict=True):
            cycles = cycles - frequency * pitch * shift[..., None, None]
        return kernel * cycles_phasor(cycles).to(dtype)
    # The factor beyond Fresnel is even in both frequencies, so that one quadrant determines it.
    (height, width), (py, px) = padded.shape, padded.pitch
    fy = torch.arange(height // 2 + 1, dtype=torch.float64, device=distance.device)[:, None] / (height * py)
    fx = torch.arange(width // 2 + 1, dtype=torch.float64, device=distance.device)[None, :] / (width * px)
    quadrant = remainder_kernel(fy, fx, wavelength, distance).to(dtype)
    if kernel.requires_grad or quadrant.requires_grad:
        half = torch.cat([quadrant, quadrant[..., 1 : (width + 1) // 2].flip(-1)], -1)
        return kernel * torch.cat([half, half[..., 1 : (height + 1) // 2, :].flip(-2)], -2)
    return multiply_even(kernel, quadrant)


def times_transfer_function(
    spectrum: Tensor,
    wavelength: Tensor,
    distance: Tensor,
    *,
    planes: PlanePair,
    padded: Grid,
    sampled: tuple[bool, bool],
    paraxial: bool,
) -> Tensor:
    """``spectrum`` [..., H, W] times :func:`transfer_function`, by its closed form if only one distance is learned.

    Otherwise ``spectrum`` may be overwritten.
    """
    by_autograd = partial(transfer_function, planes, padded, sampled=sampled, paraxial=paraxial, dtype=spectrum.dtype)
    if not has_closed_form(planes, wavelength, distance):
        return multiplied(spectrum, by_autograd(wavelength, distance))
    return times_learned(
        spectrum, padded, wavelength, distance, sampled=sampled, paraxial=paraxial, differentiable=by_autograd
    )


def wide_transfer_function(
    planes: PlanePair, padded: Grid, wavelength: Tensor, distance: Tensor, *, dtype: torch.dtype
) -> Tensor:
    """Band-limited angular spectrum with its carrier, [..., H, W], for pitches below 0.9 wavelengths."""
    kernel = angular_spectrum_kernel(padded, wavelength, distance)
    kernel = kernel * carrier(wavelength, distance)[..., None, None]
    no_tilt = torch.zeros(2, dtype=torch.float64, device=distance.device)
    positions = shifts(planes, distance, no_tilt)
    for frequency, pitch, position in zip(padded.frequencies(distance.device), padded.pitch, positions, strict=True):
        if bool((position != 0).any()):
            kernel = kernel * cycles_phasor(frequency * pitch * position[..., None, None])
    return kernel.to(dtype)


def _axis_factor(
    planes: PlanePair, axis: int, padded: Grid, wavelength: Tensor, distance: Tensor, position: Tensor, *, sampled: bool
) -> Tensor:
    """Paraxial factor of one axis in frequency, complex128 [..., size]; ``position`` is a result of :func:`shifts`."""
    size, pitch = padded.shape[axis], padded.pitch[axis]
    if sampled:
        frequency = torch.fft.fftfreq(size, pitch, dtype=torch.float64, device=distance.device)
        cycles = -(wavelength * distance)[..., None] / 2 * frequency.square()
        return cycles_phasor(cycles + frequency * pitch * position[..., None])
    index = tap_indices(size, planes.grid.shape[axis], planes.out.shape[axis]).to(distance.device, non_blocking=True)
    positions = index + position[..., None]
    at_zero = (distance == 0)[..., None]
    taps = fresnel_taps(positions, pitch, wavelength, torch.where(distance == 0, pitch, distance))
    # Masked, since the second derivative of torch.sinc is NaN at 0.
    identity = torch.sinc(torch.where(at_zero, positions, 0.5))
    return torch.fft.fft(torch.where(at_zero, identity.to(taps.dtype), taps))
