"""DirectHologram: the exact sum over all pairs of a source and a pixel, the reference for the faster methods."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.hologram.band_limited import band_limited_wave
from holotorch.hologram.cone import Cone, cone_samples, is_plain, spherical_wave
from holotorch.hologram.layered import LayerHologram
from holotorch.hologram.raster import has_light

_EXACT = 1e-8  # relative difference below which the closed form of the full wave replaces the tapered wave


class DirectHologram(LayerHologram):
    """E(x) = sum_v A(v) exp(i phi(v)) exp(i k r) / r, thesis Eq. 5.1 and Algorithm 4, without FFT, in float64.

    Here v runs over the sources and r is the distance from source v to the pixel at x. Sources and pixels lie on
    regular grids, so the wave is computed once for all pairs with the same displacement. The waves from a row of
    sources to a row of pixels form a matrix, which is the same for all pairs of rows at the same distance. There is no
    wrap-around. Rows and columns of dark sources, and rows of pixels outside the cone, are skipped.

    Arguments and exceptions as for :class:`LayerHologram`. For ``cone`` "taper" and "band" the waves are integrals over
    frequency, with a relative error of 1e-8.
    """

    def pairs(self, layers: Tensor) -> int:
        """Number of pairs of a nonzero source in ``layers`` [D, h, w] and a pixel (for "box" and "disc", in a box)."""
        total = 0
        for plane, depth in zip(layers, self.depths, strict=True):
            sharp = self.cone in ("box", "disc")
            half = cone_samples(self.grid, self.wavelength, depth) if sharp else (math.inf, math.inf)
            counts = []
            for axis in (0, 1):
                positions = torch.tensor(self._positions(plane.shape[axis], axis))
                counts.append(((torch.arange(self.grid.shape[axis])[:, None] - positions).abs() <= half[axis]).sum(0))
            total += int(((plane != 0) * (counts[0][:, None] * counts[1])).sum())
        return total

    def _forward(self, layers: Tensor) -> Tensor:
        out = layers.new_zeros(len(layers), *self.grid.shape, dtype=torch.complex128)
        for item, field in zip(layers.to(out.dtype), out, strict=True):
            for plane, depth in zip(item, self.depths, strict=True):
                rows, columns = _lit(plane)
                if not rows:
                    continue
                positions = self._positions(plane.shape[0], 0)
                if len(rows) < len(plane):
                    plane, positions = plane[rows], [positions[row] for row in rows]
                sources = plane[:, columns.start : columns.stop].flip(-1)
                for matrix, pairs in self._row_matrices(depth, plane.shape[1], columns, positions, plane.device):
                    product = sources @ matrix
                    for inside, target in pairs:
                        field.index_add_(0, target, product[inside])
        return out.to(layers.dtype)

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        out = field.new_zeros(len(field), len(self.depths), *shape, dtype=torch.complex128)
        everywhere = range(shape[1]), self._positions(shape[0], 0)
        for item, layers in zip(field.to(out.dtype), out, strict=True):
            for plane, depth in zip(layers, self.depths, strict=True):
                back = torch.zeros_like(plane)
                for matrix, pairs in self._row_matrices(depth, shape[1], *everywhere, item.device):
                    received = item.new_zeros(shape[0], self.grid.shape[1])
                    for inside, target in pairs:
                        received[inside] += item[target]
                    back += received @ matrix.mH
                plane.copy_(back.flip(-1))
        return out.to(field.dtype)

    def _positions(self, sources: int, axis: int) -> range:
        """Position of each of the ``sources`` along an axis as a pixel index, possibly outside the hologram."""
        first = self.grid.shape[axis] // 2 - sources // 2 * self.stride
        return range(first, first + sources * self.stride, self.stride)

    def _row_matrices(
        self, depth: float, width: int, columns: range, positions: Sequence[int], device: torch.device
    ) -> Iterator[tuple[Tensor, list[tuple[slice, Tensor]]]]:
        """For each distance between a source row and a pixel row, yield the waves, and all such pairs of rows.

        The waves are complex128 [columns, W], from the last source column to the first. There is one entry for pixel
        rows above the source rows and one for those below: the source rows, and the indices of their pixel rows.
        ``width`` is the number of sources in a row, ``columns`` are those to compute, and ``positions`` is the position
        of each source row as a pixel index, rising.
        """
        (height, pixels), stride = self.grid.shape, self.stride
        farthest = max(height - 1 - positions[0], positions[-1])
        if self.cone in ("box", "disc"):
            farthest = int(min(farthest, cone_samples(self.grid, self.wavelength, depth)[0] + 1))
        # Displacements of pixels from the last source; those from the source before it begin ``stride`` samples later.
        count, last = (len(columns) - 1) * stride + pixels, self._positions(width, 1)[columns[-1]]
        index = (torch.arange(count, device=device) - last).abs()
        wave_row = self._wave_rows(depth, farthest, max(abs(last), abs(count - 1 - last)), device)
        rows = torch.tensor(positions).to(device, non_blocking=True)
        for offset in range(farthest + 1):
            wave = wave_row(offset)[index]
            if has_light(wave):
                pairs = []
                for step in (offset, -offset) if offset else (0,):
                    inside = slice(*(sum(position < end - step for position in positions) for end in (0, height)))
                    pairs.append((inside, rows[inside] + step))
                yield wave.as_strided((len(columns), pixels), (stride, 1)).clone(), pairs

    def _wave_rows(self, depth: float, rows: int, columns: int, device: torch.device) -> Callable[[int], Tensor]:
        """Function from a row distance, in samples, to the wave at column distances 0 to ``columns``."""
        pitch, counts = self.grid.pitch, (rows + 1, columns + 1)
        plain = self.cone == "taper" and is_plain(self.grid, self.wavelength, depth, (rows, columns), _EXACT)
        if self.cone in ("taper", "band") and not plain:
            soft = self.cone == "taper"
            quadrant = band_limited_wave(counts, pitch, self.wavelength, depth, soft=soft, device=device)
            return lambda offset: quadrant[offset]
        cone: Cone = "full" if plain else self.cone
        dy, dx = (
            torch.arange(count, dtype=torch.float64, device=device) * step
            for count, step in zip(counts, pitch, strict=True)
        )
        return lambda offset: spherical_wave(dy[offset], dx, pitch, self.wavelength, depth, cone)


def _lit(plane: Tensor) -> tuple[Sequence[int], range]:
    """Rows of a plane [h, w] that may have light, and the range of columns between the outermost ones that may."""
    height, width = plane.shape
    if not checks.readable(plane):
        return range(height), range(width)
    rows, columns = (plane.any(axis).nonzero().flatten().tolist() for axis in (1, 0))
    return rows, range(columns[0], columns[-1] + 1) if columns else range(0)
