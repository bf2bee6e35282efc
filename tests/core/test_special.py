import numpy as np
import pytest
import torch
from scipy.special import fresnel

from holotorch.core.special import FRESNEL_BORDER, fresnel_auxiliary, fresnel_integral


def test_power_series_equals_scipy():
    u = torch.linspace(-FRESNEL_BORDER, FRESNEL_BORDER, 801, dtype=torch.float64)
    s, c = fresnel(u.numpy())
    np.testing.assert_allclose(fresnel_integral(u), c - 1j * s, atol=1e-15)


@pytest.mark.parametrize(("low", "high"), [(FRESNEL_BORDER, 2), (2, 10), (10, 60)])
def test_auxiliary_functions_equal_scipy(low, high):
    u = torch.linspace(low, high, 801, dtype=torch.float64)
    f, g = (values.numpy() for values in fresnel_auxiliary(u))
    s, c = fresnel(u.numpy())
    phase = np.pi / 2 * u.numpy() ** 2
    # scipy's own phase of up to 5.7e3 rad is rounded to 5.7e3 * 1e-16.
    np.testing.assert_allclose((1 - 1j) / 2 + (1j * f - g) * np.exp(-1j * phase), c - 1j * s, atol=2e-12)


def test_auxiliary_functions_at_huge_arguments_follow_their_series():
    u = torch.tensor([1e3, 1e6], dtype=torch.float64)
    f, g = fresnel_auxiliary(u)
    np.testing.assert_allclose(f, 1 / (np.pi * u), rtol=1e-9)
    np.testing.assert_allclose(g, 1 / (np.pi**2 * u**3), rtol=1e-9)


def test_gradcheck():
    small = torch.linspace(-1, 1, 7, dtype=torch.float64, requires_grad=True)
    large = torch.linspace(1.4, 9, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(fresnel_integral, (small,))
    assert torch.autograd.gradcheck(fresnel_auxiliary, (large,))
