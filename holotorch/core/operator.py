"""Linear operators: their protocol, a base class for operators on fields, and autograd with a given adjoint."""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.learning import PreciseModule

Wavelengths = float | Sequence[float] | Tensor  # in metres: one number, or one per channel


class LinearOperator(Protocol):
    """A linear map and its conjugate transpose."""

    def __call__(self, field: Tensor, /) -> Tensor:
        """Apply the operator to ``field`` [..., C, H, W]."""
        ...

    def adjoint(self, field: Tensor, /) -> Tensor:
        """Apply the conjugate transpose."""
        ...


class FieldOperator(PreciseModule):
    """Base class of operators from fields [..., C, H, W] on ``grid`` to fields [..., C, H', W'] on ``out_grid``.

    Fields are complex64 or complex128 and keep their dtype. Kernels are computed in float64, and converted to the
    precision of the field. Subclasses implement ``_forward`` and ``_adjoint``, which receive a checked field.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel; None for an operator that takes any number of channels.
        out_grid: Sampling of the result; ``grid`` by default.
    """

    wavelengths: tuple[float, ...]

    def __init__(self, grid: Grid, wavelengths: Wavelengths | None, out_grid: Grid | None = None):
        super().__init__()
        self.grid, self.out_grid = grid, out_grid or grid
        if wavelengths is not None:
            self.wavelengths = checks.wavelengths(wavelengths)

    def forward(self, field: Tensor) -> Tensor:
        """Apply the operator to ``field`` [..., C, H, W] of ``grid``.

        Returns [..., C, H', W'] of ``out_grid`` in the same dtype. Raises TypeError for a real field and ValueError for
        a field of another shape.
        """
        self.check_field(field, self.grid)
        return self._forward(field)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W']; the result [..., C, H, W] is on ``grid``."""
        self.check_field(field, self.out_grid)
        return self._adjoint(field)

    def _forward(self, field: Tensor) -> Tensor:
        raise NotImplementedError

    def _adjoint(self, field: Tensor) -> Tensor:
        raise NotImplementedError

    def check_field(self, field: Tensor, grid: Grid) -> None:
        """Raise TypeError unless ``field`` is complex, and ValueError unless it ends in [C, H, W] of ``grid``."""
        channels = (len(self.wavelengths),) if hasattr(self, "wavelengths") else ()
        checks.field("field", field, (*channels, *grid.shape))

    def extra_repr(self) -> str:
        """Samplings and wavelengths, for ``print(module)``."""
        names = ["grid"] + ["out_grid"] * (self.out_grid != self.grid) + ["wavelengths"] * hasattr(self, "wavelengths")
        return ", ".join(f"{name}={getattr(self, name)}" for name in names)


def linear(x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
    """Return ``apply(x)``. Its derivatives of any order use ``adjoint`` and save no tensor for the backward pass.

    Both functions are linear and accept leading batch axes.
    """
    function = _Linear if torch.compiler.is_compiling() else _Differentiable
    return function.apply(x, apply, adjoint)  # type: ignore[return-value]


class _Linear(torch.autograd.Function):
    """A linear map without forward-mode derivative, which torch.compile does not accept where gradients are needed."""

    @staticmethod
    def forward(x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        return apply(x)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.maps = inputs[2], inputs[1]

    @staticmethod
    def vmap(info, in_dims, *args):
        # Both maps accept leading batch axes, so the mapped axis becomes a batch axis.
        x, *maps = args
        return linear(x.movedim(in_dims[0], 0), *maps), 0

    @staticmethod
    def backward(ctx, *grad_outputs):
        return linear(*grad_outputs, *ctx.maps), None, None


class _Differentiable(_Linear):
    @staticmethod
    def jvp(ctx, *tangents):
        return linear(tangents[0], *reversed(ctx.maps))
