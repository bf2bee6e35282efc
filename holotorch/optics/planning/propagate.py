"""propagate and Propagator: propagation by the method and padding that a plan chooses."""

import math
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import fft2, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.core.plan import Plan
from holotorch.core.quantities import DISTANCE, WAVELENGTH, Quantity
from holotorch.optics.free_space.kernels import carrier
from holotorch.optics.free_space.padding import FINEST
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair
from holotorch.optics.free_space.propagators import SpectralFilter
from holotorch.optics.free_space.resampled import ResampledKernel, resample, resampling_factors
from holotorch.optics.free_space.transfer import transfer_function, wide_transfer_function
from holotorch.optics.free_space.zoomed import ZoomedFilter, chirps, zoomed
from holotorch.optics.planning.candidates import Candidate, candidates
from holotorch.optics.planning.content import field_content
from holotorch.optics.planning.plan import choose, plan_from

_ZOOMED = "angular spectrum, zoomed"  # Candidate.method that reads the result on another grid by chirp-z transforms
_UNUSABLE = 0.1  # expected relative error above which a propagation is refused
# Fraction of the light below which both axes together decide how much arrives. Measured content, which holds each axis
# by itself, says nothing about such a small fraction.
_DIM = 1e-5
_DIM_ERROR = 5.0  # times the tolerance: error relative to the light that arrives above which a dim result is reported


def propagate(
    field: Tensor,
    grid: Grid,
    wavelength: float | Tensor,
    distance: float | Tensor,
    *,
    tolerance: float = 1e-3,
    band: tuple[float, float] | None = None,
    spread: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
    measure: bool = False,
    out_grid: Grid | None = None,
    offset: tuple[float, float] = (0.0, 0.0),
    tilt: tuple[float, float] | Tensor = (0.0, 0.0),
) -> Tensor:
    """Propagate ``field`` over ``distance`` by the cheapest method that is accurate enough.

    Args:
        field: complex64 or complex128, shape [..., H, W].
        grid: Sampling of the field.
        wavelength: In metres: a number, or a tensor whose shape broadcasts against the leading axes of ``field``. In a
            medium it is the wavelength there: the one in vacuum divided by the refractive index.
        distance: In metres, a number or a tensor like ``wavelength``; both may carry gradients. A field with an axis
            of size 1 where the distances have theirs is transformed once for all distances.
        tolerance: Largest accepted relative L2 error, in expectation over noise that fills ``band`` and the window.
        band: Highest frequencies (y, x) of the content, in cycles per metre; those of the grid by default.
        spread: Alternative to ``band``: distance (y, x) in metres that the content travels sideways on its path.
        margin: Widths (y, x) in metres over which the content fades smoothly to zero at both ends of each axis.
        measure: Plan for this field instead of a description, at the cost of two products with thin matrices.
        out_grid: Sampling of the result, of any shape and pitch; that of the field by default.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
        tilt: Sines (y, x) of the direction of a carrier wave that is divided out. The light is
            ``field`` exp(2 pi i (y s_y + x s_x) / wavelength), and the result times the same carrier is the light that
            arrives; y and x are relative to the axis of the source in both. May be a tensor [2] with gradients.

    Returns:
        Same dtype, shape [..., H', W'] broadcast with the leading axes. The carrier exp(ikz) is included; evanescent
        waves decay for either sign of the distance.

    Raises:
        TypeError: A field that is not complex.
        ValueError: Wrong shape, NaN or infinity, a wavelength that is not positive, or an expected error above 0.1 with
            every method.

    Warns:
        SamplingWarning: No method meets the tolerance: the most accurate one is used, and the message gives its
            expected error. Or so little light arrives in the window of the result that the error is large relative to
            it; this is neither checked during compilation nor by :class:`Propagator`.
        PrecisionWarning: A wavelength or distance in float32 whose rounding changes the phase by 0.01 rad or more.

    For a gradient in the pitch of both grids by a common factor s, use that scaling all lengths changes nothing:
    ``propagate(field, grid, wavelength / s, distance / s)`` is the field on a grid of s times the pitch.
    """
    checks.field("field", field, grid.shape)
    norms = None if torch.compiler.is_compiling() else _finite_norms(field)
    wavelengths, distances = _float64(WAVELENGTH, wavelength, field), _float64(DISTANCE, distance, field)
    checks.precise(wavelength, distance)
    every_wavelength, every_distance = (each.detach().reshape(-1).tolist() for each in (wavelengths, distances))
    planes = plane_pair(grid, out_grid, offset, tilt, every_wavelength)
    sample = field if measure else None
    scene = every_wavelength, every_distance
    content = field_content(grid, *scene, band=band, spread=spread, margin=margin, field=sample)
    best = _best(candidates(planes, *scene, content, field.dtype), checks.positive("tolerance", tolerance))
    if best.method == "identity":
        return field * carrier(wavelengths, distances)[..., None, None].to(field.dtype)
    sines = tilt.to(field.device, torch.float64) if isinstance(tilt, Tensor) else None
    result = _propagate_by(best, planes, field, wavelengths, distances, sines)
    _warn_if_dim(best, tolerance, planes, norms, result, measured=measure)
    return result


def _propagate_by(
    candidate: Candidate, planes: PlanePair, field: Tensor, wavelengths: Tensor, distances: Tensor, tilt: Tensor | None
) -> Tensor:
    """Propagate ``field`` by one method, for each wavelength and distance in turn."""
    dtype, out_shape = field.dtype, planes.out.shape

    def filtered(spectrum: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        kernel = kernel_of(planes, candidate, wavelength, distance, dtype, tilt)
        # Several distances share the spectrum; the memory of a spectrum that serves one distance is reused.
        single = wavelengths.numel() * distances.numel() == 1
        return ifft2(multiplied(spectrum, kernel) if single else spectrum * kernel, out_shape)

    def zoomed_in(each: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        padded = Grid(candidate.padded, planes.grid.pitch)
        kernel = kernel_of(_on_source_grid(planes), candidate, wavelength, distance, dtype, tilt)
        return zoomed(each, kernel, chirps(planes.grid, padded, planes.out, planes.offset, field.device))

    def resampled(each: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        padded = None if candidate.paraxial else candidate.padded
        return resample(each, resampling_factors(planes, wavelength, distance, padded=padded, tilt=tilt, dtype=dtype))

    if planes.same_pitch:
        return _one_by_one(fft2(field, candidate.padded), wavelengths, distances, out_shape, filtered)
    if bool((distances == 0).any()):
        raise ValueError("distance must not be 0 for a propagation onto another grid")
    apply = zoomed_in if candidate.method == _ZOOMED else resampled
    return _one_by_one(field, wavelengths, distances, out_shape, apply)


def _one_by_one(
    field: Tensor,
    wavelengths: Tensor,
    distances: Tensor,
    shape: tuple[int, int],
    apply: Callable[[Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    """``apply`` for each wavelength and distance: the kernels of all of them would not fit into the cache or memory."""
    wavelengths, distances = torch.broadcast_tensors(wavelengths, distances)
    batch = torch.broadcast_shapes(wavelengths.shape, field.shape[:-2])
    if wavelengths.numel() == 1:
        return apply(field, wavelengths.reshape(()), distances.reshape(())).expand(*batch, *shape)
    fields = field.expand(*batch, *field.shape[-2:])
    fields = fields.flatten(fields.ndim - 2 - wavelengths.ndim, -3)
    pairs = zip(wavelengths.reshape(-1), distances.reshape(-1), strict=True)
    parts = [apply(fields[..., i, :, :], wavelength, distance) for i, (wavelength, distance) in enumerate(pairs)]
    return torch.stack(parts, -3).reshape(*batch, *shape)


class Propagator(nn.Module):
    """The planned propagation as a module, which plans once and keeps the kernel of the chosen method.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, negative to travel back.
        tolerance: Largest accepted relative L2 error, in expectation over noise that fills ``band`` and the window.
        band: Highest frequencies (y, x) of the content, in cycles per metre; those of the grid by default.
        spread: Alternative to ``band``: distance (y, x) in metres that the content travels sideways on its path.
        margin: Widths (y, x) in metres over which the content fades smoothly to zero at both ends of each axis.
        example: A field [..., H, W] like those to be propagated, which is measured and replaces the description.
        out_grid: Sampling of the result; that of the field by default.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
        tilt: Sines (y, x) of the direction of a carrier wave that is divided out, as in :func:`propagate`.
        memory_limit: Refuse a plan that needs more bytes than this per channel.

    Attributes:
        plan: What was chosen and why.

    Raises and warns like ``propagate``.
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
        spread: tuple[float, float] | None = None,
        margin: tuple[float, float] = (0.0, 0.0),
        example: Tensor | None = None,
        out_grid: Grid | None = None,
        offset: tuple[float, float] = (0.0, 0.0),
        tilt: tuple[float, float] = (0.0, 0.0),
        memory_limit: int | None = None,
    ):
        super().__init__()
        self.wavelengths = checks.wavelengths(wavelengths)
        self.distance = checks.quantity(DISTANCE, distance)
        planes = plane_pair(grid, out_grid, offset, tilt, self.wavelengths)
        self.grid, self.out_grid, self.offset, self.tilt = grid, planes.out, planes.offset, planes.tilt
        scene = self.wavelengths, [self.distance]
        content = field_content(grid, *scene, band=band, spread=spread, margin=margin, field=example)
        options = candidates(planes, *scene, content)
        self.plan = plan_from(options, planes, tolerance, memory_limit)
        best = _best(options, tolerance)
        if not planes.same_pitch and best.method != _ZOOMED:
            self.operator = ResampledKernel(
                grid, self.wavelengths, self.distance, planes.out,
                offset=offset, tilt=tilt, paraxial=best.paraxial, padded=best.padded,
            )  # fmt: skip
            return
        lengths = _double(self.wavelengths), _double(self.distance)
        if planes.same_pitch:
            kernel = kernel_of(planes, best, *lengths, torch.complex128)
            self.operator = SpectralFilter(grid, self.wavelengths, kernel, out_grid=planes.out)
        else:
            kernel = kernel_of(_on_source_grid(planes), best, *lengths, torch.complex128)
            self.operator = ZoomedFilter(grid, self.wavelengths, kernel, planes.out, offset=planes.offset)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field``, complex [..., C, H, W], to [..., C, H', W'], same dtype."""
        return self.operator(field)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        return self.operator.adjoint(field)

    def extra_repr(self) -> str:
        """Distance and plan, for ``print(module)``."""
        return f"distance={self.distance}, method={self.plan.method!r}, padded={self.plan.padded}"


def _best(options: list[Candidate], tolerance: float) -> Candidate:
    """The candidate to use; refused or warned of, in the name of the calling function, where it is not adequate."""
    best, _ = choose(options, tolerance)
    if best.error > tolerance:
        text = (
            f"no method reaches a tolerance of {tolerance:.1e} for noise that fills the described band and window; "
            f"{best.method} on {best.padded[0]} x {best.padded[1]} samples comes to {best.error:.1e}. Describe the "
            "content by band= and margin=, or ask for less"
        )
        if best.error > _UNUSABLE:
            raise ValueError(text)
        warnings.warn(text, SamplingWarning, stacklevel=3)
    return best


def _norms(field: Tensor) -> Tensor:
    return torch.linalg.vector_norm(torch.view_as_real(field.detach().resolve_conj()), dim=(-3, -2, -1))


def _finite_norms(field: Tensor) -> Tensor:
    """L2 norms [...] of ``field``; ValueError for elements that are not finite."""
    norms = _norms(field)
    if not bool(torch.isfinite(norms).all()):  # or squares that overflow
        checks.all_finite("field", torch.view_as_real(field.detach().resolve_conj()))
    return norms


def _warn_if_dim(
    best: Candidate, tolerance: float, planes: PlanePair, norms: Tensor | None, result: Tensor, *, measured: bool
) -> None:
    """Warn where so much less light arrives than expected that the predicted error is large relative to it.

    ``norms`` are the L2 norms [...] of the fields at the source; without them nothing is checked.
    """
    if norms is None or 0 in result.shape or best.error > tolerance:  # _best has warned of the last case
        return
    cells = math.prod(planes.out.pitch) / math.prod(planes.grid.pitch)
    shares = torch.where(norms > 0, (_norms(result) / norms).square() * cells, 1.0)
    dimmest = float(torch.where(torch.isfinite(shares), shares, 1.0).min())
    allowed = _DIM_ERROR * tolerance
    # No more than all light can be expected. Most calls end here, before the expectation is computed.
    if best.error <= allowed * math.sqrt(dimmest):
        return
    expected = 1.0 if measured and dimmest < _DIM else best.captured()
    left = best.error * math.sqrt(expected / max(dimmest, 1e-300))
    if left > allowed:
        warnings.warn(
            f"only {dimmest:.2g} of the light lands in the window of the result, and the error of {best.method} may be "
            f"{left:.1e} of what lands, more than the tolerance of {tolerance:.1e}. Move the window to the light, or "
            f"ask for a tolerance below {tolerance * allowed / left:.1e}",
            SamplingWarning,
            stacklevel=3,
        )


def _on_source_grid(planes: PlanePair) -> PlanePair:
    """The planes of the transfer function alone, without the other grid on which chirp-z transforms read the result."""
    return PlanePair(planes.grid, planes.grid, (0.0, 0.0), planes.tilt)


def kernel_of(
    planes: PlanePair,
    candidate: Candidate,
    wavelength: Tensor,
    distance: Tensor,
    dtype: torch.dtype,
    tilt: Tensor | None = None,
) -> Tensor:
    """Transfer function of a candidate with its carrier, [..., H, W] on its padded grid, in ``dtype``."""
    grid = planes.grid
    padded = Grid(candidate.padded, grid.pitch)
    sampled = candidate.method in ("angular spectrum", _ZOOMED)
    if sampled and not any(planes.tilt) and min(grid.pitch) < FINEST * wavelength.detach().max().item():
        return wide_transfer_function(planes, padded, wavelength, distance, dtype=dtype)
    if candidate.method == "identity":
        ones = torch.ones(*torch.broadcast_shapes(wavelength.shape, distance.shape), *grid.shape, dtype=dtype)
        return ones * carrier(wavelength, distance)[..., None, None].to(dtype)
    return transfer_function(
        planes,
        padded,
        wavelength,
        distance,
        sampled=candidate.sampled,
        paraxial=candidate.paraxial,
        tilt=tilt,
        dtype=dtype,
    )


def _float64(kind: Quantity, value: float | Tensor, field: Tensor) -> Tensor:
    """A checked quantity as float64 tensor on the device of ``field``."""
    if not isinstance(value, Tensor):
        value = torch.tensor(checks.quantity(kind, value), dtype=torch.float64)
    value = value.to(field.device, torch.float64)
    checks.quantities(kind, value)
    return value


def _double(values: float | Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
