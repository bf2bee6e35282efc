"""Spectra against the closed forms of their shapes."""

import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from holotorch.optics.light.spectrum import Spectrum

GREEN = 520e-9
PRESETS = {"laser": 1.4e-9, "narrow_sled": 5e-9, "sled": 10e-9, "led": 20e-9}
SOURCES = {
    "lorentzian": Spectrum.lorentzian(GREEN, 5e-9),
    "gaussian": Spectrum.gaussian(GREEN, 5e-9),
    "table": Spectrum.table([500e-9, 515e-9, 522e-9, 524e-9, 540e-9], [0.0, 3.0, 8.0, 7.0, 0.0]),
    "low cutoff": Spectrum.lorentzian(GREEN, 5e-9, cutoff=1e-3),
}


def test_widths_are_full_widths_at_half_maximum():
    for name, fwhm in PRESETS.items():
        spectrum = getattr(Spectrum, name)(GREEN)
        peak, *half = spectrum.power([GREEN, GREEN - fwhm / 2, GREEN + fwhm / 2]).tolist()
        assert spectrum.fwhm == fwhm and half == pytest.approx([peak / 2] * 2, rel=1e-9)
        # 10 % cut-off: 3 gamma, and every nanometre within (thesis Sec. 5.5.2.2).
        assert spectrum.band() == pytest.approx((GREEN - 1.5 * fwhm, GREEN + 1.5 * fwhm), rel=1e-12)
        assert len(spectrum.every()[0]) == {"laser": 5, "narrow_sled": 15, "sled": 31, "led": 61}[name]
        literal = Spectrum.lorentzian_as_printed(GREEN, fwhm)
        assert literal.fwhm == 2 * fwhm
        assert len(literal.every()[0]) == {"laser": 9, "narrow_sled": 31, "sled": 61, "led": 121}[name]
        # Eq. 5.15 to the letter.
        away = torch.tensor([-2.2, 0.4, 3.0], dtype=torch.float64) * fwhm
        peak = literal.power(GREEN)
        wanted = peak / (1 + (away / fwhm) ** 2)
        torch.testing.assert_close(literal.power(GREEN + away * (1 - 1e-9)), wanted, rtol=1e-6, atol=0)
    low, high = Spectrum.gaussian(GREEN, 5e-9).band(0.5)
    assert high - low == pytest.approx(5e-9, rel=1e-9)


@pytest.mark.parametrize("name", SOURCES)
def test_the_band_has_unit_power_and_nothing_is_outside(name):
    spectrum = SOURCES[name]
    low, high = spectrum.band()
    corners = [520e-9] if name == "low cutoff" else [515e-9, 522e-9, 524e-9]
    total, error = quad(lambda w: spectrum.power(w).item(), low, high, points=corners, limit=200, epsrel=1e-9)
    assert total == pytest.approx(1, abs=max(2e-9, 2 * error))
    edges = spectrum.power([low * (1 - 1e-9), low * (1 + 1e-9), high * (1 - 1e-9), high * (1 + 1e-9)])
    assert edges[0] == edges[3] == 0 and edges[1] > 0
    peak = max(spectrum.power(np.linspace(low, high, 20001)).tolist())
    assert edges[1:3].tolist() == pytest.approx([spectrum.cutoff * peak] * 2, rel=1e-3)
    places, weights = spectrum.measure()
    assert weights.sum().item() == pytest.approx(1, rel=1e-12)
    middle = quad(lambda w: w * spectrum.power(w).item(), low, high, points=corners, limit=200, epsrel=1e-9)[0]
    assert (places @ weights).item() == pytest.approx(middle, rel=1e-9)


def test_the_lorentzian_over_its_band_is_an_arctangent():
    # Peak 1 / (2 gamma arctan(reach / gamma)) at reach = 3 gamma.
    spectrum = Spectrum.sled(GREEN)
    assert spectrum.power(GREEN).item() == pytest.approx(1 / (2 * 5e-9 * math.atan(3)), rel=1e-12)


def test_a_table_is_followed_in_straight_lines():
    spectrum = SOURCES["table"]
    assert spectrum.centre == 522e-9
    # Half of the peak, 4, lies on the way from 3 to 8 and from 7 to 0.
    low, high = 515e-9 + 7e-9 / 5, 524e-9 + 16e-9 * 3 / 7
    assert spectrum.band(0.5) == pytest.approx((low, high), rel=1e-12)
    assert spectrum.fwhm == pytest.approx(high - low, rel=1e-9)
    power = spectrum.power(np.array([[515e-9, 523e-9], [522e-9, 532e-9]]))
    torch.testing.assert_close(power / power[1, 0] * 8, torch.tensor([[3, 7.5], [8, 3.5]], dtype=torch.float64))
    for outside in (499e-9, 541e-9):
        with pytest.raises(ValueError, match=r"wavelength .* lies outside the table, which covers 5e-07 to 5.4e-07"):
            spectrum.power([GREEN, outside])
    # A table that does not fall to the cutoff is taken to its ends.
    assert Spectrum.table([500e-9, 510e-9], [1.0, 1.0]).band() == (500e-9, 510e-9)


def test_every_step_starts_from_the_centre():
    places, weights = Spectrum.narrow_sled(GREEN).every(2e-9)
    torch.testing.assert_close(places * 1e9, torch.arange(514.0, 527.0, 2.0, dtype=torch.float64))
    shape = 1 / (1 + ((places - GREEN) / 2.5e-9) ** 2)
    torch.testing.assert_close(weights, shape / shape.sum(), rtol=1e-9, atol=0)


def test_a_spectrum_is_a_value():
    assert Spectrum.led(GREEN) == Spectrum.lorentzian(GREEN, 20e-9) != Spectrum.gaussian(GREEN, 20e-9)
    with pytest.raises(FrozenInstanceError):
        Spectrum.led(GREEN).centre = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("fwhm", [0.0, -5e-9, math.nan, math.inf])
def test_refuses_a_bad_width(fwhm):
    for build in (Spectrum.lorentzian, Spectrum.gaussian, Spectrum.lorentzian_as_printed):
        with pytest.raises(ValueError, match="must be (above zero|finite) in metres"):
            build(GREEN, fwhm)


def test_refuses_what_is_no_spectrum():
    with pytest.raises(ValueError, match="reaches wavelength 0; widths are in metres"):
        Spectrum.lorentzian(GREEN, 5e-7)
    with pytest.raises(ValueError, match="fwhm must lie within 1 fm .. 100 um, got 5 m; 5 looks like nanometres"):
        Spectrum.lorentzian(GREEN, 5)
    with pytest.raises(ValueError, match="wavelength must lie within 10 nm .. 300 um"):
        Spectrum.gaussian(520, 5e-9)
    with pytest.raises(ValueError, match="cutoff must lie between 0 and 1"):
        Spectrum.lorentzian(GREEN, 5e-9, cutoff=1.0)
    with pytest.raises(ValueError, match="cutoff must lie between 0 and 1"):
        Spectrum.led(GREEN).band(0.0)
    with pytest.raises(ValueError, match=r"must increase, but number 2 is 5.1e-07 after 5.2e-07; sort the rows"):
        Spectrum.table([500e-9, 520e-9, 510e-9], [0, 1, 0])
    with pytest.raises(ValueError, match="must increase"):
        Spectrum.table([500e-9, 500e-9], [0, 1])
    with pytest.raises(ValueError, match="two or more wavelengths and as many powers"):
        Spectrum.table([500e-9, 510e-9], [1, 1, 1])
    for powers in ([0, 0], [-1, 2]):
        with pytest.raises(ValueError, match="power must be nonnegative, and positive somewhere"):
            Spectrum.table([500e-9, 510e-9], powers)
    with pytest.raises(ValueError, match="step must be above zero"):
        Spectrum.led(GREEN).every(0.0)
