"""DepthStack: one hologram to several depths, from one forward transform."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.fourier import fft2, ifft2
from holotorch.optics.free_space.propagators import SpectralFilter


class DepthStack(nn.Module):
    """Fields complex [..., C, H, W] to their propagations to D depths, [..., C, D, H, W].

    Args:
        filters: Propagators to each depth, of one grid, one set of wavelengths and one padded size.

    Raises:
        TypeError: A propagator that is no ``SpectralFilter``.
        ValueError: No filters, ones that differ in these, or whose result has another grid than the field.
    """

    def __init__(self, filters: Sequence[SpectralFilter]):
        super().__init__()
        if not filters:
            raise ValueError("DepthStack needs at least one propagator")
        if not all(isinstance(each, SpectralFilter) for each in filters):
            raise TypeError("DepthStack needs propagators that are filters in frequency, such as Fresnel")
        first = filters[0]
        if first.out_grid != first.grid:
            raise ValueError("DepthStack needs propagators whose result has the grid of the field")
        for each in filters[1:]:
            if _kind(each) != _kind(first):
                raise ValueError("DepthStack needs propagators of one grid, one set of wavelengths and one padded size")
        self.filters = nn.ModuleList(filters)
        self.grid, self.wavelengths = first.grid, first.wavelengths

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field`` [..., C, H, W] to all depths, [..., C, D, H, W], same dtype."""
        kernels = self._kernels_for(field)
        spectrum = fft2(field, (kernels[0].shape[-2], kernels[0].shape[-1]))
        return torch.stack([ifft2(spectrum * kernel, self.grid.shape) for kernel in kernels], -3)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, D, H, W]."""
        expected = len(self.wavelengths), len(self.filters), *self.grid.shape
        if tuple(field.shape[-4:]) != expected:
            raise ValueError(f"field must end in (C, D, H, W) = {expected}, got {tuple(field.shape)}")
        parts = zip(self._each(), field.unbind(-3), strict=True)
        return torch.stack([each.adjoint(part) for each, part in parts]).sum(0)

    def _kernels_for(self, field: Tensor) -> list[Tensor]:
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        single = field.dtype == torch.complex64
        return [torch.view_as_complex(each.single if single else each.kernel) for each in self._each()]

    def _each(self) -> list[SpectralFilter]:
        return [each for each in self.filters if isinstance(each, SpectralFilter)]


def _kind(each: SpectralFilter) -> tuple:
    return each.grid, each.out_grid, each.wavelengths, each.kernel.shape
