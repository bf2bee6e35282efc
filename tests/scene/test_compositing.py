"""Opacity correction, weights and the root of the radiance against the printed formulas."""

import math

import pytest
import torch

from holotorch.scene.compositing import absorb, corrected_opacity, extinction, front_to_back, safe_sqrt


def test_thesis_example_with_the_bound_from_above():
    # Algorithm 3 with max, as printed, gives (0.3, 0, 0).
    weights, left = front_to_back(torch.full((3, 1), 0.3, dtype=torch.float64))
    torch.testing.assert_close(weights[:, 0], torch.tensor([0.3, 0.21, 0.147], dtype=torch.float64))
    torch.testing.assert_close(left, torch.tensor([0.343], dtype=torch.float64))


def test_weights_are_the_printed_product():
    alpha = torch.rand(7, 5, dtype=torch.float64)
    weights, left = front_to_back(alpha)
    for i in range(7):
        transmitted = (1 - alpha[:i]).prod(0)  # T_0 = 1 is the empty product
        torch.testing.assert_close(weights[i], transmitted * alpha[i], rtol=1e-14, atol=1e-15)
    torch.testing.assert_close(left, (1 - alpha).prod(0), rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_and_what_is_left_make_one(dtype):
    alpha = torch.rand(200, 1000, dtype=dtype) ** 4
    weights, left = front_to_back(alpha)
    # 200 subtractions, each of them rounded once, of numbers up to 1.
    torch.testing.assert_close(
        weights.sum(0) + left, torch.ones(1000, dtype=dtype), rtol=0, atol=100 * torch.finfo(dtype).eps
    )
    assert (left >= 0).all() and (weights >= 0).all()


def test_correction_is_the_power_and_steps_add_up():
    alpha = torch.tensor([0.0, 1e-9, 0.1, 0.5, 0.9, 0.999], dtype=torch.float64)
    # 1 - alpha is rounded to 1e-16, which the power multiplies by at most 2.5 / (1 - alpha).
    torch.testing.assert_close(corrected_opacity(alpha, 2.5), 1 - (1 - alpha) ** 2.5, rtol=1e-12, atol=1e-15)
    parts = front_to_back(torch.stack([corrected_opacity(alpha, part) for part in (0.1, 0.7, 0.2)]))[1]
    torch.testing.assert_close(parts, 1 - alpha, rtol=1e-12, atol=0)
    assert corrected_opacity(alpha, 0.0).eq(0).all()


def test_thin_steps_of_faint_matter_are_not_lost_in_single_precision():
    # The printed power rounds 1 - 1e-9 to 1.
    found = corrected_opacity(torch.tensor(1e-9), 1e-2)
    assert found.item() == pytest.approx(1e-11, rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_the_ends_are_right_and_finite(dtype):
    alpha = torch.tensor([0.0, 1.0], dtype=dtype, requires_grad=True)
    for length in (0.0, 0.3, 1.0, 4.0):
        (slope,) = torch.autograd.grad(corrected_opacity(alpha, length).sum(), alpha)
        assert torch.isfinite(slope).all()
        assert slope[0].item() == pytest.approx(length)
        # The tangent of the extinction at 1 - 2^-20, behind the transmission left at 1.
        left = math.exp(-length * (20 * math.log(2) + 1))
        # torch's derivative of expm1 adds 1 to a result near -1, right to its rounding.
        rounding = length * 2**20 * torch.finfo(dtype).eps
        assert slope[1].item() == pytest.approx(length * 2**20 * left, rel=2e-5, abs=rounding)


def test_extinction_is_continuous_where_it_bends():
    border = 1 - 2.0**-20
    around = torch.tensor([border - 1e-12, border, border + 1e-12], dtype=torch.float64)
    steps = extinction(around).diff()
    # Slope 2^20 on both sides; the numbers below 1 are 1.1e-16 apart, so the steps of 1e-12 are right to 1e-4.
    torch.testing.assert_close(steps, torch.full((2,), 2.0**20 * 1e-12, dtype=torch.float64), rtol=3e-4, atol=0)


def test_gradcheck():
    alpha = (torch.rand(4, 3, dtype=torch.float64) * 0.9).requires_grad_()
    length = torch.rand(3, dtype=torch.float64).add(0.1).requires_grad_()
    assert torch.autograd.gradcheck(corrected_opacity, (alpha, length))
    assert torch.autograd.gradcheck(front_to_back, (alpha,))
    assert torch.autograd.gradcheck(absorb, (alpha, torch.rand(4, 3, dtype=torch.float64)))
    assert torch.autograd.gradcheck(safe_sqrt, (alpha + 0.01,))


def test_root_at_zero():
    radiance = torch.tensor([0.0, 0.25, 1.0], requires_grad=True)
    amplitude = safe_sqrt(radiance)
    assert amplitude.tolist() == [0, 0.5, 1] == safe_sqrt(radiance.detach()).tolist()
    amplitude.sum().backward()
    assert radiance.grad is not None and radiance.grad.tolist() == [0, 1, 0.5]
