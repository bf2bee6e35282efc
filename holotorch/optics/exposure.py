"""From intensity to a picture: equal power under different sources, and the curve of Eq. 5.16."""

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import at_least_single

GAMMA = 0.5  # of Eq. 5.16


def equal_power(intensity: Tensor, reference: Tensor) -> Tensor:
    """Scale each channel of ``intensity`` [..., C, H, W] to the total of the same channel of ``reference``.

    The text below Eq. 5.16: what may enter the eye limits the source, so pictures under different sources compare at
    equal power. Black channels stay black. ``reference`` may have another H and W on an equal extent: then its mean
    counts. ValueError for other leading axes.
    """
    for name, part in (("intensity", intensity), ("reference", reference)):
        checks.real(name, part)
        if part.ndim < 2:
            raise ValueError(f"{name} must be [..., H, W], got {tuple(part.shape)}")
    if intensity.shape[:-2] != reference.shape[:-2]:
        raise ValueError(f"channels must match, got {tuple(intensity.shape)} and {tuple(reference.shape)}")
    ours, wanted = (at_least_single(part).mean((-2, -1), keepdim=True) for part in (intensity, reference))
    black = ours == 0
    return intensity * torch.where(black, 0.0, wanted / torch.where(black, 1.0, ours)).to(intensity.dtype)


def exposed(intensity: Tensor, *, peak: Tensor | None = None, gamma: float = GAMMA) -> Tensor:
    """Picture (intensity / peak)^gamma in 0..1, Eq. 5.16; what exceeds the peak is cut to 1, an empty one is black.

    Args:
        intensity: [..., C, H, W], not negative; a tiny negative from rounding counts as 0.
        peak: Intensity that becomes 1, which broadcasts against ``intensity``; to compare sources, that of one of them.
            By default the largest value of each picture over C, H and W: Eq. 5.16 is printed for one channel, and a
            peak of its own for each would change the colours.
        gamma: Exponent, above 0.

    Returns:
        Same shape and dtype. Differentiable; the gradient where the intensity is 0 is 0, not the curve's infinity.
    """
    checks.real("intensity", intensity)
    if intensity.ndim < 3:
        raise ValueError(f"intensity must be [..., C, H, W], got {tuple(intensity.shape)}")
    gamma = checks.positive("gamma", gamma)
    if peak is None:
        peak = intensity.amax((-3, -2, -1), keepdim=True)
    lit = (intensity > 0) & (peak > 0)
    part = torch.where(lit, intensity, 1.0) / torch.where(peak > 0, peak, 1.0)
    return torch.where(lit, part.clamp(max=1).pow(gamma), 0.0)
