"""ResampledKernel: exact propagation onto another grid, with a pitch, size and centre of its own."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.fourier import fft2, good_length, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE
from holotorch.optics.candidates import FINEST, resampling_rim
from holotorch.optics.kernels import carrier
from holotorch.optics.passage import Passage, passage
from holotorch.optics.taps import fresnel_taps, remainder_kernel

Factors = tuple[Tensor, Tensor, Tensor | None]


def resampling_factors(
    path: Passage,
    wavelength: Tensor,
    distance: Tensor,
    *,
    paraxial: bool = False,
    tilt: Tensor | None = None,
    dtype: torch.dtype = torch.complex128,
) -> Factors:
    """Dense weights of both axes and the factor beyond Fresnel (None if ``paraxial``), differentiable in all tensors.

    Wavelength and distance are float64 of shape [...] that broadcast, the distance nowhere 0. Returns columns
    [..., H', H + rims] with the carrier, rows [..., W', W + rims] and the factor [..., P, Q] in FFT order.
    """
    wavelength, distance = torch.broadcast_tensors(wavelength, distance)
    if tilt is None:
        tilt = torch.tensor(path.tilt, dtype=torch.float64, device=distance.device)
    cosine2 = 1 - tilt.square().sum()
    longest, far = wavelength.detach().max().item(), distance.detach().abs().max().item()
    rims = [0 if paraxial else resampling_rim(path, axis, longest, far) for axis in (0, 1)]
    matrices = []
    for axis, rim in enumerate(rims):
        pitch, size = path.grid.pitch[axis], path.grid.shape[axis]
        source = torch.arange(-rim, size + rim, dtype=torch.float64, device=distance.device) - size // 2
        reached = path.out.coordinates(distance.device)[axis].reshape(-1) + path.offset[axis]
        aside = distance * tilt[axis] / torch.sqrt(cosine2)
        place = (reached[:, None] - aside[..., None, None]) / pitch - source
        bent = distance * (1 - tilt[1 - axis].square()) / cosine2**1.5
        weights = fresnel_taps(place.flatten(-2), pitch, wavelength, bent)
        matrices.append(weights.unflatten(-1, place.shape[-2:]))
    columns = matrices[0] * carrier(wavelength, distance * torch.sqrt(cosine2))[..., None, None]
    beyond = None
    if not paraxial:
        sizes = [good_length(size + 2 * rim) for size, rim in zip(path.grid.shape, rims, strict=True)]
        fy, fx = Grid((sizes[0], sizes[1]), path.grid.pitch).frequencies(distance.device)
        slanted = tilt if any(path.tilt) else None
        beyond = remainder_kernel(fy, fx, wavelength[..., None, None], distance[..., None, None], slanted).to(dtype)
    return columns.to(dtype), matrices[1].to(dtype), beyond


def resample(field: Tensor, factors: Factors) -> Tensor:
    """Apply :func:`resampling_factors` to a field [..., H, W]."""
    columns, rows, beyond = factors
    if beyond is not None:
        top, left = _rims(columns, rows, field.shape)
        height, width = field.shape[-2] + 2 * top, field.shape[-1] + 2 * left
        field = nn.functional.pad(field, (left, left, top, top))
        field = ifft2(multiplied(fft2(field, (beyond.shape[-2], beyond.shape[-1])), beyond), (height, width))
    return columns @ field @ rows.transpose(-1, -2)


def _rims(columns: Tensor, rows: Tensor, shape: Sequence[int]) -> tuple[int, int]:
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
        offset: Where (y, x) in metres the axis of the result lies beside that of the field.
        tilt: Sines (y, x) of the direction of a carrier that is taken out, as in ``propagate``.
        paraxial: Leave out the correction beyond the Fresnel approximation.

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
    ):
        super().__init__()
        self.grid, self.out_grid, self.wavelengths = grid, out_grid, checks.wavelengths(wavelengths)
        self.distance = checks.quantity(DISTANCE, distance)
        path = passage(grid, out_grid, offset, tilt, self.wavelengths)
        self.offset = path.offset
        if self.distance == 0:
            raise ValueError("distance must not be 0 for a propagation onto another grid")
        longest = max(self.wavelengths)
        if min(grid.pitch) < FINEST * longest:
            raise ValueError(f"pitch must be at least {FINEST} wavelengths of {longest:g} m, got {min(grid.pitch):g} m")
        waves = torch.tensor(self.wavelengths, dtype=torch.float64)
        far = torch.tensor(self.distance, dtype=torch.float64)
        factors = resampling_factors(path, waves, far, paraxial=paraxial)
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
        columns, rows, beyond = self._buffers_for(field)
        (height, width), (top, left) = self.grid.shape, _rims(columns, rows, self.grid.shape)
        spread = columns.transpose(-1, -2).conj() @ field @ rows.conj()
        if beyond is None:
            return spread
        back = ifft2(fft2(spread, (beyond.shape[-2], beyond.shape[-1])) * beyond.conj())
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
