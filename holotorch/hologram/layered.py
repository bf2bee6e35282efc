"""LayerHologram: what all methods from planes of sources to a hologram have in common."""

from collections.abc import Sequence

from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.operator import linear
from holotorch.hologram.cone import Cone, check_cone, check_layers, check_scene


class LayerHologram(nn.Module):
    """A linear map from layers of sources to the field on a hologram, with its conjugate transpose.

    A method is its two halves ``_forward`` and ``_adjoint``; gradients of any order follow from them.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Of the planes, in metres, above 0; any order and spacing.
        cone: What is kept of each wave, see ``holotorch.hologram.cone``.
        stride: Pixels between neighbouring sources of a plane.

    Raises:
        TypeError, ValueError: Impossible arguments; in a call: layers that are not complex [..., D, h, w].
    """

    def __init__(self, grid: Grid, wavelength: float, depths: Sequence[float], cone: Cone, stride: int):
        super().__init__()
        self.grid = grid
        self.wavelength, self.depths, self.stride = check_scene(grid, wavelength, depths, stride)
        check_cone(cone, grid.pitch, self.wavelength)
        self.cone: Cone = cone

    def forward(self, layers: Tensor) -> Tensor:
        """Field [..., H, W] of ``layers``, complex [..., D, h, w], whose samples h // 2, w // 2 lie on the axis."""
        check_layers(layers, len(self.depths))
        shape = (layers.shape[-2], layers.shape[-1])
        if 0 in layers.shape[:-3]:  # a batch of no scenes
            return (layers.sum((-3, -2, -1))[..., None, None]).expand(*layers.shape[:-3], *self.grid.shape)
        return linear(layers, self._forward, lambda field: self._adjoint(field, shape))

    def adjoint(self, field: Tensor, shape: tuple[int, int] | None = None) -> Tensor:
        """Conjugate transpose: layers [..., D, h, w] from a field, complex [..., H, W].

        ``shape`` (h, w) is that of the layers; by default they cover the hologram, H / stride x W / stride rounded up.
        """
        checks.field("field", field, self.grid.shape)
        if shape is None:
            height, width = (-(-size // self.stride) for size in self.grid.shape)
            shape = height, width
        if 0 in field.shape[:-2]:  # a batch of no fields
            return field.sum((-2, -1))[..., None, None, None].expand(*field.shape[:-2], len(self.depths), *shape)
        return linear(field, lambda given: self._adjoint(given, shape), self._forward)

    def _forward(self, layers: Tensor) -> Tensor:
        raise NotImplementedError

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        raise NotImplementedError
