"""DirectHologram: the exact sum over all pairs of a source and a pixel, the reference for the faster methods."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from holotorch.hologram.band_limited import band_limited_wave
from holotorch.hologram.cone import Cone, cone_samples, is_plain, spherical_wave
from holotorch.hologram.layered import LayerHologram

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
                positions = self._positions(plane.shape[axis], axis)
                counts.append(((torch.arange(self.grid.shape[axis])[:, None] - positions).abs() <= half[axis]).sum(0))
            total += int(((plane != 0) * (counts[0][:, None] * counts[1])).sum())
        return total

    def _forward(self, layers: Tensor) -> Tensor:
        out = layers.new_zeros(len(layers), *self.grid.shape, dtype=torch.complex128)
        for item, field in zip(layers.to(out.dtype), out, strict=True):
            for plane, depth in zip(item, self.depths, strict=True):
                rows, columns = plane.any(1).nonzero()[:, 0], plane.any(0).nonzero()[:, 0]
                if len(rows) == 0:
                    continue
                low, high = int(columns[0]), int(columns[-1]) + 1
                sources = plane[rows, low:high].flip(-1)
                positions = self._positions(plane.shape[0], 0, rows.device)[rows]
                for targets, matrix in self._row_matrices(depth, plane.shape, (low, high), positions):
                    product = sources @ matrix
                    for inside, target in targets:
                        field.index_add_(0, target, product[inside])
        return out.to(layers.dtype)

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        out = field.new_zeros(len(field), len(self.depths), *shape, dtype=torch.complex128)
        positions = self._positions(shape[0], 0, field.device)
        for item, layers in zip(field.to(out.dtype), out, strict=True):
            for plane, depth in zip(layers, self.depths, strict=True):
                back = torch.zeros_like(plane)
                for targets, matrix in self._row_matrices(depth, shape, (0, shape[1]), positions):
                    received = item.new_zeros(shape[0], self.grid.shape[1])
                    for inside, target in targets:
                        received[inside] += item[target]
                    back += received @ matrix.mH
                plane.copy_(back.flip(-1))
        return out.to(field.dtype)

    def _positions(self, sources: int, axis: int, device: torch.device | None = None) -> Tensor:
        """Position of each of the ``sources`` along an axis as a pixel index, possibly outside the hologram."""
        return (torch.arange(sources, device=device) - sources // 2) * self.stride + self.grid.shape[axis] // 2

    def _row_matrices(
        self, depth: float, shape: Sequence[int], columns: tuple[int, int], positions: Tensor
    ) -> Iterator[tuple[list[tuple[Tensor, Tensor]], Tensor]]:
        """For each distance between a source row and a pixel row, yield all such pairs of rows, and the waves.

        There is one entry for pixel rows above the source rows and one for those below: a mask of source rows, and the
        indices of their pixel rows. The waves are complex128 [columns, W], from the last source column to the first.
        ``shape`` (h, w) is the number of sources of a plane, ``columns`` the first column and the one after the last,
        ``positions`` the position of each source row as a pixel index.
        """
        (height, width), stride = self.grid.shape, self.stride
        low, high = columns
        farthest = max(height - 1 - int(positions.min()), int(positions.max()))
        if self.cone in ("box", "disc"):
            farthest = int(min(farthest, cone_samples(self.grid, self.wavelength, depth)[0] + 1))
        # Displacements of pixels from the last source; those from the source before it begin ``stride`` samples later.
        index = torch.arange((high - low - 1) * stride + width, device=positions.device)
        index -= int(self._positions(shape[1], 1)[high - 1])
        wave_row = self._wave_rows(depth, farthest, int(index.abs().max()), index.device)
        for offset in range(farthest + 1):
            wave = wave_row(offset)[index.abs()]
            if wave.any():
                targets = [positions + offset, positions - offset] if offset else [positions]
                masks = [(target >= 0) & (target < height) for target in targets]
                pairs = [(mask, target[mask]) for mask, target in zip(masks, targets, strict=True)]
                yield pairs, wave.as_strided((high - low, width), (stride, 1)).clone()

    def _wave_rows(self, depth: float, rows: int, columns: int, device: torch.device) -> Callable[[int], Tensor]:
        """Function from a row distance, in samples, to the wave at column distances 0 to ``columns``."""
        pitch = self.grid.pitch
        dy, dx = (
            torch.arange(count + 1, dtype=torch.float64, device=device) * step
            for count, step in zip((rows, columns), pitch, strict=True)
        )
        plain = self.cone == "taper" and is_plain(self.grid, self.wavelength, depth, (rows, columns), _EXACT)
        if self.cone in ("taper", "band") and not plain:
            quadrant = band_limited_wave(dy, dx, pitch, self.wavelength, depth, soft=self.cone == "taper")
            return lambda offset: quadrant[offset]
        cone: Cone = "full" if plain else self.cone
        return lambda offset: spherical_wave(dy[offset], dx, pitch, self.wavelength, depth, cone)
