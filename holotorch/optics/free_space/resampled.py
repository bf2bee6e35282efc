"""ResampledKernel: exact propagation onto another grid, with a pitch, size and centre of its own."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.fourier import fft2, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.impulse_response import fresnel_taps, levelling_shift, remainder_kernel, tilted_turns
from holotorch.optics.free_space.kernels import carrier, turns_phasor
from holotorch.optics.free_space.padding import FINEST, resampled_padding
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair

Factors = tuple[Tensor, Tensor, Tensor | None]


def resampling_factors(
    planes: PlanePair,
    wavelength: Tensor,
    distance: Tensor,
    *,
    padded: tuple[int, int] | None,
    tilt: Tensor | None = None,
    dtype: torch.dtype = torch.complex128,
) -> Factors:
    """Dense weights of both axes and the factor beyond Fresnel, differentiable in all tensors.

    That factor is applied on ``padded`` samples, whose excess is shared between both ends of the window; None leaves it
    out. Wavelength and distance are float64 of shape [...] that broadcast, the distance nowhere 0. Returns columns
    [..., H', H + rims] with the carrier, rows [..., W', W + rims] and the factor [..., P, Q] in FFT order.
    """
    wavelength, distance = torch.broadcast_tensors(wavelength, distance)
    if tilt is None:
        tilt = torch.tensor(planes.tilt, dtype=torch.float64, device=distance.device)
    cosine2 = 1 - tilt.square().sum()
    extra = [(room - size) // 2 for room, size in zip(padded or planes.grid.shape, planes.grid.shape, strict=True)]
    # What the taps take over from the factor beyond Fresnel.
    top = 0.5 / planes.grid.pitch[0], 0.5 / planes.grid.pitch[1]
    levels = [torch.zeros_like(distance)] * 2
    if padded is not None and any(planes.tilt):
        levels = [levelling_shift(top, wavelength, distance, tilt, axis) for axis in (0, 1)]
    matrices = []
    for axis, margin in enumerate(extra):
        pitch, size = planes.grid.pitch[axis], planes.grid.shape[axis]
        source = torch.arange(-margin, size + margin, dtype=torch.float64, device=distance.device) - size // 2
        targets = planes.out.coordinates(distance.device)[axis].reshape(-1) + planes.offset[axis]
        aside = distance * tilt[axis] / torch.sqrt(cosine2) - levels[axis]
        position = (targets[:, None] - aside[..., None, None]) / pitch - source
        curvature_distance = distance * (1 - tilt[1 - axis].square()) / cosine2**1.5
        weights = fresnel_taps(position.flatten(-2), pitch, wavelength, curvature_distance)
        matrices.append(weights.unflatten(-1, position.shape[-2:]))
    columns = matrices[0] * carrier(wavelength, distance * torch.sqrt(cosine2))[..., None, None]
    remainder = None
    if padded is not None:
        fy, fx = Grid(padded, planes.grid.pitch).frequencies(distance.device)
        wavelength, distance = wavelength[..., None, None], distance[..., None, None]
        if any(planes.tilt):
            cycles = tilted_turns(fy, fx, wavelength, distance, tilt, squares=False)
            cycles = cycles - fy * levels[0][..., None, None] - fx * levels[1][..., None, None]
            remainder = turns_phasor(cycles).to(dtype)
        else:
            remainder = remainder_kernel(fy, fx, wavelength, distance).to(dtype)
    return columns.to(dtype), matrices[1].to(dtype), remainder


def resample(field: Tensor, factors: Factors) -> Tensor:
    """Apply :func:`resampling_factors` to a field [..., H, W]."""
    columns, rows, remainder = factors
    if remainder is not None:
        top, left = _margins(columns, rows, field.shape)
        height, width = field.shape[-2] + 2 * top, field.shape[-1] + 2 * left
        field = nn.functional.pad(field, (left, left, top, top))
        field = ifft2(multiplied(fft2(field, (remainder.shape[-2], remainder.shape[-1])), remainder), (height, width))
    return columns @ field @ rows.transpose(-1, -2)


def _margins(columns: Tensor, rows: Tensor, shape: Sequence[int]) -> tuple[int, int]:
    return (columns.shape[-1] - shape[-2]) // 2, (rows.shape[-1] - shape[-1]) // 2


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
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
        tilt: Sines (y, x) of the direction of a carrier that is taken out, as in ``propagate``.
        paraxial: Leave out the correction beyond the Fresnel approximation.
        padded: Samples of the transforms that apply that correction; by default the window, an eighth on each side and
            room for what the correction moves.

    Raises:
        ValueError: A wavelength that is not positive, a distance that is 0 or not finite, a pitch below 0.9
            wavelengths; in a call: a field of another shape.
    """

    rows: Tensor
    columns: Tensor
    beyond: Tensor | None

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        out_grid: Grid,
        *,
        offset: tuple[float, float] = (0.0, 0.0),
        tilt: tuple[float, float] = (0.0, 0.0),
        paraxial: bool = False,
        padded: tuple[int, int] | None = None,
    ):
        super().__init__()
        self.grid, self.out_grid, self.wavelengths = grid, out_grid, checks.wavelengths(wavelengths)
        self.distance = checks.quantity(DISTANCE, distance)
        planes = plane_pair(grid, out_grid, offset, tilt, self.wavelengths)
        self.offset = planes.offset
        if self.distance == 0:
            raise ValueError("distance must not be 0 for a propagation onto another grid")
        longest = max(self.wavelengths)
        if min(grid.pitch) < FINEST * longest:
            raise ValueError(f"pitch must be at least {FINEST} wavelengths of {longest:g} m, got {min(grid.pitch):g} m")
        wavelength_tensor = torch.tensor(self.wavelengths, dtype=torch.float64)
        distance_tensor = torch.tensor(self.distance, dtype=torch.float64)
        if padded is None and not paraxial:
            padded = resampled_padding(planes, longest, abs(self.distance))
        factors = resampling_factors(planes, wavelength_tensor, distance_tensor, padded=None if paraxial else padded)
        for name, values in zip(("columns", "rows", "beyond"), factors, strict=True):
            pair = None if values is None else torch.view_as_real(values).contiguous()
            self.register_buffer(name, pair, persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field``, complex [..., C, H, W], to [..., C, H', W'] of the output grid, same dtype."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        return resample(field, self._buffers_for(field))

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        checks.field("field", field, (len(self.wavelengths), *self.out_grid.shape))
        columns, rows, remainder = self._buffers_for(field)
        (height, width), (top, left) = self.grid.shape, _margins(columns, rows, self.grid.shape)
        spread = columns.transpose(-1, -2).conj() @ field @ rows.conj()
        if remainder is None:
            return spread
        back = ifft2(fft2(spread, (remainder.shape[-2], remainder.shape[-1])) * remainder.conj())
        return back[..., top : top + height, left : left + width]

    def extra_repr(self) -> str:
        """Samplings and wavelengths, for ``print(module)``."""
        return f"grid={self.grid}, out_grid={self.out_grid}, wavelengths={self.wavelengths}"

    def _buffers_for(self, field: Tensor) -> Factors:
        dtype = field.real.dtype
        columns, rows = (torch.view_as_complex(values.to(dtype)) for values in (self.columns, self.rows))
        return columns, rows, None if self.beyond is None else torch.view_as_complex(self.beyond.to(dtype))

    def _apply(self, fn, recurse=True):
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)
