"""DirectHologram: every light source on every pixel, the slow sum that judges the fast ones."""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.hologram.band_limited import band_limited_wave
from holotorch.hologram.cone import Cone, cone_samples, is_plain, spherical_wave
from holotorch.hologram.layered import LayerHologram

_EXACT = 1e-8  # part of the wave by which the taper may change it where the closed form is taken


class DirectHologram(LayerHologram):
    """E(x) = sum_v A(v) exp(i phi(v)) exp(i k r) / r, thesis Eq. 5.1 and Algorithm 4, pair by pair in float64.

    Sources lie on a raster, so pairs with one displacement share their wave: rows of sources are multiplied with the
    matrix of one row of displacements, for both signs at once. No transform, no wrap-around, no approximation; dark
    rows and columns of sources, and rows of pixels outside the cone, are left out.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Of the planes, in metres, above 0; any order and spacing.
        cone: What is kept of each wave, see ``holotorch.hologram.cone``. ``taper`` and ``band`` are integrated over
            frequencies, exact to 1e-8.
        stride: Pixels between neighbouring sources of a plane.

    Raises:
        TypeError, ValueError: Impossible arguments; in a call: layers that are not complex [..., D, h, w].
    """

    def __init__(self, grid: Grid, wavelength: float, depths: Sequence[float], *, cone: Cone = "box", stride: int = 1):
        super().__init__(grid, wavelength, depths, cone, stride)

    def pairs(self, layers: Tensor) -> int:
        """How many pairs of a lit source and a pixel inside its cone ``layers`` [D, h, w] have."""
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
        flat = layers.reshape(-1, *layers.shape[-3:]).to(torch.complex128)
        out = flat.new_zeros(len(flat), *self.grid.shape)
        for item, field in zip(flat, out, strict=True):
            for plane, depth in zip(item, self.depths, strict=True):
                rows, columns = plane.any(1).nonzero()[:, 0], plane.any(0).nonzero()[:, 0]
                if len(rows) == 0:
                    continue
                low, high = int(columns[0]), int(columns[-1]) + 1
                lit = plane[rows, low:high].flip(-1)
                places = self._places(rows, plane.shape[-2])
                for aside, matrix in self._rows(depth, plane.shape, (low, high), places):
                    product = lit @ matrix
                    for sign in (1, -1) if aside else (1,):
                        inside, target = self._hit(places, sign * aside)
                        field.index_add_(0, target, product[inside])
        return out.reshape(*layers.shape[:-3], *self.grid.shape).to(layers.dtype)

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        flat = field.reshape(-1, *field.shape[-2:]).to(torch.complex128)
        out = flat.new_zeros(len(flat), len(self.depths), *shape)
        places = self._places(torch.arange(shape[0], device=field.device), shape[0])
        for given, layers in zip(flat, out, strict=True):
            for plane, depth in zip(layers, self.depths, strict=True):
                back = torch.zeros_like(plane)
                for aside, matrix in self._rows(depth, shape, (0, shape[1]), places):
                    seen = given.new_zeros(shape[0], self.grid.shape[1])
                    for sign in (1, -1) if aside else (1,):
                        inside, target = self._hit(places, sign * aside)
                        seen[inside] += given[target]
                    back += seen @ matrix.mH
                plane.copy_(back.flip(-1))
        return out.reshape(*field.shape[:-2], len(self.depths), *shape).to(field.dtype)

    def _places(self, rows: Tensor, height: int) -> Tensor:
        """Rows of pixels on which rows of sources lie, counted from the hologram's first; may lie outside."""
        return (rows - height // 2) * self.stride + self.grid.shape[0] // 2

    def _hit(self, places: Tensor, aside: int) -> tuple[Tensor, Tensor]:
        """Which sources have a row of pixels so far aside, and which."""
        target = places + aside
        inside = (target >= 0) & (target < self.grid.shape[0])
        return inside, target[inside]

    def _rows(
        self, depth: float, shape: Sequence[int], columns: tuple[int, int], places: Tensor
    ) -> Iterator[tuple[int, Tensor]]:
        """For each distance between rows: the waves from a row's columns, last to first, to all pixels [w', W]."""
        (height, width), stride = self.grid.shape, self.stride
        low, high = columns
        farthest = max(height - 1 - int(places.min()), int(places.max()))
        if self.cone in ("box", "disc"):
            farthest = int(min(farthest, cone_samples(self.grid, self.wavelength, depth)[0] + 1))
        # Pixel b and source a lie b - W // 2 - (a - w // 2) stride samples apart; the last source comes first.
        first = -(width // 2) - (high - 1 - shape[1] // 2) * stride
        index = torch.arange((high - low - 1) * stride + width, device=places.device) + first
        waves = self._waves(depth, farthest, int(index.abs().max()), index.device)
        for aside in range(farthest + 1):
            wave = waves(aside)[index.abs()]
            if wave.any():
                yield aside, wave.as_strided((high - low, width), (stride, 1)).clone()

    def _waves(self, depth: float, rows: int, columns: int, device: torch.device) -> Callable[[int], Tensor]:
        """What gives a row of the quadrant of a point's wave: [columns + 1], by the row's distance in samples."""
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
