"""Raster: one periodic array that holds sources and pixels, with transforms between layers, spectra and fields."""

import math

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid


class Raster:
    """A periodic array of samples at the pixel pitch, which holds both the sources of a layer and the pixels.

    ``grid`` describes the pixels, ``shape`` is the number of sources (h, w). ``size`` is the number of samples
    (N_y, N_x), both multiples of ``stride``. The sources begin at sample 0 and lie ``stride`` samples apart. Their
    spectrum [N_y, N_x] therefore repeats after (N_y / stride, N_x / stride), and an FFT of that size suffices.
    """

    def __init__(self, grid: Grid, shape: tuple[int, int], stride: int, size: tuple[int, int]):
        self.grid, self.shape, self.stride, self.size = grid, shape, stride, size
        self.period = size[0] // stride, size[1] // stride
        # Sample at which the first pixel lies, along (y, x).
        self.first = [
            (count // 2 * stride - pixels // 2) % length
            for count, pixels, length in zip(shape, grid.shape, size, strict=True)
        ]

    def frequencies(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Nonnegative frequencies fy [N_y // 2 + 1, 1] and fx [1, N_x // 2 + 1] of the array in cycles per metre."""
        fy, fx = (
            torch.arange(length // 2 + 1, dtype=torch.float64, device=device) / (length * pitch)
            for length, pitch in zip(self.size, self.grid.pitch, strict=True)
        )
        return fy[:, None], fx[None, :]

    def spectrum(self, layer: Tensor) -> Tensor:
        """One period of the spectrum of a layer [h, w]: [N_y / stride, N_x / stride]."""
        return fft2(layer, self.period)

    def tiles(self, spectrum: Tensor) -> Tensor:
        """View of a spectrum [N_y, N_x] as a matrix of periods, [s, N_y / s, s, N_x / s] with s = ``stride``."""
        y, x = self.period
        return spectrum.view(self.stride, y, self.stride, x)

    def pixels(self, spectrum: Tensor) -> Tensor:
        """Field on the pixels of the hologram, [H, W], from its spectrum [N_y, N_x] on the array."""
        return ifft2(spectrum, self.grid.shape, (self.first[0], self.first[1]))

    def spectrum_of_pixels(self, field: Tensor) -> Tensor:
        """Adjoint of :meth:`pixels`: a spectrum [N_y, N_x] from a field [H, W]."""
        rows, columns = (
            (torch.arange(count, device=field.device) + first) % length
            for first, count, length in zip(self.first, self.grid.shape, self.size, strict=True)
        )
        padded = field.new_zeros(self.size)
        padded[rows[:, None], columns] = field
        return fft2(padded) * (1 / math.prod(self.size))

    def layer(self, spectrum: Tensor) -> Tensor:
        """Layer [h, w] from a spectrum [N_y, N_x]: adjoint of :meth:`spectrum` followed by repetition of the period."""
        folded = self.tiles(spectrum).sum((0, 2))
        return ifft2(folded, self.shape) * math.prod(self.period)


def span(grid: Grid, shape: tuple[int, int], stride: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Largest displacement from a source to a pixel, and the larger extent, of sources or pixels: (y, x) in samples."""
    displacement, extent = [], []
    for count, pixels in zip(shape, grid.shape, strict=True):
        before, after = count // 2 * stride, (count - 1 - count // 2) * stride
        displacement.append(max(pixels - 1 - pixels // 2 + before, after + pixels // 2))
        extent.append(max(before + after + 1, pixels))
    return (displacement[0], displacement[1]), (extent[0], extent[1])


def strided_length(minimum: int, stride: int) -> int:
    """Smallest length >= ``minimum`` that is ``stride`` times a length with a fast FFT."""
    return stride * good_length(-(-minimum // stride))


def has_light(values: Tensor) -> bool:
    """Whether an element may differ from zero; NaN does. Values that are not ``checks.readable`` may.

    For speed, a few elements are tested before all of them.
    """
    return not checks.readable(values) or bool(values.flatten()[::251].any() or values.any())
