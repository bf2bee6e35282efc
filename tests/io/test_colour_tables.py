"""Colours of light against values printed elsewhere than in the tables that are read."""

import subprocess
import sys

import pytest
import torch

from holotorch.io.colour_tables import srgb_matrix, tristimulus, white_balance
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.picture import gamut_map, linear_srgb

COLOURS = (636e-9, 520e-9, 455e-9)


def test_matching_functions_are_those_of_the_standard():
    # CIE 1931, 2 degrees, at 450, 555 and 600 nm (ISO/CIE 11664-1).
    printed = [[0.3362, 0.0380, 1.77211], [0.5121, 1.0000, 0.00575], [1.0622, 0.6310, 0.0008]]
    torch.testing.assert_close(
        tristimulus([450e-9, 555e-9, 600e-9]).T, torch.tensor(printed, dtype=torch.float64), rtol=1e-3, atol=2e-4
    )
    between, around = tristimulus([550.5e-9]), tristimulus([550e-9, 551e-9])
    assert (between[:, 0] - around.mean(1)).abs().max() < 1e-4  # curvature of 1e-3 per nm^2 over 8, and less


def test_balanced_sources_show_grey_and_green_is_out_of_gamut():
    power = white_balance(COLOURS)
    assert power.max() == 1 and (power > 0).all()
    matrix = srgb_matrix(COLOURS, power)
    white = linear_srgb(torch.ones(3, 1, 1, dtype=torch.float64), matrix)
    # The matrix of IEC 61966-2-1 has four decimals: its white is D65 to 1e-3.
    torch.testing.assert_close(white, torch.ones_like(white), rtol=2e-3, atol=0)
    green = linear_srgb(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)[:, None, None], matrix)
    assert green.min() < -0.1  # a pure 520 nm lies far outside sRGB
    assert gamut_map(green).min() >= 0
    # Equal energy of the three is another white: strong in blue.
    equal = linear_srgb(torch.ones(3, 1, 1, dtype=torch.float64), srgb_matrix(COLOURS))
    assert (equal.flatten() @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)).item() == pytest.approx(
        1, abs=1e-3
    )
    assert (equal - 1).abs().max() > 0.1


def test_wide_light_is_a_mean_of_its_colours():
    places, weights = Spectrum.led(520e-9).samples(6)
    wide = srgb_matrix(places.tolist(), weights)
    assert wide.shape == (3, 6)
    colour = linear_srgb(torch.ones(6, 2, 2), wide)
    assert colour.dtype == torch.float32
    matching = tristimulus(places.tolist()) @ weights
    luminance = torch.tensor([0.2126, 0.7152, 0.0722]) @ colour[:, 0, 0]
    assert luminance.item() == pytest.approx(1, abs=1e-3) and matching[1] > 0.5


def test_refusals():
    with pytest.raises(ValueError, match="900 nm has no colour: the CIE 1931 table covers 360 to 830 nm"):
        tristimulus([500e-9, 900e-9])
    with pytest.raises(ValueError, match="wavelength must lie within 10 nm .. 300 um"):
        tristimulus([520])
    with pytest.raises(ValueError, match="weights must be 3 nonnegative numbers"):
        srgb_matrix(COLOURS, [1.0, -1.0, 1.0])
    with pytest.raises(ValueError, match="white has no luminance"):
        srgb_matrix(COLOURS, [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="cannot be mixed to the white D65"):
        white_balance([636e-9, 620e-9, 600e-9])
    with pytest.raises(ValueError, match="needs three wavelengths"):
        white_balance([636e-9, 520e-9])


def test_the_tables_are_read_only_when_asked_for_and_numbers_are_printed_as_before():
    code = (
        "import sys, numpy, holotorch.io.colour_tables as tables, holotorch.optics.light.spectrum\n"
        "assert 'colour' not in sys.modules\n"
        "printed = numpy.get_printoptions()\n"
        "tables.srgb_matrix([630e-9])\n"
        "assert 'colour' in sys.modules and numpy.get_printoptions() == printed\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
