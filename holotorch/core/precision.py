"""Conversion of half-precision numbers before they are summed."""

import torch
from torch import Tensor


def at_least_single(values: Tensor) -> Tensor:
    """``values`` in float32 if they are float16 or bfloat16, otherwise unchanged.

    float16 cannot represent values below 6e-8 or above 65504, nor every integer above 2048 (bfloat16: above 256).
    """
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values
