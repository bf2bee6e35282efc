"""Few wavelengths for a spectrum, and its contrast, on speckle that is really replayed, by plain numpy."""

import math

import numpy as np
import pytest
import torch
from oracles.speckle import contrast_of_band, contrast_of_lorentzian, replayed

from holotorch.metrics import speckle_contrast
from holotorch.optics.light.coherence import (
    chromatic_defocus,
    depth_of_focus,
    optimum_fwhm,
    path_difference,
    predicted_contrast,
    samples_needed,
)
from holotorch.optics.light.quadrature import SpeckleIntegral
from holotorch.optics.light.spectrum import Spectrum

PITCH, DISTANCE, APERTURE = 3.74e-6, 0.03, 0.056
PATH = path_difference(DISTANCE, APERTURE)
COLOURS = (636e-9, 520e-9, 455e-9)
PRESETS = ("laser", "narrow_sled", "sled", "led")


def scene(side: int, seed: int = 2) -> np.ndarray:
    """Bars of two brightnesses on black with random Gaussian amplitudes: the speckle is fully developed."""
    generator = np.random.default_rng(seed)
    field = generator.normal(size=(side, side)) + 1j * generator.normal(size=(side, side))
    bars = np.zeros((side, side))
    bars[:, : side // 3] = 1
    bars[: side // 2, side // 2 :] = 0.6
    return field * np.sqrt(bars)


def seen(source: np.ndarray, centre: float, places: torch.Tensor, weights: torch.Tensor, iris: bool) -> np.ndarray:
    total = np.zeros(source.shape)
    for place, weight in zip(places.tolist(), weights.tolist(), strict=True):
        total += weight * replayed(source, PITCH, centre, place, DISTANCE, APERTURE, iris)
    return total


def distance_between(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


# Wavelengths for 1 % of light limited by the hologram's band, in the order of COLOURS; every nanometre takes 5, 15, 31
# and 61. A quarter of that is 1, 3, 7 and 15: reached by all LEDs, SLEDs but the blue one, and one narrow SLED.
COUNTS = {"laser": (2, 2, 2), "narrow_sled": (3, 4, 5), "sled": (5, 7, 8), "led": (8, 12, 15)}
# An iris cuts sharply: 3 %.
IRIS_COUNTS = {"laser": (2, 2, 3), "narrow_sled": (3, 4, 5), "sled": (5, 7, 9), "led": (9, 12, 15)}


@pytest.mark.parametrize("iris", [False, True])
@pytest.mark.parametrize("colour", range(3))
@pytest.mark.parametrize("preset", PRESETS)
def test_few_wavelengths_reach_the_sum_over_every_nanometre(preset, colour, iris):
    centre = COLOURS[colour]
    spectrum = getattr(Spectrum, preset)(centre)
    tolerance, counts = (0.03, IRIS_COUNTS) if iris else (0.01, COUNTS)
    dense = spectrum.every(1e-9)
    places, weights = spectrum.samples(tolerance=tolerance, path_difference=PATH, step=1e-9, iris=iris)
    assert len(places) <= counts[preset][colour]
    assert weights.sum().item() == pytest.approx(1, rel=1e-12) and (weights > 0).all()
    low, high = spectrum.band()
    assert low <= places.min() and places.max() <= high
    source = scene(128)
    error = distance_between(
        seen(source, centre, places, weights, iris), seen(source, centre, dense[0], dense[1], iris)
    )
    # What is expected over scenes; one of 128 x 128 px has some 3000 grains lit: 2 % of it, 3 sigma.
    assert error <= 1.06 * tolerance
    predicted = error_of((places, weights), dense, centre, iris)
    assert predicted <= tolerance
    # The bars' edges are no speckle, and near the rim few frequencies count: 30 %.
    if predicted > 0.003:
        assert error == pytest.approx(predicted, rel=0.3)


def error_of(rule, dense, centre: float, iris: bool = False) -> float:
    away, there = dense[0] - centre, rule[0] - centre
    return SpeckleIntegral(away, dense[1], PATH / centre**2, iris / centre).error(there, rule[1]).item()


def test_the_least_error_takes_fewer_wavelengths_than_gauss():
    centre = 455e-9
    spectrum = Spectrum.led(centre)
    dense = spectrum.measure()
    count = samples_needed(spectrum, PATH, 0.01, iris=False)
    gauss = [error_of(spectrum.samples(k), dense, centre) for k in (count, 21, 22)]
    best = error_of(spectrum.samples(count, path_difference=PATH, iris=False), dense, centre)
    assert best <= 0.01 < gauss[1] and gauss[2] <= 0.01 and gauss[0] > 5 * best
    assert count <= 14
    # One fewer does not do: the count is the least found, not a safe one.
    fewer = spectrum.samples(count - 1, path_difference=PATH, iris=False)
    assert error_of(fewer, dense, centre) > 0.01
    # The rough part of an iris is not to be had for less; the rule made for it is the better one there.
    rough = spectrum.samples(count, path_difference=PATH)
    assert error_of(rough, dense, centre, True) < error_of(
        spectrum.samples(count, path_difference=PATH, iris=False), dense, centre, True
    )


@pytest.mark.parametrize("iris", [0.0, 0.05])
def test_the_gradient_of_the_search_is_that_of_the_error(iris):
    nodes = torch.linspace(-1, 1, 64, dtype=torch.float64)
    integral = SpeckleIntegral(nodes, torch.softmax(-nodes.square(), 0), 6.0, iris)
    positions = torch.tensor([-0.8, -0.3, nodes[30], 0.2, 0.2004, 0.7], dtype=torch.float64)  # equal and near ones too
    value, gradient = integral._least_square(positions)
    _, shares = integral._descend(positions)  # any weights with a sum of 1 are worse than the best
    assert value < 2 * integral.error(positions, shares).log() + integral._energy.log() + 1e-9
    ahead, behind = (
        torch.stack([integral._least_square(positions + step * e)[0] for e in torch.eye(6, dtype=torch.float64)])
        for step in (1e-6, -1e-6)
    )
    close = torch.tensor([True, True, iris == 0, True, True, True])  # at a kink it is the mean of both sides
    assert ((ahead - behind) / 2e-6 - gradient)[close].abs().max() < 1e-5 * gradient.abs().max()


@pytest.mark.parametrize("spectrum", [Spectrum.led(520e-9), Spectrum.gaussian(520e-9, 8e-9)], ids=["led", "gaussian"])
@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_gauss_is_exact_for_polynomials(spectrum, count):
    places, weights = spectrum.samples(count)
    dense, power = spectrum.measure()
    low, high = spectrum.band()
    half, middle = (high - low) / 2, (high + low) / 2
    for degree in range(2 * count):
        wanted = (((dense - middle) / half) ** degree @ power).item()
        assert (((places - middle) / half) ** degree @ weights).item() == pytest.approx(wanted, abs=1e-13)
    top = ((dense - middle) / half) ** (2 * count) @ power
    assert abs(top - ((places - middle) / half) ** (2 * count) @ weights) > 1e-9


def test_a_lopsided_table_is_sampled_within_itself():
    spectrum = Spectrum.table([500e-9, 515e-9, 522e-9, 524e-9, 540e-9], [0.0, 3.0, 8.0, 7.0, 1.0])
    places, weights = spectrum.samples(tolerance=1e-3, path_difference=PATH, iris=False)
    low, high = spectrum.band()
    assert low <= places.min() and places.max() <= high and spectrum.power(places).min() > 0
    assert error_of((places, weights), spectrum.measure(), (low + high) / 2) <= 1e-3
    # A sum over every nanometre can be compressed, and not beyond itself.
    assert len(Spectrum.laser(520e-9).samples(5, step=1e-9)[0]) == 5
    with pytest.raises(ValueError, match="count must be at most 5"):
        Spectrum.laser(520e-9).samples(6, step=1e-9)


@pytest.mark.parametrize("centre", COLOURS)
def test_contrast_follows_the_width_of_the_spectrum(centre):
    side, generator = 192, np.random.default_rng(4)
    source = generator.normal(size=(side, side)) + 1j * generator.normal(size=(side, side))
    for fwhm in (1.4e-9, 12e-9):
        spectrum = Spectrum.lorentzian(centre, fwhm)
        places, weights = spectrum.samples(tolerance=0.003, path_difference=PATH, iris=False)
        picture = seen(source, centre, places, weights, False)
        wanted = predicted_contrast(spectrum, PATH)
        # 192^2 px at 2.9 px a grain or less: 12 000 grains, whose contrast scatters by 1 %.
        assert speckle_contrast(torch.from_numpy(picture)).item() == pytest.approx(wanted, rel=0.035)
        oracle = contrast_of_band(fwhm / 2, 1.5 * fwhm, PATH / centre**2)
        assert wanted == pytest.approx(oracle, rel=1e-5)  # midpoints: (3 fwhm / 3000)^2 beats squared


def test_contrast_of_a_whole_lorentzian_and_of_what_was_measured_on_a_volume():
    for fwhm in (1e-9, 10e-9):
        # A cutoff at 1e-4 leaves out 2 / (100 pi) of the power.
        wide = predicted_contrast(Spectrum.lorentzian(COLOURS[0], fwhm, cutoff=1e-4), PATH)
        beat = PATH / COLOURS[0] ** 2
        assert contrast_of_lorentzian(fwhm, beat) == pytest.approx(wide, rel=0.01)
    assert predicted_contrast(Spectrum.led(520e-9), 0.0) == pytest.approx(1)
    # Eq. 5.15 as printed with gamma of 5, 7, 10 nm on a CT volume: contrast with two digits, from 8 to 10 seeds.
    measured = {636e-9: (0.585, 0.51, 0.44), 520e-9: (0.495, 0.43, 0.37), 455e-9: (0.43, 0.375, 0.325)}
    for centre, contrasts in measured.items():
        for gamma, contrast in zip((5e-9, 7e-9, 10e-9), contrasts, strict=True):
            predicted = predicted_contrast(Spectrum.lorentzian_as_printed(centre, gamma), PATH)
            assert predicted == pytest.approx(contrast, rel=0.05)


def test_the_best_width_is_that_of_chromatic_defocus():
    for centre, measured, shift, focus in zip(
        COLOURS, (9.8e-9, 6.6e-9, 5.0e-9), (47e-6, 58e-6, 66e-6), (203e-6, 166e-6, 145e-6), strict=True
    ):
        # Measured on a CT scan with an earlier program, for the cone of the pupil: the law of the colours.
        assert optimum_fwhm(centre, APERTURE, DISTANCE, defocus=2.3) == pytest.approx(2 * measured, rel=0.02)
        assert -chromatic_defocus(DISTANCE, centre, 1e-9) == pytest.approx(shift, rel=0.01)
        assert depth_of_focus(centre, APERTURE) == pytest.approx(focus, rel=0.01)
    # Measured on a CT scan of a bonsai, which the default was not fitted to (FWHM in nm at 20 and 30 mm, 520 nm).
    for distance, aperture, fwhm in ((20e-3, 0.0348, 9.3e-9), (30e-3, 0.0320, 9.2e-9)):
        assert optimum_fwhm(520e-9, aperture, distance) == pytest.approx(fwhm, rel=0.25)
    assert optimum_fwhm(520e-9, 0.028, 0.06) == pytest.approx(2 * optimum_fwhm(520e-9, 0.056, 0.03))


def test_path_differences():
    assert pytest.approx(DISTANCE * (1 - math.sqrt(1 - APERTURE**2)), rel=2e-3) == PATH
    assert path_difference(-0.03, 0.05, tilt=0.02) == pytest.approx(0.03 * 0.07**2 / 2)
    assert path_difference(0.03, 0.05, tilt=-0.2) == pytest.approx(0.03 * 2 * 0.2 * 0.05)
    # Twice the path or the width takes twice the beats over the band.
    counts = [samples_needed(Spectrum.led(520e-9), PATH * part, iris=False) for part in (0.01, 0.3, 0.6)]
    assert counts[0] <= 2 and counts == sorted(counts)


def test_refusals():
    spectrum = Spectrum.laser(520e-9)
    for wrong in ({}, {"count": 3, "tolerance": 0.1}):
        with pytest.raises(ValueError, match="either count or tolerance"):
            spectrum.samples(**wrong)
    with pytest.raises(ValueError, match="tolerance needs path_difference"):
        spectrum.samples(tolerance=0.01)
    with pytest.raises(ValueError, match="path_difference must be above zero"):
        spectrum.samples(3, path_difference=0.0)
    with pytest.raises(ValueError, match="count must be at least 1"):
        spectrum.samples(0)
    with pytest.raises(ValueError, match="needs more than 256 wavelengths"):
        spectrum.samples(tolerance=0.01, path_difference=1.0)
    with pytest.raises(ValueError, match="path_difference must be at least zero"):
        predicted_contrast(spectrum, -1e-6)
    with pytest.raises(ValueError, match="sines and must add up to at most 1"):
        path_difference(0.03, 0.7, tilt=0.5)
    with pytest.raises(ValueError, match="aperture must be above zero"):
        optimum_fwhm(520e-9, 0.0, 0.03)
