import math

import pytest
import torch

from holotorch.tracking import Status
from holotorch.tracking.evaluation.latency import latency
from holotorch.tracking.evaluation.protocols import (
    chi_square_quantile,
    counts,
    coverage,
    grid_accuracy,
    planar_accuracy,
    s_rms,
    wrong_poses,
)

NAN = [math.nan] * 3


def rows(*points) -> torch.Tensor:
    return torch.tensor(points, dtype=torch.float64)


def rotation() -> torch.Tensor:
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    return turn * torch.linalg.det(turn).sign()


def test_stability_by_hand():
    # Changes 3 mm, 4 mm, 0: root of (9 + 16 + 0) / 3; the mean is (1.5, 2, 0) mm.
    tips = 1e-3 * rows([0, 0, 0], [3, 0, 0], [3, 4, 0], [3, 4, 0])
    found = s_rms(tips)
    assert found.s_rms == pytest.approx(1e-3 * math.sqrt(25 / 3), rel=1e-12) and found.differences == 3
    middle = tips.mean(0)
    assert found.sd == pytest.approx(math.sqrt(float((tips - middle).square().sum()) / 3), rel=1e-12)
    # The change of 50 mm behind the refusal is no change from one frame to the next.
    found = s_rms(1e-3 * rows([0, 0, 0], [3, 0, 0], NAN, [53, 0, 0], [53, 4, 0], NAN, [9, 9, 9]))
    assert found.s_rms == pytest.approx(1e-3 * math.sqrt(25 / 2), rel=1e-12)
    assert (found.differences, found.answered) == (2, 5)


def test_white_noise_is_root_two_of_its_deviation_and_drift_is_not_seen():
    noise = 2e-4 * torch.randn(20000, 3, dtype=torch.float64)
    found = s_rms(noise)
    # Relative standard error of either about 1 / sqrt(2 * 3 * 20000) = 0.3 %.
    assert found.sd == pytest.approx(2e-4 * math.sqrt(3), rel=0.015)
    assert found.s_rms == pytest.approx(math.sqrt(2) * found.sd, rel=0.02)
    drifting = s_rms(noise + torch.linspace(0, 0.01, 20000, dtype=torch.float64)[:, None])
    assert drifting.s_rms == pytest.approx(found.s_rms, rel=0.001) and drifting.sd > 5 * found.sd


def test_stability_needs_neighbours():
    for tips in (rows([0, 0, 0]), rows([0, 0, 0], NAN, [0, 0, 0]), rows(NAN, NAN)):
        with pytest.raises(ValueError, match="no two neighbouring frames"):
            s_rms(tips)
    with pytest.raises(ValueError, match=r"shape \[n, 3\], n >= 1, in metres, got \[3\]"):
        s_rms(torch.zeros(3))
    with pytest.raises(TypeError, match="real floating-point"):
        s_rms(torch.zeros(4, 3, dtype=torch.int64))


def face(turn: torch.Tensor, shift: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A face of 8 x 8 holes 10 mm apart, and where they are in the camera's frame."""
    i, j = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    grid = torch.stack([i, j, torch.zeros(8, 8)], -1).reshape(64, 3).to(torch.float64) * 0.01
    return grid, grid @ turn.T + shift


def test_grid_accuracy_sees_what_it_sees():
    grid, truth = face(rotation(), rows([0.02, -0.01, 0.5])[0])
    reference = 27
    exact = grid_accuracy(truth, grid, reference, truth)
    assert max(exact.acc, *exact.absolute, *exact.rigid) < 1e-14 and (exact.answered, exact.refused) == (64, 0)
    # A constant bias is seen by the absolute error alone.
    biased = grid_accuracy(truth + 1e-3, grid, reference, truth)
    assert biased.acc < 1e-14 and max(biased.rigid) < 1e-14
    assert biased.absolute == pytest.approx((1e-3 * math.sqrt(3),) * 3, rel=1e-9)
    # One point 0.63 mm further from the reference: the mean is over 63 points, not 64.
    moved = truth.clone()
    away = (truth[0] - truth[reference]) / (truth[0] - truth[reference]).norm()
    moved[0] += 0.63e-3 * away
    assert grid_accuracy(moved, grid, reference).acc == pytest.approx(0.63e-3 / 63, rel=1e-9)
    # Scaled by 1 %: each distance is wrong by 1 % of itself, and no rigid motion mends that.
    centre = truth.mean(0)
    scaled = grid_accuracy(centre + 1.01 * (truth - centre), grid, reference)
    designed = (grid - grid[reference]).norm(dim=-1)
    assert scaled.acc == pytest.approx(0.01 * float(designed.sum()) / 63, rel=1e-9)
    assert scaled.rigid[2] == pytest.approx(0.01 * float((grid - grid.mean(0)).norm(dim=-1).max()), rel=1e-9)
    assert all(math.isnan(value) for value in scaled.absolute)


def test_a_mirrored_grid_is_no_rigid_motion():
    grid = rows([0, 0, 0], [0.01, 0, 0], [0, 0.02, 0], [0, 0, 0.03])
    mirror = torch.diag(torch.tensor([1.0, 1, -1], dtype=torch.float64))
    assert grid_accuracy(grid @ mirror, grid, 0).rigid[2] > 1e-3


def test_refused_points_are_left_out_and_counted():
    grid, truth = face(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    found = truth + 1e-4
    found[5:9] = math.nan
    result = grid_accuracy(found, grid, 0, truth)
    assert (result.answered, result.refused) == (60, 4) and result.absolute[2] == pytest.approx(1e-4 * math.sqrt(3))
    with pytest.raises(ValueError, match="reference point 6 was refused"):
        grid_accuracy(found, grid, 6)
    with pytest.raises(ValueError, match="one of 64 points, got 64"):
        grid_accuracy(found, grid, 64)
    with pytest.raises(ValueError, match="grid must have a row for each of 64, got 63"):
        grid_accuracy(found, grid[1:], 0)
    with pytest.raises(ValueError, match="only the reference was answered"):
        grid_accuracy(torch.where(torch.arange(64)[:, None] == 3, truth, math.nan), grid, 3)


def test_planar_accuracy_by_hand():
    right, up = rows([2, 0, 0], [0, 0, -3])  # lengths do not matter
    grid = torch.tensor([[0, 0], [0.04, 0], [0, 0.04]], dtype=torch.float64)
    # Point 1 is 3 mm too far right and 4 mm off the plane; point 2 is exact.
    tips = rows([0.1, 0.2, 0.5], [0.143, 0.204, 0.5], [0.1, 0.2, 0.46])
    found = planar_accuracy(tips, grid, right, up, 0)
    assert (found.in_plane, found.in_space) == pytest.approx((1.5e-3, 2.5e-3), rel=1e-9)
    assert (found.answered, found.refused) == (2, 0)
    with pytest.raises(ValueError, match="at right angles, their cosine is 0.0995"):
        planar_accuracy(tips, grid, right, rows([0.1, 0, -1])[0], 0)
    with pytest.raises(ValueError, match="up must be a direction"):
        planar_accuracy(tips, grid, right, rows([0, 0, 0])[0], 0)


def test_coverage_of_a_covariance_that_tells_the_truth():
    # From tables of chi-square with 3 degrees of freedom.
    for level, value in ((0.5, 2.3660), (0.95, 7.8147), (0.99, 11.3449), (0.999, 16.2662)):
        assert chi_square_quantile(level) == pytest.approx(value, abs=5e-5)
    root = 1e-4 * torch.tensor([[1.0, 0, 0], [0.5, 2, 0], [-1, 3, 9]], dtype=torch.float64)
    truth = torch.randn(20000, 3, dtype=torch.float64)
    tips = truth + torch.randn(20000, 3, dtype=torch.float64) @ root.T
    covariance = (root @ root.T).expand(20000, 3, 3)
    share, count = coverage(tips, covariance, truth)
    # Standard error sqrt(0.95 * 0.05 / 20000) = 0.0015.
    assert share == pytest.approx(0.95, abs=0.007) and count == 20000
    # Deviations that are claimed half as large: P(chi-square <= 7.8147 / 4) = 0.4177.
    assert coverage(tips, covariance / 4, truth)[0] == pytest.approx(0.4177, abs=0.015)


def test_coverage_counts_answers_alone():
    unit = 1e-6 * torch.eye(3, dtype=torch.float64).expand(3, 3, 3).clone()
    unit[1] = math.nan  # as a refusal has it
    tips = rows([0, 0, 0], NAN, [0.0028, 0, 0])  # 2.8 deviations: 7.84 > 7.8147
    assert coverage(tips, unit, torch.zeros(3, 3, dtype=torch.float64)) == (0.5, 2)
    with pytest.raises(ValueError, match="1 covariances are not positive definite"):
        coverage(torch.zeros(3, 3), unit, torch.zeros(3, 3))
    with pytest.raises(ValueError, match="none of 1 frames was answered"):
        coverage(rows(NAN), unit[:1], torch.zeros(1, 3))
    with pytest.raises(ValueError, match="level must be between 0 and 1"):
        chi_square_quantile(1.0)


def test_answers_that_should_not_have_been():
    truth = rows([0, 0, 0.5], [0, 0, 0.5], [0, 0, 0.5], NAN, NAN)
    tips = rows([0, 0, 0.5049], [0, 0.0051, 0.5], NAN, [0, 0, 0.3], NAN)
    found = wrong_poses(tips, truth)
    assert (found.false, found.empty, found.wrong, found.present, found.refused) == (1, 2, 1, 3, 1)
    given = [Status.UNCERTAIN, Status.OK, Status.OK]
    assert list(counts(given).items()) == [("OK", 2), ("UNCERTAIN", 1)]


def motion(times: torch.Tensor) -> torch.Tensor:
    """At rest for a second, then back and forth ever faster."""
    t = (times - 1).clamp(min=0)
    x = 0.05 * torch.sin(2 * math.pi * (0.7 * t + 0.09 * t * t))
    return torch.stack([x, 0.03 * (1 - torch.cos(8.2 * t)), 0.5 + 0.2 * x], -1)


CLOCK = torch.arange(0, 10, 1 / 90, dtype=torch.float64) - 0.37


@pytest.mark.parametrize("lag", [0.095, -0.04, 0.0, 0.3])
def test_the_lag_comes_back_from_tracks_of_other_clocks_and_frames(lag):
    times = torch.arange(0, 9, 1 / 30, dtype=torch.float64) + 4e-3 * torch.rand(270, dtype=torch.float64)
    tips = motion(times - lag) + 2e-4 * torch.randn(270, 3, dtype=torch.float64)
    tips[100:112] = math.nan  # a refusal, not bridged
    found = latency(times, tips, CLOCK, motion(CLOCK) @ rotation().T + 0.3)
    # Noise shifts the peak by sd; linear interpolation and distances near zero add below a millisecond.
    assert abs(found.seconds - lag) < 1e-3 + 4 * found.sd and found.sd < 1e-3
    assert found.correlation > 0.99 and 0.02 < found.width < 0.3


def test_the_deviation_of_the_lag_is_that_of_repetitions():
    times = torch.arange(0, 9, 1 / 30, dtype=torch.float64)
    clean = motion(times - 0.1)
    found = [
        latency(times, clean + 2e-3 * torch.randn(270, 3, dtype=torch.float64), times, motion(times)) for _ in range(40)
    ]
    spread = torch.tensor([each.seconds for each in found]).std()
    stated = sum(each.sd for each in found) / len(found)
    # The estimate takes residuals as white, and a distance is not linear in the tip: a factor of two either way.
    assert stated / 2 < spread < 2 * stated


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, p: (t + 100, p), "the tracks share 0 s"),
        (lambda t, p: (t[:24], p[:24]), "share 0.767 s"),
        (lambda t, p: (t[::15], p[::15]), "has 18 answered samples"),
        (lambda t, p: (t, torch.where(t[:, None] > 0.5, math.nan, p)), "has 16 answered samples"),
        (lambda t, p: (t, torch.randn(270, 3, dtype=torch.float64)), "do not show the same motion"),
        (lambda t, p: (t, motion(t - 0.52)), "still rises at 0.5"),
        (lambda t, p: (t.flip(0), p), "times of the track must rise"),
        (lambda t, p: (t[:9], p), "must be of shape"),
    ],
)
def test_tracks_without_a_lag_are_refused(change, message):
    times = torch.arange(0, 9, 1 / 30, dtype=torch.float64)
    own, tips = change(times, motion(times))
    with pytest.raises(ValueError, match=message):
        latency(own, tips, CLOCK, motion(CLOCK))


def test_flat_and_rhythmic_motion_are_refused():
    times = torch.arange(0, 9, 1 / 30, dtype=torch.float64)

    def straight(t, way):
        return torch.stack([way(t), torch.zeros_like(t), torch.zeros_like(t)], -1)

    with pytest.raises(ValueError, match="do not show the same motion: correlation|still rises|flat"):
        latency(times, straight(times, lambda t: 0.01 * t), times, straight(times, lambda t: 0.01 * t))
    rhythm = straight(times, lambda t: torch.sin(2 * math.pi * 3 * t))
    with pytest.raises(ValueError, match="fit alike"):
        latency(times, rhythm, times, rhythm)
    slow = straight(times, lambda t: torch.sin(2 * math.pi * t / 20))
    with pytest.raises(ValueError, match="the peak is flat"):
        latency(times, slow, times, slow, longest=0.2)
