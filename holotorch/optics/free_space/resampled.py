"""ResampledKernel: exact propagation onto a grid of another pitch, size and centre."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.core import checks
from holotorch.core.fourier import fft2, ifft2, multiplied
from holotorch.core.grid import Grid, Pair
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.core.precision import double
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.impulse_response import fresnel_taps, levelling_shift, remainder_kernel, tilted_cycles
from holotorch.optics.free_space.kernels import carrier, cycles_phasor
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
    """Dense matrices of the paraxial weights of both axes and the factor beyond Fresnel, differentiable in all tensors.

    Args:
        planes: Samples of source and result, and the carrier.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...] that broadcasts, not 0.
        padded: Samples (P, Q) on which the factor beyond Fresnel is applied, with equal margins on both sides of the
            source window; None leaves the factor out.
        tilt: Sines (y, x) of the carrier, float64 [2], for gradients; those of ``planes`` by default.
        dtype: Of the result.

    Returns:
        Matrix along y, [..., H', H + margins], with the carrier exp(ikz) as a factor, matrix along x,
        [..., W', W + margins], and the factor beyond Fresnel, [..., P, Q] in FFT order, or None.
    """
    wavelength, distance = torch.broadcast_tensors(wavelength, distance)
    if tilt is None:
        tilt = double(planes.tilt, distance.device)
    cosine2 = 1 - tilt.square().sum()
    nyquist = 0.5 / planes.grid.pitch[0], 0.5 / planes.grid.pitch[1]
    # Shifts in metres: the linear phases that are moved from the factor beyond Fresnel into the taps.
    shifts = [torch.zeros_like(distance)] * 2
    if padded is not None and any(planes.tilt):
        shifts = [levelling_shift(nyquist, wavelength, distance, tilt, axis) for axis in (0, 1)]
    matrices = []
    for axis, (size, pitch) in enumerate(zip(planes.grid.shape, planes.grid.pitch, strict=True)):
        margin = (padded[axis] - size) // 2 if padded else 0
        source = torch.arange(-margin, size + margin, dtype=torch.float64, device=distance.device) - size // 2
        targets = planes.out.coordinates(distance.device)[axis].reshape(-1) + planes.offset[axis]
        lateral = distance * tilt[axis] / torch.sqrt(cosine2) - shifts[axis]
        position = (targets[:, None] - lateral[..., None, None]) / pitch - source
        curvature_distance = distance * (1 - tilt[1 - axis].square()) / cosine2**1.5
        weights = fresnel_taps(position.flatten(-2), pitch, wavelength, curvature_distance)
        matrices.append(weights.unflatten(-1, position.shape[-2:]))
    columns = matrices[0] * carrier(wavelength, distance * torch.sqrt(cosine2))[..., None, None]
    remainder = None
    if padded is not None:
        fy, fx = Grid(padded, planes.grid.pitch).frequencies(distance.device)
        wavelength, distance = wavelength[..., None, None], distance[..., None, None]
        if any(planes.tilt):
            cycles = tilted_cycles(fy, fx, wavelength, distance, tilt, squares=False)
            cycles = cycles - fy * shifts[0][..., None, None] - fx * shifts[1][..., None, None]
            remainder = cycles_phasor(cycles).to(dtype)
        else:
            remainder = remainder_kernel(fy, fx, wavelength, distance).to(dtype)
    return columns.to(dtype), matrices[1].to(dtype), remainder


def resample(field: Tensor, factors: Factors) -> Tensor:
    """Apply the ``factors`` of :func:`resampling_factors` to a field [..., H, W]; returns [..., H', W']."""
    columns, rows, remainder = factors
    if remainder is not None:
        top, left = _margins(columns, rows, field.shape)
        height, width = field.shape[-2] + 2 * top, field.shape[-1] + 2 * left
        field = functional.pad(field, (left, left, top, top))
        field = ifft2(multiplied(fft2(field, (remainder.shape[-2], remainder.shape[-1])), remainder), (height, width))
    return columns @ field @ rows.transpose(-1, -2)


def _margins(columns: Tensor, rows: Tensor, shape: Sequence[int]) -> tuple[int, int]:
    """Samples (y, x) by which the matrices exceed a window of ``shape`` [..., H, W] on each side."""
    return (columns.shape[-1] - shape[-2]) // 2, (rows.shape[-1] - shape[-1]) // 2


class ResampledKernel(FieldOperator):
    """Exact scalar propagation of band-limited samples to the points of another grid; includes the carrier exp(ikz).

    The paraxial kernel is known at every position (:func:`fresnel_taps`), so each axis is one product with a dense
    matrix of H' x H or W' x W weights. The pitch and the centre of the result are arbitrary and nothing is
    interpolated. The factor beyond Fresnel (see ``CroppedKernel``) is applied to the padded field first. The accuracy
    is that of ``CroppedKernel``; the cost is H' H W + H' W W' products instead of two FFTs.

    Args:
        grid, wavelengths, out_grid: As for :class:`FieldOperator`.
        distance: In metres, not 0, negative for backward propagation.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
        tilt: Sines (y, x) of the direction of a carrier wave that is divided out, as in ``propagate``.
        paraxial: Leave out the factor beyond Fresnel.
        padded: Number of samples (y, x) of the FFTs that apply this factor. The default adds to each side of the window
            an eighth of its size and the distance by which the factor moves light.

    Raises ValueError for a number outside its range, a distance of 0, or a pitch below 0.9 wavelengths.
    """

    columns: Tensor
    rows: Tensor
    beyond: Tensor | None

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float,
        out_grid: Grid,
        *,
        offset: Pair = (0.0, 0.0),
        tilt: Pair = (0.0, 0.0),
        paraxial: bool = False,
        padded: tuple[int, int] | None = None,
    ):
        super().__init__(grid, wavelengths, out_grid)
        self.distance = checks.quantity(DISTANCE, distance)
        planes = plane_pair(grid, out_grid, offset, tilt, self.wavelengths)
        self.offset = planes.offset
        if self.distance == 0:
            raise ValueError("distance must not be 0 for a propagation onto another grid")
        longest = max(self.wavelengths)
        if min(grid.pitch) < FINEST * longest:
            raise ValueError(f"pitch must be at least {FINEST} wavelengths of {longest:g} m, got {min(grid.pitch):g} m")
        wavelength, z = (torch.tensor(value, dtype=torch.float64) for value in (self.wavelengths, self.distance))
        padded = None if paraxial else padded or resampled_padding(planes, longest, abs(self.distance))
        factors = resampling_factors(planes, wavelength, z, padded=padded)
        for name, values in zip(("columns", "rows", "beyond"), factors, strict=True):
            self.keep(name, values)

    def _forward(self, field: Tensor) -> Tensor:
        return resample(field, self._factors_for(field))

    def _adjoint(self, field: Tensor) -> Tensor:
        columns, rows, remainder = self._factors_for(field)
        (height, width), (top, left) = self.grid.shape, _margins(columns, rows, self.grid.shape)
        spread = columns.transpose(-1, -2).conj() @ field @ rows.conj()
        if remainder is None:
            return spread
        back = ifft2(fft2(spread, (remainder.shape[-2], remainder.shape[-1])) * remainder.conj())
        return back[..., top : top + height, left : left + width]

    def _factors_for(self, field: Tensor) -> Factors:
        beyond = None if self.beyond is None else self.beyond.to(field.dtype)
        return self.columns.to(field.dtype), self.rows.to(field.dtype), beyond
