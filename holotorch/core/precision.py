"""Conversion of half-precision numbers before they are summed."""

import torch
from torch import Tensor


def at_least_single(values: Tensor) -> Tensor:
    """``values`` in float32 if they are float16 or bfloat16, otherwise unchanged.

    float16 cannot represent squares below 6e-8, sums above 65504, or all counts above 2048 (256 in bfloat16).
    """
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values
