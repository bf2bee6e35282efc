"""LinearOperator: the protocol of linear operators, and a function with a given adjoint as derivative."""

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor


class LinearOperator(Protocol):
    """A linear map with its conjugate transpose, which is its inverse where it is unitary."""

    def __call__(self, field: Tensor, /) -> Tensor:
        """Apply it to ``field`` [..., C, H, W]."""
        ...

    def adjoint(self, field: Tensor, /) -> Tensor:
        """Apply the conjugate transpose."""
        ...


def linear(x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
    """``apply(x)`` with ``adjoint`` as its derivative, of any order, whatever either does inside; keeps no tensor."""
    return _Linear.apply(x, apply, adjoint)  # type: ignore[return-value]


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.maps = adjoint, apply
        return apply(x)

    @staticmethod
    def backward(ctx, *grad_outputs):
        return _Linear.apply(*grad_outputs, *ctx.maps), None, None
