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
    """``apply(x)`` with ``adjoint`` as its derivative, of any order; no tensor is saved for the backward pass.

    Both functions are linear and accept leading batch axes.
    """
    return _Linear.apply(x, apply, adjoint)  # type: ignore[return-value]


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        return apply(x)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.maps = inputs[2], inputs[1]

    @staticmethod
    def vmap(info, in_dims, *args):
        # Operators accept leading batch axes, so the mapped axis becomes one.
        x, *maps = args
        return _Linear.apply(x.movedim(in_dims[0], 0), *maps), 0

    @staticmethod
    def backward(ctx, *grad_outputs):
        return _Linear.apply(*grad_outputs, *ctx.maps), None, None
