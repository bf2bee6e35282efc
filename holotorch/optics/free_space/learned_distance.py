"""A spectrum times the transfer function over one learned distance, with its derivative in closed form.

The values are those of :func:`~holotorch.optics.free_space.transfer.transfer_function`, whose gradients by autograd are
the check here. The closed form takes a quarter of the time: transfer functions are even, so that one quadrant
determines them, and their gradient is never computed for each sample.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.optics.free_space.padding import FINEST
from holotorch.optics.free_space.plane_pair import PlanePair

_REMEMBERED = 1 << 22  # largest number of samples of a remembered factor of the phase; 16 MB in complex64
_NEAREST = 1.0  # least wavelength times distance, in squared pitches; below it the closed form loses digits

Array = np.ndarray[Any, np.dtype[Any]]
Differentiable = Callable[[Tensor, Tensor], Tensor]  # from wavelength and distance to the transfer function


def has_closed_form(planes: PlanePair, wavelength: Tensor, distance: Tensor) -> bool:
    """Whether :func:`times_learned` applies: one learned distance, and equal samples on both planes.

    Forward mode, transforms of ``torch.func``, ``torch.compile`` and GPUs, where the checks of values would be slow or
    impossible, are left to autograd.
    """
    if not (distance.requires_grad and torch.is_grad_enabled()) or wavelength.requires_grad or distance.numel() != 1:
        return False
    if not checks.readable(distance) or not planes.straight:
        return False
    if torch._C._are_functorch_transforms_active() or forward_ad.unpack_dual(distance).tangent is not None:
        return False
    lengths = wavelength.reshape(-1).tolist()  # faster than to ask tensors for the smallest and the largest
    shortest, longest = min(lengths), max(lengths)
    near = shortest * abs(distance.item()) < _NEAREST * max(planes.grid.pitch) ** 2
    return not near and min(planes.grid.pitch) >= FINEST * longest


def times_learned(
    spectrum: Tensor,
    padded: Grid,
    wavelength: Tensor,
    distance: Tensor,
    *,
    sampled: tuple[bool, bool],
    paraxial: bool,
    differentiable: Differentiable,
) -> Tensor:
    """``spectrum`` [..., H, W] times the transfer function with the carrier exp(ikz), with gradients in both.

    The other arguments are those of :func:`~holotorch.optics.free_space.transfer.transfer_function`, except that
    ``wavelength`` has no gradient and ``distance`` one element; ``differentiable`` is the same function by autograd,
    for derivatives of higher order.
    """
    options = padded, sampled, paraxial, differentiable
    return _TimesLearned.apply(spectrum, distance, wavelength, *options)  # type: ignore[return-value]


class _TimesLearned(torch.autograd.Function):
    @staticmethod
    def forward(ctx, spectrum, distance, wavelength, padded, sampled, paraxial, differentiable):
        z, wavelengths = distance.item(), wavelength.reshape(-1).numpy()
        axes = list(zip(padded.shape, padded.pitch, sampled, strict=True))
        factors = [_axis_factor(*axis, wavelengths, z) for axis in (axes if axes[0] != axes[1] else axes[:1])]
        rows = torch.from_numpy(factors[-1]).to(spectrum.dtype)
        lines = factors[0] * _cycles_phasor(z / wavelengths)[:, None]
        lines[1] += 2j * math.pi / wavelengths[:, None] * lines[0]  # the derivative of the carrier
        columns = torch.from_numpy(lines).to(spectrum.dtype)
        quadrants = columns[:, :, :, None] * rows[0, :, None, :]  # of the function and of its derivative
        quadrants[1].addcmul_(columns[0, :, :, None], rows[1, :, None, :])
        if not paraxial:
            cycles, slope = _cycles_per_metre(padded, tuple(wavelengths.tolist()), spectrum.dtype)
            quadrants[1].addcmul_(quadrants[0], slope)
            quadrants *= _phasor(z * cycles, spectrum.dtype)
        ones = [1] * (distance.ndim - wavelength.ndim)
        kernel, slope = quadrants.reshape(2, *ones, *wavelength.shape, *quadrants.shape[-2:])
        product = _times_even(spectrum, kernel)
        ctx.save_for_backward(spectrum, kernel.conj_physical_(), slope, distance, wavelength)
        ctx.differentiable = differentiable
        return product

    @staticmethod
    def backward(ctx, *grad_outputs):
        spectrum, conjugate, slope, distance, wavelength = ctx.saved_tensors
        (grad,) = grad_outputs
        if torch.is_grad_enabled():  # a second derivative may follow
            product = spectrum * ctx.differentiable(wavelength, distance)
            inputs = [each for each, needed in zip((spectrum, distance), ctx.needs_input_grad, strict=False) if needed]
            slopes = iter(torch.autograd.grad(product, inputs, grad, create_graph=True))
            return *[next(slopes) if needed else None for needed in ctx.needs_input_grad[:2]], *[None] * 5
        to_spectrum = _times_even(grad, conjugate).sum_to_size(spectrum.shape) if ctx.needs_input_grad[0] else None
        total = _dot_even(grad, spectrum, slope)
        return to_spectrum, total.to(distance.dtype).reshape(distance.shape), *[None] * 5


def _axis_factor(size: int, pitch: float, sampled: bool, wavelength: Array, distance: float) -> Array:
    """Paraxial factor of one axis and its derivative in distance, complex128 [2, C, size // 2 + 1]."""
    index = np.arange(size // 2 + 1, dtype=np.float64)
    if sampled:
        curvature = -wavelength[:, None] / 2 * np.square(index / (size * pitch))
        factor = _cycles_phasor(distance * curvature)
        return np.stack([factor, 2j * math.pi * curvature * factor])
    taps = _taps_and_slopes(index, wavelength[:, None] * (abs(distance) / pitch**2))
    # From the derivative in a = wavelength |z| / pitch^2 to that in z.
    taps[1] *= math.copysign(1, distance) * wavelength[:, None] / pitch**2
    if distance < 0:
        taps = taps.conj()
    whole = np.concatenate([taps, taps[..., (size - 1) // 2 : 0 : -1]], -1)
    return np.fft.fft(whole)[..., : size // 2 + 1]


def _taps_and_slopes(index: Array, a: Array) -> Array:
    """Taps t(n) at displacements ``index`` [N] for ``a`` [C, 1], and dt / da, complex128 [2, C, N].

    t(n) = int exp(-i pi a s^2 + 2 pi i s n) ds over |s| < 1/2, as in
    :func:`~holotorch.optics.free_space.impulse_response.fresnel_taps`. Integration by parts gives
    dt/da = (end - t (1 + 2 pi i n^2 / a)) / (2 a), where ``end`` is the integrand at both ends of the band. The Fresnel
    integral up to u >= 0 is (1 - i)/2 (1 - exp(-i pi u^2 / 2) w), with the Faddeeva function w of (i - 1) sqrt(pi)/2 u
    (Abramowitz and Stegun 7.3.22 and 7.1.3).
    """
    from scipy.special import wofz  # here, since importing it changes the filters of warnings

    scale = np.sqrt(2 * a)
    curvature = np.square(index) / a
    chirp, end = _cycles_phasor(curvature / 2), _cycles_phasor(-a / 8) * (1 - 2 * (index % 2))
    shift = index * (2 / scale)
    u = np.stack([scale / 2 - shift, scale / 2 + shift])
    ends = np.sign(u) * (chirp - end * wofz((1j - 1) * math.sqrt(math.pi) / 2 * np.abs(u)))
    taps = ends.sum(0) * ((0.5 - 0.5j) / scale)
    slopes = (end - taps * (1 + 2j * math.pi * curvature)) / (2 * a)
    return np.stack([taps, slopes])


def _cycles_phasor(cycles: Array) -> Array:
    """exp(2 pi i cycles); whole cycles are subtracted first."""
    return np.exp(2j * math.pi * (cycles - np.round(cycles)))


def _cycles_per_metre(padded: Grid, wavelengths: tuple[float, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Phase of the factor beyond Fresnel per distance, in float64 cycles, and 2 pi i times it; remembered if small.

    Both have the shape [C, H // 2 + 1, W // 2 + 1].
    """
    small = len(wavelengths) * math.prod(padded.shape) <= _REMEMBERED
    return (_remembered_cycles if small else _remembered_cycles.__wrapped__)(padded, wavelengths, dtype)


@lru_cache(maxsize=2)
def _remembered_cycles(padded: Grid, wavelengths: tuple[float, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    wavelength = torch.tensor(wavelengths, dtype=torch.float64)[:, None, None]
    y, x = (
        wavelength * torch.arange(size // 2 + 1, dtype=torch.float64) / (size * pitch)
        for size, pitch in zip(padded.shape, padded.pitch, strict=True)
    )
    sine2 = y.transpose(-1, -2).square() + x.square()
    cycles = -(sine2 / (1 + torch.sqrt(1 - sine2))).square() / (2 * wavelength)
    return cycles, torch.complex(torch.zeros_like(cycles), 2 * math.pi * cycles).to(dtype)


def _phasor(cycles: Tensor, dtype: torch.dtype) -> Tensor:
    """exp(2 pi i cycles) in ``dtype``; whole cycles are subtracted in float64, which overwrites ``cycles``."""
    angle = cycles.frac_().mul_(2 * math.pi).to(dtype.to_real())
    return torch.complex(angle.cos(), angle.sin())


def _times_even(spectrum: Tensor, quadrant: Tensor) -> Tensor:
    """``spectrum`` [..., H, W] times the even array of which ``quadrant`` [..., H // 2 + 1, W // 2 + 1] is a part.

    The whole array is never made: new memory takes longer than the product.
    """
    leading = quadrant.shape[:-2]
    if spectrum.shape[max(0, spectrum.ndim - 2 - len(leading)) : -2] != leading:  # torch.broadcast_shapes takes 8 us
        shape = torch.broadcast_shapes(spectrum.shape[:-2], leading)
        spectrum = spectrum.expand(*shape, *spectrum.shape[-2:])
    height, width = spectrum.shape[-2:]
    upper, lower = slice(0, height // 2 + 1), slice(height // 2 + 1, height)
    half = torch.cat([quadrant, quadrant[..., 1 : (width + 1) // 2].flip(-1)], -1)
    product = spectrum.new_empty(spectrum.shape)
    torch.mul(spectrum[..., upper, :], half, out=product[..., upper, :])
    torch.mul(spectrum[..., lower, :], half[..., 1 : (height + 1) // 2, :].flip(-2), out=product[..., lower, :])
    return product


def _dot_even(grad: Tensor, spectrum: Tensor, quadrant: Tensor) -> Tensor:
    """Real part of the scalar product of ``grad`` and :func:`_times_even`, for which no array of their size is made."""
    height, width = grad.shape[-2:]
    upper, lower = slice(0, height // 2 + 1), slice(height // 2 + 1, height)
    conjugate = grad.conj()
    rows = conjugate[..., upper, :] * spectrum[..., upper, :]
    rows[..., 1 : (height + 1) // 2, :] += (conjugate[..., lower, :] * spectrum[..., lower, :]).flip(-2)
    folded = rows[..., : width // 2 + 1]
    folded[..., 1 : (width + 1) // 2] += rows[..., width // 2 + 1 :].flip(-1)
    return torch.vdot(folded.sum_to_size(quadrant.shape).conj().reshape(-1), quadrant.reshape(-1)).real
