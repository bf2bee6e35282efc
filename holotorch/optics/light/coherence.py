"""Closed formulas for the effect of a spectrum on a holographic image: speckle contrast, defocus, optimum width."""

import math

from holotorch.core import checks
from holotorch.core.quantities import DEPTH, DISTANCE, WAVELENGTH_CHANGE
from holotorch.optics.light.quadrature import correlation
from holotorch.optics.light.spectrum import Spectrum

# Focal shift by half the optimum width, in depths of focus: fitted to the CT scan of a teapot, three colours at 10, 20
# and 30 mm. Optimum of other scenes: 0.47 (CT scan of a bonsai), 0.67 (a tooth) and 0.84 (a molecule).
DEFOCUS = 0.47


def path_difference(distance: float, aperture: float, *, tilt: float = 0.0) -> float:
    """Greatest difference in metres between paths from a hologram to a point in focus that is seen through a pupil.

    A hologram diffracts light of spatial frequency f to the sine f lambda. Over ``distance`` the phase of this light
    changes by -pi distance lambda f^2. From the centre to the edge of the pupil, the difference of the phases at two
    wavelengths therefore changes by 2 pi (lambda - lambda') / lambda^2 times the result, which on the axis is
    distance aperture^2 / 2. The depth of the object points has no effect, since the hologram does not depend on the
    wavelength. The result is paraxial; at a sine of 0.1 it is 1 % too small.

    Args:
        distance: From the hologram to the depth in focus, in metres; its sign does not matter.
        aperture: Sine of half the angle of the light cone from a point in focus into the pupil, which the pupil of the
            eye or the window of the hologram limits.
        tilt: Sine of the direction from the point in focus to the centre of the pupil, 0 for points on the axis. If
            it exceeds ``aperture``, the difference is 2 distance tilt aperture.

    Raises ValueError for an aperture that is not above 0, or an aperture and a tilt that add up to more than 1.
    """
    distance = abs(checks.quantity(DISTANCE, distance))
    aperture, tilt = checks.positive("aperture", aperture), abs(checks.finite("tilt", tilt))
    if aperture + tilt > 1:
        raise ValueError(f"aperture and tilt are sines and must add up to at most 1, got {aperture:g} and {tilt:g}")
    nearest = max(0.0, tilt - aperture)
    return distance * ((tilt + aperture) ** 2 - nearest**2) / 2


def predicted_contrast(spectrum: Spectrum, path_difference: float) -> float:
    """Speckle contrast of a uniformly illuminated round pupil under ``spectrum``, between 0 and 1.

    The squared contrast C^2 is the double integral of S(l) S(l') sinc^2(path_difference (l - l') / lambda^2) over the
    wavelengths l and l', where S is the power density, normalised over the band, and lambda the central wavelength. For
    a Lorentzian without cut-off, C^2 = 2 (b - 1 + exp(-b)) / b^2 with b = 2 pi path_difference fwhm / lambda^2; the
    cut-off at 10 % raises C. For a path difference of 0, C is 1.

    The contrast of simulated holograms of a CT volume at 30 mm with an aperture of 0.056, in three colours, was
    predicted within 5 % for half widths of 5 to 10 nm, 8 % too low at 20 nm, and 7 % too high for a laser.

    Source: Goodman, Speckle Phenomena in Optics, Sec. 6.5.
    """
    difference = checks.nonnegative("path_difference", path_difference, "metres")
    nodes, weights = spectrum.measure()
    return math.sqrt(float(weights @ correlation(nodes, nodes, difference / spectrum.centre**2) @ weights))


def samples_needed(spectrum: Spectrum, path_difference: float, tolerance: float = 0.01, *, iris: bool = True) -> int:
    """Number of wavelengths that keep the expected rms error of an image, relative to its rms, within ``tolerance``.

    The arguments are those of :meth:`Spectrum.samples`. For 1 % without an iris the number is about
    bandwidth path_difference / lambda^2 + 2. For a hologram at 30 mm with an aperture of 0.056 it is at 636, 520 and
    455 nm: 2, 2, 2 for the laser, 3, 4, 5 for the narrow SLED, 5, 6, 8 for the SLED and 8, 11, 14 for the LED. With an
    iris these numbers give an error of 2 to 3 %, and 1 % needs about twice as many. For comparison, the sum over every
    nanometre has an error of 0.4 to 1.4 % with an iris.
    """
    return len(spectrum.samples(tolerance=tolerance, path_difference=path_difference, iris=iris)[0])


def chromatic_defocus(distance: float, wavelength: float, change: float) -> float:
    """Shift in metres of the depth in focus when the wavelength rises by ``change``: -distance change / wavelength.

    All arguments are in metres. A hologram is a diffractive lens, whose power is proportional to the wavelength.
    """
    wavelength = checks.wavelengths(wavelength)[0]
    return -checks.quantity(DISTANCE, distance) * checks.quantity(WAVELENGTH_CHANGE, change) / wavelength


def depth_of_focus(wavelength: float, aperture: float) -> float:
    """Depth of focus in metres, wavelength / aperture^2; ``aperture`` is the one of :func:`path_difference`.

    At both ends of this range the defocus is a quarter of a wavelength at the edge of the aperture.
    """
    return checks.wavelengths(wavelength)[0] / checks.positive("aperture", aperture) ** 2


def optimum_fwhm(wavelength: float, aperture: float, distance: float, *, defocus: float = DEFOCUS) -> float:
    """Full width at half maximum in metres that balances speckle and blur.

    The result is 2 defocus wavelength^2 / (aperture^2 distance): a change of the wavelength by half of this width moves
    the focus by ``defocus`` times the depth of focus. The formula holds for all colours and distances of a scene within
    a quarter, for Lorentzian spectra cut off at 10 % and the SSIM against the mean image over other random seeds. The
    best value of ``defocus`` depends on the scene, from 0.47 to 0.84 for three CT scans and a molecule: fine structure
    suffers sooner (``holotorch run configs/eye/teapot.yaml 'tradeoff=[10 mm, 20 mm, 30 mm]'`` finds it).

    Args:
        wavelength: In metres.
        aperture: Sine of half the angle of the light cone that carries the picture: the one of :func:`path_difference`,
            or the sine wavelength / (2 ray pitch) of the finest detail of the scene if that is smaller.
        distance: From the hologram to the depth in focus, in metres, above 0.
        defocus: Shift of the focus by half the width, in depths of focus.
    """
    distance, defocus = checks.quantity(DEPTH, distance, "distance"), checks.positive("defocus", defocus)
    return 2 * defocus * depth_of_focus(wavelength, aperture) * checks.wavelengths(wavelength)[0] / distance
