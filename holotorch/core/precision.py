"""Numbers in the precision that a phase needs: protection against half precision, and lengths in float64."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from holotorch.core.tracing import constant_when_compiled


def at_least_single(values: Tensor) -> Tensor:
    """``values`` in float32 if they are float16 or bfloat16, otherwise unchanged.

    float16 cannot represent values below 6e-8 or above 65504, nor every integer above 2048 (bfloat16: above 256).
    """
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def double(value: Tensor | float | Sequence[float], device: torch.device) -> Tensor:
    """``value`` in float64 on ``device``. The processor does not wait for a GPU to receive it."""
    return torch.as_tensor(value, dtype=torch.float64).to(device, non_blocking=True)


def without_autocast(values: Tensor) -> AbstractContextManager[object]:
    """Context in which products of matrices, which autocast would round, keep the dtype of ``values``."""
    device = values.device.type
    return torch.autocast(device, enabled=False) if _has_autocast(device) else nullcontext()


@constant_when_compiled
def _has_autocast(device: str) -> bool:
    return torch.amp.is_autocast_available(device)
