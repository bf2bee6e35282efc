"""One-Euro filter and prediction: the stated lag measured, resets, and a covariance that grows."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from holotorch.tracking.pose.smoothing import OneEuro
from holotorch.tracking.pose.status import Pose, Status

AXIS = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
ACROSS = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)  # square to AXIS: turns lead from it in a plane


def pose(tip, angle: float = 0.0, sd: float = 1e-4) -> Pose:
    direction = AXIS * math.cos(angle) + ACROSS * math.sin(angle)
    one = torch.ones((), dtype=torch.float64)
    covariance = torch.eye(6, dtype=torch.float64) * sd**2
    return Pose(torch.as_tensor(tip, dtype=torch.float64), direction, covariance, one, one, Status.OK)


def angle_of(found: Pose) -> float:
    return math.atan2(float(found.direction @ ACROSS), float(found.direction @ AXIS))


def times(steps: list[float]) -> list[float]:
    return [sum(steps[:i]) for i in range(len(steps) + 1)]


steps = st.lists(st.floats(1e-3, 0.2), min_size=1, max_size=20)


@settings(max_examples=25, deadline=None)
@given(steps, st.floats(0.1, 50), st.floats(0, 1000))
def test_a_catheter_at_rest_stays_where_it_is(gaps, cutoff, beta):
    filtered, still = OneEuro(cutoff, beta), pose([0.1, -0.2, 0.5], 0.3)
    for time in times(gaps):
        found = filtered(still, time)
        torch.testing.assert_close(found.tip, still.tip, rtol=0, atol=1e-15)
        torch.testing.assert_close(found.direction, still.direction, rtol=0, atol=1e-14)
        torch.testing.assert_close(found.covariance, still.covariance)
    assert filtered.cutoff == pytest.approx(cutoff)


@settings(max_examples=25, deadline=None)
@given(steps, st.integers(0, 2**31))
def test_answers_are_finite_between_the_measured_and_of_unit_length(gaps, seed):
    generator, filtered = torch.Generator().manual_seed(seed), OneEuro()
    tips = torch.randn(len(gaps) + 1, 3, generator=generator, dtype=torch.float64)
    turns = torch.randn(len(gaps) + 1, generator=generator, dtype=torch.float64)
    for time, tip, turn in zip(times(gaps), tips, turns, strict=True):
        found = filtered(pose(tip, float(turn)), time)
        assert bool(((found.tip >= tips.amin(0) - 1e-12) & (found.tip <= tips.amax(0) + 1e-12)).all())
        assert float(found.direction.norm()) == pytest.approx(1, abs=1e-12)
        assert torch.linalg.eigvalsh(found.covariance).min() > 0
        later = filtered.predict(time + 0.05)
        if later.status is Status.OK:
            assert bool(later.tip.isfinite().all()) and float(later.direction.norm()) == pytest.approx(1, abs=1e-12)


def test_the_first_pose_passes_unchanged():
    filtered, first = OneEuro(), pose([0.1, 0.2, 0.5])
    assert filtered(first, 3.0) is first and filtered.lag == 0


@pytest.mark.parametrize("rate", [30, 90])
@pytest.mark.parametrize("beta", [0.0, 200.0])
def test_the_lag_is_the_one_that_is_stated(rate, beta):
    """Behind a steady motion of tip and direction, from the first frame on and in the end 1 / (2 pi cutoff)."""
    filtered, speed, turning = OneEuro(2.0, beta), 0.05, 0.4
    generator = torch.Generator().manual_seed(5)
    time = 0.0
    for _ in range(4 * rate):
        found = filtered(pose([speed * time, 0.1, 0.5], turning * time), time)
        lag = filtered.lag
        assert float(found.tip[0]) == pytest.approx(speed * (time - lag), abs=1e-13)
        assert angle_of(found) == pytest.approx(turning * (time - lag), abs=1e-12)
        time += (0.5 + float(torch.rand((), generator=generator))) / rate
    # The point 127 mm behind moves across the tip's way or along it: at most the sum of both speeds counts.
    reached = 1 / (2 * math.pi * filtered.cutoff)
    assert filtered.lag == pytest.approx(reached, rel=0.01 if beta == 0 else 0.2)
    low, high = speed, speed + 0.127 * turning
    assert 2 + beta * low - 1e-9 <= filtered.cutoff <= 2 + beta * high + 1e-9
    if beta == 0:
        assert filtered.lag == pytest.approx(0.0796, abs=1e-3)  # the documented 80 ms at 2 Hz


def test_a_faster_catheter_lags_less_and_jitter_falls():
    slow, fast = OneEuro(), OneEuro()
    for i in range(120):
        slow(pose([1e-4 * i / 60, 0, 0.5]), i / 60)
        fast(pose([0.2 * i / 60, 0, 0.5]), i / 60)
    assert fast.lag < 0.1 * slow.lag
    # White noise of variance s^2 leaves a first-order low-pass of share alpha with alpha / (2 - alpha) of it.
    noise = 1e-4 * torch.randn(3000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    plain = OneEuro(2.0, 0.0)
    found = torch.stack([plain(pose(tip), i / 60).tip for i, tip in enumerate(noise)])[200:]
    alpha = (1 / 60) / (1 / 60 + 1 / (4 * math.pi))
    # 8400 numbers, each like its (2 - alpha) / alpha = 10.5 neighbours: the variance is known to sqrt(2 / 800) = 5 %.
    assert float(found.var() / noise.var()) == pytest.approx(alpha / (2 - alpha), rel=0.2)


def test_nothing_crosses_a_refusal_a_gap_or_a_flip():
    far = pose([0.3, 0.3, 0.9], 0.5)
    refused = Pose.refused(Status.NO_CATHETER, "no bands")
    for way in ("refusal", "gap", "flip"):
        filtered, time = OneEuro(longest_gap=0.2), 0.0
        for i in range(10):
            time = i / 60
            filtered(pose([0.05 * time, 0, 0.5]), time)
        new = far
        if way == "refusal":
            assert filtered(refused, time + 1 / 60) is refused
            assert filtered.predict(time + 2 / 60).status is Status.UNCERTAIN
            assert bool(filtered.predict(time + 2 / 60).tip.isnan().all())
        if way == "flip":
            new = replace(far, direction=-far.direction)
        at = time + (2 / 60 if way != "gap" else 0.21)
        assert filtered(new, at) is new and filtered.lag == 0
        assert filtered.predict(at).status is Status.UNCERTAIN  # one pose has no speed
        assert filtered(new, at + 1 / 60).status is Status.OK
        assert torch.equal(filtered.predict(at + 2 / 60).tip, new.tip)


def test_a_fast_turn_is_not_lost_behind_a_slow_filter():
    """Half a turn behind, the shorter way would lead back: 4 rad/s at 0.8 s of lag would end at 183 degrees."""
    filtered = OneEuro(0.2, 0.0)
    for i in range(240):
        found = filtered(pose([0, 0, 0.5], 4 * i / 60), i / 60)
        assert float(found.direction @ pose([0, 0, 0.5], 4 * i / 60).direction) > 0


def test_steady_motion_is_predicted_without_error():
    filtered, rate = OneEuro(), 60
    for i in range(2 * rate):
        filtered(pose([0.1 * i / rate, 0.2, 0.5], 0.5 * i / rate), i / rate)
    last = (2 * rate - 1) / rate
    for ahead in (0.0, 0.03, 0.095):
        found = filtered.predict(last + ahead)
        wanted = pose([0.1 * (last + ahead), 0.2, 0.5], 0.5 * (last + ahead))
        torch.testing.assert_close(found.tip, wanted.tip, rtol=0, atol=1e-12)
        torch.testing.assert_close(found.direction, wanted.direction, rtol=0, atol=1e-12)
    sizes = [float(filtered.predict(last + ahead).tip_sd) for ahead in (0.0, 0.03, 0.06, 0.095)]
    assert sizes == sorted(sizes) and sizes[-1] > 2 * sizes[0]
    late = filtered.predict(last + 0.12)
    assert late.status is Status.UNCERTAIN and "120 ms from the last frame, more than 100 ms" in late.reason
    assert filtered.predict(last + 0.12, longest=0.2).status is Status.OK


def test_prediction_covers_an_acceleration_as_it_says():
    """A hand that swings: the error keeps within the stated deviation of three for its largest acceleration."""
    filtered, size, turn = OneEuro(), 0.02, 2 * math.pi * 0.8
    shares = []
    for i in range(300):
        filtered(pose([size * math.sin(turn * i / 60), 0, 0.5]), i / 60)
        found = filtered.predict(i / 60 + 0.05, acceleration=size * turn**2)
        if found.status is Status.OK:
            error = abs(float(found.tip[0]) - size * math.sin(turn * (i / 60 + 0.05)))
            shares.append(error / math.sqrt(float(found.covariance[0, 0])))
    assert len(shares) == 299 and max(shares) < 3
    assert max(shares) > 0.3  # nor is it so wide that it says nothing


def test_speed_from_noise_is_as_uncertain_as_its_covariance_says():
    generator, errors, stated = torch.Generator().manual_seed(3), [], 0.0
    filtered = OneEuro(2.0, 0.0)
    for i in range(2000):
        filtered(pose([1e-4 * float(torch.randn((), generator=generator)), 0, 0.5]), i / 60)
        if i > 100:
            errors.append(float((filtered.predict(i / 60 + 0.09).tip - filtered.predict(i / 60).tip)[0]) / 0.09)
            stated = float((filtered.predict(i / 60 + 0.09).covariance - filtered.predict(i / 60).covariance)[0, 0])
    spread = torch.tensor(errors).std().item()
    assert spread**2 * 0.09**2 < stated  # neighbouring differences partly cancel, and acceleration is added


def test_impossible_input():
    filtered = OneEuro()
    filtered(pose([0, 0, 0.5]), 1.0)
    with pytest.raises(ValueError, match="in the order of capture, got 1.0 after 1.0"):
        filtered(pose([0, 0, 0.5]), 1.0)
    with pytest.raises(ValueError, match="captured must be finite"):
        filtered(pose([0, 0, 0.5]), math.nan)
    with pytest.raises(ValueError, match="tip must be finite"):
        filtered(pose([math.nan, 0, 0.5]), 2.0)
    with pytest.raises(TypeError, match="index the batch"):
        filtered(replace(pose([0, 0, 0.5]), tip=torch.zeros(2, 3)), 2.0)
    with pytest.raises(ValueError, match="min_cutoff must be above zero in Hz"):
        OneEuro(0.0)
    with pytest.raises(ValueError, match="beta must be at least zero in Hz per m/s"):
        OneEuro(beta=-1.0)
    filtered.reset()
    assert filtered(pose([0, 0, 0.5]), 0.5).status is Status.OK
