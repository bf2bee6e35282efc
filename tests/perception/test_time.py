import math

import numpy as np
import pytest
import torch
from oracles import perception as oracle

from holotorch.perception import PerceptionTime

SIZES = [5.0, 8.0, 11.0, 14.0, 17.0, 20.0, 23.0, 26.0]


def noisy(slope: float = -0.08, intercept: float = 0.75, seed: int = 3) -> torch.Tensor:
    noise = 0.02 * torch.randn(8, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return slope * torch.tensor(SIZES).double().log() + intercept + noise


def test_fit_is_that_of_the_normal_equations():
    times = noisy()
    found = PerceptionTime.fit(SIZES, times)
    line, covariance = oracle.line(np.log(SIZES), times.numpy())
    assert [found.slope.item(), found.intercept.item()] == pytest.approx(line.tolist(), rel=1e-11)
    assert found.covariance is not None and found.freedom == 6 and found.falls
    torch.testing.assert_close(found.covariance, torch.from_numpy(covariance), rtol=1e-9, atol=0)
    # By hand: through (e, 0.5) and (e^3, 0.3) goes a = -0.1, b = 0.6.
    exact = PerceptionTime.fit([math.e, math.e**3], [0.5, 0.3])
    assert [exact.slope.item(), exact.intercept.item()] == pytest.approx([-0.1, 0.6], rel=1e-13)
    assert exact.covariance is not None and exact.covariance.isnan().all() and exact.freedom == 0


def test_covariance_is_that_of_repeated_experiments():
    """4000 fits scatter as the covariance says; a variance of 4000 draws is known to sqrt(2 / 4000) = 2.2 %."""
    noise = 0.03 * torch.randn(4000, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = PerceptionTime.fit(SIZES, noise + 0.7 - 0.07 * torch.tensor(SIZES).double().log())
    assert found.covariance is not None and found.deviation is not None
    scatter = torch.cov(torch.stack([found.slope, found.intercept]))
    torch.testing.assert_close(scatter, found.covariance.mean(0), rtol=0.1, atol=0)
    assert found.deviation.square().mean().sqrt().item() == pytest.approx(0.03, rel=0.03)


def test_missed_patterns_are_left_out_of_a_batch():
    times = torch.stack([noisy(seed=seed) for seed in range(3)])
    seen = torch.ones(3, 8, dtype=torch.bool)
    seen[1, 2:5] = False
    gaps = torch.where(seen, times, torch.nan).requires_grad_()
    found = PerceptionTime.fit(SIZES, gaps, seen=seen)
    alone = PerceptionTime.fit([s for s, kept in zip(SIZES, seen[1], strict=True) if kept], times[1][seen[1]])
    torch.testing.assert_close(found[1].slope, alone.slope)
    torch.testing.assert_close(found[1].covariance, alone.covariance)
    (gradient,) = torch.autograd.grad(found.slope.sum() + found.intercept.sum(), gaps)
    assert gradient.isfinite().all() and not gradient[~seen].any()
    with pytest.raises(ValueError, match="no seen pattern in 1 of 3 laws"):
        PerceptionTime.fit(SIZES, times, seen=seen & torch.tensor([[True], [False], [True]]))
    with pytest.raises(ValueError, match="must be finite"):
        PerceptionTime.fit(SIZES, gaps.detach())


def test_size_inverts_seconds_and_both_have_the_right_gradient():
    time = PerceptionTime.fit(SIZES, noisy())
    sizes = torch.tensor(SIZES).double().requires_grad_()
    torch.testing.assert_close(time.size(time.seconds(sizes)), sizes)
    assert torch.autograd.gradcheck(time.seconds, sizes)
    wanted = torch.tensor([0.45, 0.5, 0.55], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(time.size, wanted)
    assert torch.autograd.gradcheck(lambda t: PerceptionTime.fit(SIZES, t).size(0.5), noisy().requires_grad_())


def test_a_law_that_rises_gives_times_and_no_size():
    rising = PerceptionTime.fit(SIZES, noisy(slope=+0.05, intercept=0.4))
    assert not rising.falls and rising.seconds(10.0).item() == pytest.approx(0.4 + 0.05 * math.log(10), abs=0.05)
    with pytest.raises(ValueError, match=r"larger pattern is not perceived sooner \(a = 0.0.* in 1 of 1"):
        rising.size(0.5)
    both = PerceptionTime(torch.tensor([-0.1, 0.1]), torch.tensor([0.7, 0.7]))
    with pytest.raises(ValueError, match=r"time\[time.falls\]"):
        both.size(0.5)
    assert both[both.falls].size(0.5).item() == pytest.approx(math.exp(2), rel=1e-5)
    with pytest.raises(ValueError, match="not perceived sooner"):
        PerceptionTime(torch.tensor(0.0), torch.tensor(0.5)).size(0.4)


def test_sizes_beyond_the_field_are_infinite_with_finite_gradients():
    flat = PerceptionTime(torch.tensor([-1e-4, -0.1]).double(), torch.tensor([0.9, 0.7]).double())
    time = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    sizes = flat.size(time)
    assert sizes[0] == math.inf and sizes[1].item() == pytest.approx(math.exp(2))
    (gradient,) = torch.autograd.grad(sizes[1] + sizes[0].clamp(max=400), time)
    assert gradient.item() == pytest.approx(math.exp(2) / -0.1)
    # Data on the line: the deviation is 0, and its gradient is no NaN.
    times = torch.tensor([0.6, 0.55, 0.5], dtype=torch.float64, requires_grad=True)
    exact = PerceptionTime.fit([math.e, math.e**1.5, math.e**2], times)
    assert exact.deviation is not None and exact.deviation < 1e-12
    assert torch.autograd.grad(exact.deviation, times)[0].isfinite().all()


def test_one_size_only_and_other_bad_data():
    with pytest.raises(ValueError, match="patterns of two sizes or more, got one size only"):
        PerceptionTime.fit([5.0, 5.0, 5.0], [0.4, 0.5, 0.6])
    with pytest.raises(ValueError, match="one size only"):
        PerceptionTime.fit([5.0], [0.4])
    with pytest.raises(ValueError, match="450 ms is 0.45"):
        PerceptionTime.fit(SIZES, noisy() * 1000)
    with pytest.raises(ValueError, match="450 ms is 0.45"):  # also where most were missed
        PerceptionTime.fit(SIZES, noisy() * 1000, seen=torch.arange(8) < 3)
    with pytest.raises(ValueError, match="times above zero"):
        PerceptionTime.fit(SIZES, -noisy())
    with pytest.raises(ValueError, match="size_deg must be above zero"):
        PerceptionTime.fit([-5.0, 8.0], [0.4, 0.5])
    with pytest.raises(ValueError, match="size_deg must be above zero"):
        PerceptionTime.fit(SIZES, noisy()).seconds(0.0)
    with pytest.raises(ValueError, match="at least one"):
        PerceptionTime.fit([], [])
    with pytest.raises(TypeError, match="seen must be a bool"):
        PerceptionTime.fit(SIZES, noisy(), seen=torch.ones(8))
    with pytest.raises(ValueError, match="share a shape"):
        PerceptionTime(torch.zeros(2), torch.zeros(3))
