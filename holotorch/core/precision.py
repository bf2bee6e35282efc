"""Sums of half-precision numbers."""

import torch
from torch import Tensor

_HALVES = (torch.float16, torch.bfloat16)


def at_least_single(values: Tensor) -> Tensor:
    """``values`` in float32 if they are float16 or bfloat16, else as they are.

    A square below 6e-8, a sum above 65504 and a count above 2048 are lost in float16; in bfloat16, a count above 256.
    """
    return values.float() if values.dtype in _HALVES else values
