"""Front-to-back compositing: opacities of any step length, what every step adds, and the root that makes amplitudes.

Section 5.3.1 and Algorithm 3 of the thesis, with two corrections. Its last line prints ``max`` where opacity must be
bounded from above: min(alpha + (1 - alpha) alpha_p, 1), which never binds for opacities in [0, 1], is used. And T_0 = 1
in Eq. 5.7 is the empty product.
"""

import torch
from torch import Tensor

# Transmission over the unit distance below which extinction grows no faster than along its tangent.
_CLEAREST = 2.0**-20


def extinction(opacity: Tensor) -> Tensor:
    """Extinction per unit distance, -ln(1 - opacity), of an opacity in [0, 1] per unit distance.

    Opacity 1 is an infinite extinction, with an infinite derivative. Above 1 - 2^-20 it is therefore continued along
    its tangent, to 14.9 at 1: light of 3.5e-7 is left after the unit distance, and the gradient is finite and says
    still which way is less. float32 and float64 agree.
    """
    border = 1 - _CLEAREST
    # Not opacity minus the bounded one: their slopes of 2^20 would have to cancel below the border.
    return (opacity - border).clamp(min=0) * (1 / _CLEAREST) - torch.log1p(-opacity.clamp(max=border))


def corrected_opacity(opacity: Tensor, length: Tensor | float) -> Tensor:
    """Opacity 1 - (1 - opacity)^length of a step, from the opacity of one unit distance.

    Args:
        opacity: In [0, 1], any shape.
        length: Of the step, in units of that distance, >= 0; broadcasts.

    Returns:
        In [0, 1). Steps through a homogeneous medium add up to the same whatever their number, as the powers do.
        Written in logarithms: the power has an infinite gradient at opacity 1 for a length below 1.
    """
    return -torch.expm1(extinction(opacity) * -length)


def absorb(transmittance: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """One step of a ray: its weight T alpha (Eq. 5.6) and the transmittance T (1 - alpha) behind it (Eq. 5.7).

    Weight and rest are subtracted from one another, so that the weights of a ray and its last transmittance make 1.
    """
    weight = transmittance * opacity
    return weight, transmittance - weight


def front_to_back(opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [D, ...] of D steps of opacities [D, ...] in [0, 1], nearest first, and the transmittance [...] left."""
    transmittance = torch.ones_like(opacities[0])
    weights = []
    for opacity in opacities:
        weight, transmittance = absorb(transmittance, opacity)
        weights.append(weight)
    return torch.stack(weights), transmittance


def safe_sqrt(radiance: Tensor) -> Tensor:
    """Amplitude: the root of a radiance >= 0, with gradient 0 at 0, where the root's own is infinite.

    Without it the light that a ray sends from empty planes makes every gradient NaN (0 times infinity).
    """
    if not radiance.requires_grad:
        return radiance.sqrt()
    lit = radiance > 0
    return torch.where(lit, radiance, 1).sqrt() * lit
