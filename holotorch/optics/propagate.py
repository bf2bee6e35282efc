"""propagate and Propagator: the planned way, which picks method and padding and says why."""

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import fft2, ifft2
from holotorch.core.grid import Grid
from holotorch.core.plan import Plan
from holotorch.optics.kernels import carrier
from holotorch.optics.plan import FINEST, Candidate, candidates, choose, plan_from
from holotorch.optics.propagators import SpectralFilter
from holotorch.optics.transfer import transfer_function, wide_transfer_function

_UNUSABLE = 0.1  # expected error from which a result is refused


def propagate(
    field: Tensor,
    grid: Grid,
    wavelength: float | Tensor,
    distance: float | Tensor,
    *,
    tolerance: float = 1e-3,
    band: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """Propagate ``field`` over ``distance`` on its own grid, by the cheapest way that is accurate enough.

    Args:
        field: complex64 or complex128, shape [..., H, W].
        grid: Its sampling.
        wavelength: In metres: a number, or a tensor whose shape broadcasts against the leading axes of ``field``. In a
            medium, the wavelength there: the one in vacuum divided by the refractive index.
        distance: In metres, likewise; both may carry gradients. Many distances share one forward transform: give the
            field an axis of size 1 where the distances have theirs.
        tolerance: Largest relative L2 error, in expectation over noise that fills ``band`` and the window.
        band: Highest frequencies (y, x) of the content, in cycles per metre; the grid's own by default.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at the ends of each axis.

    Returns:
        Same dtype, shape [..., H, W] broadcast with the leading axes. The carrier exp(ikz) is included; evanescent
        waves decay for either sign of the distance.

    Raises:
        TypeError: A field that is not complex.
        ValueError: Wrong shape, NaN or infinity anywhere, a wavelength that is not positive, or no way whose expected
            error is below 0.1.

    Warns:
        SamplingWarning: No way meets the tolerance; the most accurate one is used and its expected error named.
    """
    checks.field("field", field, grid.shape)
    if not torch.compiler.is_compiling():
        checks.all_finite("field", torch.view_as_real(field.detach().resolve_conj()))
    waves, distances = _float64("wavelength", wavelength, field), _float64("distance", distance, field)
    listed = [values.detach().reshape(-1).tolist() for values in (waves, distances)]
    found = candidates(grid, *listed, band=band, margin=margin, dtype=field.dtype)
    way = _best(found, checks.positive("tolerance", tolerance))
    if way.method == "identity":
        return field * carrier(waves, distances)[..., None, None].to(field.dtype)
    spectrum = fft2(field, way.padded)
    height, width = grid.shape
    waves, distances = torch.broadcast_tensors(waves, distances)
    batch = torch.broadcast_shapes(waves.shape, spectrum.shape[:-2])
    if waves.numel() == 1:
        kernel = kernel_of(grid, way, waves.reshape(()), distances.reshape(()), field.dtype)
        return ifft2(spectrum * kernel, grid.shape).expand(*batch, height, width)
    # One kernel at a time: all of them together would not fit into the processor's cache, nor perhaps into memory.
    pairs = zip(waves.reshape(-1), distances.reshape(-1), strict=True)
    spectra = spectrum.expand(*batch, *way.padded)
    lead = spectra.ndim - 2 - waves.ndim
    spectra = spectra.flatten(lead, -3)
    parts = [
        ifft2(spectra[..., i, :, :] * kernel_of(grid, way, wave, distance, field.dtype), grid.shape)
        for i, (wave, distance) in enumerate(pairs)
    ]
    return torch.stack(parts, -3).reshape(*batch, height, width)


class Propagator(SpectralFilter):
    """The planned propagation as a module: plans once and keeps its kernel. Fields [..., C, H, W], as ``propagate``.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, negative to travel back.
        tolerance: Largest relative L2 error, in expectation over noise that fills ``band`` and the window.
        band: Highest frequencies (y, x) of the content, in cycles per metre; the grid's own by default.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at the ends of each axis.
        memory_limit: Refuse a plan that needs more bytes than this per channel.

    Attributes:
        plan: What was chosen and why.

    Raises and warns as ``propagate``.
    """

    plan: Plan

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        *,
        tolerance: float = 1e-3,
        band: tuple[float, float] | None = None,
        margin: tuple[float, float] = (0.0, 0.0),
        memory_limit: int | None = None,
    ):
        waves = torch.tensor(checks.wavelengths(wavelengths), dtype=torch.float64)
        far = torch.tensor(checks.finite("distance", distance, "metres"), dtype=torch.float64)
        found = candidates(grid, waves.tolist(), distance, band=band, margin=margin)
        plan = plan_from(found, grid, tolerance, memory_limit)
        way = _best(found, tolerance)
        super().__init__(grid, wavelengths, kernel_of(grid, way, waves, far, torch.complex128))
        self.plan, self.distance = plan, float(distance)


def _best(found: list[Candidate], tolerance: float) -> Candidate:
    best, _ = choose(found, tolerance)
    if best.error > tolerance:
        text = (
            f"no way reaches a tolerance of {tolerance:.1e} for noise that fills the described band and window; "
            f"{best.method} on {best.padded[0]} x {best.padded[1]} samples comes to {best.error:.1e}. Describe the "
            "content by band= and margin=, or ask for less"
        )
        if best.error > _UNUSABLE:
            raise ValueError(text)
        warnings.warn(text, SamplingWarning, stacklevel=3)
    return best


def kernel_of(grid: Grid, way: Candidate, waves: Tensor, distances: Tensor, dtype: torch.dtype) -> Tensor:
    """Transfer function of a chosen way, carrier included: [..., H, W] of its padded grid, in ``dtype``."""
    padded = Grid(way.padded, grid.pitch)
    if way.method == "angular spectrum" and min(grid.pitch) < FINEST * waves.detach().max().item():
        return wide_transfer_function(padded, waves, distances, dtype=dtype)
    if way.method == "identity":
        ones = torch.ones(*torch.broadcast_shapes(waves.shape, distances.shape), *grid.shape, dtype=dtype)
        return ones * carrier(waves, distances)[..., None, None].to(dtype)
    return transfer_function(padded, waves, distances, sampled=way.sampled, paraxial=way.paraxial, dtype=dtype)


def _float64(name: str, value: float | Tensor, field: Tensor) -> Tensor:
    if not isinstance(value, Tensor):
        value = torch.tensor(checks.finite(name, value, "metres"), dtype=torch.float64)
    value = value.to(field.device, torch.float64)
    checks.all_finite(name, value.detach())
    if name == "wavelength" and (value <= 0).any():
        raise ValueError(f"wavelength must be above zero in metres, got {value.min().item()!r}")
    return value
