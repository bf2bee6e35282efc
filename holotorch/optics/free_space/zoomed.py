"""ZoomedFilter: a spectral filter whose result is computed on another grid by the chirp-z transform."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core.fourier import fft, fft2, good_length, ifft2, ifft_unscaled, multiplied
from holotorch.core.grid import Grid, Pair
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.optics.free_space.kernels import cycles_phasor

Chirp = tuple[Tensor, Tensor, Tensor]


def chirp(size: int, step: float, start: float, count: int, device: torch.device | None = None) -> Chirp:
    """Factors with which :func:`zoom` evaluates a field at ``count`` points, ``step`` apart, beginning at ``start``.

    ``step`` and ``start`` are in samples of the field, which has ``size`` of them. The identity
    k j = (k^2 + j^2 - (j - k)^2) / 2 makes the sum over frequencies k a convolution with a chirp (Rabiner, Schafer and
    Rader 1969; Bluestein 1970). Returns the factor on the spectrum [size], the DFT of the convolving chirp
    [L >= size + count - 1] and the factor on the result [count], complex128.
    """
    index = torch.arange(size, dtype=torch.float64, device=device)
    index = torch.where(index >= (size + 1) // 2, index - size, index)
    target = torch.arange(count, dtype=torch.float64, device=device)
    length = good_length(size + count - 1)
    between = torch.arange(length, dtype=torch.float64, device=device)
    # Differences j - k in FFT order: from 0 to the largest, then from the most negative to -1.
    between = torch.where(between >= count + size // 2, between - length, between)
    rate = step / size
    pre_chirp = cycles_phasor(rate / 2 * index.square() + index * (start / size))
    post_chirp = cycles_phasor(rate / 2 * target.square()) / size
    return pre_chirp, torch.fft.fft(cycles_phasor(-rate / 2 * between.square())) / length, post_chirp


def zoom(spectrum: Tensor, factors: Chirp) -> Tensor:
    """Inverse DFT of ``spectrum`` [..., size], in FFT order, at the points of :func:`chirp`: [..., count]."""
    pre_chirp, kernel, post_chirp = factors
    size, half = len(pre_chirp), (len(pre_chirp) + 1) // 2
    lines = spectrum * pre_chirp
    gap = lines.new_zeros(*lines.shape[:-1], len(kernel) - size)
    lines = fft(torch.cat([lines[..., :half], gap, lines[..., half:]], -1))
    return ifft_unscaled(multiplied(lines, kernel))[..., : len(post_chirp)] * post_chirp


def zoom_adjoint(values: Tensor, factors: Chirp) -> Tensor:
    """Conjugate transpose of :func:`zoom`: ``values`` [..., count] to [..., size]."""
    pre_chirp, kernel, post_chirp = factors
    size, half = len(pre_chirp), (len(pre_chirp) + 1) // 2
    lines = fft(values * post_chirp.conj(), len(kernel))
    lines = ifft_unscaled(multiplied(lines, kernel.conj()))
    return torch.cat([lines[..., :half], lines[..., len(kernel) - size + half :]], -1) * pre_chirp.conj()


def chirps(
    grid: Grid, padded: Grid, out: Grid, offset: Sequence[float], device: torch.device | None = None
) -> list[Chirp]:
    """:func:`chirp` per axis (y, x) to evaluate a field of ``grid``, zero-padded to ``padded``, on the grid ``out``.

    ``offset`` is the position (y, x) in metres of the axis of ``out`` relative to the axis of ``grid``.
    """
    factors = []
    for axis in (0, 1):
        pitch, step, count = grid.pitch[axis], out.pitch[axis], out.shape[axis]
        start = (offset[axis] - count // 2 * step) / pitch + grid.shape[axis] // 2
        factors.append(chirp(padded.shape[axis], step / pitch, start, count, device))
    return factors


def zoomed(field: Tensor, kernel: Tensor, factors: Sequence[Chirp]) -> Tensor:
    """Filter ``field`` [..., h, w] with ``kernel`` [..., P, Q] and evaluate it at the points of :func:`chirps`."""
    spectrum = multiplied(fft2(field, (kernel.shape[-2], kernel.shape[-1])), kernel)
    columns, rows = ([part.to(spectrum.dtype) for part in chirp] for chirp in factors)
    lines = zoom(spectrum, (rows[0], rows[1], rows[2])).transpose(-1, -2)
    return zoom(lines, (columns[0], columns[1], columns[2])).transpose(-1, -2)


class ZoomedFilter(FieldOperator):
    """A filter that is diagonal in frequency and evaluated on a grid of any pitch.

    The padded result is a band-limited periodic field. It is summed from its spectrum at the points of ``out_grid``,
    which is exact as long as no light wraps around into them. It takes two to four times as long as a
    ``SpectralFilter``, whereas the cost of ``ResampledKernel`` grows with the cube of the size.

    Args:
        grid, wavelengths, out_grid: As for :class:`FieldOperator`.
        kernel: Transfer function, complex128 [C, P, Q] in FFT order; the field is zero-padded to P x Q samples.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
    """

    def __init__(self, grid: Grid, wavelengths: Wavelengths, kernel: Tensor, out_grid: Grid, *, offset: Pair = (0, 0)):
        super().__init__(grid, wavelengths, out_grid)
        padded = Grid((kernel.shape[-2], kernel.shape[-1]), grid.pitch)
        columns, rows = chirps(grid, padded, out_grid, offset)
        for i, part in enumerate((kernel, *columns, *rows)):
            self.keep(f"part{i}", part)

    def _forward(self, field: Tensor) -> Tensor:
        kernel, columns, rows = self._parts_for(field)
        return zoomed(field, kernel, (columns, rows))

    def _adjoint(self, field: Tensor) -> Tensor:
        kernel, columns, rows = self._parts_for(field)
        lines = zoom_adjoint(field.transpose(-1, -2), columns).transpose(-1, -2)
        spectrum = multiplied(zoom_adjoint(lines, rows), kernel.conj())
        # The adjoint of the unscaled transform is the inverse transform without its scale.
        return ifft2(spectrum, self.grid.shape) * math.prod(kernel.shape[-2:])

    def _parts_for(self, field: Tensor) -> tuple[Tensor, Chirp, Chirp]:
        parts = [getattr(self, f"part{i}").to(field.dtype) for i in range(7)]
        return parts[0], (parts[1], parts[2], parts[3]), (parts[4], parts[5], parts[6])
