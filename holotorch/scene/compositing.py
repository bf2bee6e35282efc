"""Front-to-back compositing: opacity of a step of any length, weights of the steps, and amplitudes.

Section 5.3.1 and Algorithm 3 of the thesis, with two corrections. The last line of the algorithm prints ``max`` for the
upper bound min(alpha + (1 - alpha) alpha_p, 1), which never takes effect for opacities in [0, 1]. In Eq. 5.7 T_0 is the
empty product, 1.
"""

import torch
from torch import Tensor

# Transmittance over the unit distance below which the extinction is continued along its tangent, see ``extinction``.
_LEAST_TRANSMITTANCE = 2.0**-20


def extinction(opacity: Tensor) -> Tensor:
    """Extinction per unit distance, -ln(1 - opacity), of an opacity in [0, 1] per unit distance.

    The extinction of opacity 1 and its derivative are infinite. Above 1 - 2^-20 it is therefore continued along its
    tangent, to 14.9 at 1. A fraction of 3.5e-7 of the light is then left after the unit distance, and the gradient is
    finite and not zero. float32 and float64 agree.
    """
    border = 1 - _LEAST_TRANSMITTANCE
    # The excess is clamped itself: in a difference from the clamped opacity, slopes of 2^20 would have to cancel.
    return (opacity - border).clamp(min=0) * (1 / _LEAST_TRANSMITTANCE) - torch.log1p(-opacity.clamp(max=border))


def corrected_opacity(opacity: Tensor, length: Tensor | float) -> Tensor:
    """Opacity 1 - (1 - opacity)^length of a step, from the opacity of one unit distance.

    Args:
        opacity: In [0, 1], any shape.
        length: Of the step, in units of that distance, >= 0; broadcasts.

    Returns:
        In [0, 1). Through a homogeneous medium the total opacity does not depend on the number of steps. Logarithms are
        used, since the power has an infinite gradient at opacity 1 for a length below 1.
    """
    return -torch.expm1(extinction(opacity) * -length)


def absorb(transmittance: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """One step of a ray: its weight T alpha (Eq. 5.6) and the transmittance T (1 - alpha) behind it (Eq. 5.7).

    The transmittance is a difference, so that the weights of a ray and its last transmittance add up to 1.
    """
    weight = transmittance * opacity
    return weight, transmittance - weight


def front_to_back(opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [D, ...] of steps with ``opacities`` [D, ...] in [0, 1], nearest first, and the transmittance left."""
    transmittance = torch.ones_like(opacities[0])
    weights = []
    for opacity in opacities:
        weight, transmittance = absorb(transmittance, opacity)
        weights.append(weight)
    return torch.stack(weights), transmittance


def safe_sqrt(radiance: Tensor) -> Tensor:
    """Amplitude: square root of a radiance >= 0, with gradient 0 at 0, where that of the root is infinite.

    The infinite gradient would make the gradients of rays through empty planes NaN (0 times infinity).
    """
    if not radiance.requires_grad:
        return radiance.sqrt()
    lit = radiance > 0
    return torch.where(lit, radiance, 1).sqrt() * lit
