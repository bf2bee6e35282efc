"""PixelShape: what a panel of pixels of finite size emits, higher diffraction orders included."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.fourier import fft, good_length, ifft_unscaled
from holotorch.core.grid import Grid
from holotorch.optics.free_space.impulse_response import tap_indices


class PixelShape(nn.Module):
    """Pixel values, complex [..., C, H, W], to the band-limited field that they emit, [..., C, sH, sW].

    Every pixel is a uniformly bright rectangle of ``fill`` times the pitch, dark between. The panel's spectrum repeats
    every 1 / pitch, a repetition for each diffraction order, under the envelope sinc(fill pitch f) per axis. Kept is
    the band |f| < s / (2 pitch) with s = 2 orders + 1, which holds the orders up to +-``orders`` whole and which
    samples s times finer carry exactly. No wavelength enters, so C is free.

    The amplitude is relative to that of the panel as point sources: a uniform panel of ones has 1 in its zero order,
    and ``fill`` near 0 with ``orders=0`` is the identity. The true amplitude for unit illumination is this times
    ``fill[0] * fill[1]``; inside its rectangle a pixel of value 1 therefore shows 1 / (fill[0] fill[1]).

    Pixel i of an axis with n of them has its centre exactly on output sample s i + (s n) // 2 - s (n // 2), that is s i
    for even n and s i + ``orders`` for odd n, at the same coordinate in both grids. The two extents are equal, so for
    even n ``orders`` samples to the negative side of the centre of pixel 0 lie outside; what it emits there is cut off.
    It is a linear convolution: nothing wraps round. The cut band's tails beyond the grid are lost.

    Args:
        grid: Sampling of the panel, one sample per pixel.
        fill: Side of a pixel's bright rectangle as a part of the pitch, above 0 and at most 1, per axis (y, x) or one
            for both; the root of the usual fill factor, which is one of areas.
        orders: Highest diffraction order to keep, 0 for the zero order alone.

    Raises:
        TypeError: ``orders`` is no integer or ``fill`` no number; in a call: a real field.
        ValueError: ``orders`` below 0 or ``fill`` outside its range; in a call: a field of another shape.
        MemoryError: In a call: the result needs more memory than is available.

    Source: Goodman, Sec. 2.4 (sampled functions) and 4.4 (rectangular aperture).
    """

    columns: Tensor
    rows: Tensor

    def __init__(self, grid: Grid, *, fill: float | tuple[float, float] = 1.0, orders: int = 0):
        super().__init__()
        self.grid, self.fill, self.orders = grid, _fill_pair(fill), checks.whole("orders", orders, 0)
        finer = 2 * self.orders + 1
        (height, width), (y, x) = grid.shape, grid.pitch
        self.out_grid = Grid((finer * height, finer * width), (y / finer, x / finer))
        for name, size, part in zip(("columns", "rows"), grid.shape, self.fill, strict=True):
            kernel = torch.view_as_real(_axis_kernel(size, part, finer))
            self.register_buffer(name, kernel.contiguous(), persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Emit from pixel values ``field``, complex [..., C, H, W]; returns [..., C, sH, sW] in the same dtype."""
        checks.field("field", field, self.grid.shape)
        height, width = self.out_grid.shape
        checks.affordable(
            5.5 * field.dtype.itemsize * (2 * self.orders + 1) ** 2 * field.numel(),  # measured
            f"PixelShape with orders={self.orders} on {height} x {width} samples",
            "use fewer orders, a smaller grid, or fewer fields at once",
            field.device,
        )
        for kernel in self._kernels_for(field):
            # Columns first: each turn brings the other axis to the end, and two bring both home.
            field = _spread(field.transpose(-1, -2), kernel)
        return field

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, sH, sW] of the output grid."""
        checks.field("field", field, self.out_grid.shape)
        for kernel in reversed(self._kernels_for(field)):
            field = _gather(field, kernel).transpose(-1, -2)
        return field

    def extra_repr(self) -> str:
        """Samplings, fill and orders, for ``print(module)``."""
        return f"grid={self.grid}, out_grid={self.out_grid}, fill={self.fill}, orders={self.orders}"

    def _kernels_for(self, field: Tensor) -> tuple[Tensor, Tensor]:
        columns, rows = (torch.view_as_complex(part.to(field.real.dtype)) for part in (self.columns, self.rows))
        return columns, rows

    def _apply(self, fn, recurse=True):
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)


def order_efficiency(fill: float | tuple[float, float], order: tuple[float, float]) -> float:
    """Part of the light on a uniform panel that goes into one diffraction order: the product of (a sinc(m a))^2.

    Per axis, a is ``fill`` as in :class:`PixelShape` and m the order, in directions sin(angle) = m wavelength / pitch.
    An order (y, x) need not be whole: on a blazed panel, whose phase rises by 2 pi t from pixel to pixel, order m is
    found at m + t, and that is the number to give. All orders together hold fill[0] * fill[1]; the rest falls between
    the pixels. Raises as :class:`PixelShape` does.

    Source: array theorem; Goodman, Sec. 4.4 (rectangular aperture, whose sinc^2 is sampled by the grating's orders).
    """
    if not isinstance(order, Sequence) or len(order) != 2:
        raise ValueError(f"order must be a pair (y, x), got {order!r}")
    efficiency = 1.0
    for part, number in zip(_fill_pair(fill), order, strict=True):
        efficiency *= (part * float(np.sinc(checks.finite("order", number) * part))) ** 2
    return efficiency


def _fill_pair(fill: float | tuple[float, float]) -> tuple[float, float]:
    parts = tuple(fill) if isinstance(fill, Sequence) else (fill, fill)
    if len(parts) != 2:
        raise ValueError(f"fill must be one number or a pair (y, x), got {fill!r}")
    y, x = (checks.positive("fill", part) for part in parts)
    if max(y, x) > 1:
        raise ValueError(f"fill must be at most 1, a part of the pitch, got {fill!r}")
    return y, x


def _pixel_taps(place: Tensor, fill: float, finer: int) -> Tensor:
    """Field of a single pixel of value 1 at ``place``, in pitches from its centre, float64 of any shape.

    int_{-s/2}^{s/2} sinc(fill u) exp(2 pi i u place) du with s = ``finer``, u in cycles per pitch. That is the mean of
    s sinc(s t) over the bright width around ``place``, without a difference of sine integrals that cancels for small
    fills. The mean is Gauss's rule; its error is rounding once twice the nodes exceed pi s fill / 2 turned radians.
    """
    nodes, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(16 + 2 * finer))
    return torch.sinc(finer * (place[..., None] + nodes * (fill / 2))) @ weights * (finer / 2)


def _axis_kernel(size: int, fill: float, finer: int) -> Tensor:
    """DFT of the taps for each of the ``finer`` output samples of a pixel, complex128 [finer, padded].

    Padded to twice the window, so that every displacement has its own tap. Divided by the padded length: the inverse
    transforms below then need no scale of their own, see ``core.fourier``.
    """
    padded = good_length(2 * size - 1)
    centre = finer * size // 2 - finer * (size // 2)  # the output sample of a pixel that is its centre
    place = tap_indices(padded, size, size) + (torch.arange(finer, dtype=torch.float64)[:, None] - centre) / finer
    return torch.fft.fft(_pixel_taps(place, fill, finer)) / padded


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
