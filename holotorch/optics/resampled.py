"""ResampledKernel: exact propagation onto another grid, with a pitch, size and centre of its own."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid
from holotorch.optics.kernels import carrier
from holotorch.optics.plan import FINEST
from holotorch.optics.taps import fresnel_taps, remainder_kernel


class ResampledKernel(nn.Module):
    """Exact scalar propagation of band-limited samples to the points of another grid; includes the carrier exp(ikz).

    The paraxial kernel is known at every place (:func:`fresnel_taps`), so each axis is one product with a dense matrix
    of H' x H or W' x W weights: any output pitch, coarser or finer, and any centre, without interpolation. What lies
    beyond Fresnel is applied to the field first, on a window that holds its short reach. Same accuracy as
    ``CroppedKernel``; the cost is H' H W + H' W W' products instead of two FFTs.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, not 0, negative to travel back.
        out_grid: Sampling of the result.
        offset: Where (y, x) in metres the axis of the result lies beside that of the field.

    Raises:
        ValueError: A wavelength that is not positive, a distance that is 0 or not finite, a pitch below 0.9
            wavelengths; in a call: a field of another shape.
    """

    rows: Tensor
    columns: Tensor
    beyond: Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        out_grid: Grid,
        *,
        offset: tuple[float, float] = (0.0, 0.0),
    ):
        super().__init__()
        self.grid, self.out_grid, self.wavelengths = grid, out_grid, checks.wavelengths(wavelengths)
        self.distance = checks.finite("distance", distance, "metres")
        self.offset = checks.finite("offset", offset[0], "metres"), checks.finite("offset", offset[1], "metres")
        if self.distance == 0:
            raise ValueError("distance must not be 0 for a propagation onto another grid")
        longest = max(self.wavelengths)
        if min(grid.pitch) < FINEST * longest:
            raise ValueError(f"pitch must be at least {FINEST} wavelengths of {longest:g} m, got {min(grid.pitch):g} m")
        waves = torch.tensor(self.wavelengths, dtype=torch.float64)
        far = torch.tensor(self.distance, dtype=torch.float64)
        self._rims = [self._rim(axis) for axis in (0, 1)]
        sizes = [good_length(size + 2 * rim) for size, rim in zip(grid.shape, self._rims, strict=True)]
        fy, fx = Grid((sizes[0], sizes[1]), grid.pitch).frequencies()
        matrices = [self._matrix(axis, waves, far) for axis in (0, 1)]
        matrices[0] = matrices[0] * carrier(waves, far)[:, None, None]
        buffers = {"columns": matrices[0], "rows": matrices[1]}
        buffers["beyond"] = remainder_kernel(fy, fx, waves[:, None, None], far)
        for name, values in buffers.items():
            self.register_buffer(name, torch.view_as_real(values).contiguous(), persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field``, complex [..., C, H, W], to [..., C, H', W'] of the output grid, same dtype."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        columns, rows, beyond = self._buffers_for(field)
        (height, width), (top, left) = self.grid.shape, self._rims
        spread = nn.functional.pad(field, (left, left, top, top))
        spread = ifft2(
            fft2(spread, (beyond.shape[-2], beyond.shape[-1])) * beyond, (height + 2 * top, width + 2 * left)
        )
        return columns @ spread @ rows.transpose(-1, -2)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        checks.field("field", field, (len(self.wavelengths), *self.out_grid.shape))
        columns, rows, beyond = self._buffers_for(field)
        (height, width), (top, left) = self.grid.shape, self._rims
        spread = columns.transpose(-1, -2).conj() @ field @ rows.conj()
        back = ifft2(fft2(spread, (beyond.shape[-2], beyond.shape[-1])) * beyond.conj())
        return back[..., top : top + height, left : left + width]

    def extra_repr(self) -> str:
        """Samplings and wavelengths, for ``print(module)``."""
        return f"grid={self.grid}, out_grid={self.out_grid}, wavelengths={self.wavelengths}"

    def _buffers_for(self, field: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        dtype = field.real.dtype
        columns, rows, beyond = (
            torch.view_as_complex(values.to(dtype)) for values in (self.columns, self.rows, self.beyond)
        )
        return columns, rows, beyond

    def _apply(self, fn, recurse=True):
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)

    def _rim(self, axis: int) -> int:
        """Samples on each side for what the factor beyond Fresnel moves, and an eighth of the window for its tails."""
        sine = min(max(self.wavelengths) * math.hypot(*(0.5 / pitch for pitch in self.grid.pitch)), 0.99)
        extents = (self.grid.extent[axis] + self.out_grid.extent[axis]) / 2 + abs(self.offset[axis])
        sine = min(sine, 2 * extents / math.hypot(2 * extents, self.distance))
        shift = abs(self.distance) * (sine / math.sqrt(1 - sine * sine) - sine)
        return math.ceil(self.grid.shape[axis] / 8 + shift / self.grid.pitch[axis])

    def _matrix(self, axis: int, waves: Tensor, far: Tensor) -> Tensor:
        """complex128 [C, samples out, samples in with their rims]."""
        pitch, rim = self.grid.pitch[axis], self._rims[axis]
        source = torch.arange(-rim, self.grid.shape[axis] + rim, dtype=torch.float64) - self.grid.shape[axis] // 2
        reached = self.out_grid.coordinates()[axis].reshape(-1) + self.offset[axis]
        place = reached[:, None] / pitch - source
        return fresnel_taps(place.reshape(-1), pitch, waves, far).unflatten(-1, tuple(place.shape))
