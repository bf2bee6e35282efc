"""DirectHologram: the exact sum over all pairs of a source and a pixel, the reference for the faster methods."""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.hologram.band_limited import band_limited_wave
from holotorch.hologram.cone import Cone, cone_samples, is_plain, spherical_wave
from holotorch.hologram.layered import LayerHologram

# The closed form of the unlimited wave replaces the tapered one if their relative difference is below this.
_EXACT = 1e-8


class DirectHologram(LayerHologram):
    """E(x) = sum_v A(v) exp(i phi(v)) exp(i k r) / r, thesis Eq. 5.1 and Algorithm 4, pair by pair in float64.

    Sources lie on a raster, so all pairs with the same displacement share one value of the spherical wave: rows of
    sources are multiplied by the matrix of one row displacement, for both signs at once. There is no FFT, no
    wrap-around and no approximation. Rows and columns of dark sources, and rows of pixels outside the cone, are
    skipped.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Distances of the planes from the hologram in metres, above 0; any order and spacing.
        cone: The part of each spherical wave that is kept, see ``holotorch.hologram.cone``. ``taper`` and ``band`` are
            integrated over frequencies, exact to 1e-8.
        stride: Distance between neighbouring sources of a plane in pixels.

    Raises:
        TypeError, ValueError: Invalid arguments; in a call: layers that are not complex [..., D, h, w].
    """

    def __init__(self, grid: Grid, wavelength: float, depths: Sequence[float], *, cone: Cone = "box", stride: int = 1):
        super().__init__(grid, wavelength, depths, cone, stride)

    def pairs(self, layers: Tensor) -> int:
        """Number of pairs of a lit source of ``layers`` [D, h, w] and a pixel inside its cone."""
        total = 0
        for plane, depth in zip(layers, self.depths, strict=True):
            half = cone_samples(self.grid, self.wavelength, depth)
            if self.cone not in ("box", "disc"):
                half = (float("inf"), float("inf"))
            counts = []
            for axis in (0, 1):
                pixel = torch.arange(self.grid.shape[axis]) - self.grid.shape[axis] // 2
                source = (torch.arange(plane.shape[axis]) - plane.shape[axis] // 2) * self.stride
                counts.append(((pixel[:, None] - source).abs() <= half[axis]).sum(0))
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
                positions = self._pixel_rows(rows, plane.shape[-2])
                for aside, matrix in self._row_matrices(depth, plane.shape, (low, high), positions):
                    product = sources @ matrix
                    for sign in (1, -1) if aside else (1,):
                        inside, target = self._rows_at_distance(positions, sign * aside)
                        field.index_add_(0, target, product[inside])
        return out.to(layers.dtype)

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        out = field.new_zeros(len(field), len(self.depths), *shape, dtype=torch.complex128)
        positions = self._pixel_rows(torch.arange(shape[0], device=field.device), shape[0])
        for item, layers in zip(field.to(out.dtype), out, strict=True):
            for plane, depth in zip(layers, self.depths, strict=True):
                back = torch.zeros_like(plane)
                for aside, matrix in self._row_matrices(depth, shape, (0, shape[1]), positions):
                    received = item.new_zeros(shape[0], self.grid.shape[1])
                    for sign in (1, -1) if aside else (1,):
                        inside, target = self._rows_at_distance(positions, sign * aside)
                        received[inside] += item[target]
                    back += received @ matrix.mH
                plane.copy_(back.flip(-1))
        return out.to(field.dtype)

    def _pixel_rows(self, rows: Tensor, height: int) -> Tensor:
        """Pixel row at the position of each source row, from the first row of the hologram; may lie outside it."""
        return (rows - height // 2) * self.stride + self.grid.shape[0] // 2

    def _rows_at_distance(self, positions: Tensor, aside: int) -> tuple[Tensor, Tensor]:
        """Mask of the source rows that have a pixel row ``aside`` rows away, and those pixel rows."""
        target = positions + aside
        inside = (target >= 0) & (target < self.grid.shape[0])
        return inside, target[inside]

    def _row_matrices(
        self, depth: float, shape: Sequence[int], columns: tuple[int, int], positions: Tensor
    ) -> Iterator[tuple[int, Tensor]]:
        """Yield each row distance and the matrix [w', W] of waves from w' columns, last to first, to all W pixels."""
        (height, width), stride = self.grid.shape, self.stride
        low, high = columns
        farthest = max(height - 1 - int(positions.min()), int(positions.max()))
        if self.cone in ("box", "disc"):
            farthest = int(min(farthest, cone_samples(self.grid, self.wavelength, depth)[0] + 1))
        # Pixel b and source a lie b - W // 2 - (a - w // 2) stride samples apart; the last source comes first.
        first = -(width // 2) - (high - 1 - shape[1] // 2) * stride
        index = torch.arange((high - low - 1) * stride + width, device=positions.device) + first
        wave_row = self._wave_rows(depth, farthest, int(index.abs().max()), index.device)
        for aside in range(farthest + 1):
            wave = wave_row(aside)[index.abs()]
            if wave.any():
                yield aside, wave.as_strided((high - low, width), (stride, 1)).clone()

    def _wave_rows(self, depth: float, rows: int, columns: int, device: torch.device) -> Callable[[int], Tensor]:
        """Function of a row distance in samples: that row of the quadrant of a spherical wave, [columns + 1]."""
        pitch = self.grid.pitch
        dy, dx = (
            torch.arange(count + 1, dtype=torch.float64, device=device) * step
            for count, step in zip((rows, columns), pitch, strict=True)
        )
        plain = self.cone == "taper" and is_plain(self.grid, self.wavelength, depth, (rows, columns), _EXACT)
        if self.cone in ("taper", "band") and not plain:
            quadrant = band_limited_wave(dy, dx, pitch, self.wavelength, depth, soft=self.cone == "taper")
            return lambda aside: quadrant[aside]
        cone: Cone = "full" if plain else self.cone
        return lambda aside: spherical_wave(dy[aside], dx, pitch, self.wavelength, depth, cone)
