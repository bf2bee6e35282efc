"""What the rest of the library calls a linear operator."""

from typing import Protocol

from torch import Tensor


class LinearOperator(Protocol):
    """A linear map with its conjugate transpose, which is its inverse where it is unitary."""

    def __call__(self, field: Tensor, /) -> Tensor:
        """Apply it to ``field`` [..., C, H, W]."""
        ...

    def adjoint(self, field: Tensor, /) -> Tensor:
        """Apply the conjugate transpose."""
        ...
