"""Fresnel integrals in float64, differentiable and on any device; torch has none."""

import math

import torch
from torch import Tensor

# Below this argument the power series is exact to rounding, above it the quadrature is.
FRESNEL_BORDER = 1.3
_SERIES_TERMS = 34
_STEP, _NODES = 0.13, 42


def fresnel_integral(u: Tensor) -> Tensor:
    """int_0^u exp(-i pi t^2 / 2) dt = C(u) - i S(u) for abs(u) <= 1.3, complex128; a power series, odd in u."""
    factor = math.pi / 2 * u.square()
    power, parts = u, [u, torch.zeros_like(u)]
    for n in range(1, _SERIES_TERMS):
        power = power * factor / n
        # (-i)^n: to C and S in turn, the sign changing after every two terms.
        parts[n % 2] = parts[n % 2] + power * ((1 if n % 4 < 2 else -1) / (2 * n + 1))
    return torch.complex(parts[0], -parts[1])


def fresnel_auxiliary(u: Tensor) -> tuple[Tensor, Tensor]:
    """f(u) and g(u) for u >= 1.3, float64, with C - iS = (1 - i)/2 + (i f - g) exp(-i pi u^2 / 2).

    They vary slowly where C and S oscillate, so that the phase pi u^2 / 2, which may be huge, can be kept exact by the
    caller. Both are Laplace integrals (Abramowitz and Stegun 7.3.24-25) of exp(-pi t^2 / 2) / (1 + (t/u)^4) after
    substitution; the trapezoidal rule converges geometrically there, the poles being 0.7 u away from the real axis.
    """
    t = torch.arange(_NODES, dtype=torch.float64, device=u.device) * _STEP
    weight = torch.exp(-math.pi / 2 * t.square()) * _STEP
    weight[0] /= 2
    inverse = 1 / u
    density = weight / (1 + (t * inverse[..., None]).square().square())
    scale = math.sqrt(2) / math.pi
    return scale * density.sum(-1) * inverse, scale * (density * t.square()).sum(-1) * inverse**3
