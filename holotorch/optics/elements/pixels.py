"""PixelShape: what a panel of pixels of finite size emits, higher diffraction orders included."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft, good_length, ifft_unscaled
from holotorch.core.grid import Grid, Pair
from holotorch.core.operator import FieldOperator
from holotorch.optics.free_space.impulse_response import tap_indices


class PixelShape(FieldOperator):
    """Map pixel values, complex [..., C, H, W], to the band-limited field that they emit, [..., C, sH, sW].

    Every pixel is a uniformly bright rectangle of ``fill`` times the pitch with dark gaps between. The spectrum of the
    panel repeats with the period 1 / pitch, once for each diffraction order, under the envelope sinc(fill pitch f) per
    axis. The band |f| < s / (2 pitch) with s = 2 orders + 1 is kept. It contains all orders up to ``orders`` on both
    sides completely and is sampled s times as finely as the panel. The result does not depend on the wavelength,
    so C is arbitrary.

    The amplitude is relative to that of the panel as point sources: a uniform panel of ones has 1 in its zero order,
    and ``fill`` near 0 with ``orders=0`` is the identity. The true amplitude for unit illumination is the result times
    fill[0] fill[1]; inside its rectangle a pixel of value 1 therefore has the amplitude 1 / (fill[0] fill[1]).

    The centre of pixel i of n on an axis is output sample s i for even n and s i + ``orders`` for odd n, at the same
    coordinate in both grids. Both grids have the same extent, so for even n the grid of the result begins at the centre
    of pixel 0: the light before this centre is cut off, as is all light outside the grid. No light wraps around.

    Args:
        grid: Sampling of the panel, one sample per pixel.
        fill: Side of the bright rectangle as a fraction of the pitch, above 0 and at most 1, one number or one per axis
            (y, x). The fill factor by area is fill[0] fill[1].
        orders: Highest diffraction order to keep, 0 for the zero order alone.

    Raises:
        TypeError: ``orders`` is not an integer or ``fill`` not a number.
        ValueError: ``orders`` below 0 or ``fill`` outside its range.
        MemoryError: In a call: the result needs more memory than is available.

    Source: Goodman, Sec. 2.4 (sampled functions) and 4.4 (rectangular aperture).
    """

    def __init__(self, grid: Grid, *, fill: float | Pair = 1.0, orders: int = 0):
        finer = 2 * checks.whole("orders", orders, 0) + 1
        (height, width), (y, x) = grid.shape, grid.pitch
        super().__init__(grid, None, Grid((finer * height, finer * width), (y / finer, x / finer)))
        self.fill, self.orders = _fill_pair(fill), (finer - 1) // 2
        for name, size, part in zip(("columns", "rows"), grid.shape, self.fill, strict=True):
            self.keep(name, _axis_kernel(size, part, finer))

    def _forward(self, field: Tensor) -> Tensor:
        height, width = self.out_grid.shape
        checks.affordable(
            5.5 * field.dtype.itemsize * (2 * self.orders + 1) ** 2 * field.numel(),  # measured
            f"PixelShape with orders={self.orders} on {height} x {width} samples",
            "use fewer orders, a smaller grid, or fewer fields at once",
            field.device,
        )
        for name in ("columns", "rows"):  # two transpositions restore the order of the axes
            field = _spread(field.transpose(-1, -2), getattr(self, name).to(field.dtype))
        return field

    def _adjoint(self, field: Tensor) -> Tensor:
        for name in ("rows", "columns"):
            field = _gather(field, getattr(self, name).to(field.dtype)).transpose(-1, -2)
        return field

    def extra_repr(self) -> str:
        """Samplings, fill and orders, for ``print(module)``."""
        return f"{super().extra_repr()}, fill={self.fill}, orders={self.orders}"


def order_efficiency(fill: float | Pair, order: Pair) -> float:
    """Fraction of the light on a uniform panel in one diffraction order: the product of (a sinc(m a))^2 over the axes.

    Per axis, a is ``fill`` of :class:`PixelShape` and m the order, whose direction has the sine m wavelength / pitch.
    Orders (y, x) need not be whole: if the phase rises by 2 pi t from pixel to pixel (a blazed panel), order m lies at
    m + t, which is the number to pass. All orders together contain fill[0] fill[1] of the light; the rest falls on the
    gaps between the pixels.

    Raises:
        TypeError: ``fill`` is not a number.
        ValueError: ``fill`` outside its range, or an order that is not a pair.

    Source: array theorem; Goodman, Sec. 4.4 (rectangular aperture, whose sinc^2 is sampled at the orders).
    """
    if not isinstance(order, Sequence) or len(order) != 2:
        raise ValueError(f"order must be a pair (y, x), got {order!r}")
    parts = zip(_fill_pair(fill), order, strict=True)
    return math.prod((part * float(np.sinc(checks.finite("order", number) * part))) ** 2 for part, number in parts)


def _fill_pair(fill: float | Pair) -> Pair:
    parts = tuple(fill) if isinstance(fill, Sequence) else (fill, fill)
    if len(parts) != 2:
        raise ValueError(f"fill must be one number or a pair (y, x), got {fill!r}")
    y, x = (checks.positive("fill", part) for part in parts)
    if max(y, x) > 1:
        raise ValueError(f"fill must be at most 1, a part of the pitch, got {fill!r}")
    return y, x


def _axis_kernel(size: int, fill: float, finer: int) -> Tensor:
    """DFT of the field of a pixel of value 1 at ``finer`` samples per pitch, divided by ``padded``: [finer, padded].

    The field at t pitches from the centre of the pixel is int_{-s/2}^{s/2} sinc(fill u) exp(2 pi i u t) du with
    s = ``finer``: the mean of s sinc(s x) over the bright width around t, computed by Gauss's rule to rounding error.
    """
    padded = good_length(2 * size - 1)
    centre = finer * size // 2 - finer * (size // 2)  # index of the output sample at the centre of a pixel
    position = tap_indices(padded, size, size) + (torch.arange(finer, dtype=torch.float64)[:, None] - centre) / finer
    nodes, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(16 + 2 * finer))
    taps = torch.sinc(finer * (position[..., None] + nodes * (fill / 2))) @ weights * (finer / 2)
    return torch.fft.fft(taps) / padded


def _spread(lines: Tensor, kernel: Tensor) -> Tensor:
    """Convolve lines [..., n] with each of the s kernels [s, padded] and interleave the results, [..., s n]."""
    spectrum = fft(lines, kernel.shape[-1])[..., None, :] * kernel
    phases = ifft_unscaled(spectrum)[..., : lines.shape[-1]]
    return phases.transpose(-1, -2).flatten(-2)


def _gather(lines: Tensor, kernel: Tensor) -> Tensor:
    """Conjugate transpose of :func:`_spread`: lines [..., s n] to [..., n]."""
    count, padded = kernel.shape
    phases = lines.unflatten(-1, (-1, count)).transpose(-1, -2)
    spectrum = (fft(phases, padded) * kernel.conj()).sum(-2)
    return ifft_unscaled(spectrum)[..., : lines.shape[-1] // count]
