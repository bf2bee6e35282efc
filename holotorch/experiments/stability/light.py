"""Sweeps of light of a spectrum: few wavelengths that the toolkit chooses, against very many."""

import math
from functools import lru_cache, partial

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.experiments.stability import reference
from holotorch.experiments.stability.sweep import ASKED, Answer, Sweep
from holotorch.optics import (
    Display,
    Eye,
    SpectralRetina,
    Spectrum,
    plan_retina,
    propagate_collapsed,
    propagate_elements,
)
from holotorch.optics.free_space.cropped import CroppedKernel
from holotorch.optics.light.coherence import path_difference
from holotorch.optics.light.wavelength_sampling import least_count, neighbour_error, pupil_illumination

CENTRE = 520e-9  # metres
SMALL, GRID = Grid((20, 17), 8e-6), Grid((40, 32), 8e-6)  # of a hologram alone, and of one behind an eyepiece
OPTICS = Display(45e-3, 40e-3, 50e-3), Eye(1.5e-3, accommodation=0.25)
DENSE = 24  # wavelengths of the reference of ``Spectrum.samples``
EVERY = 21  # wavelengths of the light that ``SpectralRetina`` sums
TOLERANCE = 0.02
LOOSE = 0.5  # tolerance of the propagation of a single wavelength, which is not what is swept here


def sweeps() -> list[Sweep]:
    """Sweeps of the width of the spectrum, the distance and the tolerance."""
    widths = (0.1e-9, 1e-9, 5e-9, 12e-9)
    tolerances = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-5)
    return [
        Sweep("Spectrum.samples", "width (m)", widths, partial(_few, 20e-3, TOLERANCE), partial(_many, 20e-3),
              TOLERANCE, ASKED),
        Sweep("Spectrum.samples", "distance (m)", (1e-4, 1e-3, 1e-2, 0.05), lambda z: _few(z, TOLERANCE, 10e-9),
              lambda z: _many(z, 10e-9), TOLERANCE, ASKED),
        Sweep("Spectrum.samples", "tolerance", tolerances, lambda t: _few(10e-3, t, 10e-9),
              lambda _: _many(10e-3, 10e-9), tolerance_from=ASKED),
        Sweep("SpectralRetina", "width (m)", widths, partial(_propagated, TOLERANCE),
              partial(_each, TOLERANCE), TOLERANCE, ASKED),
        Sweep("SpectralRetina", "tolerance", tolerances, lambda t: _propagated(t, 20e-9), lambda t: _each(t, 20e-9),
              tolerance_from=ASKED),
    ]  # fmt: skip


def _sum(wavelengths: Tensor, weights: Tensor, distance: float) -> Tensor:
    """Weighted intensities [H, W] of one hologram at a distance under several wavelengths."""
    field, total = reference.noise(SMALL.shape)[None], torch.zeros(SMALL.shape, dtype=torch.float64)
    for wavelength, weight in zip(wavelengths.tolist(), weights.tolist(), strict=True):
        total += weight * intensity(CroppedKernel(SMALL, wavelength, distance)(field))[0]
    return total


def _few(distance: float, tolerance: float, fwhm: float) -> Answer:
    """The image under the wavelengths that a tolerance requires; the band of the grid limits the light, not an iris."""
    spectrum = Spectrum.lorentzian(CENTRE, fwhm)
    aperture = math.hypot(*(CENTRE / (2 * pitch) for pitch in SMALL.pitch))
    difference = path_difference(distance, aperture)
    wavelengths, weights = spectrum.samples(tolerance=tolerance, path_difference=difference, iris=False)
    return Answer(_sum(wavelengths, weights, distance), tolerance, f"{len(wavelengths)} wavelengths", tolerance)


@lru_cache(maxsize=16)
def _many(distance: float, fwhm: float) -> Tensor:
    """The same image under :data:`DENSE` wavelengths of Gauss's rule for the spectrum."""
    return _sum(*Spectrum.lorentzian(CENTRE, fwhm).samples(DENSE), distance)


def _light(fwhm: float) -> tuple[Tensor, Tensor]:
    return Spectrum.lorentzian(CENTRE, fwhm).samples(EVERY)


@lru_cache(maxsize=1)
def _chosen(tolerance: float, fwhm: float) -> tuple[SpectralRetina, float]:
    """The retina that propagates as many wavelengths as the tolerance requires, and the error that is predicted."""
    wavelengths, weights = _light(fwhm)
    count = least_count(wavelengths, weights, tolerance, GRID, *OPTICS)
    light = pupil_illumination(GRID, wavelengths.mean().item(), *OPTICS)
    predicted = neighbour_error(wavelengths, weights, count, light)
    return SpectralRetina(GRID, [(wavelengths, weights)], *OPTICS, count=count, tolerance=LOOSE), predicted


def _propagated(tolerance: float, fwhm: float) -> Answer:
    """The image [1, H, W] with as many wavelengths propagated as the tolerance requires.

    The error of the propagation of each wavelength is left to ``Retina`` and is the same in the reference.
    """
    retina, predicted = _chosen(tolerance, fwhm)
    chosen = f"{len(retina.chosen[0][0])} of {EVERY} wavelengths"
    return Answer(retina(reference.noise_inside(GRID)), predicted, chosen, tolerance)


def _each(tolerance: float, fwhm: float) -> Tensor:
    """The same image with every wavelength propagated, in the same window, so that the pupil has the same samples.

    The method is chosen once: wavelengths this close differ in no choice, and a choice takes longer than an image.
    """
    wavelengths, weights = _light(fwhm)
    wide = _chosen(tolerance, fwhm)[0].wide[0]
    y, x = ((big - small) // 2 for big, small in zip(wide.shape, GRID.shape, strict=True))
    field, total = (
        functional.pad(reference.noise_inside(GRID), (x, x, y, y)),
        torch.zeros(1, *wide.shape, dtype=torch.float64),
    )
    method = plan_retina(wide, CENTRE, *OPTICS, tolerance=LOOSE).method
    propagate = propagate_collapsed if method == "collapse" else propagate_elements
    for wavelength, weight in zip(wavelengths.tolist(), weights.tolist(), strict=True):
        total += weight * intensity(propagate(field, wide, wavelength, *OPTICS))
    return total[..., y : y + GRID.shape[0], x : x + GRID.shape[1]]
