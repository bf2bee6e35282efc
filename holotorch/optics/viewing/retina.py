"""Retina: the image on the retina, by the cheaper of two methods that is accurate enough."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.core.quantities import WIDTH
from holotorch.optics.viewing.display import Display, Length, inverse, number
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling, propagate_elements
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.imaging import (
    CollapseSampling,
    collapse_sampling,
    propagate_collapsed,
    pupil_bands,
    retinal_scale,
)

# Error of sampling the hard edge of a pupil, times the number of samples across its diameter. Measured: 1.1 to 3.2 for
# the collapse of points with 1360 samples, 0.6 to 3.4 for noise with 42 to 55, 0.4 to 1.3 for elements with 3800.
_EDGE_ERROR = 3.0
_RAYS, _HEIGHTS = 512, 9  # rays across the pupil, and points of the scene, that predict the error of the collapse
_UNUSABLE = 0.5  # expected relative error above which an image is refused


@dataclass(frozen=True)
class RetinaPlan:
    """Method of propagation to the retina, and the reason for it.

    Attributes:
        method: "collapse" or "elements".
        sampling: Sizes of that method, for :func:`propagate_collapsed` or :func:`propagate_elements`.
        predicted_error: Expected relative L2 error of the intensity, over points of light within the scene.
        memory_bytes: Largest extra memory of one image of one wavelength.
        flops: Floating-point operations for one image of one wavelength.
        reason: One sentence that says why this method was chosen.
        runner_up: One sentence on the other method.
        adequate: Whether ``predicted_error`` is within the tolerance.
    """

    method: str
    sampling: CollapseSampling | ElementSampling
    predicted_error: float
    memory_bytes: int
    flops: float
    reason: str
    runner_up: str
    adequate: bool


def plan_retina(
    grid: Grid,
    wavelengths: float | Sequence[float],
    display: Display,
    eye: Eye,
    *,
    tolerance: float = 0.02,
    plane: Length | None = None,
    reach: float | None = None,
    paraxial: bool = False,
    registered: bool = False,
    dtype: torch.dtype = torch.complex64,
    memory_limit: int | None = None,
) -> RetinaPlan:
    """Choose between :func:`propagate_collapsed` and :func:`propagate_elements`.

    Args:
        grid: Sampling of the hologram.
        wavelengths: In metres, one per channel.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil, retina, accommodation.
        tolerance: Largest accepted relative L2 error of the intensity.
        plane: Object plane in metres from the hologram, the one in focus by default.
        reach: Half width in metres of the scene in that plane, the hologram's by default.
        paraxial: Predict errors in the Fresnel model, in which the collapse has no error other than its sampling.
        registered: Do not count as an error that parts of the image move by a fraction of a spot.
        dtype: complex64 or complex128, of the field.
        memory_limit: Refuse a method that needs more bytes than this.

    Returns:
        The cheapest method within the tolerance, or else the most accurate one, marked as not adequate.

    Raises:
        ValueError: Invalid arguments, more memory than the limit, or an expected error above 0.5.
    """
    wavelengths = checks.wavelengths(wavelengths)
    tolerance = checks.positive("tolerance", tolerance)
    plane = display.object_plane(plane, eye.accommodation)
    if reach is None:
        reach = max(n * p for n, p in zip(grid.shape, grid.pitch, strict=True) if n > 1) / 2
    options: list[tuple[float, str, CollapseSampling | ElementSampling, float, int]] = []
    heights = [checks.quantity(WIDTH, reach, "reach") * i / (_HEIGHTS - 1) for i in range(_HEIGHTS)]
    size, refused = 8 if dtype == torch.complex64 else 16, ""
    try:
        collapse = collapse_sampling(grid, wavelengths, display, eye, plane)
        error = max(
            collapse_error(grid, w, display, eye, plane, heights, paraxial=paraxial, registered=registered)
            for w in wavelengths
        )
        spot = max(wavelengths) * (abs(number(display.matrix(plane)[1])) / (2 * number(eye.pupil_radius)))
        across = max(spot / (n * p) for n, p in zip(collapse.window, grid.pitch, strict=True) if n > 1)
        passed = max(math.prod(pupil_bands(grid, w, display, eye, plane)) for w in wavelengths)
        memory = collapse.memory_bytes(passed * math.prod(collapse.window), size)
        options.append((collapse.flops, "collapse", collapse, math.hypot(error, _EDGE_ERROR * across), memory))
    except ValueError as reason:
        refused = f"collapse is impossible here: {reason}"
    elements = least_oversampling(grid, wavelengths, display, eye, plane=plane)
    step = max(p / m for n, p, m in zip(grid.shape, grid.pitch, elements.oversampling, strict=True) if n > 1)
    edge = min(1.0, _EDGE_ERROR * step / (2 * number(eye.pupil_radius)))
    options.append((elements.flops, "elements", elements, edge, elements.memory_bytes(size)))
    limit = math.inf if memory_limit is None else memory_limit
    fitting = [option for option in options if option[4] <= limit]
    if not fitting:
        raise ValueError(f"no way to the retina fits into {limit:.3g} bytes, the smallest takes "
                         f"{min(o[4] for o in options):.3g}; crop the hologram or raise memory_limit")  # fmt: skip
    within = [option for option in fitting if option[3] <= tolerance]
    best = min(within) if within else min(fitting, key=lambda option: option[3])
    flops, method, sampling, error, memory = best
    if error > _UNUSABLE:
        raise ValueError(f"the only way that fits, {method}, has an expected error of {error:.2g}; raise memory_limit, "
                         "or make the scene smaller (reach)")  # fmt: skip
    others = [
        f"{option[1]}: error {option[3]:.2g}, {option[0]:.2g} operations, {option[4]:.2g} bytes" for option in options
    ]
    reason = (
        f"{method} at {max(sampling.oversampling):.2f} times the hologram's sampling: error {error:.2g} "
        f"{'within' if within else 'beyond'} the tolerance {tolerance:g}, {flops:.2g} operations, {memory:.2g} bytes"
    )
    runner_up = next((text for text in others if not text.startswith(method)), refused)
    return RetinaPlan(method, sampling, error, memory, flops, reason, runner_up, bool(within))


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

    One axis is computed. The ray from the point y in the object plane through xi on the pupil has the slope
    u0 = (xi - A y) / B before the eyepiece, u1 behind it and u2 behind the eye. Fresnel's model neglects the phase
    -k / 8 (d_eye u1^4 + d_r u2^4), which the collapse includes for y = 0 only; the collapse also neglects the edge of
    the eyepiece. Spots with and without these are compared, and the errors are averaged over y, weighted with energy.
    Most of the error is a shift of the spot by a fraction of its width, which an observer does not notice; with
    ``registered`` this shift is removed before the comparison.
    """
    first, second, _, back = (number(value) for value in display.matrix(plane))
    s0, eye_distance, d_r = (
        number(display.lens_distance) - number(plane),
        number(display.eye_distance),
        number(eye.axial_length),
    )
    power, radius = number(inverse(display.focal_length)), number(eye.pupil_radius)
    sine = max(wavelength / (2 * p) for n, p in zip(grid.shape, grid.pitch, strict=True) if n > 1)
    y = torch.tensor(heights, dtype=torch.float64)[:, None]
    xi = ((torch.arange(_RAYS, dtype=torch.float64) + 0.5) / _RAYS * 2 - 1) * radius

    def left_out(y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        u0 = (xi - first * y) / second
        lens = y + s0 * u0
        u1, u2 = u0 - power * lens, -(xi + d_r / second * y) / d_r
        return eye_distance * u1**4 + d_r * u2**4, u0, lens

    path, slope, lens = left_out(y)
    lit = (slope.abs() <= sine).double()
    edge = lit if display.lens_radius is None else lit * (lens.abs() <= number(display.lens_radius))
    phase = torch.zeros_like(path) if paraxial else -math.pi / (4 * wavelength) * (path - left_out(0 * y)[0])
    # A phase that all rays of a spot share is not visible.
    phase = phase - (phase * lit).sum(-1, keepdim=True) / lit.sum(-1, keepdim=True).clamp(min=1)
    if registered:
        # A phase linear in xi moves the spot and nothing else.
        ramp = (xi - (xi * lit).sum(-1, keepdim=True) / lit.sum(-1, keepdim=True).clamp(min=1)) * lit
        phase = (
            phase - (phase * ramp).sum(-1, keepdim=True) / ramp.square().sum(-1, keepdim=True).clamp(min=1e-30) * ramp
        )
    truth, made = (torch.fft.fft(torch.polar(a, b), 4 * _RAYS) for a, b in ((edge, phase), (lit, 0 * phase)))
    wanted, got = intensity(truth), intensity(made)
    total = got.square().sum()
    return math.sqrt(((got - wanted).square().sum() / total).item()) if total > 0 else 0.0


class Retina(nn.Module):
    """Planned propagation from hologram to retina: from complex fields [..., C, H, W] to the intensity on the retina.

    Lengths given as tensors keep their gradients; the plan is made for their values at construction.

    Args:
        grid: Sampling of the hologram, also of the result, which is referred back to the object plane (upright).
        wavelengths: In metres, one per channel.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil, retina, accommodation.
        tolerance: Largest relative L2 error of the intensity.
        plane: Object plane in metres from the hologram, by default the one in focus.
        reach: Half width in metres of the scene.
        paraxial: Use Fresnel's model for every distance.
        registered: Do not count as an error that parts of the image move by a fraction of a spot.
        memory_limit: Refuse a method that needs more bytes than this for an image of one wavelength.

    Attributes:
        plan: The chosen method and the reason for it.
        scale: Size on the retina divided by size in the object plane, negative; the retina's pitch is abs(scale) times
            that of ``grid``.

    Raises:
        ValueError: As :func:`plan_retina`.
        MemoryError: In a call, before anything is allocated: the field needs more memory than is available.

    Warns:
        SamplingWarning: No method meets the tolerance; the most accurate one within the memory limit is used.
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        display: Display,
        eye: Eye,
        *,
        tolerance: float = 0.02,
        plane: Length | None = None,
        reach: float | None = None,
        paraxial: bool = False,
        registered: bool = False,
        memory_limit: int | None = None,
    ):
        super().__init__()
        self.grid, self.out_grid, self.wavelengths = grid, grid, checks.wavelengths(wavelengths)
        self.display, self.eye, self.plane, self.paraxial = display, eye, plane, paraxial
        self.plan = plan_retina(
            grid, self.wavelengths, display, eye, tolerance=tolerance, plane=plane, reach=reach, paraxial=paraxial,
            registered=registered, memory_limit=memory_limit,
        )  # fmt: skip

        if not self.plan.adequate:
            warnings.warn(
                f"Retina: no way meets the tolerance {tolerance:g}; {self.plan.reason}", SamplingWarning, stacklevel=2
            )

    @property
    def scale(self) -> Length:
        """Metres on the retina per metre in the object plane."""
        return retinal_scale(self.display, self.eye, self.plane)

    def field(self, field: Tensor) -> Tensor:
        """Complex field on the retina, [..., C, H, W], scaled as by :func:`propagate_collapsed`."""
        propagate = propagate_collapsed if self.plan.method == "collapse" else propagate_elements
        return propagate(
            field, self.grid, self.wavelengths, self.display, self.eye, plane=self.plane, paraxial=self.paraxial,
            sampling=self.plan.sampling,  # type: ignore[arg-type]
        )  # fmt: skip

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
