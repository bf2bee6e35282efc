"""Camera to headset: noise of a hand, sets that determine nothing, frames of the other hand."""

import math

import pytest
import torch

from holotorch.tracking.pose.alignment import headset_from_camera, tool_points


def rotation(generator):
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    return turn * turn.det()


def truth(seed=0):
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation(generator)
    matrix[:3, 3] = torch.tensor([0.03, -0.08, 0.05])
    return matrix


def poses(count, seed=1, spread=1.0):
    """Tips in a working volume of 200 mm half a metre away, directions around -z + y."""
    generator = torch.Generator().manual_seed(seed)
    tips = (torch.rand(count, 3, dtype=torch.float64, generator=generator) - 0.5) * 0.2
    tips[:, 2] += 0.5
    directions = torch.randn(count, 3, dtype=torch.float64, generator=generator) * spread
    return tool_points(tips, directions + torch.tensor([0.0, 0.6, -0.6]))


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
    with pytest.raises(ValueError, match="parallel to within 0.0 degrees.*different directions"):
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
