"""LayerHologram: the common part of all operators from planes of point sources to a hologram."""

import math
from collections.abc import Callable, Sequence
from typing import get_args

from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.operator import linear
from holotorch.hologram.cone import Cone, check_scene
from holotorch.optics.free_space.padding import FINEST


class LayerHologram(nn.Module):
    """A linear map from layers of point sources to the complex field on a hologram, with its conjugate transpose.

    A subclass implements ``_forward`` and ``_adjoint`` for one batch axis B. From these two methods this class derives
    gradients of any order and support for ``vmap``.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Distances of the planes from the hologram in metres, above 0; any order and spacing.
        cone: The part of each spherical wave that is kept, see ``holotorch.hologram.cone``.
        stride: Distance between neighbouring sources of a plane in pixels.

    Raises:
        TypeError, ValueError: Invalid arguments; in a call: layers that are not complex [..., D, h, w].
    """

    def __init__(self, grid: Grid, wavelength: float, depths: Sequence[float], *, cone: Cone = "box", stride: int = 1):
        super().__init__()
        if any(isinstance(value, Tensor) and value.requires_grad for value in (wavelength, depths, *depths)):
            raise ValueError(
                f"{type(self).__name__} has fixed wavelength and depths, whose gradients would be lost here: propagate "
                "each plane with holotorch.optics.propagate and a distance that requires a gradient, and add the fields"
            )
        self.grid = grid
        self.wavelength, self.depths, self.stride = check_scene(grid, wavelength, depths, stride)
        if cone not in get_args(Cone):
            raise ValueError(f"cone must be one of {', '.join(map(repr, get_args(Cone)))}, got {cone!r}")
        if cone in ("taper", "band") and min(grid.pitch) < FINEST * self.wavelength:
            raise ValueError(
                f"cone={cone!r} needs a pitch of at least {FINEST} wavelengths, {FINEST * self.wavelength:.3g} m, got "
                f"{min(grid.pitch):g} m: use cone='box' of ConvolutionHologram"
            )
        self.cone: Cone = cone

    def forward(self, layers: Tensor) -> Tensor:
        """Field [..., H, W] of complex layers [..., D, h, w], one per depth; sample (h // 2, w // 2) is on the axis."""
        if not isinstance(layers, Tensor) or not layers.is_complex():
            kind = getattr(layers, "dtype", type(layers))
            raise TypeError(f"layers must be a complex tensor (..., D, h, w), got {kind}")
        count = len(self.depths)
        if layers.ndim < 3 or layers.shape[-3] != count or 0 in layers.shape[-2:]:
            raise ValueError(f"layers must end in (D, h, w) with D = {count} depths, got {tuple(layers.shape)}")
        # The length of a range is a number under torch.compile as well, which then compiles for every size.
        height, width = (len(range(n)) for n in layers.shape[-2:])
        return linear(layers, *self._maps((height, width)))

    def adjoint(self, field: Tensor, shape: tuple[int, int] | None = None) -> Tensor:
        """Conjugate transpose: layers [..., D, h, w] from a complex field [..., H, W] on the grid of the hologram.

        ``shape`` is the number of sources (h, w) of a layer; by default the number of pixels along each axis divided by
        ``stride`` and rounded up.
        """
        checks.field("field", field, self.grid.shape)
        height, width = shape or (-(-n // self.stride) for n in self.grid.shape)
        forward, adjoint = self._maps((height, width))
        return linear(field, adjoint, forward)

    def _maps(self, shape: tuple[int, int]) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
        """Functions for the operator and its adjoint with any number of batch axes; layers have ``shape`` (h, w)."""
        return (
            lambda layers: _flattened(self._forward, layers, 3),
            lambda field: _flattened(lambda flat: self._adjoint(flat, shape), field, 2),
        )

    def _forward(self, layers: Tensor) -> Tensor:
        """Fields [B, H, W] of layers [B, D, h, w]."""
        raise NotImplementedError

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        """Layers [B, D, h, w] of fields [B, H, W]; ``shape`` is (h, w)."""
        raise NotImplementedError


def _flattened(function: Callable[[Tensor], Tensor], x: Tensor, axes: int) -> Tensor:
    """Apply ``function``, which expects one batch axis before ``axes`` axes, to ``x`` with any number of batch axes."""
    batch = x.shape[:-axes]
    out = function(x.reshape(math.prod(batch), *x.shape[-axes:]))
    return out.reshape(*batch, *out.shape[1:])
