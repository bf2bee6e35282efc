"""RayleighSommerfeld: the diffraction integral as a double sum, the reference for all other propagators."""

import math
import warnings
from collections.abc import Iterator

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.grid import Grid, Pair
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.core.precision import double
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.kernels import cycles_phasor

_CHUNK = 4_000_000  # kernel values at a time: 64 MB of complex128


class RayleighSommerfeld(FieldOperator):
    """First Rayleigh-Sommerfeld integral over point samples, summed pair by pair in float64, slow: H W H' W' terms.

    u(p) = sum_q u(q) dA z / (2 pi r^2) (1 / r - i k) exp(i k r), where r is the distance from q to p and dA the area of
    a sample. For a negative distance the kernel is the complex conjugate, which is time reversal. The sum over point
    samples agrees with band-limited propagation for fields well below the highest frequency of the grid. The result is
    meaningless where the kernel is undersampled: for fields at that frequency, at distances below about
    2 L pitch / wavelength, with L the extent of the grid.

    Args:
        grid, wavelengths, out_grid: As for :class:`FieldOperator`.
        distance: In metres, not 0.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.

    Raises ValueError for a number outside its range, and warns with SamplingWarning if the kernel is undersampled for
    any field. Source: Goodman, Eq. 3-36.
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float,
        *,
        out_grid: Grid | None = None,
        offset: Pair = (0, 0),
    ):
        super().__init__(grid, wavelengths, out_grid)
        self.distance, self.offset = checks.quantity(DISTANCE, distance), checks.offset(offset)
        if self.distance == 0:
            raise ValueError("distance must not be 0 for a sum over point sources")
        for axis in range(2):
            lateral = abs(self.offset[axis]) + (grid.extent[axis] + self.out_grid.extent[axis]) / 2
            step = grid.pitch[axis] / min(self.wavelengths) * lateral / math.hypot(lateral, self.distance)
            if step > 1.01:
                warnings.warn(
                    f"between neighbouring points of the {'yx'[axis]} axis the farthest path changes by {step:.3g} "
                    "wavelengths, more than one: the sum aliases whatever the field; use a finer pitch, a smaller "
                    "window, a longer distance, or AngularSpectrum",
                    SamplingWarning,
                    stacklevel=2,
                )

    def _forward(self, field: Tensor) -> Tensor:
        flat = field.to(torch.complex128).flatten(-2)
        parts = [torch.einsum("...cq,cpq->...cp", flat, kernel) for kernel in self._kernels(field.device)]
        return torch.cat(parts, -1).unflatten(-1, self.out_grid.shape).to(field.dtype)

    def _adjoint(self, field: Tensor) -> Tensor:
        flat = field.to(torch.complex128).flatten(-2)
        total, start = torch.zeros(1, dtype=torch.complex128, device=field.device), 0
        for kernel in self._kernels(field.device):
            part = flat[..., start : start + kernel.shape[1]]
            total, start = total + torch.einsum("...cp,cpq->...cq", part, kernel.conj()), start + kernel.shape[1]
        return total.unflatten(-1, self.grid.shape).to(field.dtype)

    def _kernels(self, device: torch.device) -> Iterator[Tensor]:
        """Yield the kernel, complex128 [C, points, H W], for successive chunks of output points."""
        y, x = self.grid.coordinates(device)
        rows, columns = self.out_grid.coordinates(device)
        points = torch.cartesian_prod(rows[:, 0] + self.offset[0], columns[0] + self.offset[1])
        wavelengths = double(self.wavelengths, device)[:, None, None]
        area, z = math.prod(self.grid.pitch), abs(self.distance)
        for chunk in points.split(max(1, _CHUNK // math.prod(self.grid.shape) // len(self.wavelengths))):
            dy, dx = chunk[:, 0, None, None] - y, chunk[:, 1, None, None] - x
            r = torch.sqrt(dy.square() + dx.square() + z * z).flatten(1)
            weight = area * z / (2 * math.pi * r.square())
            phasor = cycles_phasor(r / wavelengths)
            factor = torch.complex(1 / r.expand(phasor.shape), -2 * math.pi / wavelengths.expand(phasor.shape))
            kernel = weight * factor * phasor
            yield kernel if self.distance > 0 else kernel.conj()
