"""Fresnel integrals in float64, differentiable and on any device, which torch does not provide."""

import math
from functools import lru_cache

import torch
from torch import Tensor

FRESNEL_BORDER = 1.3  # the power series is exact to rounding up to this argument, and the quadrature above it
_TERMS = 16  # number of terms of each of the two series, a power of 2; from the 14th on they are below 1e-17
_SERIES = [[(-1) ** k / (math.factorial(n) * (2 * n + 1)) for n in (2 * k, 2 * k + 1)] for k in range(_TERMS)]
_STEP, _NODES = 0.13, 42  # step and number of nodes of the quadrature


def fresnel_integral(u: Tensor) -> Tensor:
    """int_0^u exp(-i pi t^2 / 2) dt = C(u) - i S(u) for abs(u) <= 1.3 by a power series, complex128."""
    factor = math.pi / 2 * u.square()
    # Terms (-i factor)^n / (n! (2 n + 1)): even n contribute to C, odd n to S. The powers of factor^2 are products, and
    # each turn doubles their number; derivatives of ``pow`` and ``cumprod`` are NaN at 0.
    power = factor.square()[..., None]
    powers = torch.cat([torch.ones_like(power), power], -1)
    while powers.shape[-1] < _TERMS:
        power = power.square()
        powers = torch.cat([powers, power * powers], -1)
    sums = powers @ _series(u.device)
    return torch.complex(u * sums[..., 0], -u * factor * sums[..., 1])


def fresnel_auxiliary(u: Tensor) -> tuple[Tensor, Tensor]:
    """Auxiliary functions f, g of C(u) - i S(u) = (1 - i)/2 + (i f - g) exp(-i pi u^2 / 2), float64, for u >= 1.3.

    f and g vary slowly where C and S oscillate, so that the caller can compute the phase pi u^2 / 2, which may be
    large, without loss of precision. Both are Laplace integrals (Abramowitz and Stegun 7.3.24-25), here with the
    integrand exp(-pi t^2 / 2) / (1 + (t/u)^4). Its poles are 0.7 u away from the real axis, so that the trapezoidal
    rule converges geometrically.
    """
    t, weights = _quadrature(u.device)
    inverse = 1 / u
    sums = (1 / (1 + (t * inverse[..., None]).square().square())) @ weights
    return sums[..., 0] * inverse, sums[..., 1] * inverse**3


@lru_cache(maxsize=8)  # making the constants takes longer than using them
def _series(device: torch.device) -> Tensor:
    """Coefficients [TERMS, 2] of C and S."""
    with torch.inference_mode(False):
        return torch.tensor(_SERIES, dtype=torch.float64, device=device)


@lru_cache(maxsize=8)
def _quadrature(device: torch.device) -> tuple[Tensor, Tensor]:
    """Nodes [NODES] and weights [NODES, 2] of the integrals for f and g."""
    with torch.inference_mode(False):
        t = torch.arange(_NODES, dtype=torch.float64, device=device) * _STEP
        weight = torch.exp(-math.pi / 2 * t.square()) * (_STEP * math.sqrt(2) / math.pi)
        weight[0] /= 2
        return t, torch.stack([weight, weight * t.square()], -1)


def chirped_fresnel_integral(u: Tensor, chirp: Tensor, end: Tensor, sign: Tensor | None = None) -> Tensor:
    """``chirp`` times int_0^u exp(-i sign pi t^2 / 2) dt, complex128; ``end`` is chirp exp(-i sign pi u^2 / 2).

    ``sign`` is 1 or -1 and broadcasts; None stands for 1.
    """
    large = u.abs() > FRESNEL_BORDER
    f, g = fresnel_auxiliary(torch.where(large, u.abs(), 2.0))
    integral = fresnel_integral(torch.where(large, 0.0, u))
    half: Tensor | complex = 0.5 - 0.5j
    if sign is not None:
        f, half = sign * f, 0.5 - 0.5j * sign
        integral = torch.complex(integral.real, sign * integral.imag)
    outside = torch.sign(u) * (half * chirp + torch.complex(-g, f) * end)
    return torch.where(large, outside, chirp * integral)
