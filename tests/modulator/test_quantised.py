import pytest
import torch

from holotorch.modulator.quantised import quantised


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bits", [1, 2, 3, 8])
def test_levels(bits, dtype):
    phase = torch.rand(2, 3, 64, 65, dtype=dtype) * torch.tensor([7.3, 0.1, 1e3]).to(dtype)[:, None, None]
    stepped = quantised(phase, bits)
    for item, whole in zip(stepped.flatten(0, 1), phase.flatten(0, 1), strict=True):
        step = whole.max() / (2**bits - 1)
        levels = torch.arange(2**bits).to(dtype) * step
        assert set(item.unique().tolist()) == set(levels.tolist())  # to the bit, and each is met
        assert (item - whole).abs().max() <= step / 2 * (1 + 1e-5)
        assert item.max() == pytest.approx(whole.max().item(), rel=1e-6)
    assert stepped.dtype == dtype
    # Scaling by the largest phase again may move every level by a rounding, but no phase to another level.
    torch.testing.assert_close(quantised(stepped, bits), stepped, rtol=1e-6, atol=0)


def test_all_levels_of_24_bits_are_the_phases_themselves_in_float32():
    phase = torch.rand(1, 32, 32)
    torch.testing.assert_close(quantised(phase, 24), phase, rtol=0, atol=2**-24)


def test_gradient_is_that_of_the_identity():
    phase = (torch.rand(2, 5, 6, dtype=torch.float64) * 6).requires_grad_()
    weights = torch.randn(2, 5, 6, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * quantised(phase, 3)).sum(), phase)
    assert torch.equal(gradient, weights)


def test_a_cold_array_stays_cold():
    assert torch.equal(quantised(torch.zeros(2, 3, 3), 4), torch.zeros(2, 3, 3))


@pytest.mark.parametrize(
    ("phase", "bits", "error", "message"),
    [
        (torch.ones(2, 2), 0, ValueError, "bits must be at least 1"),
        (torch.ones(2, 2), 25, ValueError, "bits must be at most 24, got 25"),
        (torch.ones(2, 2), 2.0, TypeError, "bits must be a whole number"),
        (torch.tensor([[1.0, -0.1]]), 3, ValueError, "phase must be >= 0 to be quantised, got a minimum of -0.1"),
        (torch.ones(2, 2, dtype=torch.int64), 3, TypeError, "real floating-point"),
    ],
)
def test_refuses_what_has_no_levels(phase, bits, error, message):
    with pytest.raises(error, match=message):
        quantised(phase, bits)
