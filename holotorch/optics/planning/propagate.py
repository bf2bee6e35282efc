"""propagate and Propagator: the planned propagation, which picks method and padding and says why."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import fft2, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.core.plan import Plan
from holotorch.core.quantities import DISTANCE, WAVELENGTH
from holotorch.optics.free_space.kernels import carrier
from holotorch.optics.free_space.padding import FINEST
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair
from holotorch.optics.free_space.propagators import SpectralFilter
from holotorch.optics.free_space.resampled import ResampledKernel, resample, resampling_factors
from holotorch.optics.free_space.transfer import transfer_function, wide_transfer_function
from holotorch.optics.free_space.zoomed import ZoomedFilter, chirps, zoomed
from holotorch.optics.planning.candidates import Candidate
from holotorch.optics.planning.plan import choose, find, plan_from

_ZOOMED = "angular spectrum, zoomed"
_UNUSABLE = 0.1  # expected error from which a result is refused
_DIM = 1e-5  # share of the light below which both axes together decide what lands, which measured lines do not tell
_DIMMER = 5.0  # times the tolerance: the error of what is left of the light from which a dim result is warned of


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
        grid: Its sampling.
        wavelength: In metres: a number, or a tensor whose shape broadcasts against the leading axes of ``field``. In a
            medium, the wavelength there: the one in vacuum divided by the refractive index.
        distance: In metres, likewise; both may carry gradients. Many distances share one forward transform: give the
            field an axis of size 1 where the distances have theirs.
        tolerance: Largest relative L2 error, in expectation over noise that fills ``band`` and the window.
        band: Highest frequencies (y, x) of the content, in cycles per metre; the grid's own by default.
        spread: The same said as how far (y, x) in metres the content travels sideways over the distance.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at the ends of each axis.
        measure: Plan for this very field instead of a description, at the cost of two thin matrix products.
        out_grid: Sampling of the result, of any shape and pitch; that of the field by default.
        offset: Where (y, x) in metres the axis of the result lies beside that of the field.
        tilt: Sines (y, x) of the direction of a carrier that is taken out: the light is
            ``field`` exp(2 pi i (y s_y + x s_x) / wavelength), and the result times the same carrier is the light that
            arrives, with y and x counted from the axis of the source in both. May be a tensor [2] with gradients.

    Returns:
        Same dtype, shape [..., H', W'] broadcast with the leading axes. The carrier exp(ikz) is included; evanescent
        waves decay for either sign of the distance.

    Raises:
        TypeError: A field that is not complex.
        ValueError: Wrong shape, NaN or infinity anywhere, a wavelength that is not positive, or no method whose
            expected error is below 0.1.

    Warns:
        SamplingWarning: No method meets the tolerance; the most accurate one is used and its expected error named. Or
            so little of the light lands in the window of the result that the error is large compared with it. The
            second is not checked while compiling, nor by :class:`Propagator`, which plans before there is a result.
        PrecisionWarning: A wavelength or distance in float32, whose rounding turns the phase by 0.01 rad or more.

    A gradient in the pitch, say a factor s on it and on the output's: nothing changes when all lengths are scaled, so
    ``propagate(field, grid, wavelength / s, distance / s)`` is the field on a grid of s times the pitch.
    """
    checks.field("field", field, grid.shape)
    sent = None if torch.compiler.is_compiling() else _finite_norms(field)
    wavelengths, distances = _float64("wavelength", wavelength, field), _float64("distance", distance, field)
    checks.precise(wavelength, distance)
    numbers = [values.detach().reshape(-1).tolist() for values in (wavelengths, distances)]
    planes = plane_pair(grid, out_grid, offset, tilt, numbers[0])
    sines = tilt.to(field.device, torch.float64) if isinstance(tilt, Tensor) else None
    sample = field if measure else None
    candidates = find(planes, *numbers, band=band, spread=spread, margin=margin, field=sample, dtype=field.dtype)
    best = _best(candidates, checks.positive("tolerance", tolerance))
    if best.method == "identity":
        return field * carrier(wavelengths, distances)[..., None, None].to(field.dtype)
    carry_out = _filtered if planes.same_pitch else _resampled
    result = carry_out(field, planes, best, wavelengths, distances, sines)
    _check_light(best, tolerance, planes, sent, result, measured=measure)
    return result


def _filtered(
    field: Tensor, planes: PlanePair, best: Candidate, wavelengths: Tensor, distances: Tensor, tilt: Tensor | None
) -> Tensor:
    """Propagate onto samples of the same pitch: one filter in frequency per wavelength and distance."""

    def apply(spectrum: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        kernel = kernel_of(planes, best, wavelength, distance, field.dtype, tilt)
        # The spectrum serves several distances; only when there is one may its memory be taken.
        product = multiplied(spectrum, kernel) if wavelengths.numel() * distances.numel() == 1 else spectrum * kernel
        return ifft2(product, planes.out.shape)

    return _one_by_one(fft2(field, best.padded), wavelengths, distances, planes.out.shape, apply)


def _resampled(
    field: Tensor, planes: PlanePair, best: Candidate, wavelengths: Tensor, distances: Tensor, tilt: Tensor | None
) -> Tensor:
    """Propagate onto a grid of another pitch. ValueError for a distance of 0."""
    if bool((distances == 0).any()):
        raise ValueError("distance must not be 0 for a propagation onto another grid")

    def apply(each: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        if best.method == _ZOOMED:
            padded = Grid(best.padded, planes.grid.pitch)
            kernel = kernel_of(_on_source_samples(planes), best, wavelength, distance, field.dtype, tilt)
            return zoomed(each, kernel, chirps(planes.grid, padded, planes.out, planes.offset, field.device))
        room = None if best.paraxial else best.padded
        return resample(
            each, resampling_factors(planes, wavelength, distance, padded=room, tilt=tilt, dtype=field.dtype)
        )

    return _one_by_one(field, wavelengths, distances, planes.out.shape, apply)


def _one_by_one(
    field: Tensor,
    wavelengths: Tensor,
    distances: Tensor,
    shape: tuple[int, int],
    apply: Callable[[Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    """``apply`` for each wavelength and distance: all kernels together would not fit into the cache, nor memory."""
    wavelengths, distances = torch.broadcast_tensors(wavelengths, distances)
    batch = torch.broadcast_shapes(wavelengths.shape, field.shape[:-2])
    if wavelengths.numel() == 1:
        return apply(field, wavelengths.reshape(()), distances.reshape(())).expand(*batch, *shape)
    fields = field.expand(*batch, *field.shape[-2:])
    fields = fields.flatten(fields.ndim - 2 - wavelengths.ndim, -3)
    pairs = zip(wavelengths.reshape(-1), distances.reshape(-1), strict=True)
    parts = [apply(fields[..., i, :, :], *pair) for i, pair in enumerate(pairs)]
    return torch.stack(parts, -3).reshape(*batch, *shape)


class Propagator(nn.Module):
    """The planned propagation as a module: plans once and keeps the one kernel that it needs.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, negative to travel back.
        tolerance: Largest relative L2 error, in expectation over noise that fills ``band`` and the window.
        band: Highest frequencies (y, x) of the content, in cycles per metre; the grid's own by default.
        spread: The same said as how far (y, x) in metres the content travels sideways over the distance.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at the ends of each axis.
        example: A field [..., H, W] like those to come, to measure instead of a description.
        out_grid: Sampling of the result; that of the field by default.
        offset: Where (y, x) in metres the axis of the result lies beside that of the field.
        tilt: Sines (y, x) of the direction of a carrier that is taken out, as in :func:`propagate`.
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
        content: dict[str, Any] = {"band": band, "spread": spread, "margin": margin, "field": example}
        candidates = find(planes, self.wavelengths, [self.distance], **content)
        self.plan = plan_from(candidates, planes, tolerance, memory_limit)
        best = _best(candidates, tolerance)
        if not planes.same_pitch and best.method != _ZOOMED:
            self.operator = ResampledKernel(
                grid, self.wavelengths, self.distance, planes.out,
                offset=offset, tilt=tilt, paraxial=best.paraxial, padded=best.padded,
            )  # fmt: skip
            return
        lengths = (
            torch.tensor(self.wavelengths, dtype=torch.float64),
            torch.tensor(self.distance, dtype=torch.float64),
        )
        if planes.same_pitch:
            kernel = kernel_of(planes, best, *lengths, torch.complex128)
            self.operator = SpectralFilter(grid, self.wavelengths, kernel, out_grid=planes.out)
        else:
            kernel = kernel_of(_on_source_samples(planes), best, *lengths, torch.complex128)
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


def _best(candidates: list[Candidate], tolerance: float) -> Candidate:
    best, _ = choose(candidates, tolerance)
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


def _check_light(
    best: Candidate, tolerance: float, planes: PlanePair, sent: Tensor | None, result: Tensor, *, measured: bool
) -> None:
    """Warn where so much less light arrives than was expected that the error of the plan is large beside it."""
    if sent is None or 0 in result.shape or best.error > tolerance:  # of which _best has warned
        return
    cells = math.prod(planes.out.pitch) / math.prod(planes.grid.pitch)
    shares = torch.where(sent > 0, (_norms(result) / sent).square() * cells, 1.0)
    dimmest = float(torch.where(torch.isfinite(shares), shares, 1.0).min())
    allowed = _DIMMER * tolerance
    # All light is the most that can be expected: most calls end here, without asking what is.
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


def _on_source_samples(planes: PlanePair) -> PlanePair:
    """The same propagation with the result on the source's samples, to be read at other points afterwards."""
    return PlanePair(planes.grid, planes.grid, (0.0, 0.0), planes.tilt)


def kernel_of(
    planes: PlanePair,
    best: Candidate,
    wavelengths: Tensor,
    distances: Tensor,
    dtype: torch.dtype,
    tilt: Tensor | None = None,
) -> Tensor:
    """Transfer function of the chosen method, carrier included: [..., H, W] of its padded grid, in ``dtype``."""
    grid = planes.grid
    padded = Grid(best.padded, grid.pitch)
    sampled = best.method in ("angular spectrum", _ZOOMED)
    if sampled and not any(planes.tilt) and min(grid.pitch) < FINEST * wavelengths.detach().max().item():
        return wide_transfer_function(planes, padded, wavelengths, distances, dtype=dtype)
    if best.method == "identity":
        ones = torch.ones(*torch.broadcast_shapes(wavelengths.shape, distances.shape), *grid.shape, dtype=dtype)
        return ones * carrier(wavelengths, distances)[..., None, None].to(dtype)
    return transfer_function(
        planes, padded, wavelengths, distances, sampled=best.sampled, paraxial=best.paraxial, tilt=tilt, dtype=dtype
    )


def _float64(name: str, value: float | Tensor, field: Tensor) -> Tensor:
    kind = WAVELENGTH if name == "wavelength" else DISTANCE
    if not isinstance(value, Tensor):
        value = torch.tensor(checks.quantity(kind, value), dtype=torch.float64)
    value = value.to(field.device, torch.float64)
    checks.quantities(kind, value)
    return value
