"""Front-to-back compositing: opacity of a step of any length, weights of the steps, and amplitudes.

Section 5.3.1 and Algorithm 3 of the thesis, with two corrections. The last line of the algorithm prints ``max`` for
``min`` in min(alpha + (1 - alpha) alpha_p, 1), which is never needed for opacities in [0, 1]. T_0 in Eq. 5.7 is 1.
"""

import torch
from torch import Tensor


def extinction(opacity: Tensor) -> Tensor:
    """Extinction per unit distance, -ln(1 - opacity), of an opacity in [0, 1] per unit distance.

    At opacity 1 the logarithm and its derivative are infinite. Above 1 - 2^-20 the function is therefore replaced by
    its tangent at this opacity. It reaches 14.9 at opacity 1: a fraction of 3.5e-7 of the light is left after the unit
    distance. The gradient is finite and not zero, in float32 as in float64.
    """
    border = 1 - 2.0**-20
    # The excess is computed from the opacity, since in a difference of two terms slopes of 2^20 would have to cancel.
    return (opacity - border).clamp(min=0) * 2.0**20 - torch.log1p(-opacity.clamp(max=border))


def corrected_opacity(opacity: Tensor, length: Tensor | float) -> Tensor:
    """Opacity 1 - (1 - opacity)^length of a step, from the opacity per unit distance.

    ``opacity`` in [0, 1] and ``length`` >= 0, in unit distances, have any shapes that broadcast; the result is in
    [0, 1). Through a homogeneous medium the total opacity does not depend on the number of steps. The power is computed
    by :func:`extinction`, since its gradient is infinite at opacity 1 for a length below 1.
    """
    return -torch.expm1(extinction(opacity) * -length)


def absorb(transmittance: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Weight T alpha of a step of a ray (Eq. 5.6), and the transmittance T (1 - alpha) behind it (Eq. 5.7).

    The transmittance is computed as T - T alpha, so that the weights of a ray and its last transmittance add up to 1.
    """
    weight = transmittance * opacity
    return weight, transmittance - weight


def front_to_back(opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [D, ...] of steps with ``opacities`` [D, ...], nearest first, and the transmittance [...] behind them."""
    transmittance = torch.ones_like(opacities[0])
    weights = []
    for opacity in opacities:
        weight, transmittance = absorb(transmittance, opacity)
        weights.append(weight)
    return torch.stack(weights), transmittance


def safe_sqrt(radiance: Tensor) -> Tensor:
    """Amplitude: square root of a radiance >= 0, with gradient 0 at 0.

    The root's own gradient there is infinite, and would make gradients of rays through empty planes NaN.
    """
    if not radiance.requires_grad:
        return radiance.sqrt()
    lit = radiance > 0
    return torch.where(lit, radiance, 1).sqrt() * lit
