"""Sources and pixels on one periodic array: their positions, the spectra of layers, and the field on the pixels."""

import math

import torch
from torch import Tensor

from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid

_PROBE_STEP = 251  # distance between the elements that ``has_light`` tests before it tests all of them


class Raster:
    """A periodic array of ``size`` samples (N_y, N_x) that holds the pixels and the sources, ``stride`` samples apart.

    The sources begin at sample 0. Their spectrum has the period N / stride, so an FFT of that length is repeated.

    Args:
        grid: Pixels of the hologram.
        shape: Number of sources (h, w) of a layer.
        stride: Distance between neighbouring sources in pixels.
        size: Size of the array in samples (N_y, N_x), multiples of ``stride``.
    """

    def __init__(self, grid: Grid, shape: tuple[int, int], stride: int, size: tuple[int, int]):
        self.grid, self.shape, self.stride, self.size = grid, shape, stride, size
        self.period = size[0] // stride, size[1] // stride
        # Position of the first pixel along each axis, in samples.
        self.first = [
            (count // 2 * stride - pixels // 2) % length
            for count, pixels, length in zip(shape, grid.shape, size, strict=True)
        ]

    def spectrum(self, layer: Tensor) -> Tensor:
        """One period of the spectrum of a layer [h, w]: [N_y / stride, N_x / stride]."""
        return fft2(layer, self.period)

    def repeated(self, period: Tensor) -> Tensor:
        """The whole spectrum of ``size`` from one period, as a new tensor."""
        return period.repeat(self.stride, self.stride)

    def tiles(self, spectrum: Tensor) -> Tensor:
        """View of a whole spectrum [..., N_y, N_x] divided into periods, [..., s, N_y / s, s, N_x / s], s = stride."""
        y, x = self.period
        return spectrum.view(*spectrum.shape[:-2], self.stride, y, self.stride, x)

    def pixels(self, spectrum: Tensor) -> Tensor:
        """Field on the hologram [H, W] from a whole spectrum."""
        return ifft2(spectrum, self.grid.shape, (self.first[0], self.first[1]))

    def spectrum_of_pixels(self, field: Tensor) -> Tensor:
        """Adjoint of :meth:`pixels`."""
        rows, columns = (
            (torch.arange(count, device=field.device) + first) % length
            for first, count, length in zip(self.first, self.grid.shape, self.size, strict=True)
        )
        padded = field.new_zeros(self.size)
        padded[rows[:, None], columns] = field
        return fft2(padded) * (1 / math.prod(self.size))

    def layer(self, spectrum: Tensor) -> Tensor:
        """Adjoint of :meth:`spectrum` followed by :meth:`repeated`: a layer [h, w] from a whole spectrum."""
        folded = self.tiles(spectrum).sum((-4, -2))
        return ifft2(folded, self.shape) * math.prod(self.period)


def span(grid: Grid, shape: tuple[int, int], stride: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Largest distance between a source and a pixel, and the larger extent of the two, each (y, x) in samples."""
    apart, least = [], []
    for count, pixels in zip(shape, grid.shape, strict=True):
        low, high = -(count // 2) * stride, (count - 1 - count // 2) * stride
        apart.append(max(pixels - 1 - pixels // 2 - low, high + pixels // 2))
        least.append(max(high - low + 1, pixels))
    return (apart[0], apart[1]), (least[0], least[1])


def strided_length(minimum: int, stride: int) -> int:
    """Smallest length >= ``minimum`` that is ``stride`` times a length with small prime factors, for the FFT."""
    return stride * good_length(-(-minimum // stride))


def has_light(plane: Tensor) -> bool:
    """Whether any element is not zero (NaN counts as light). Tests a few elements first, then all of them."""
    if plane.is_complex():
        plane = torch.view_as_real(plane.resolve_conj())
    if plane.is_contiguous() and plane.detach().view(-1)[::_PROBE_STEP].any():
        return True
    low, high = torch.aminmax(plane.detach())
    return bool((low != 0) | (high != 0))
