"""Eye: pupil, lens and retina, with the aberrations and the longitudinal chromatic aberration of human eyes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.learning import without_graph
from holotorch.core.precision import double
from holotorch.core.quantities import ACCOMMODATION, EYE_LENGTH, PUPIL_RADIUS, SOFTNESS, WAVEFRONT_ERROR
from holotorch.optics.elements.lens import Transmission, affordable, lens_phase, opening, warn_if_coarse
from holotorch.optics.free_space.kernels import cycles_phasor
from holotorch.optics.viewing.display import Length, inverse, number

_HIGHEST = 27  # largest OSA index of a Zernike polynomial: sixth radial order


@dataclass(frozen=True)
class Eye:
    """Reduced eye: one thin lens with the pupil in its plane, in air, and a retina (thesis Sec. 5.5.2).

    Lengths in metres; pupil radius, axial length, accommodation and the coefficients of aberrations may be tensors that
    carry a gradient.

    Attributes:
        pupil_radius: Radius of the opening of the iris; 1 to 4 mm, 1.5 mm in normal light.
        axial_length: d_r from the lens to the retina; 24 mm in the thesis.
        accommodation: Distance s in front of the lens that is in focus, above 0, infinite for the relaxed eye. The
            focal length of the lens follows from 1 / f_eye = 1 / s + 1 / d_r.
        aberrations: Wavefront error over the pupil: coefficients in metres of normalised Zernike polynomials, with
            their OSA/ANSI single indices j as keys. A positive error is a longer path, that is a delay. A coefficient c
            of index 4, defocus, acts as a lens of power -4 sqrt(3) c / pupil_radius^2.
        chromatic_reference: Wavelength in metres that is in focus at ``accommodation``. The refraction at another
            wavelength differs by the difference of :func:`chromatic_refraction`. None for no chromatic aberration.
        softness: Width in metres of the pupil's edge, 0 for a hard edge. A gradient in the radius needs a soft edge.

    Raises:
        ValueError: A length outside its plausible range, such as one in millimetres, or an unknown Zernike index.
    """

    pupil_radius: Length = 1.5e-3
    axial_length: Length = 24e-3
    accommodation: Length = math.inf
    aberrations: Mapping[int, Length] = field(default_factory=dict)
    chromatic_reference: float | None = None
    softness: float = 0.0

    def __post_init__(self):
        checks.quantity(PUPIL_RADIUS, number(self.pupil_radius))
        checks.quantity(EYE_LENGTH, number(self.axial_length))
        checks.quantity(ACCOMMODATION, number(self.accommodation))
        for index, coefficient in self.aberrations.items():
            if checks.whole("Zernike index", index, 0) > _HIGHEST:
                raise ValueError(f"Zernike index must be an OSA index of 0 .. {_HIGHEST}, got {index}")
            checks.quantity(WAVEFRONT_ERROR, number(coefficient), f"Zernike coefficient {index}")
        if self.chromatic_reference is not None:
            chromatic_refraction(self.chromatic_reference)
        checks.quantity(SOFTNESS, self.softness)

    @property
    def focal_length(self) -> Length:
        """f_eye in metres at ``accommodation``, at ``chromatic_reference``."""
        return 1 / (inverse(self.accommodation) + inverse(self.axial_length))

    def pupil_function(self, y: Tensor, x: Tensor, wavelength: Length) -> Tensor:
        """Complex transmission of the pupil without the ideal lens, complex128: opening and phase of :meth:`path`.

        ``y`` and ``x`` are positions on the plane of the pupil, float64, and broadcast; all lengths in metres.
        """
        square = y.square() + x.square()
        radius = double(self.pupil_radius, square.device)
        return opening(square, radius, self.softness) * cycles_phasor(self.path(y, x, wavelength) / wavelength)

    def path(self, y: Tensor, x: Tensor, wavelength: Length) -> Tensor:
        """Path in metres, float64, that all aberrations add; arguments as in :meth:`pupil_function`."""
        square = y.square() + x.square()
        radius = double(self.pupil_radius, square.device)
        path = torch.zeros_like(square)
        for index, coefficient in self.aberrations.items():
            path = path + coefficient * zernike(index, y / radius, x / radius)
        if self.chromatic_reference is not None:
            # Excess power P, which shortens the path at radius r by P r^2 / 2, is a negative (myopic) refraction.
            excess = chromatic_refraction(self.chromatic_reference) - chromatic_refraction(wavelength)
            path = path - excess * square / 2
        return path


class EyeLens(Transmission):
    """Lens of an :class:`Eye` with pupil and aberrations, as an element of an ``OpticalPath``.

    The lengths of the eye that are ``nn.Parameter`` are learned; they are registered as ``eye_accommodation``,
    ``eye_pupil_radius``, ``eye_axial_length`` and ``eye_aberrations_4`` for the Zernike index 4.

    Raises:
        ValueError: A length with a gradient that is no Parameter.
        MemoryError: The grid has more samples than memory is available for.

    Warns:
        SamplingWarning: The grid is too coarse for the phase of the lens within the pupil, as for :class:`Lens`.
    """

    def __init__(self, grid: Grid, wavelengths: float | Sequence[float], eye: Eye):
        wavelengths = checks.wavelengths(wavelengths)
        for name in ("pupil_radius", "axial_length", "accommodation"):
            without_graph(name, getattr(eye, name))
        for index, coefficient in eye.aberrations.items():
            without_graph(f"Zernike coefficient {index}", coefficient)
        affordable("the lens of an eye", grid, len(wavelengths))
        super().__init__(grid, wavelengths, None)
        if not self.adopt("eye", eye):
            self.values = self.computed()
        length = number(eye.focal_length)
        warn_if_coarse(grid, wavelengths, [length] * len(wavelengths), number(eye.pupil_radius))

    def computed(self) -> Tensor:
        """Transmission for the present lengths of the eye, complex128 [C, H, W]."""
        eye: Eye = self.present("eye")
        length = torch.as_tensor(eye.focal_length, dtype=torch.float64)
        y, x = self.grid.coordinates(length.device)
        values = [
            cycles_phasor(lens_phase(self.grid, each, length) / (2 * math.pi)) * eye.pupil_function(y, x, each)
            for each in self.wavelengths
        ]
        return torch.stack(values)


def chromatic_refraction(wavelength: Length) -> Length:
    """Refractive error of the human eye in dioptres at a wavelength in metres, 0 near 590 nm and -1.7 at 400 nm.

    1.68524 - 0.63346 / (wavelength in um - 0.21410): Thibos, Ye, Zhang and Bradley (1992), "The chromatic eye: a new
    reduced-eye model of ocular chromatic aberration in humans", Appl. Opt. 31, 3594. Negative values are myopic: the
    power of the eye is too large, and the objects in focus are nearer.

    Raises:
        ValueError: A wavelength outside 380 .. 900 nm, the range of the fit.
    """
    if not 380e-9 <= number(wavelength) <= 900e-9:
        raise ValueError(f"the eye's colour error is known within 380 .. 900 nm, got {number(wavelength):g} m")
    return 1.68524 - 0.63346 / (wavelength * 1e6 - 0.21410)


def zernike(index: int, y: Tensor, x: Tensor) -> Tensor:
    """Normalised Zernike polynomial of OSA/ANSI single index j at (y, x) in units of the pupil radius.

    ``y`` and ``x`` broadcast. The polynomials are orthogonal with mean square 1 over the disc; the angle is measured
    from +x towards +y. j = (n (n + 2) + m) / 2 for the radial order n and the angular frequency m. Raises TypeError for
    an index that is not an integer and ValueError for one below 0. Source: ANSI Z80.28.
    """
    checks.whole("Zernike index", index, 0)
    order = math.ceil((-3 + math.sqrt(9 + 8 * index)) / 2)
    signed = 2 * index - order * (order + 2)
    m = abs(signed)
    square = y.square() + x.square()
    radial = torch.zeros_like(square)
    for k in range((order - m) // 2 + 1):
        coefficient = math.factorial(order - k) / math.factorial(k)
        coefficient /= math.factorial((order + m) // 2 - k) * math.factorial((order - m) // 2 - k)
        radial = radial + (-1) ** k * coefficient * square ** ((order - m) // 2 - k)
    # r^m cos(m t) and r^m sin(m t) as polynomials in y and x, since the angle t is undefined at the centre.
    real, imaginary = torch.ones_like(square), torch.zeros_like(square)
    for _ in range(m):
        real, imaginary = real * x - imaginary * y, real * y + imaginary * x
    if m == 0:
        return math.sqrt(order + 1) * radial
    return math.sqrt(2 * (order + 1)) * radial * (imaginary if signed < 0 else real)
