"""Errors of late poses, for motions whose error has a closed form."""

import math

import numpy as np
import pytest
import torch
from simulated_hand import pose

from holotorch.tracking import Pose, Status
from holotorch.tracking.evaluation.prediction import prediction_errors

RATE, DELAY = 60.0, 0.08
REFUSED = Pose.refused(Status.NO_CATHETER, "hidden")


def poses(tips, refused=()):
    times = torch.arange(len(tips), dtype=torch.float64) / RATE
    return times, [REFUSED if i in refused else pose(tip) for i, tip in enumerate(tips)]


def line(speed, count=60):
    return np.array([0.01, 0.0, 0.5]) + np.arange(count)[:, None] / RATE * speed * np.array([0.6, 0.8, 0.0])


def test_a_steady_motion_is_predicted_and_lags_without():
    times, errors = prediction_errors(*poses(line(0.2)), DELAY)
    # The last poses are those with a measured one 80 ms, 4.8 frames, later.
    assert len(times) == 55 and torch.allclose(errors[:, 0], torch.tensor(0.2 * DELAY, dtype=torch.float64))
    assert float(errors[1:, 1].max()) < 1e-12  # the first pose has no velocity
    assert errors[0, 1] == errors[0, 0] == errors[0, 2]
    assert float(errors[1:, 2].max()) < 1e-9  # the filter's lag is known exactly for a steady motion


def test_an_acceleration_leaves_what_the_formula_says():
    """x = a t^2 / 2: the velocity of two poses is that half a frame ago, so that a D (D + T) / 2 is left."""
    acceleration, t = 1.5, np.arange(60) / RATE
    tips = np.stack([acceleration * t**2 / 2, 0 * t, 0.5 + 0 * t], -1)
    delay = 5 / RATE  # at a frame, so that nothing is interpolated
    times, errors = prediction_errors(*poses(tips), delay)
    left = acceleration * delay * (delay + 1 / RATE) / 2
    assert torch.allclose(errors[1:, 1], torch.full((len(times) - 1,), left, dtype=torch.float64), atol=1e-12)


def test_a_refusal_breaks_the_velocity_and_the_truth():
    times, errors = prediction_errors(*poses(line(0.2), refused={30}), DELAY)
    known = (times * RATE).round().long().tolist()
    # Frame 30 has no pose; of those before it, frames 25 and 26 would be compared with a tip beside it.
    assert set(range(55)) - set(known) == {25, 26, 30}
    after = known.index(31)
    assert errors[after, 1] == errors[after, 0] and float(errors[after + 1, 1]) < 1e-12


def test_the_page_predicts_at_most_a_tenth_of_a_second():
    _, errors = prediction_errors(*poses(line(0.2)), 0.25)
    assert torch.allclose(errors[1:, 1], torch.tensor(0.2 * 0.15, dtype=torch.float64))
    assert torch.allclose(errors[1:, 2], torch.tensor(0.2 * 0.15, dtype=torch.float64), atol=1e-9)


def test_poses_far_apart_have_no_velocity():
    times, tips = torch.arange(10, dtype=torch.float64) * 0.3, line(0.2, 10)
    errors = prediction_errors(times, [pose(tip) for tip in tips], 0.3)[1]
    assert torch.equal(errors[:, 0], errors[:, 1])


def test_noise_at_rest_is_worse_with_prediction():
    """Of independent noise s along each axis: sqrt(2) s unpredicted, and sqrt(1 + (1 + r)^2 + r^2) s for r = D / T."""
    tips = np.array([0, 0, 0.5]) + 1e-4 * np.random.default_rng(4).standard_normal((6000, 3))
    delay = 3 / RATE
    _, errors = prediction_errors(*poses(tips), delay)
    rms = errors.square().mean(0).sqrt() / math.sqrt(3) / 1e-4
    assert float(rms[0]) == pytest.approx(math.sqrt(2), rel=0.03)
    assert float(rms[1]) == pytest.approx(math.sqrt(1 + 16 + 9), rel=0.03)
    assert 1 < float(rms[2]) < float(rms[1])


def test_mistakes_are_said():
    with pytest.raises(ValueError, match="no pose of 3 has measured ones 80 ms later"):
        prediction_errors(*poses(line(0.2, 3)), DELAY)
    times, given = poses(line(0.2, 5))
    with pytest.raises(ValueError, match="times must rise"):
        prediction_errors(times.flip(0), given, DELAY)
    with pytest.raises(ValueError, match="delay"):
        prediction_errors(times, given, -0.1)
