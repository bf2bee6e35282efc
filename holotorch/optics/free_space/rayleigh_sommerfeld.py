"""RayleighSommerfeld: the diffraction integral as a plain double sum, the reference that everything else is held to."""

import math
import warnings
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE, OFFSET

_CHUNK = 4_000_000  # kernel values at a time: 64 MB of complex128


class RayleighSommerfeld(nn.Module):
    """First Rayleigh-Sommerfeld integral over point samples, summed pair by pair in float64. Slow: H W H' W' terms.

    u(p) = sum_q u(q) dA z / (2 pi r^2) (1 / r - i k) exp(i k r), r the distance from q to p; for a negative distance
    its complex conjugate, which is time reversal. It reads samples as points, which agrees with band-limited
    propagation for content well below the grid's highest frequency, and is meaningless where the kernel is
    undersampled (distances below about 2 L pitch / wavelength for content at that frequency).

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, not 0.
        out_grid: Sampling of the result, with any shape and pitch; ``grid`` by default.
        offset: Position (y, x) in metres of the result's axis.

    Raises:
        ValueError: Impossible numbers; in a call: a field of another shape.

    Source: Goodman, Eq. 3-36.
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        *,
        out_grid: Grid | None = None,
        offset: tuple[float, float] = (0.0, 0.0),
    ):
        super().__init__()
        self.grid, self.out_grid = grid, out_grid or grid
        self.wavelengths = checks.wavelengths(wavelengths)
        self.distance = checks.quantity(DISTANCE, distance)
        y, x = checks.pair("offset", offset, "metres")
        self.offset = checks.quantity(OFFSET, y), checks.quantity(OFFSET, x)
        if self.distance == 0:
            raise ValueError("distance must not be 0 for a sum over point sources")
        self._check_sampling()

    def _check_sampling(self) -> None:
        for axis in range(2):
            aside = abs(self.offset[axis]) + (self.grid.extent[axis] + self.out_grid.extent[axis]) / 2
            step = self.grid.pitch[axis] / min(self.wavelengths) * aside / math.hypot(aside, self.distance)
            if step > 1.01:
                warnings.warn(
                    f"between neighbouring points of the {'yx'[axis]} axis the farthest path changes by {step:.3g} "
                    "wavelengths, more than one: the sum aliases whatever the field; use a finer pitch, a smaller "
                    "window, a longer distance, or AngularSpectrum",
                    SamplingWarning,
                    stacklevel=3,
                )

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field``, complex [..., C, H, W], to [..., C, H', W'] of the output grid, same dtype."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        flat = field.to(torch.complex128).flatten(-2)
        parts = [torch.einsum("...cq,cpq->...cp", flat, kernel) for kernel in self._kernels(field.device)]
        return torch.cat(parts, -1).unflatten(-1, self.out_grid.shape).to(field.dtype)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        checks.field("field", field, (len(self.wavelengths), *self.out_grid.shape))
        flat = field.to(torch.complex128).flatten(-2)
        total, begin = torch.zeros(1, dtype=torch.complex128, device=field.device), 0
        for kernel in self._kernels(field.device):
            part = flat[..., begin : begin + kernel.shape[1]]
            total, begin = total + torch.einsum("...cp,cpq->...cq", part, kernel.conj()), begin + kernel.shape[1]
        return total.unflatten(-1, self.grid.shape).to(field.dtype)

    def _kernels(self, device: torch.device) -> Iterator[Tensor]:
        """complex128 [C, points, H W] for one chunk of output points after the other."""
        y, x = self.grid.coordinates(device)
        rows, columns = self.out_grid.coordinates(device)
        points = torch.cartesian_prod(rows[:, 0] + self.offset[0], columns[0] + self.offset[1])
        wavelengths = torch.tensor(self.wavelengths, dtype=torch.float64, device=device)[:, None, None]
        area, z = math.prod(self.grid.pitch), abs(self.distance)
        for chunk in points.split(max(1, _CHUNK // math.prod(self.grid.shape) // len(self.wavelengths))):
            dy, dx = chunk[:, 0, None, None] - y, chunk[:, 1, None, None] - x
            r = torch.sqrt(dy.square() + dx.square() + z * z).flatten(1)
            weight = area * z / (2 * math.pi * r.square())
            cycles = r / wavelengths
            phase = 2 * math.pi * (cycles - cycles.round())
            phasor = torch.polar(torch.ones_like(phase), phase)
            kernel = (
                weight * torch.complex(1 / r.expand_as(phase), -2 * math.pi / wavelengths.expand_as(phase)) * phasor
            )
            yield kernel if self.distance > 0 else kernel.conj()
