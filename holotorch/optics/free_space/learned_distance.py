"""The transfer function over one learned distance, with its derivative in closed form.

It has the values of :func:`~holotorch.optics.free_space.transfer.transfer_function`, whose gradients by autograd are
its check, and takes a quarter of the time: kernels are even, so that one quadrant determines them, and no tensor of the
size of the kernel is kept for the backward pass.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor
from torch.autograd import forward_ad

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.special import FRESNEL_BORDER, fresnel_auxiliary, fresnel_integral
from holotorch.optics.free_space.kernels import turns_phasor
from holotorch.optics.free_space.padding import FINEST
from holotorch.optics.free_space.plane_pair import PlanePair

_REMEMBERED = 1 << 22  # largest number of samples of a remembered factor of the phase; 32 MB
_NEAREST = 1.0  # least wavelength times distance, in squared pitches; below it the closed form loses digits

Differentiable = Callable[[Tensor, Tensor], Tensor]  # from wavelength and distance to the transfer function


def has_closed_form(planes: PlanePair, wavelength: Tensor, distance: Tensor) -> bool:
    """Whether :func:`learned_transfer_function` applies: only one distance is learned, between planes that face.

    Forward mode, transforms of ``torch.func``, ``torch.compile`` and GPUs, where the checks of values would be slow or
    impossible, are left to autograd.
    """
    if not (distance.requires_grad and torch.is_grad_enabled()) or wavelength.requires_grad or distance.numel() != 1:
        return False
    if not checks.readable(distance) or not planes.straight:
        return False
    if torch._C._are_functorch_transforms_active() or forward_ad.unpack_dual(distance).tangent is not None:
        return False
    shortest, longest = wavelength.min().item(), wavelength.max().item()
    near = shortest * abs(distance.item()) < _NEAREST * max(planes.grid.pitch) ** 2
    return not near and min(planes.grid.pitch) >= FINEST * longest


def learned_transfer_function(
    padded: Grid,
    wavelength: Tensor,
    distance: Tensor,
    *,
    sampled: tuple[bool, bool],
    paraxial: bool,
    dtype: torch.dtype,
    differentiable: Differentiable,
) -> Tensor:
    """The transfer function with the carrier exp(ikz) and the gradient in ``distance``.

    Arguments and result are those of :func:`~holotorch.optics.free_space.transfer.transfer_function`, except that
    ``wavelength`` has no gradient and ``distance`` one element; ``differentiable`` is the same function by autograd,
    for derivatives of higher order.
    """
    shape = torch.broadcast_shapes(wavelength.shape, distance.shape)
    options = padded, sampled, paraxial, dtype, differentiable
    kernel: Tensor = _LearnedDistance.apply(distance, wavelength.reshape(-1), *options)  # type: ignore[assignment]
    return kernel.reshape(*shape, *padded.shape)


class _LearnedDistance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, distance, wavelength, padded, sampled, paraxial, dtype, differentiable):
        z = distance.item()
        axes = list(zip(padded.shape, padded.pitch, sampled, strict=True))
        factors = [_axis_factor(*axis, wavelength, z) for axis in (axes if axes[0] != axes[1] else axes[:1])]
        rows = factors[-1].to(dtype)
        columns = factors[0] * turns_phasor(z / wavelength)[:, None]
        columns[1] += 2j * math.pi / wavelength[:, None] * columns[0]  # the derivative of the carrier
        columns = columns.to(dtype)
        quadrant = columns[0, :, :, None] * rows[0, :, None, :]
        beyond = None
        if not paraxial:
            cycles = z * _cycles_per_metre(padded, tuple(wavelength.tolist()))
            beyond = _phasor(cycles, dtype)
            quadrant *= beyond
        ctx.save_for_backward(distance, wavelength, columns, rows, beyond)
        ctx.padded, ctx.differentiable = padded, differentiable
        return _mirrored(_mirrored(quadrant, padded.shape[1], -1), padded.shape[0], -2)

    @staticmethod
    def backward(ctx, *grad_outputs):
        distance, wavelength, columns, rows, beyond = ctx.saved_tensors
        (grad,) = grad_outputs
        if torch.is_grad_enabled():  # a second derivative may follow
            kernel = ctx.differentiable(wavelength, distance).reshape(grad.shape)
            (slope,) = torch.autograd.grad(kernel, distance, grad, create_graph=True)
            return slope, *[None] * 6
        folded = _folded(_folded(grad.conj(), -2), -1)
        if beyond is not None:
            folded = folded * beyond
        # The sum over one axis with its factor and with the derivative of that, [C, h, 2], then over the other axis.
        sums = folded @ rows.movedim(0, -1)
        total = (columns.movedim(0, -1) * sums.flip(-1)).sum()
        if beyond is not None:
            factor = _cycles_per_metre(ctx.padded, tuple(wavelength.tolist())).to(folded.real.dtype)
            curved = (folded * factor) @ rows[0, :, :, None]
            total = total + 2j * math.pi * (columns[0, :, :, None] * curved).sum()
        return total.real.to(distance.dtype).reshape(distance.shape), *[None] * 6


def _axis_factor(size: int, pitch: float, sampled: bool, wavelength: Tensor, distance: float) -> Tensor:
    """Paraxial factor of one axis and its derivative in distance, complex128 [2, C, size // 2 + 1]."""
    index = torch.arange(size // 2 + 1, dtype=torch.float64)
    if sampled:
        curvature = -wavelength[:, None] / 2 * (index / (size * pitch)).square()
        factor = turns_phasor(distance * curvature)
        return torch.stack([factor, 2j * math.pi * curvature * factor])
    taps = _taps_and_slopes(index, wavelength[:, None] * abs(distance) / pitch**2)
    # From the derivative in a = wavelength |z| / pitch^2 to that in z.
    taps[1] *= math.copysign(1, distance) * wavelength[:, None] / pitch**2
    if distance < 0:
        taps = taps.conj()
    return torch.fft.fft(_mirrored(taps, size, -1))[..., : size // 2 + 1]


def _taps_and_slopes(index: Tensor, a: Tensor) -> Tensor:
    """Taps t(n) at displacements ``index`` [N] for ``a`` [C, 1], and dt / da, complex128 [2, C, N].

    t(n) = int exp(-i pi a s^2 + 2 pi i s n) ds over |s| < 1/2, as in
    :func:`~holotorch.optics.free_space.impulse_response.fresnel_taps`. Integration by parts gives
    dt/da = (end - t (1 + 2 pi i n^2 / a)) / (2 a), where ``end`` is the integrand at both ends of the band.
    """
    scale = torch.sqrt(2 * a)
    curvature = index.square() / a
    chirp, end = turns_phasor(curvature / 2), turns_phasor(-a / 8) * (1 - 2 * (index % 2))
    u = torch.stack([scale / 2 - index / scale * 2, scale / 2 + index / scale * 2])
    size = u.abs()
    f, g = fresnel_auxiliary(size.clamp(min=FRESNEL_BORDER))
    ends = torch.sign(u) * (chirp * (0.5 - 0.5j) + torch.complex(-g, f) * end)
    near = (size <= FRESNEL_BORDER).nonzero(as_tuple=True)
    ends[near] = chirp[near[1:]] * fresnel_integral(u[near])
    taps = ends.sum(0) / scale
    slopes = (end - taps * torch.complex(torch.ones_like(curvature), 2 * math.pi * curvature)) / (2 * a)
    return torch.stack([taps, slopes])


def _cycles_per_metre(padded: Grid, wavelengths: tuple[float, ...]) -> Tensor:
    """Phase of the factor beyond Fresnel per distance, float64 [C, H // 2 + 1, W // 2 + 1]; remembered if small."""
    small = len(wavelengths) * math.prod(padded.shape) <= _REMEMBERED
    return (_remembered_cycles if small else _remembered_cycles.__wrapped__)(padded, wavelengths)


@lru_cache(maxsize=2)
def _remembered_cycles(padded: Grid, wavelengths: tuple[float, ...]) -> Tensor:
    wavelength = torch.tensor(wavelengths, dtype=torch.float64)[:, None, None]
    y, x = (
        wavelength * torch.arange(size // 2 + 1, dtype=torch.float64) / (size * pitch)
        for size, pitch in zip(padded.shape, padded.pitch, strict=True)
    )
    sine2 = y.transpose(-1, -2).square() + x.square()
    return -(sine2 / (1 + torch.sqrt(1 - sine2))).square() / (2 * wavelength)


def _phasor(cycles: Tensor, dtype: torch.dtype) -> Tensor:
    """exp(2 pi i cycles) in ``dtype``; whole cycles are subtracted in float64."""
    angle = ((cycles - cycles.round()) * (2 * math.pi)).to(dtype.to_real())
    return torch.complex(angle.cos(), angle.sin())


def _mirrored(half: Tensor, size: int, axis: int) -> Tensor:
    """The even sequence of ``size`` samples, in FFT order, whose samples 0 to size // 2 along ``axis`` are given."""
    return torch.cat([half, half.narrow(axis, 1, (size - 1) // 2).flip(axis)], axis)


def _folded(whole: Tensor, axis: int) -> Tensor:
    """Adjoint of :func:`_mirrored`: the second half of the samples along ``axis`` is added to its mirror images."""
    size = whole.shape[axis]
    mirrored = (size - 1) // 2
    half = whole.narrow(axis, 0, size // 2 + 1).clone()
    half.narrow(axis, 1, mirrored).add_(whole.narrow(axis, size // 2 + 1, mirrored).flip(axis))
    return half
