"""Camera to headset: noise of a hand, sets that determine nothing, frames of the other hand."""

import math

import pytest
import torch

from holotorch.tracking.pose.alignment import HAND_LENGTH, TOOL_LENGTH, headset_from_camera, in_frame, tool_points
from holotorch.tracking.pose.status import Pose, Status


def rotation(generator):
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    return turn * turn.det()


def truth(seed=0):
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation(generator)
    matrix[:3, 3] = torch.tensor([0.03, -0.08, 0.05])
    return matrix


def poses(count, seed=1, spread=1.0, length=TOOL_LENGTH):
    """Tips in a working volume of 200 mm half a metre away, directions around -z + y."""
    generator = torch.Generator().manual_seed(seed)
    tips = (torch.rand(count, 3, dtype=torch.float64, generator=generator) - 0.5) * 0.2
    tips[:, 2] += 0.5
    directions = torch.randn(count, 3, dtype=torch.float64, generator=generator) * spread
    return tool_points(tips, directions + torch.tensor([0.0, 0.6, -0.6]), length)


def moved(matrix, points):
    return points @ matrix[:3, :3].mT + matrix[:3, 3]


@pytest.mark.parametrize("count", [3, 6])
def test_exact_alignments_give_the_exact_map(count):
    wanted = truth()
    points = poses(count)
    found = headset_from_camera(points, moved(wanted, points))
    torch.testing.assert_close(found.headset_from_camera, wanted, rtol=0, atol=1e-14)
    assert found.residuals.max() < 1e-14 and found.leave_one_out.max() < 1e-13


def test_six_alignments_by_a_hand_are_right_to_less_than_a_millimetre():
    """1 mm per axis at each point; the goal is 0.7 mm elsewhere, in the mean over 200 sets."""
    generator = torch.Generator().manual_seed(3)
    errors, left_out, residuals = [], [], []
    for seed in range(200):
        wanted, points = truth(seed), poses(6, seed)
        noise = 1e-3 * torch.randn(6, 2, 3, dtype=torch.float64, generator=generator)
        found = headset_from_camera(points, moved(wanted, points) + noise)
        elsewhere = poses(50, 1000 + seed)[:, 0]
        errors.append((moved(found.headset_from_camera, elsewhere) - moved(wanted, elsewhere)).norm(dim=-1))
        left_out.append(found.leave_one_out)
        residuals.append(found.residuals)
    errors = torch.stack(errors)
    assert errors.mean() < 0.7e-3 and errors.median() < 0.7e-3
    # 36 equations and 6 unknowns: residuals of sqrt(3) mm times sqrt(30 / 36); 5 % is over five deviations of 200 sets.
    expected = math.sqrt(3 * 30 / 36) * 1e-3
    assert torch.stack(residuals).square().mean().sqrt().item() == pytest.approx(expected, rel=0.05)
    # A left out one shows its own noise and the error of the map, no less than the noise.
    assert torch.stack(left_out).square().mean().sqrt() > math.sqrt(3) * 1e-3


def test_leaving_one_out_finds_the_one_that_slipped():
    wanted, points = truth(), poses(6)
    seen = moved(wanted, points)
    seen[4] += torch.tensor([0.0, 0.012, 0.0])
    found = headset_from_camera(points, seen)
    assert found.leave_one_out.argmax() == 4
    assert found.leave_one_out[4] > 0.011 > found.residuals[4]


def test_map_is_differentiable():
    points = poses(3)
    seen = moved(truth(), points) + 1e-3 * torch.randn(3, 2, 3, dtype=torch.float64)
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda p, q: headset_from_camera(p, q).headset_from_camera, (points, seen))


@pytest.mark.parametrize("count", [1, 2])
def test_few_alignments_are_refused(count):
    with pytest.raises(ValueError, match="3 poses"):
        headset_from_camera(poses(count), poses(count))


def test_parallel_alignments_are_refused():
    points = poses(6, spread=0.0)
    with pytest.raises(ValueError, match="parallel to within 0.0 degrees.*in directions that"):
        headset_from_camera(points, moved(truth(), points))
    # Opposite directions are parallel too.
    points[::2] = points[::2].flip(1)
    with pytest.raises(ValueError, match="parallel"):
        headset_from_camera(points, moved(truth(), points))


def test_others_that_are_parallel_leave_the_one_unchecked():
    points = torch.cat([poses(2, spread=0.0), poses(1, 5)])
    found = headset_from_camera(points, moved(truth(), points))
    assert found.leave_one_out[2] == math.inf and found.leave_one_out[:2].isfinite().all()


def test_left_handed_frame_is_named():
    points = poses(5)
    with pytest.raises(ValueError, match="left-handed"):
        headset_from_camera(points, moved(truth(), points) * torch.tensor([1.0, 1, -1]))


@pytest.mark.parametrize(
    ("camera", "headset", "words"),
    [
        (poses(4), poses(3), "same alignments"),
        (poses(4), poses(4) * 1000, "headset must lie within -10 m .. 10 m, got .* looks like millimetres"),
        (poses(4)[:, 0], poses(4), r"\[n, 2, 3\]"),
        (poses(4) * math.nan, poses(4), "finite"),
    ],
)
def test_bad_input_is_named(camera, headset, words):
    with pytest.raises(ValueError, match=words):
        headset_from_camera(camera, headset)


def test_directions_of_no_length_are_refused():
    with pytest.raises(ValueError, match="null vector"):
        tool_points(torch.zeros(2, 3), torch.zeros(2, 3))
    with pytest.raises(TypeError, match="floating"):
        headset_from_camera(torch.zeros(3, 2, 3, dtype=torch.int64), poses(3))


def _single(tip, direction, covariance=None) -> Pose:
    covariance = torch.zeros(6, 6, dtype=torch.float64) if covariance is None else covariance
    zero = torch.zeros((), dtype=torch.float64)
    return Pose(tip, direction, covariance, zero, zero, Status.OK)


def _several(tips, directions) -> Pose:
    covariance, zero = torch.zeros(len(tips), 6, 6, dtype=torch.float64), torch.zeros(len(tips), dtype=torch.float64)
    return Pose(tips, directions, covariance, zero, zero, (Status.OK,) * len(tips))


def _hand(points, generator):
    """Points of tools that a hand has aligned, with errors of 1 mm and 1 degree (root mean square)."""
    place, turn = 1e-3 / math.sqrt(3), math.radians(1) / math.sqrt(2)  # per axis
    axis = points[:, 1] - points[:, 0]
    shift = place * torch.randn(len(points), 3, dtype=torch.float64, generator=generator)
    turned = torch.linalg.cross(turn * torch.randn(len(points), 3, dtype=torch.float64, generator=generator), axis)
    new = axis + turned
    new = new / new.norm(dim=-1, keepdim=True) * axis.norm(dim=-1, keepdim=True)
    return torch.stack([points[:, 0] + shift, points[:, 0] + shift + new], 1)


@pytest.mark.parametrize("count", [4, 6, 12])
def test_the_stated_uncertainty_of_the_tip_is_the_true_one(count):
    """A user who errs by 1 mm and 1 degree: the 95 % ellipsoid of a tip elsewhere contains the truth in 90 to 98 %."""
    generator, inside, errors = torch.Generator().manual_seed(5), [], []
    for seed in range(300):
        wanted, points = truth(seed), poses(count, seed, length=HAND_LENGTH)
        found = headset_from_camera(points, _hand(moved(wanted, points), generator))
        tools = poses(4, 5000 + seed)
        tips, directions = tools[:, 0], tools[:, 1] - tools[:, 0]
        pose = in_frame(_several(tips, directions), found.headset_from_camera, found.covariance)
        off = pose.tip - moved(wanted, tips)
        inside += ((off * torch.linalg.solve(pose.covariance[:, :3, :3], off)).sum(-1) < 7.815).tolist()
        errors += off.norm(dim=-1).tolist()
    assert 0.9 <= sum(inside) / len(inside) <= 0.98
    if count == 6:
        assert sorted(errors)[len(errors) // 2] < 0.7e-3


def test_a_pose_in_another_frame_is_turned_with_its_covariance():
    generator = torch.Generator().manual_seed(4)
    matrix, half = truth(2), torch.randn(6, 6, dtype=torch.float64, generator=generator)
    tip, direction = torch.tensor([0.1, -0.05, 0.5]).double(), torch.tensor([0.0, 0.6, -0.8]).double()
    pose = _single(tip, direction, half @ half.mT * 1e-6)
    moved_pose = in_frame(pose, matrix)
    torch.testing.assert_close(moved_pose.tip, moved(matrix, tip[None])[0])
    torch.testing.assert_close(moved_pose.direction, matrix[:3, :3] @ direction)
    back = in_frame(moved_pose, torch.linalg.inv(matrix))
    for name in ("tip", "direction", "covariance"):
        torch.testing.assert_close(getattr(back, name), getattr(pose, name), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(moved_pose.tip_sd, pose.tip_sd)
    tensors = [torch.stack([value] * 2) for value in (tip, direction, pose.covariance, tip[0], tip[0])]
    batch = Pose(tensors[0], tensors[1], tensors[2], tensors[3], tensors[4], (Status.OK,) * 2)
    covariance = torch.diag(torch.tensor([1e-6, 2e-6, 3e-6, 1e-8, 2e-8, 3e-8], dtype=torch.float64))
    both = in_frame(batch, matrix, covariance)
    torch.testing.assert_close(both.covariance[1], in_frame(pose, matrix, covariance).covariance)
    refused = in_frame(Pose.refused(Status.NO_CATHETER, "none"), matrix, covariance)
    assert not refused.answered and refused.tip.isnan().all() and refused.reason == "none"


def test_the_covariance_of_the_map_turns_and_shifts_a_pose():
    """Against many maps drawn from it."""
    matrix, covariance = truth(3), torch.diag(torch.tensor([4e-6, 1e-6, 9e-6, 1e-7, 4e-7, 2e-7], dtype=torch.float64))
    pose = _single(torch.tensor([0.1, -0.05, 0.5]).double(), torch.tensor([0.0, 0.6, -0.8]).double())
    stated = in_frame(pose, matrix, covariance)
    drawn = torch.randn(200_000, 6, dtype=torch.float64) * covariance.diagonal().sqrt()
    tips = stated.tip + torch.linalg.cross(drawn[:, :3], stated.tip.expand(len(drawn), 3)) + drawn[:, 3:]
    directions = stated.direction + torch.linalg.cross(drawn[:, :3], stated.direction.expand(len(drawn), 3))
    found = torch.cov(torch.cat([tips, directions], 1).mT)
    torch.testing.assert_close(found, stated.covariance, rtol=0.05, atol=2e-8)
