"""Speckle against sharpness: the best width, and the closed form that goes with it."""

import math

import numpy as np
import pytest
import torch

from holotorch.experiments.eye import tradeoff as eye_tradeoff
from holotorch.experiments.eye.tradeoff import WIDTHS, Case, fitted_prefactor, in_words, tradeoff
from holotorch.experiments.registry import load_config
from holotorch.io.bundled import find_config
from holotorch.optics.light.spectrum import Spectrum


def case(distance: float, wavelength: float, aperture: float, best: float, inside: bool = True) -> Case:
    flat = (0.5,) * len(WIDTHS)
    return Case(distance, wavelength, aperture, flat, flat, best, inside)


def test_the_prefactor_is_that_of_the_cases():
    """FWHM = 2 k wavelength^2 / (aperture^2 distance), with k = 0.5 and one case off by a tenth each way.

    The words judge each case by the prefactor of the other distances: 1.1 * 1.1^0.5 - 1 is 15 %.
    """
    cases = []
    for distance, off in ((0.01, 1.1), (0.02, 1 / 1.1), (0.03, 1.0)):
        cases.append(case(distance, 520e-9, 0.04, off * 520e-9**2 / (0.04**2 * distance)))
    cases.append(case(0.05, 520e-9, 0.04, 1e-6, inside=False))  # beyond the widths tried: it tells nothing
    assert fitted_prefactor(cases) == pytest.approx(0.5, rel=1e-12)
    words = in_words(cases)
    assert "3 of 4 optima" in words[0] and "-13% to +15%" in words[0] and "nearest to a sled" in words[2]
    # Without an optimum inside the widths there is no formula, and the measurements are written all the same.
    assert math.isnan(fitted_prefactor([cases[-1]]))
    assert math.isnan(cases[-1].row(float("nan"))["formula_nm"]) and "0 of 1 optima" in in_words([cases[-1]])[0]


@pytest.mark.parametrize("fwhm", [10e-9, 13e-9])
def test_weights_are_those_of_the_spectrum(fwhm):
    wavelengths = 520e-9 + np.arange(-40, 41) * 1e-9
    spectrum = Spectrum.lorentzian(520e-9, fwhm)
    dense, weights = spectrum.measure()
    wanted = (weights * (dense - 520e-9).square()).sum().item()
    moment = (eye_tradeoff._weights(wavelengths, spectrum) * (wavelengths - 520e-9) ** 2).sum()
    # p = 1 / (1 + (x / 5)^2) in steps of 1 nm from -15 to 15 nm, where it has fallen to a tenth: h^2 / 12 times the
    # change of slope of p x^2, 0.6, is 0.05 in 437.8; that of p, -0.024, is -0.002 in 12.49; 3e-4 in all. At 13 nm the
    # ends, +-19.5 nm, lie between two samples: x^2 is 0.25 too large there, for a quarter of a step and p = 0.1: 1e-5.
    assert moment / wanted == pytest.approx(1, abs=5e-4)  # of 1: both are 1e-17 m^2, and approx allows 1e-12


def test_a_small_scene_has_its_cases(monkeypatch):
    monkeypatch.setattr(eye_tradeoff, "_OFFSETS", 1e-9 * np.array([0, 5, 15, 40]))
    looking, shown = find_config("configs/eye/teapot.yaml"), find_config("configs/volume/c60.yaml")
    assert looking is not None and shown is not None
    change = "hologram={shape: [128, 128], pitch: 3.74 um, distance: 12 mm, depths: 8, rays: 64}"
    scene = load_config(shown, [change, "volume={phantom: c60, samples: 24}"])

    def similarity(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        assert a.shape == b.shape == (1, len(WIDTHS), 1, 64, 64) and a.min() >= 0 and a.max() <= 1
        return 1 - (a - b).abs().mean((-3, -2, -1))

    cases = tradeoff(load_config(looking), scene, (12e-3,), seeds=1, others=2, similarity=similarity)
    assert all("; by LPIPS " in line for line in in_words(cases)[1:])
    assert [found.wavelength for found in cases] == list(scene.wavelengths)
    for found in cases:
        assert len(found.ssim) == len(WIDTHS) and found.contrast[0] > found.contrast[-1]
        # 64 rays of 7.48 um: what they carry, or the sine to the edge of 128 pixels at 12 mm.
        edge = math.sin(math.atan2(64 * 3.74e-6, 12e-3))
        assert found.aperture == pytest.approx(min(edge, found.wavelength / 14.96e-6), rel=1e-6)
        assert found.lpips is not None and found.lpips[0] < max(found.lpips)  # a laser's speckle is far from the mean
        assert found.row(0.5)["lpips_1.4"] == round(found.lpips[0], 4)
        row = found.row(0.5)
        assert row["ssim_1.4"] == round(found.ssim[0], 4) and row["inside"] == found.inside
