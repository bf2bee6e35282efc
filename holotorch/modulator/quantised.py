"""Heater phases with a limited number of levels."""

import torch
from torch import Tensor

from holotorch.core import checks


def quantised(phase: Tensor, bits: int) -> Tensor:
    """Round ``phase`` [..., H, W] >= 0 to 2^bits evenly spaced levels from 0 to the largest phase of each [H, W].

    The gradient is that of the identity (straight-through estimator), so that a quantised phase can be optimised.
    Raises ValueError for fewer than 1 or more than 24 bits, or a negative phase.
    """
    checks.real("phase", phase)
    checked_bits(bits, maximum=24)
    if phase.numel() and phase.detach().min() < 0:
        raise ValueError(f"phase must be >= 0 to be quantised, got a minimum of {phase.detach().min().item():g}")
    top = phase.detach().amax((-2, -1), keepdim=True)
    step = torch.where(top > 0, top, 1) / (2**bits - 1)
    stepped = (phase.detach() / step).round() * step
    return phase + (stepped - phase.detach())


def checked_bits(bits: int, maximum: int = 16) -> int:
    """``bits``, or TypeError unless it is an integer and ValueError unless it is 1 to ``maximum``."""
    if checks.whole("bits", bits, 1) > maximum:
        raise ValueError(f"bits must be at most {maximum}, got {bits}")
    return bits
