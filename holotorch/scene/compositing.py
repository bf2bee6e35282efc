"""Front-to-back compositing along a ray: opacities and weights of its steps, and amplitudes.

This follows Section 5.3.1 and Algorithm 3 of the thesis, with two corrections. The last line of the algorithm prints
max(alpha + (1 - alpha) alpha_p, 1) for min(...), which is omitted here, since opacities in [0, 1] never exceed 1. The
transmittance T_0 before the first step in Eq. 5.7 is 1.
"""

import torch
from torch import Tensor


def extinction(opacity: Tensor) -> Tensor:
    """Extinction per unit distance, -ln(1 - opacity), of an opacity in [0, 1] per unit distance.

    At opacity 1 the logarithm and its derivative are infinite. For opacities above 1 - 2^-20 the function is therefore
    replaced by its tangent at 1 - 2^-20. At opacity 1 the tangent is 14.9, which transmits a fraction of 3.5e-7 of the
    light over the unit distance. The gradient is finite and nonzero in both float32 and float64.
    """
    border = 1 - 2.0**-20
    # Each opacity has a nonzero gradient in one of the two terms only, so that no slopes of 2^20 have to cancel.
    return (opacity - border).clamp(min=0) * 2.0**20 - torch.log1p(-opacity.clamp(max=border))


def corrected_opacity(opacity: Tensor, length: Tensor | float) -> Tensor:
    """Opacity 1 - (1 - opacity)^length of a step, from the opacity per unit distance.

    ``opacity`` is in [0, 1] and ``length`` >= 0 is in unit distances; their shapes broadcast. The result is in [0, 1).
    The total opacity of a homogeneous medium does not depend on the number of steps. The power is computed as
    exp(-extinction * length), since its own gradient is infinite at opacity 1 for lengths below 1.
    """
    return -torch.expm1(extinction(opacity) * -length)


def absorb(transmittance: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Weight T alpha of one step (Eq. 5.6), and transmittance T (1 - alpha) up to the end of the step (Eq. 5.7).

    The transmittance is computed as T - T alpha, so that the weights of a ray and its last transmittance add up to 1.
    """
    weight = transmittance * opacity
    return weight, transmittance - weight


def front_to_back(opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [D, ...] of steps with ``opacities`` [D, ...], nearest first, and transmittance [...] of all steps."""
    transmittance = torch.ones_like(opacities[0])
    weights = []
    for opacity in opacities:
        weight, transmittance = absorb(transmittance, opacity)
        weights.append(weight)
    return torch.stack(weights), transmittance


def safe_sqrt(radiance: Tensor) -> Tensor:
    """Amplitude: square root of a radiance >= 0, with gradient 0 at 0.

    The derivative of the square root is infinite at 0, and makes the gradients of rays through empty planes NaN.
    """
    if not radiance.requires_grad:
        return radiance.sqrt()
    lit = radiance > 0
    return torch.where(lit, radiance, 1).sqrt() * lit
