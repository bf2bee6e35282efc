"""propagate and Propagator: propagation by the cheapest method and padding with a small enough predicted error."""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import fft2, filter_spectrum, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.core.operator import Wavelengths
from holotorch.core.plan import Plan
from holotorch.core.quantities import DISTANCE, WAVELENGTH, Quantity
from holotorch.optics.free_space.kernels import carrier
from holotorch.optics.free_space.learned_distance import has_closed_form, times_learned
from holotorch.optics.free_space.padding import FINEST
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair
from holotorch.optics.free_space.propagators import DistanceFilter, checked_distance, checked_wavelengths
from holotorch.optics.free_space.resampled import ResampledKernel, resample, resampling_factors
from holotorch.optics.free_space.transfer import transfer_function, wide_transfer_function
from holotorch.optics.free_space.zoomed import ZoomedFilter, chirps, zoomed
from holotorch.optics.planning.candidates import ZOOMED, Candidate, Method, candidates
from holotorch.optics.planning.content import FieldContent, field_content
from holotorch.optics.planning.plan import choose, plan_from

STEP = 1.1  # ratio of successive distances for which propagations over a learned distance are planned
_REMEMBERED = 1 << 24  # largest number of samples of the kernels that one call remembers; 128 MB in complex64
_UNUSABLE = 0.1  # expected relative error above which a propagation is refused
_DIM = 1e-5  # arriving fraction of the light below which measured content, stored per axis, cannot predict it
_DIM_ERROR = 5.0  # error relative to the arriving light above which a warning is given, in units of the tolerance


def propagate(
    field: Tensor,
    grid: Grid,
    wavelength: Wavelengths,
    distance: float | Tensor,
    *,
    plan: Plan | None = None,
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
        wavelength: Wavelength in metres in the medium: a number, or several numbers or a tensor whose shape broadcasts
            against the leading axes of ``field``.
        distance: In metres, a number or a tensor like ``wavelength``; both may carry gradients. A field whose axis has
            size 1 where ``distance`` has several values is transformed once for all of them.
        plan: Result of :func:`plan_propagation` for these planes, which is used whatever the distance, in place of the
            arguments that describe the content. By default the propagation is planned here; plans and, unless they
            carry gradients, a few kernels are remembered. A distance that carries a gradient is planned as the next
            longer power of :data:`STEP`, so that the method does not change from step to step of an optimisation.
        tolerance: Largest accepted relative L2 error, in expectation over noise that fills ``band`` and the window;
            smoother content has a smaller error.
        band: Highest frequencies (y, x) of the content, in cycles per metre; those of the grid by default.
        spread: Alternative to ``band``: distance (y, x) in metres that the content travels sideways on its path.
        margin: Widths (y, x) in metres over which the content fades smoothly to zero at both ends of each axis. By
            default the window cuts the content off, and the edges diffract.
        measure: Plan for this field instead of a description, at the cost of two products with thin matrices.
        out_grid: Sampling of the result, of any shape and pitch; that of the field by default.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
        tilt: Sines (y, x) of the direction of a carrier wave by which both fields are divided: the light at the source
            is ``field`` exp(2 pi i (y s_y + x s_x) / wavelength), and the light that arrives is the result times the
            same carrier, with y and x relative to the axis of the source. May be a tensor [2] with gradients.

    Returns:
        Same dtype, shape [..., H', W'], with leading axes broadcast over ``field``, ``wavelength`` and ``distance``.
        The factor exp(ikz) is included; evanescent waves decay for either sign of the distance.

    Raises:
        TypeError: A field that is not complex.
        ValueError: Wrong shape, NaN or infinity, a wavelength that is not positive, an expected error above 0.1 with
            every method, or a plan for other planes.

    Warns:
        SamplingWarning: No method meets the tolerance: the most accurate one is used, and the message gives its
            expected error. Or so little light arrives in the window of the result that the error is large relative to
            this light; compiled calls, calls with a ``plan`` and :class:`Propagator` omit this check.
        PrecisionWarning: A wavelength or distance in float32 whose rounding changes the phase by 0.01 rad or more.

    A gradient in a common factor s of both pitches is that of ``propagate(field, grid, wavelength / s, distance / s)``,
    the result on grids of s times the pitch, because scaling all lengths changes nothing.
    """
    norms = _checked_norms(field, grid)
    call = grid, wavelength, distance, plan, tolerance, out_grid, offset, tilt, band, spread, margin
    tensors = any(isinstance(value, Tensor) for value in (wavelength, distance, tilt))
    if measure or tensors or torch.compiler.is_compiling():
        job = _prepared(*call, field.dtype, field.device, example=field if measure else None)
    else:
        try:
            job = _remembered_job(*call, field.dtype, field.device)
        except TypeError:  # a list, which cannot be remembered
            job = _prepared(*call, field.dtype, field.device)
    if job.chosen is not None:
        _accept(job.chosen, tolerance)
    result = _propagate_by(job, field, tilt if isinstance(tilt, Tensor) else None)
    if job.chosen is not None:
        _warn_if_dim(job.chosen, tolerance, job.planes, norms, result, measured=measure)
    return result


class _Job(NamedTuple):
    """What a call of :func:`propagate` does with its field.

    ``pairs`` are the wavelengths and distances of the kernels that are remembered; None if they are made anew.
    ``chosen`` is None for a plan that was handed in.
    """

    planes: PlanePair
    method: Method
    chosen: Candidate | None
    wavelengths: Tensor
    distances: Tensor
    pairs: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    leading: tuple[int, ...] = ()  # shape of the pairs


def _prepared(
    grid: Grid,
    wavelength: Wavelengths,
    distance: float | Tensor,
    plan: Plan | None,
    tolerance: float,
    out_grid: Grid | None,
    offset: tuple[float, float],
    tilt: tuple[float, float] | Tensor,
    band: tuple[float, float] | None,
    spread: tuple[float, float] | None,
    margin: tuple[float, float],
    dtype: torch.dtype,
    device: torch.device,
    *,
    example: Tensor | None = None,
) -> _Job:
    """Check the arguments of :func:`propagate` and choose a method; ``example`` is the field if it is measured."""
    wavelengths, distances = _float64(WAVELENGTH, wavelength, device), _float64(DISTANCE, distance, device)
    checks.precise(wavelengths if isinstance(wavelength, Sequence) else wavelength, distance)
    every_wavelength, every_distance = (each.detach().reshape(-1).tolist() for each in (wavelengths, distances))
    planes = plane_pair(grid, out_grid, offset, tilt, every_wavelength)
    learned = wavelengths.requires_grad or distances.requires_grad or isinstance(tilt, Tensor)
    if plan is None:
        chosen = _chosen(
            planes, every_wavelength, every_distance, dtype, tolerance,
            band=band, spread=spread, margin=margin, example=example, learned=distances.requires_grad,
        )  # fmt: skip
        method = chosen.plain
    else:
        chosen, method = None, _handed(plan, planes)
    if learned or not planes.same_pitch or not _rememberable(method, wavelengths, distances):
        return _Job(planes, method, chosen, wavelengths, distances)
    both = torch.broadcast_tensors(wavelengths.detach(), distances.detach())
    first, second = (tuple(each.reshape(-1).tolist()) for each in both)
    return _Job(planes, method, chosen, wavelengths, distances, (first, second), both[0].shape)


_remembered_job = lru_cache(maxsize=64)(_prepared)  # for calls with numbers only; tensors may change their values


def _propagate_by(job: _Job, field: Tensor, tilt: Tensor | None) -> Tensor:
    """Propagate ``field`` by one method, with a remembered kernel where nothing carries a gradient."""
    planes, method = job.planes, job.method
    if method.method == "identity":
        return field * carrier(job.wavelengths, job.distances)[..., None, None].to(field.dtype)
    if job.pairs is None:
        tilt = None if tilt is None else tilt.to(field.device, torch.float64)
        return _propagate_anew(method, planes, field, job.wavelengths, job.distances, tilt)
    kernel = _constant_kernel(planes, method, *job.pairs, field.dtype, field.device)
    return filter_spectrum(field, kernel.reshape(*job.leading, *kernel.shape[-2:]), planes.out.shape)


def _propagate_anew(
    candidate: Method, planes: PlanePair, field: Tensor, wavelengths: Tensor, distances: Tensor, tilt: Tensor | None
) -> Tensor:
    """Propagate ``field`` by one method, with a new kernel for each wavelength and distance in turn."""

    def filtered(spectrum: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        # Several distances share the spectrum; for a single one its memory is reused.
        single = wavelengths.numel() * distances.numel() == 1
        times = partial(_times_kernel, planes=planes, method=candidate, tilt=tilt, overwrite=single)
        return ifft2(times(spectrum, wavelength, distance), planes.out.shape)

    def zoomed_in(field: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        kernel = kernel_of(planes, candidate, wavelength, distance, field.dtype, tilt)
        padded = Grid(candidate.padded, planes.grid.pitch)
        return zoomed(field, kernel, chirps(planes.grid, padded, planes.out, planes.offset, field.device))

    def resampled(field: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
        padded = None if candidate.paraxial else candidate.padded
        factors = resampling_factors(planes, wavelength, distance, padded=padded, tilt=tilt, dtype=field.dtype)
        return resample(field, factors)

    if planes.same_pitch:
        return _one_by_one(fft2(field, candidate.padded), wavelengths, distances, planes.out.shape, filtered)
    if bool((distances == 0).any()):
        raise ValueError("distance must not be 0 for a propagation onto another grid")
    apply = zoomed_in if candidate.method == ZOOMED else resampled
    return _one_by_one(field, wavelengths, distances, planes.out.shape, apply)


def _one_by_one(
    field: Tensor, wavelengths: Tensor, distances: Tensor, shape: tuple[int, int], apply: Callable[..., Tensor]
) -> Tensor:
    """``apply(field, wavelength, distance)`` for each pair in turn, since all kernels together need too much memory."""
    if wavelengths.ndim == distances.ndim == 0:
        return apply(field, wavelengths, distances)
    wavelengths, distances = torch.broadcast_tensors(wavelengths, distances)
    batch = torch.broadcast_shapes(wavelengths.shape, field.shape[:-2])
    if wavelengths.numel() == 1:
        return apply(field, wavelengths.reshape(()), distances.reshape(())).expand(*batch, *shape)
    fields = field.expand(*batch, *field.shape[-2:]).flatten(len(batch) - wavelengths.ndim, -3)
    pairs = zip(wavelengths.reshape(-1), distances.reshape(-1), strict=True)
    parts = [apply(fields[..., i, :, :], wavelength, distance) for i, (wavelength, distance) in enumerate(pairs)]
    return torch.stack(parts, -3).reshape(*batch, *shape)


class Propagator(nn.Module):
    """The propagation of :func:`propagate` as a module, which plans once and keeps the kernel of the chosen method.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, negative to travel back. Wavelengths [C] and distance may be ``nn.Parameter``; the method
            and its padding stay those planned for their first values.
        tolerance, band, spread, margin, out_grid, offset, tilt: As in :func:`propagate`; numbers, not tensors.
        example: A field [..., H, W] like those to be propagated, which is measured and replaces the description of the
            content by ``band``, ``spread`` and ``margin``.
        memory_limit: Refuse a plan that needs more bytes than this per channel.
        learnable: Make the distance a Parameter.

    Attributes:
        plan: The chosen method and the reason for it.

    Raises and warns like :func:`propagate`.
    """

    plan: Plan

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float | Tensor,
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
        learnable: bool = False,
    ):
        super().__init__()
        self.wavelengths, z = checked_wavelengths(wavelengths), checked_distance(distance)
        self._distance = z
        planes = plane_pair(grid, out_grid, offset, tilt, self.wavelengths)
        self.grid, self.out_grid, self.offset, self.tilt = grid, planes.out, planes.offset, planes.tilt
        scene = self.wavelengths, [z]
        content = field_content(grid, *scene, band=band, spread=spread, margin=margin, field=example)
        options = candidates(planes, *scene, content)
        self.plan = plan_from(options, planes, tolerance, memory_limit)
        best, _ = choose(options, tolerance)
        _accept(best, tolerance)
        if planes.same_pitch:
            self.operator = DistanceFilter(
                grid, wavelengths, distance, best.padded, partial(kernel_of, planes, best.plain),
                times=partial(_times_kernel, planes=planes, method=best.plain),
                out_grid=planes.out, learnable=learnable,
            )  # fmt: skip
            return
        if learnable or isinstance(distance, nn.Parameter) or isinstance(wavelengths, nn.Parameter):
            raise ValueError(
                "Propagator learns distance and wavelengths only for a result of the same pitch as the field; call "
                "propagate(..., plan=plan) with tensors that carry gradients instead"
            )
        if best.method != ZOOMED:
            self.operator = ResampledKernel(
                grid, self.wavelengths, z, planes.out,
                offset=offset, tilt=tilt, paraxial=best.paraxial, padded=best.padded,
            )  # fmt: skip
            return
        lengths = torch.tensor(self.wavelengths, dtype=torch.float64), torch.tensor(z, dtype=torch.float64)
        kernel = kernel_of(planes, best, *lengths, torch.complex128)
        self.operator = ZoomedFilter(grid, self.wavelengths, kernel, planes.out, offset=planes.offset)

    @property
    def distance(self) -> float | Tensor:
        """In metres; a Parameter if it is learned."""
        return self.operator.distance if isinstance(self.operator, DistanceFilter) else self._distance

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field``, complex [..., C, H, W], to [..., C, H', W'], same dtype."""
        return self.operator(field)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        return self.operator.adjoint(field)

    def extra_repr(self) -> str:
        """Distance and plan, for ``print(module)``."""
        return f"distance={self.distance}, method={self.plan.method!r}, padded={self.plan.padded}"


def _chosen(
    planes: PlanePair,
    wavelengths: list[float],
    distances: list[float],
    dtype: torch.dtype,
    tolerance: float,
    *,
    example: Tensor | None,
    learned: bool,
    **described: tuple[float, float] | None,
) -> Candidate:
    """The best candidate for content as ``described`` (band, spread and margin) or, if given, as in ``example``."""
    checks.positive("tolerance", tolerance)
    if learned and planes.straight:  # the error of such a method grows with the distance
        distances = [next_longer(each) for each in distances]
    content = field_content(planes.grid, wavelengths, distances, field=example, **described)  # type: ignore[arg-type]
    if example is not None:
        return choose(candidates(planes, wavelengths, distances, content, dtype), tolerance)[0]
    return _cached_choice(planes, tuple(wavelengths), tuple(distances), content, dtype, tolerance)


@lru_cache(maxsize=64)
def _cached_choice(
    planes: PlanePair,
    wavelengths: tuple[float, ...],
    distances: tuple[float, ...],
    content: FieldContent,
    dtype: torch.dtype,
    tolerance: float,
) -> Candidate:
    return choose(candidates(planes, wavelengths, distances, content, dtype), tolerance)[0]


def next_longer(distance: float) -> float:
    """The number at or beyond ``distance``, with its sign, that is a power of :data:`STEP`; 0 for 0."""
    if distance == 0:
        return 0.0
    return math.copysign(STEP ** math.ceil(math.log(abs(distance), STEP) - 1e-9), distance)


def _handed(plan: Plan, planes: PlanePair) -> Method:
    """The method of a plan; TypeError if it is no plan, ValueError if it is for other planes."""
    if not isinstance(plan, Plan):
        raise TypeError(f"plan must be a result of plan_propagation, got {type(plan).__name__}")
    window = planes.out.shape, planes.out.pitch, planes.offset
    if plan.window != window:
        raise ValueError(f"plan must be for a result of (shape, pitch, offset) {window}, got one for {plan.window}")
    return Method(plan.method, plan.sampled, plan.padded, plan.paraxial)


def _rememberable(method: Method, wavelengths: Tensor, distances: Tensor) -> bool:
    """Whether the kernels of all wavelengths and distances together are small enough to be kept and used at once."""
    kernels = wavelengths.numel() * distances.numel()  # at most
    return not torch.compiler.is_compiling() and kernels * math.prod(method.padded) <= _REMEMBERED


@lru_cache(maxsize=4)
def _constant_kernel(
    planes: PlanePair,
    method: Method,
    wavelengths: tuple[float, ...],
    distances: tuple[float, ...],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """:func:`kernel_of` for pairs of wavelength and distance, without gradients, [N, P, Q]."""
    with torch.inference_mode(False), torch.no_grad():
        wavelength, distance = (
            torch.tensor(each, dtype=torch.float64, device=device) for each in (wavelengths, distances)
        )
        return kernel_of(planes, method, wavelength, distance, dtype)


def _accept(best: Candidate, tolerance: float) -> None:
    """ValueError or a warning, in the name of the caller's caller, if the best candidate exceeds the tolerance."""
    if best.error > tolerance:
        farthest = max(y.distance for y, _ in best.scenes)
        text = (
            f"no method reaches a tolerance of {tolerance:.1e} over {farthest:.3g} m, for noise that fills the "
            f"described band and window; {best.label} comes to {best.error:.1e}. Describe the content by band= and "
            "margin=, or ask for less"
        )
        if best.error > _UNUSABLE:
            raise ValueError(text)
        warnings.warn(text, SamplingWarning, stacklevel=3)


def _checked_norms(field: Tensor, grid: Grid) -> Tensor | None:
    """:func:`_norms`, None under compile; raises unless ``field`` is a finite complex field on ``grid``."""
    checks.field("field", field, grid.shape)
    norms = None if torch.compiler.is_compiling() else _norms(field)
    # One field is asked without a sum, which takes as long as its norm. Squares of finite elements may overflow, too.
    if norms is not None and not math.isfinite((norms if norms.numel() == 1 else norms.sum()).item()):
        checks.all_finite("field", torch.view_as_real(field.detach().resolve_conj()))
    return norms


def _norms(field: Tensor) -> Tensor:
    """L2 norms [...] of ``field`` [..., H, W]."""
    return torch.linalg.vector_norm(torch.view_as_real(field.detach().resolve_conj()), dim=(-3, -2, -1))


def _warn_if_dim(
    best: Candidate, tolerance: float, planes: PlanePair, norms: Tensor | None, result: Tensor, *, measured: bool
) -> None:
    """Warn if less light arrives than expected, and the error relative to this light far exceeds the tolerance.

    ``norms`` are the L2 norms [...] of the fields at the source; if they are None, nothing is checked.
    """
    if norms is None or 0 in result.shape or best.error > tolerance:  # _accept has warned of the last case
        return
    dimmest = _least_ratio(_norms(result), norms) ** 2 * math.prod(planes.out.pitch) / math.prod(planes.grid.pitch)
    allowed = _DIM_ERROR * tolerance
    # Most calls end here: the expected fraction of the light is at most 1, and computing it takes longer.
    if best.error <= allowed * math.sqrt(dimmest):
        return
    expected = 1.0 if measured and dimmest < _DIM else best.captured()
    error = best.error * math.sqrt(expected / max(dimmest, 1e-300))
    if error > allowed:
        warnings.warn(
            f"only {dimmest:.2g} of the light lands in the window of the result, and the error of {best.method} may be "
            f"{error:.1e} of what lands, more than the tolerance of {tolerance:.1e}. Move the window to the light, or "
            f"ask for a tolerance below {tolerance * allowed / error:.1e}",
            SamplingWarning,
            stacklevel=3,
        )


def _least_ratio(norms: Tensor, before: Tensor) -> float:
    """Smallest ratio of norms; a dark source gives 0 / 0, which counts as 1 so that it causes no warning."""
    if norms.numel() == before.numel() == 1:  # numbers, which take a third of the time of tensors
        one, other = norms.item(), before.item()
        ratio = one / other if other else math.nan
        return 1.0 if math.isnan(ratio) else ratio
    return torch.nan_to_num(norms / before, nan=1.0).min().item()


def _times_kernel(
    spectrum: Tensor,
    wavelength: Tensor,
    distance: Tensor,
    *,
    planes: PlanePair,
    method: Method,
    tilt: Tensor | None = None,
    overwrite: bool = True,
) -> Tensor:
    """``spectrum`` [..., H, W] times :func:`kernel_of`, by its closed form if only one distance is learned."""
    if tilt is None and method.method != "identity" and has_closed_form(planes, wavelength, distance):
        padded = Grid(method.padded, planes.grid.pitch)
        by_autograd = partial(kernel_of, planes, method, dtype=spectrum.dtype)
        return times_learned(
            spectrum, padded, wavelength, distance,
            sampled=method.sampled, paraxial=method.paraxial, differentiable=by_autograd,
        )  # fmt: skip
    kernel = kernel_of(planes, method, wavelength, distance, spectrum.dtype, tilt)
    return multiplied(spectrum, kernel) if overwrite else spectrum * kernel


def kernel_of(
    planes: PlanePair,
    candidate: Method,
    wavelength: Tensor,
    distance: Tensor,
    dtype: torch.dtype,
    tilt: Tensor | None = None,
) -> Tensor:
    """Transfer function of ``candidate`` with the factor exp(ikz), [..., H, W] on the padded grid, in ``dtype``."""
    grid = planes.grid
    if candidate.method == "identity":
        ones = torch.ones(*torch.broadcast_shapes(wavelength.shape, distance.shape), *grid.shape, dtype=dtype)
        return ones * carrier(wavelength, distance)[..., None, None].to(dtype)
    if candidate.method == ZOOMED:  # the chirp-z transforms alone account for the grid of the result
        planes = PlanePair(grid, grid, tilt=planes.tilt)
    padded = Grid(candidate.padded, grid.pitch)
    if all(candidate.sampled) and not any(planes.tilt) and min(grid.pitch) < FINEST * wavelength.detach().max().item():
        return wide_transfer_function(planes, padded, wavelength, distance, dtype=dtype)
    sampled, paraxial = candidate.sampled, candidate.paraxial
    return transfer_function(
        planes, padded, wavelength, distance, sampled=sampled, paraxial=paraxial, tilt=tilt, dtype=dtype
    )


def _float64(kind: Quantity, value: float | Sequence[float] | Tensor, device: torch.device) -> Tensor:
    """``value`` as float64 tensor on ``device``, checked to be a plausible quantity of this kind."""
    if isinstance(value, float) and not torch.compiler.is_compiling():
        return _constant(kind, value, device)
    if isinstance(value, Tensor):
        value = value.to(device, torch.float64)
        checks.quantities(kind, value)
        return value
    return _constant.__wrapped__(kind, value, device)


@lru_cache(maxsize=64)
def _constant(kind: Quantity, value: float | Sequence[float], device: torch.device) -> Tensor:
    """Checked numbers as float64 tensor; remembered for learned distances, since making it takes 10 us."""
    each = value if isinstance(value, Sequence) else [value]
    numbers = [checks.quantity(kind, number) for number in each]
    with torch.inference_mode(False):  # a later call may need gradients
        tensor = torch.tensor(numbers, dtype=torch.float64, device=device)
    return tensor if isinstance(value, Sequence) else tensor[0]
