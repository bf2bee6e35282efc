"""Sources and pixels on one periodic array: their positions, the spectra of layers, and the field on the pixels."""

import math

import torch
from torch import Tensor

from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid


class Raster:
    """A periodic array of samples at the pixel pitch, which holds both the sources of a layer and the pixels.

    ``grid`` holds the pixels, ``shape`` is the number of sources (h, w) and ``size`` the number of samples (N_y, N_x),
    multiples of ``stride``. The sources begin at sample 0 and lie ``stride`` samples apart. Their spectrum therefore
    has the period (N_y / stride, N_x / stride), and an FFT of that size suffices.
    """

    def __init__(self, grid: Grid, shape: tuple[int, int], stride: int, size: tuple[int, int]):
        self.grid, self.shape, self.stride, self.size = grid, shape, stride, size
        self.period = size[0] // stride, size[1] // stride
        # Index of the sample at the first pixel, along each axis.
        self.first = [
            (count // 2 * stride - pixels // 2) % length
            for count, pixels, length in zip(shape, grid.shape, size, strict=True)
        ]

    def frequencies(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Frequencies (fy, fx) >= 0 of the array in cycles per metre, [N_y // 2 + 1, 1] and [1, N_x // 2 + 1]."""
        fy, fx = (
            torch.arange(length // 2 + 1, dtype=torch.float64, device=device) / (length * pitch)
            for length, pitch in zip(self.size, self.grid.pitch, strict=True)
        )
        return fy[:, None], fx[None, :]

    def spectrum(self, layer: Tensor) -> Tensor:
        """One period of the spectrum of a layer [h, w]: [N_y / stride, N_x / stride]."""
        return fft2(layer, self.period)

    def tiles(self, spectrum: Tensor) -> Tensor:
        """View of a whole spectrum [N_y, N_x] divided into periods, [s, N_y / s, s, N_x / s] with s = stride."""
        y, x = self.period
        return spectrum.view(self.stride, y, self.stride, x)

    def pixels(self, spectrum: Tensor) -> Tensor:
        """Field on the hologram [H, W] from a whole spectrum [N_y, N_x]."""
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
        """Adjoint of :meth:`spectrum` with repetition of its period: a layer [h, w] from a whole spectrum."""
        folded = self.tiles(spectrum).sum((0, 2))
        return ifft2(folded, self.shape) * math.prod(self.period)


def span(grid: Grid, shape: tuple[int, int], stride: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Largest displacement from a source to a pixel, and larger extent of sources or pixels, each (y, x) in samples."""
    displacement, extent = [], []
    for count, pixels in zip(shape, grid.shape, strict=True):
        before, after = count // 2 * stride, (count - 1 - count // 2) * stride
        displacement.append(max(pixels - 1 - pixels // 2 + before, after + pixels // 2))
        extent.append(max(before + after + 1, pixels))
    return (displacement[0], displacement[1]), (extent[0], extent[1])


def strided_length(minimum: int, stride: int) -> int:
    """Smallest length >= ``minimum`` that is ``stride`` times a length with a fast FFT."""
    return stride * good_length(-(-minimum // stride))


def has_light(plane: Tensor) -> bool:
    """Whether any element is not zero (NaN counts as light). Tests a few elements before all of them, for speed."""
    return bool(plane.flatten()[::251].any() or plane.any())
