"""DepthStack: propagation of one hologram to several depths with one forward transform."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.fourier import fft2, ifft2
from holotorch.optics.free_space.propagators import SpectralFilter


class DepthStack(nn.Module):
    """Propagation of fields, complex [..., C, H, W], to D depths at once, [..., C, D, H, W].

    Args:
        filters: D propagators with the same grid, wavelengths and padded size.

    Raises:
        TypeError: A propagator that is not a ``SpectralFilter``.
        ValueError: No filters, filters that differ in grid, wavelengths or padded size, or a filter whose result has
            another grid than the field.
    """

    image_axes = 3  # of a result: (D, H, W)

    def __init__(self, filters: Sequence[SpectralFilter]):
        super().__init__()
        if not filters:
            raise ValueError("DepthStack needs at least one propagator")
        if not all(isinstance(operator, SpectralFilter) for operator in filters):
            raise TypeError("DepthStack needs propagators that are filters in frequency, such as Fresnel")
        first = filters[0]
        if first.out_grid != first.grid:
            raise ValueError("DepthStack needs propagators whose result has the grid of the field")
        if len({(operator.grid, operator.out_grid, operator.wavelengths, operator.padded) for operator in filters}) > 1:
            raise ValueError("DepthStack needs propagators of one grid, one set of wavelengths and one padded size")
        self.filters = nn.ModuleList(filters)
        self.grid, self.wavelengths = first.grid, first.wavelengths

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field`` [..., C, H, W] to all depths, [..., C, D, H, W], same dtype."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        kernels = [operator.kernel_for(field) for operator in self._filters()]
        spectrum = fft2(field, (kernels[0].shape[-2], kernels[0].shape[-1]))
        return torch.stack([ifft2(spectrum * kernel, self.grid.shape) for kernel in kernels], -3)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, D, H, W]."""
        expected = len(self.wavelengths), len(self.filters), *self.grid.shape
        if tuple(field.shape[-4:]) != expected:
            raise ValueError(f"field must end in (C, D, H, W) = {expected}, got {tuple(field.shape)}")
        parts = zip(self._filters(), field.unbind(-3), strict=True)
        return torch.stack([operator.adjoint(part) for operator, part in parts]).sum(0)

    def _filters(self) -> list[SpectralFilter]:
        return [each for each in self.filters if isinstance(each, SpectralFilter)]  # typed, unlike a ModuleList
