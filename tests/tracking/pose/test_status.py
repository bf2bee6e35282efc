from dataclasses import replace

import pytest
import torch

from holotorch.tracking import Pose, Status


def poses(directions: torch.Tensor, tip=(0.1, -0.2, 0.5)) -> Pose:
    count = len(directions)
    covariance = torch.diag(torch.tensor([1.0, 4.0, 4.0, 0, 0, 0], dtype=torch.float64) * 1e-8).expand(count, 6, 6)
    zero = torch.zeros(count, dtype=torch.float64)
    where = torch.tensor(tip, dtype=torch.float64).expand(count, 3)
    return Pose(where, torch.nn.functional.normalize(directions, dim=-1), covariance, zero, zero, (Status.OK,) * count)


def test_every_status_says_whether_there_is_a_pose_and_where_it_was_decided():
    assert [status for status in Status if status.answered] == [Status.OK, Status.UNVERIFIED]
    stages = ("frame", "colour", "axis", "edges", "camera", "pose")
    assert {status.stage for status in Status} == set(stages)
    # The later the stage, the higher the number: of two refusals, the higher came further.
    order = [stages.index(status.stage) for status in Status if not status.answered]
    assert order == sorted(order)
    assert len({int(status) for status in Status}) == len(Status) == 12


def test_refusal():
    pose = Pose.refused(Status.TOO_NARROW, "2.1 pixels wide; from 3 on there is a pure colour")
    assert not pose.answered and pose.status is Status.TOO_NARROW and pose.reason.startswith("2.1")
    for value in (pose.tip, pose.direction, pose.covariance, pose.chi_square, pose.tip_sd, pose.camera_from_tool[:3]):
        assert value.isnan().all() and value.dtype == torch.float64
    assert pose.freedom == 0
    pose.tip.zero_()
    assert pose.direction.isnan().all()  # no memory shared
    for status in (Status.OK, Status.UNVERIFIED):
        with pytest.raises(ValueError, match=f"{status.name} is no refusal"):
            Pose.refused(status, "")


def test_frame_of_the_tool():
    near = 10.0 ** -torch.arange(1.0, 17, dtype=torch.float64)
    special = torch.eye(3, dtype=torch.float64)
    back = torch.stack([near, -2 * near, -torch.ones_like(near)], -1)  # all but opposite to z
    pose = poses(torch.cat([torch.randn(500, 3, dtype=torch.float64), special, -special, back]))
    matrix = pose.camera_from_tool
    turn = matrix[:, :3, :3]
    # A direction is a unit vector to rounding, and so are the other two columns.
    torch.testing.assert_close(turn.mT @ turn, torch.eye(3).double().expand_as(turn), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(len(turn)).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(turn[..., 2], pose.direction, rtol=0, atol=0)
    torch.testing.assert_close(matrix[:, :3, 3], pose.tip)
    assert torch.equal(matrix[:, 3], torch.tensor([0.0, 0, 0, 1]).double().expand(len(turn), 4))
    # The smallest turn is about an axis at right angles to z: trace = 1 + 2 cos, with cos = direction_z.
    trace = turn.diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close(trace, 1 + 2 * pose.direction[:, 2], rtol=0, atol=1e-14)
    direction = torch.cat([special, -special]).requires_grad_()
    assert torch.autograd.grad(poses(direction).camera_from_tool.sum(), direction)[0].isfinite().all()
    assert torch.equal(poses(special[2:]).camera_from_tool[0, :3, :3], special)


def test_points_deviations_and_members():
    pose = poses(torch.tensor([[0.0, 0, 1], [1, 0, 0]]).double())
    torch.testing.assert_close(pose.tip_sd, torch.full((2,), 3e-4, dtype=torch.float64))
    torch.testing.assert_close(pose.point(0.1)[1], torch.tensor([0.2, -0.2, 0.5]).double())
    torch.testing.assert_close(pose.point(torch.tensor([0.1, 0.2]))[0], torch.tensor([0.1, -0.2, 0.6]).double())
    assert float(pose.point(0.1)[0, 2]) == 0.6  # 0.1 in float64, not in float32
    elsewhere = replace(pose, tip=pose.tip.to("meta"), direction=pose.direction.to("meta"))
    assert elsewhere.point(0.1).device == elsewhere.point(torch.tensor([0.1, 0.2])).device == torch.device("meta")
    assert len(pose) == 2 and len(pose[0]) == 1 and pose[1].answered
    assert list(pose[0])[0].tip.tolist() == pose[0].tip.tolist() and len(list(pose[0])) == 1
    assert [float(one.direction[0]) for one in pose] == [0, 1]
    assert pose[1].tip.shape == (3,) and pose[1].covariance.shape == (6, 6) and pose[1].status is Status.OK
    assert pose[1].camera_from_tool.shape == (4, 4)
    with pytest.raises(ValueError, match=r"ask pose\[i\].answered"):
        _ = pose.answered
    with pytest.raises(IndexError, match="one pose, not a batch"):
        pose[0][0]
    with pytest.raises(IndexError):
        pose[2]
