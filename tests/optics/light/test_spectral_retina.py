import math

import pytest
import torch

from holotorch import Grid
from holotorch.optics import Display, Eye, Retina, SpectralRetina, Spectrum, spectral_image

GRID = Grid((48, 40), 8e-6)
SETUP = Display(45e-3, 40e-3, 50e-3), Eye(1.5e-3, accommodation=0.25)
WAVELENGTHS = (636e-9, 520e-9)


def spectra(count: int):
    return [Spectrum.sled(each).samples(count) for each in WAVELENGTHS]


def fields(dtype=torch.complex64, batch=()):
    generator = torch.Generator().manual_seed(3)
    return torch.randn(*batch, len(WAVELENGTHS), *GRID.shape, dtype=dtype, generator=generator)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_equals_the_function_for_each_channel(count):
    light = fields(torch.complex128, (2,))
    module = SpectralRetina(GRID, spectra(5), *SETUP, count=count, tolerance=0.9)
    for c, (places, weights) in enumerate(spectra(5)):
        expected = spectral_image(light[:, c], GRID, places, weights, *SETUP, count=count, reach=1e-6)
        torch.testing.assert_close(module(light)[:, c], expected, rtol=1e-9, atol=1e-12)


def test_one_wavelength_is_the_image_of_a_retina():
    light = fields()
    module = SpectralRetina(GRID, [([each], [1.0]) for each in WAVELENGTHS], *SETUP, tolerance=0.9)
    for c, each in enumerate(WAVELENGTHS):
        retina = Retina(GRID, each, *SETUP, tolerance=0.9)
        torch.testing.assert_close(module(light)[c : c + 1], retina(light[c : c + 1]))
    assert module.wavelengths == WAVELENGTHS


def test_recomputing_changes_no_gradient():
    gradients = []
    for recompute in (False, True):
        light = fields(torch.complex128, (2, 1)).requires_grad_()
        SpectralRetina(GRID, spectra(3), *SETUP, tolerance=0.9, recompute=recompute)(light).square().sum().backward()
        gradients.append(light.grad)
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "at least one channel"),
        ([([6e-7, 5e-7], [0.5, 0.5])], "must increase"),
        ([([5e-7, 6e-7], [1.0])], "2 wavelengths and 1 weights"),
        ([([5e-7, 6e-7], [1.0, 0.0])], "above 0"),
        ([([math.nan], [1.0])], "wavelength"),
    ],
)
def test_spectra_that_are_none(given, words):
    with pytest.raises(ValueError, match=words):
        SpectralRetina(GRID, given, *SETUP, tolerance=0.9)
