"""Thin elements: lenses and apertures, which multiply the field sample by sample."""

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.grid import Grid
from holotorch.core.learning import without_graph
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.core.precision import double
from holotorch.core.quantities import APERTURE_RADIUS, FOCAL_LENGTH, PITCH, SOFTNESS, WAVELENGTH
from holotorch.optics.free_space.kernels import cycles_phasor


def lens_phase(
    grid: Grid, wavelength: Tensor | float, focal_length: Tensor | float, *, paraxial: bool = True
) -> Tensor:
    """Phase in radians that a thin lens adds, 0 on the axis; differentiable in wavelength and focal length.

    Args:
        grid: Sampling of the plane of the lens.
        wavelength: In metres, shape [...]; broadcasts against ``focal_length``.
        focal_length: In metres, not 0; positive converges, negative diverges, infinite is no lens.
        paraxial: Use the parabola -k r^2 / (2 f) of Goodman, Eq. 5-10, and of the thesis (after Voelz). Otherwise use
            the spherical phase -k (sqrt(r^2 + f^2) - |f|) with the sign of f, which focuses a plane wave without
            spherical aberration. The two differ by k r^4 / (8 f^3).

    Returns:
        float64, shape [..., H, W], not wrapped.

    Raises ValueError for a length outside its range.
    """
    checks.plausible(WAVELENGTH, wavelength)
    checks.plausible(FOCAL_LENGTH, focal_length)
    return 2 * math.pi * _phase_cycles(grid, wavelength, focal_length, paraxial)


def pupil(grid: Grid, radius: Tensor | float, *, softness: float = 0.0) -> Tensor:
    """Circular opening around the axis: 1 inside ``radius`` and 0 outside, float64 [..., H, W].

    Args:
        grid: Sampling of the plane of the pupil.
        radius: In metres, shape [...].
        softness: Width in metres of the edge, where the amplitude falls as 1 / (1 + exp((r - radius) / softness)); 0 is
            a hard edge. Only a soft edge has a gradient in the radius; about one pitch is enough.

    Raises:
        ValueError: ``radius`` carries a gradient but the edge is hard, so that the gradient would be 0; or a length
            outside its range.
    """
    checks.plausible(APERTURE_RADIUS, radius, "radius")
    checks.quantity(SOFTNESS, softness)
    radius = torch.as_tensor(radius, dtype=torch.float64)
    y, x = grid.coordinates(radius.device)
    return opening(y.square() + x.square(), radius[..., None, None], softness)


def opening(square: Tensor, radius: Tensor, softness: float) -> Tensor:
    """Transmission of :func:`pupil` at squared distances ``square`` from the axis, in square metres."""
    if softness > 0:
        # The addend keeps the gradient of the root finite on the axis.
        return torch.sigmoid((radius - torch.sqrt(square + 1e-30)) / softness)
    if radius.requires_grad:
        raise ValueError("a hard edge has no gradient in its radius; give softness, for instance one pitch")
    return (square <= radius.square()).to(torch.float64)


def lens_limit(pitch: float, wavelength: float, focal_length: float, *, paraxial: bool = True) -> float:
    """Distance in metres from the axis up to which samples ``pitch`` apart represent the phase of a lens.

    There the phase changes by pi per sample: at wavelength f / (2 pitch) for the parabola, and at
    f tan(asin(wavelength / (2 pitch))) for the spherical phase. The phase slope of light that arrives at angles with
    sines up to s adds to that of the lens and reduces the paraxial limit to (wavelength / (2 pitch) - s) f.
    """
    sine = checks.quantity(WAVELENGTH, wavelength) / (2 * checks.quantity(PITCH, pitch))
    checks.quantity(FOCAL_LENGTH, focal_length)
    if paraxial:
        return abs(focal_length) * sine
    return abs(focal_length) * sine / math.sqrt(1 - sine**2) if sine < 1 else math.inf


class Transmission(FieldOperator):
    """A thin element, which multiplies fields by one complex number per sample.

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        values: complex128, shape [C, H, W], or [1, H, W] for all channels; None for an element that learns a quantity
            and therefore computes its values in every call.

    A subclass that learns implements :meth:`computed`.
    """

    values: Tensor | None

    def __init__(self, grid: Grid, wavelengths: Wavelengths, values: Tensor | None):
        super().__init__(grid, wavelengths)
        self.keep("values", values)

    def computed(self) -> Tensor:
        """Values for the present parameters, as ``values``."""
        raise NotImplementedError

    def _values_for(self, field: Tensor) -> Tensor:
        return (self.computed() if self.values is None else self.values).to(field.dtype)

    def _forward(self, field: Tensor) -> Tensor:
        return field * self._values_for(field)

    def _adjoint(self, field: Tensor) -> Tensor:
        return field * self._values_for(field).conj()


class Lens(Transmission):
    """Thin lens with a circular edge: :func:`lens_phase` inside ``radius``, opaque outside.

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        focal_length: In metres, not 0, positive for a converging lens. One number for all channels (a refractive or
            achromatic lens) or one per channel (a holographic optical element, whose focal length is proportional to
            1 / wavelength). May be an ``nn.Parameter``, of shape [] or [C].
        radius: Radius of the clear aperture in metres; None for a lens that covers the whole window.
        paraxial: As in :func:`lens_phase`.
        learnable: Make the focal length a Parameter.

    Raises:
        ValueError: A length outside its range, such as 0 or one in millimetres, or one with a gradient that is no
            Parameter.
        MemoryError: The grid has more samples than memory is available for.

    Warns:
        SamplingWarning: The grid is too coarse for the phase at the edge of the lens or of the window, whichever is
            nearer to the axis. The message names the limit (:func:`lens_limit`) and a pitch that suffices for a plane
            wave on the axis; other light needs a finer pitch.

    Source: Goodman, Sec. 5.1; thesis Algorithm 6.
    """

    focal_length: tuple[float, ...] | Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        focal_length: float | Sequence[float] | Tensor,
        *,
        radius: float | None = None,
        paraxial: bool = True,
        learnable: bool = False,
    ):
        wavelengths = checks.wavelengths(wavelengths)
        without_graph("focal_length", focal_length)
        numbers = focal_length.detach().tolist() if isinstance(focal_length, Tensor) else focal_length
        given = list(numbers) if isinstance(numbers, Sequence) else [numbers] * len(wavelengths)
        if len(given) != len(wavelengths):
            expected = f"one number or one per wavelength ({len(wavelengths)})"
            raise ValueError(f"focal_length must be {expected}, got {len(given)}")
        lengths = [checks.quantity(FOCAL_LENGTH, length) for length in given]
        edge = None if radius is None else checks.quantity(APERTURE_RADIUS, radius, "radius")
        affordable("a lens", grid, len(wavelengths))
        super().__init__(grid, wavelengths, None)
        self.radius, self.paraxial = edge, paraxial
        value = torch.tensor(numbers, dtype=torch.float64) if learnable else tuple(lengths)
        self.hold(
            "focal_length", focal_length if isinstance(focal_length, nn.Parameter) else value, learnable=learnable
        )
        if not isinstance(self.focal_length, nn.Parameter):
            self.values = self.computed()
        warn_if_coarse(grid, wavelengths, lengths, edge, paraxial=paraxial)

    def computed(self) -> Tensor:
        """Transmission for the present focal length, complex128 [C, H, W]."""
        length = torch.as_tensor(self.focal_length, dtype=torch.float64)
        wavelength = double(self.wavelengths, length.device)
        values = cycles_phasor(_phase_cycles(self.grid, wavelength, length, self.paraxial))
        return (
            values
            if self.radius is None
            else values * pupil(self.grid, self.radius).to(length.device, non_blocking=True)
        )

    def extra_repr(self) -> str:
        """Sampling, wavelengths and lens, for ``print(module)``."""
        return f"{super().extra_repr()}, focal_length={self.focal_length}, radius={self.radius}"


class Aperture(Transmission):
    """Opening in an opaque screen.

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        shape: Radius in metres of a circle around the axis, or the amplitude transmission, real [H, W] within 0 .. 1.
            May be an ``nn.Parameter``; values of a learned transmission outside 0 .. 1 are clipped when used.
        softness: Width in metres of the edge of a circle, as in :func:`pupil`; a learned radius needs one.
        learnable: Make the radius or the transmission a Parameter, ``shape``.

    Raises:
        ValueError: A radius outside its range, a learned one with a hard edge, a transmission of another shape or with
            values outside 0 .. 1, or a shape with a gradient that is no Parameter.
        MemoryError: The grid has more samples than memory is available for.
    """

    shape: float | Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        shape: float | Tensor,
        *,
        softness: float = 0.0,
        learnable: bool = False,
    ):
        without_graph("shape", shape)
        values = shape.detach() if isinstance(shape, Tensor) else shape
        if isinstance(values, Tensor) and values.ndim:
            values = values.to(torch.float64) if values.dtype == torch.bool else values
            checks.field("aperture", values, grid.shape, complex_valued=False)
            if values.ndim != 2 or not bool(((values >= 0) & (values <= 1)).all()):
                raise ValueError(f"aperture must be [H, W] with values in 0 .. 1, got {tuple(values.shape)}")
        else:
            values = checks.quantity(APERTURE_RADIUS, float(values))
            affordable("an aperture", grid, 1)
        super().__init__(grid, wavelengths, None)
        self.softness = checks.quantity(SOFTNESS, softness)
        learned = self.hold("shape", shape if isinstance(shape, nn.Parameter) else values, learnable=learnable)
        opening = self.computed()  # a hard edge refuses a learned radius here
        if not learned:
            self.values = opening

    def computed(self) -> Tensor:
        """Transmission for the present shape, complex128 [1, H, W]."""
        shape = self.shape
        if isinstance(shape, Tensor) and shape.ndim:
            mask = shape.double().clamp(0, 1)
        else:
            mask = pupil(self.grid, shape, softness=self.softness)
        return torch.complex(mask, torch.zeros_like(mask))[None]


def affordable(what: str, grid: Grid, channels: int) -> None:
    """Raise MemoryError unless memory suffices for a thin element: 48 bytes per sample and channel (measured)."""
    height, width = grid.shape
    checks.affordable(
        48 * channels * height * width,
        f"{what} on {height} x {width} samples in {channels} channel(s)",
        "use a smaller grid",
    )


def _phase_cycles(grid: Grid, wavelength: Tensor | float, focal_length: Tensor | float, paraxial: bool) -> Tensor:
    """:func:`lens_phase` in cycles."""
    given = [v.device for v in (focal_length, wavelength) if isinstance(v, Tensor)]
    device = given[0] if given else torch.device("cpu")
    wavelength_values, length = (double(v, device)[..., None, None] for v in (wavelength, focal_length))
    y, x = grid.coordinates(length.device)
    square = y.square() + x.square()
    if paraxial:
        return -square / (2 * wavelength_values * length)
    # sqrt(r^2 + f^2) - |f| without cancellation, and finite for an infinite f.
    return -square / (wavelength_values * length * (1 + torch.sqrt(1 + square / length.square())))


def warn_if_coarse(
    grid: Grid, wavelengths: Sequence[float], lengths: Sequence[float], radius: float | None, *, paraxial: bool = True
) -> None:
    """Emit a SamplingWarning if ``grid`` is too coarse for lenses of these focal lengths within ``radius``."""
    for wavelength, length in zip(wavelengths, lengths, strict=True):
        for size, pitch in zip(grid.shape, grid.pitch, strict=True):
            outermost = min(size // 2 * pitch, radius or math.inf)
            limit = lens_limit(pitch, wavelength, length, paraxial=paraxial)
            if outermost > limit * (1 + 1e-9):
                slope = outermost / (abs(length) if paraxial else math.hypot(outermost, length))
                warnings.warn(
                    f"Lens of focal length {length:g} m at {wavelength:g} m wavelength: samples {pitch:g} m apart hold "
                    f"its phase only up to {limit * 1e3:.3g} mm from the axis, but it reaches "
                    f"{outermost * 1e3:.3g} mm; a pitch of {wavelength / 2 / slope:.3g} m or less would do for flat "
                    "light, a smaller radius too",
                    SamplingWarning,
                    stacklevel=3,
                )
                return
