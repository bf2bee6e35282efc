import math

import numpy as np
import pytest
import torch
from oracles import panel as oracle

from holotorch.modulator.dispersion import (
    BirefringenceTable,
    Cauchy,
    fit_cauchy,
    kinoform_efficiency,
    phase_scale,
    zero_order,
)


@pytest.mark.parametrize(
    ("design", "gamma", "largest", "efficiency"),
    [(636e-9, 5, 0.027, 0.9996), (636e-9, 20, 0.127, 0.993), (455e-9, 5, 0.044, 0.999), (455e-9, 20, 0.217, 0.983)],
)
def test_a_lorentzian_source_loses_little(design, gamma, largest, efficiency):
    """Every nm where the line exceeds a tenth of its peak, strictly inside +-3 gamma, gamma as printed in Eq. 5.15."""
    aside = torch.arange(1 - 3 * gamma, 3 * gamma, dtype=torch.float64)
    weight = 1 / (1 + (aside / gamma) ** 2)
    scale = phase_scale(design + aside * 1e-9, design)
    digit = 0.5e-3, 0.5 * 10.0 ** -len(str(efficiency).split(".")[1])  # half of the last one printed
    assert (scale - 1).abs().max().item() == pytest.approx(largest, abs=digit[0])
    mean = (weight * kinoform_efficiency(scale)).sum() / weight.sum()
    assert mean.item() == pytest.approx(efficiency, abs=digit[1])
    assert zero_order(scale).max() < (0.002 if gamma == 5 else 0.0295)


@pytest.mark.parametrize("scale", [0.8, 0.97, 1.0, 1.05, 1.2])
def test_powers_are_those_of_a_blaze(scale):
    at = torch.tensor(scale, dtype=torch.float64)
    # 2e5 samples in the middle of their cells: an error of (2 pi / 2e5)^2 / 24 of a value below 1.
    assert kinoform_efficiency(at).item() == pytest.approx(oracle.blazed_power(scale, 1), abs=1e-9)
    assert zero_order(at).item() == pytest.approx(oracle.blazed_power(scale, 0), abs=1e-9)


def test_about_half_of_it_is_plain_wavelength():
    plain = 455 / 441 - 1
    assert 0.5 < plain / (phase_scale(441e-9, 455e-9).item() - 1) < 0.75
    assert phase_scale(530e-9, 530e-9).item() == 1


def test_a_table_is_exact_where_cauchys_law_is_and_ends_where_it_ends():
    waves = [700e-9, 400e-9, 500e-9]
    law = Cauchy(0.2, 0.01e-12)
    table = BirefringenceTable(waves, law(torch.tensor(waves, dtype=torch.float64)).tolist())
    at = torch.linspace(400e-9, 700e-9, 50, dtype=torch.float64)
    assert torch.allclose(table(at), law(at), rtol=1e-12, atol=0)
    with pytest.raises(ValueError, match="lie outside the birefringence table, 400 to 700 nm"):
        phase_scale(710e-9, 530e-9, table)


def test_gradient_in_the_wavelength():
    light = torch.tensor([610e-9, 640e-9], dtype=torch.float64, requires_grad=True)
    for law in (Cauchy(), BirefringenceTable([450e-9, 550e-9, 700e-9], [0.22, 0.208, 0.197])):
        (gradient,) = torch.autograd.grad(phase_scale(light, 630e-9, law).sum(), light)
        step = 1e-12
        slope = (phase_scale(light.detach() + step, 630e-9, law) - phase_scale(light.detach() - step, 630e-9, law)) / (
            2 * step
        )
        # Rounding 1e-16 / 1e-12 = 1e-4 of slopes near 2e6.
        assert torch.allclose(gradient, slope, rtol=1e-6, atol=0)


def test_fit_finds_both_coefficients_within_their_errors():
    waves, path, noise = np.linspace(430e-9, 680e-9, 26), 6e-6, 0.02
    phases = 2 * math.pi * path * (0.18 + 0.0085e-12 / waves**2) / waves
    exact = fit_cauchy(waves.tolist(), phases.tolist(), path=path)
    assert (exact.law.a, exact.law.b) == pytest.approx((0.18, 8.5e-15), rel=1e-10) and exact.rms < 1e-12
    measured = phases + noise * np.random.default_rng(1).standard_normal(26)
    fit = fit_cauchy(waves.tolist(), measured.tolist(), path=path)
    assert abs(fit.law.a - 0.18) < 4 * fit.errors[0] and abs(fit.law.b - 8.5e-15) < 4 * fit.errors[1]
    assert fit.rms == pytest.approx(noise, rel=4 / math.sqrt(2 * 24))  # four deviations of a deviation
    np.testing.assert_allclose(
        fit.residuals, measured - 2 * math.pi * path * (fit.law.a + fit.law.b / waves**2) / waves, rtol=0, atol=1e-12
    )
    # Without the path only the ratio is known, and that is all a scale needs.
    ratio = phase_scale(480e-9, 630e-9, fit_cauchy(waves.tolist(), phases.tolist()).law)
    assert ratio.item() == pytest.approx(phase_scale(480e-9, 630e-9).item(), rel=1e-10)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fit_cauchy([530e-9], [6.0]), "at least two different wavelengths"),
        (lambda: fit_cauchy([530e-9, 530e-9], [6.0, 6.0]), "1 different"),
        (lambda: fit_cauchy([530e-9, 630e-9], [6.0]), "and 1 phases"),
        (lambda: fit_cauchy([530e-9, 630e-9], [6.0, -1.0]), "phase must be above zero"),
        (lambda: fit_cauchy([450e-9, 550e-9, 690e-9], [0.1, 0.1, 6.2]), "expected unwrapped ones"),
        (lambda: fit_cauchy([530, 630], [6.0, 5.0]), "wavelength must lie within 10 nm .. 300 um"),
        (lambda: BirefringenceTable([530e-9], [0.2]), "at least two different wavelengths"),
        (lambda: BirefringenceTable([530e-9, 630e-9], [0.2, 0]), "birefringence must be above zero"),
        (lambda: Cauchy(0.18, -1e-13)(torch.tensor(530e-9)), "birefringence must be positive, got -0.17"),
        (lambda: Cauchy(0.18, 0.0085), "b must lie within -1e-12 square metres .. 1e-12 square metres, got 0.0085"),
        (lambda: phase_scale(-1.0, 530e-9), "wavelength must be above zero"),
        (lambda: phase_scale(450.0, 530.0), "got 450 m; 450 looks like nanometres: pass 450e-9"),
    ],
)
def test_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()
