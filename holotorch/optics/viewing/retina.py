"""Retina: the image on the retina, by the cheaper of two methods that is accurate enough."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.core.learning import PreciseModule
from holotorch.core.quantities import WIDTH
from holotorch.core.tracing import constant_when_compiled, is_exporting
from holotorch.optics.viewing import imaging
from holotorch.optics.viewing.display import Display, Length, inverse, number
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling, propagate_elements
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.line_errors import Lines, field_lines, line_errors, noise_lines, scene_lines

_RAYS = 512  # rays across the pupil from each point of the scene that predict the error of the collapse
_HEIGHTS = 9  # points of the scene that predict the error of the collapse
_UNUSABLE = 0.5  # expected relative error above which a plan is refused
TOLERANCE = 0.1  # relative error of the intensity accepted by default; that of the collapse is mostly a shift of spots
_COSTLY = 10.0  # ratio of operations to those of the cheapest method above which a warning is given


@dataclass(frozen=True)
class RetinaPlan:
    """Method of propagation to the retina, and the reason for it.

    Attributes:
        method: "collapse" (:func:`propagate_collapsed`) or "elements" (:func:`propagate_elements`).
        sampling: Sizes for that method.
        predicted_error: Expected relative L2 error of the intensity of all channels; :func:`plan_retina` says for which
            light.
        memory_bytes: Largest extra memory in bytes for one image of one wavelength.
        flops: Floating-point operations for one image of one wavelength.
        reason: Error and cost of the chosen method, in words.
        runner_up: Error and cost of the other method, or why it is impossible, in words.
        adequate: Whether ``predicted_error`` is within the tolerance.
        cost_ratio: ``flops`` relative to those of the cheapest usable method.
        cheapest_error: ``predicted_error`` of that method.
    """

    method: str
    sampling: imaging.CollapseSampling | ElementSampling
    predicted_error: float
    memory_bytes: int
    flops: float
    reason: str
    runner_up: str
    adequate: bool
    cost_ratio: float = 1.0
    cheapest_error: float = 0.0


def plan_retina(
    grid: Grid,
    wavelengths: float | Sequence[float],
    display: Display,
    eye: Eye,
    *,
    tolerance: float | None = None,
    plane: Length | None = None,
    reach: float | None = None,
    paraxial: bool = False,
    registered: bool = False,
    example: Tensor | None = None,
    dtype: torch.dtype = torch.complex64,
    memory_limit: int | None = None,
) -> RetinaPlan:
    """Choose between :func:`propagate_collapsed` and :func:`propagate_elements`.

    The errors are those of lines of light (``optics.viewing.line_errors``): by default of noise that fills
    window and band of the hologram, in expectation, and of rows and columns of ``example`` if it is given. Errors with
    an example are within a factor 3 of those in two dimensions for noise, pictures, holograms, points and beams
    (tests/optics/viewing/test_line_errors.py). Without an example that holds for light that is speckled all over the
    hologram. Smooth light errs less, since little of it reaches the edge of the pupil: photographs of constant phase 2
    to 60 times and beams about 100 times or more; points lie anywhere between. Two exceptions: the error of a few
    points by either method may be 4 times too large, and that of the collapse, if the eyepiece cuts light off, 3 to 6
    times too small (``holotorch chart retina``).

    Args:
        grid: Sampling of the hologram.
        wavelengths: In metres, one per channel.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil, retina and accommodation.
        tolerance: Largest accepted relative L2 error of the intensity. By default the cheapest method is taken, which
            is called adequate if its error is at most 0.1.
        plane: Distance in metres from the hologram to the object plane; by default that of the plane in focus.
        reach: Half width in metres of a scene of noise in the object plane, whose hologram takes the place of noise in
            the plane of the hologram.
        paraxial: Predict errors in the Fresnel model, in which the eyepiece's edge and the sampling are the only errors
            of the collapse.
        registered: Do not count as an error that parts of the image move by a fraction of a spot. The error of oblique
            paths is then that of points within ``reach``, by default within the hologram (``collapse_error``).
        example: A field [..., C, H, W] like those to be propagated, which takes the place of noise.
        dtype: Type of the field, complex64 or complex128.
        memory_limit: Exclude a method that needs more bytes than this for one image of one wavelength.

    Returns:
        The cheapest method within the tolerance, or else the most accurate one, marked as not adequate. Without a
        tolerance, the cheapest one whose expected error is at most 0.5.

    Raises:
        ValueError: Invalid arguments, no method within the memory limit, an expected error above 0.5, or light of a row
            or column of the hologram that spreads over more than 2**22 samples.
    """
    wavelengths = checks.wavelengths(wavelengths)
    limit_of_error = TOLERANCE if tolerance is None else checks.positive("tolerance", tolerance)
    plane = display.object_plane(plane, eye.accommodation)
    lines = _lines(grid, wavelengths, number(plane), reach, example)
    setup = grid, wavelengths, display, eye, plane
    options, impossible = _options(lines, *setup, reach, paraxial, registered, dtype, limit_of_error)
    best, cheapest = _choice(options, tolerance, math.inf if memory_limit is None else memory_limit)
    reason = (
        f"{best.method} at {max(best.sampling.oversampling):.2f} times the hologram's sampling: error "
        f"{best.predicted_error:.2g} {'within' if best.adequate else 'beyond'} {limit_of_error:g}, "
        f"{best.flops:.2g} operations, {best.memory_bytes:.2g} bytes"
    )
    runner_up = next((option.reason for option in options if option is not best), impossible)
    ratio, error = best.flops / cheapest.flops, cheapest.predicted_error
    return replace(best, reason=reason, runner_up=runner_up, cost_ratio=ratio, cheapest_error=error)


def _options(
    lines: list[Lines],
    grid: Grid,
    wavelengths: Sequence[float],
    display: Display,
    eye: Eye,
    plane: Length,
    reach: float | None,
    paraxial: bool,
    registered: bool,
    dtype: torch.dtype,
    tolerance: float,
) -> tuple[list[RetinaPlan], str]:
    """Plans for all methods that are possible, and why the collapse is not, or an empty text."""
    samplings: list[imaging.CollapseSampling | ElementSampling] = []
    impossible = ""
    try:
        samplings.append(imaging.collapse_sampling(grid, wavelengths, display, eye, plane))
    except ValueError as error:
        impossible = f"collapse is impossible here: {error}"
    samplings.append(least_oversampling(grid, wavelengths, display, eye, plane=plane))
    setup = grid, wavelengths, display, eye, number(plane)
    errors = line_errors(lines, *setup, samplings, paraxial=paraxial or registered, dtype=dtype)
    options = []
    for sampling, error in zip(samplings, errors, strict=True):
        if isinstance(sampling, ElementSampling):
            options.append(_option("elements", sampling, error, sampling.memory_bytes(dtype.itemsize), tolerance))
            continue
        if registered and not paraxial:
            heights = _heights(grid, reach)
            paths = (collapse_error(grid, w, display, eye, plane, heights, registered=True) for w in wavelengths)
            error = math.hypot(error, max(paths))
        bands = max(math.prod(imaging.pupil_bands(grid, w, display, eye, plane)) for w in wavelengths)
        memory = sampling.memory_bytes(bands * math.prod(sampling.window), dtype.itemsize)
        options.append(_option("collapse", sampling, error, memory, tolerance))
    return options, impossible


def _lines(
    grid: Grid, wavelengths: Sequence[float], plane: float, reach: float | None, example: Tensor | None
) -> list[Lines]:
    """Lines of light of each wavelength on which :func:`plan_retina` measures errors."""
    if example is not None:
        checks.field("example", example, (len(wavelengths), *grid.shape))
        return [field_lines(light) for light in example.unbind(-3)]
    if reach is None:
        return [noise_lines(grid)] * len(wavelengths)
    half_width = checks.quantity(WIDTH, reach, "reach")
    return [scene_lines(grid, wavelength, plane, half_width) for wavelength in wavelengths]


def _choice(options: list[RetinaPlan], tolerance: float | None, limit: float) -> tuple[RetinaPlan, RetinaPlan]:
    """The plan within ``limit`` bytes that :func:`plan_retina` returns, and the cheapest one."""
    fitting = [option for option in options if option.memory_bytes <= limit]
    if not fitting:
        raise ValueError(
            f"no method fits into {limit:.3g} bytes, the smallest takes "
            f"{min(option.memory_bytes for option in options):.3g}; crop the hologram or raise memory_limit"
        )
    usable = [option for option in fitting if option.predicted_error <= _UNUSABLE]
    if not usable:
        best = min(fitting, key=lambda option: option.predicted_error)
        raise ValueError(
            f"the only method that fits, {best.method}, has an expected error of {best.predicted_error:.2g}; raise "
            "memory_limit, or make the scene smaller (reach)"
        )
    cheapest = min(usable, key=lambda option: option.flops)
    if tolerance is None:
        return cheapest, cheapest
    adequate = [option for option in usable if option.adequate]
    if adequate:
        return min(adequate, key=lambda option: option.flops), cheapest
    return min(usable, key=lambda option: option.predicted_error), cheapest


def _option(
    method: str, sampling: imaging.CollapseSampling | ElementSampling, error: float, memory: int, tolerance: float
) -> RetinaPlan:
    """Plan for one method, with its error and cost as the reason."""
    reason = f"{method}: error {error:.2g}, {sampling.flops:.2g} operations, {memory:.2g} bytes"
    return RetinaPlan(method, sampling, error, memory, sampling.flops, reason, "", error <= tolerance)


def collapse_error(
    grid: Grid,
    wavelength: float,
    display: Display,
    eye: Eye,
    plane: Length,
    heights: Sequence[float],
    *,
    paraxial: bool = False,
    registered: bool = False,
) -> float:
    """Relative L2 error of the intensity of the collapse for points at ``heights`` metres beside the axis, from rays.

    Only one axis is computed. The ray from the point y in the object plane through xi on the pupil has the slopes
    u0 = (xi - A y) / B before the eyepiece, u1 behind it and u2 behind the eye. Fresnel's model neglects the phase
    -k / 8 (d_eye u1^4 + d_r u2^4); the collapse includes it for y = 0 only, and neglects the edge of the eyepiece. The
    intensities of the spots with and without these are compared in an L2 norm over all points. Most of the error is a
    shift of the spot by a fraction of its width, which an observer does not notice; ``registered`` removes this shift
    before the comparison.
    """
    first, second, _, _ = (number(value) for value in display.matrix(plane))
    s0, d_eye = number(display.lens_distance) - number(plane), number(display.eye_distance)
    d_r, power, radius = number(eye.axial_length), number(inverse(display.focal_length)), number(eye.pupil_radius)
    sine = max(wavelength / (2 * p) for n, p in zip(grid.shape, grid.pitch, strict=True) if n > 1)
    y = torch.tensor(heights, dtype=torch.float64)[:, None]
    xi = ((torch.arange(_RAYS, dtype=torch.float64) + 0.5) / _RAYS * 2 - 1) * radius

    def trace(y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """d_eye u1^4 + d_r u2^4, the slope u0 and the height on the eyepiece, each [points, rays]."""
        u0 = (xi - first * y) / second
        height = y + s0 * u0
        u1, u2 = u0 - power * height, -(xi + d_r / second * y) / d_r
        return d_eye * u1**4 + d_r * u2**4, u0, height

    path, slope, height = trace(y)
    lit = (slope.abs() <= sine).double()
    rays = lit.sum(-1, keepdim=True).clamp(min=1)
    edge = lit if display.lens_radius is None else lit * (height.abs() <= number(display.lens_radius))
    phase = torch.zeros_like(path) if paraxial else -math.pi / (4 * wavelength) * (path - trace(0 * y)[0])
    # A phase that all rays of a spot share is not visible.
    phase = phase - (phase * lit).sum(-1, keepdim=True) / rays
    if registered:
        # A phase linear in xi only moves the spot.
        ramp = (xi - (xi * lit).sum(-1, keepdim=True) / rays) * lit
        slope = (phase * ramp).sum(-1, keepdim=True) / ramp.square().sum(-1, keepdim=True).clamp(min=1e-30)
        phase = phase - slope * ramp
    exact, collapsed = (
        intensity(torch.fft.fft(torch.polar(a, b), 4 * _RAYS)) for a, b in ((edge, phase), (lit, 0 * phase))
    )
    total = collapsed.square().sum()
    return math.sqrt(((collapsed - exact).square().sum() / total).item()) if total > 0 else 0.0


def scene_error(
    grid: Grid, wavelength: float, display: Display, eye: Eye, *, reach: float | None = None, paraxial: bool = False
) -> float:
    """:func:`collapse_error` without shifts, for points within ``reach`` metres of the axis, or all of the hologram."""
    plane = display.focus_plane(eye.accommodation)
    heights = _heights(grid, reach)
    return collapse_error(grid, wavelength, display, eye, plane, heights, paraxial=paraxial, registered=True)


def _heights(grid: Grid, reach: float | None) -> list[float]:
    """Heights in metres of the points of the scene that predict the error."""
    if reach is None:
        reach = max(n * p for n, p in zip(grid.shape, grid.pitch, strict=True) if n > 1) / 2
    return [checks.quantity(WIDTH, reach, "reach") * i / (_HEIGHTS - 1) for i in range(_HEIGHTS)]


class Retina(PreciseModule):
    """Planned propagation from hologram to retina: from complex fields [..., C, H, W] to the intensity on the retina.

    The result has the samples of ``grid`` and is referred back to the object plane (upright). Lengths of display and
    eye given as tensors keep their gradients; those that are ``nn.Parameter`` are registered, as ``eye_accommodation``
    or ``display_focal_length``. The plan is made for their values at construction.

    Args:
        grid, wavelengths, display, eye, plane, paraxial: As in :func:`propagate_collapsed`.
        tolerance: Largest accepted relative L2 error of the intensity. By default the cheapest method, which a training
            loop can afford; if its expected error exceeds 0.1, a warning states the cost of a better one.
        options: ``reach``, ``registered``, ``example``, ``dtype`` and ``memory_limit`` of :func:`plan_retina`.

    Attributes:
        plan: The chosen method and the reason for it.

    Raises:
        ValueError: As :func:`plan_retina`.
        MemoryError: In a call, before anything is allocated: the field needs more memory than is available.

    Warns:
        SamplingWarning: The method that is used does not meet the tolerance, 0.1 by default.
        CostWarning: The method that meets the tolerance needs more than ten times the operations of the other.
    """

    display: Display
    eye: Eye

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        display: Display,
        eye: Eye,
        *,
        tolerance: float | None = None,
        plane: Length | None = None,
        paraxial: bool = False,
        **options: Any,
    ):
        super().__init__()
        self.grid, self.out_grid, self.wavelengths = grid, grid, checks.wavelengths(wavelengths)
        self.adopt("display", display)
        self.adopt("eye", eye)
        self.plane, self.paraxial = plane, paraxial
        lengths = [plane, *vars(display).values(), *vars(eye).values(), *eye.aberrations.values()]
        self._fixed = not any(isinstance(each, Tensor) for each in lengths)
        self._factors: dict[tuple[torch.dtype, torch.device], list[imaging.CollapseFactors]] = {}
        self.plan = plan_retina(
            grid, self.wavelengths, display, eye, tolerance=tolerance, plane=plane, paraxial=paraxial, **options
        )
        plan, limit = self.plan, TOLERANCE if tolerance is None else tolerance
        if not plan.adequate:
            cure = f"; tolerance={limit:g} takes the other method: {plan.runner_up}" if tolerance is None else ""
            text = f"Retina: an error of {limit:g} is not met: {plan.reason}{cure}"
            warnings.warn(text, SamplingWarning, stacklevel=2)
        elif plan.cost_ratio > _COSTLY:
            warnings.warn(
                f"Retina: {plan.reason}, {plan.cost_ratio:.0f} times those of the other method: {plan.runner_up}; a "
                "larger tolerance accepts that",
                checks.CostWarning,
                stacklevel=2,
            )

    @property
    def scale(self) -> Length:
        """Metres on the retina per metre in the object plane, negative."""
        return imaging.retinal_scale(self.present("display"), self.present("eye"), self.plane)

    def field(self, field: Tensor) -> Tensor:
        """Complex field on the retina, [..., C, H, W], scaled as by :func:`propagate_collapsed`."""
        setup = self.grid, self.wavelengths, self.present("display"), self.present("eye")
        options = {"plane": self.plane, "paraxial": self.paraxial, "sampling": self.plan.sampling}
        if self.plan.method == "elements":
            return propagate_elements(field, *setup, **options)
        return imaging.propagate_collapsed(field, *setup, **options, factors=self._constant_factors(field))

    def _constant_factors(self, like: Tensor) -> list[imaging.CollapseFactors] | None:
        """The factors of the collapse for fields as ``like``, kept from the first call; None for learned lengths."""
        if is_exporting() or not self._fixed:
            return None
        checks.field("field", like, (len(self.wavelengths), *self.grid.shape))
        self._keep_factors(like.dtype, like.device)
        return self._factors[like.dtype, like.device]

    @constant_when_compiled
    def _keep_factors(self, dtype: torch.dtype, device: torch.device) -> None:
        """Have the factors of the collapse; torch.compile computes them when it traces, not in each call."""
        if (dtype, device) not in self._factors:
            assert isinstance(self.plan.sampling, imaging.CollapseSampling)
            plane = self.display.object_plane(self.plane, self.eye.accommodation)
            setup = self.grid, self.wavelengths, self.display, self.eye, plane
            like = torch.empty(0, dtype=dtype, device=device)
            with torch.inference_mode(False), torch.no_grad():
                factors = imaging.collapse_factors(like, *setup, self.plan.sampling, self.paraxial)
            self._factors[dtype, device] = factors

    def forward(self, field: Tensor) -> Tensor:
        """Intensity on the retina, real [..., C, H, W]; its sum times the pitches is the power that arrives."""
        return intensity(self.field(field))

    def extra_repr(self) -> str:
        """Sampling and plan, for ``print(module)``."""
        return f"grid={self.grid}, wavelengths={self.wavelengths}, {self.plan.reason}"


def retinal_image(
    field: Tensor, grid: Grid, wavelengths: float | Sequence[float], display: Display, eye: Eye, **options
) -> Tensor:
    """Intensity on the retina of one field, real [..., C, H, W]: ``Retina(grid, ..., **options)(field)``."""
    return Retina(grid, wavelengths, display, eye, **options)(field)
