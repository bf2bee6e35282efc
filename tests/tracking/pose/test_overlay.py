import math

import pytest
import torch

from holotorch.tracking import THESIS, Camera, Pose, Status, solve_pose
from holotorch.tracking.pose.overlay import ELLIPSE, ellipse_px, overlay

SIZE = (240, 320)
CAMERA = Camera(torch.tensor([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]]), torch.tensor([-0.1, 0.02, 1e-3, -1e-3, 0.0]))
DIRECTION = torch.nn.functional.normalize(torch.tensor([0.9, -0.3, -0.2], dtype=torch.float64), dim=0)
GREY = torch.full((3, *SIZE), 90, dtype=torch.uint8)


def seen_at(tip: list[float]) -> Pose:
    at = torch.tensor(tip, dtype=torch.float64)
    edges = CAMERA.project(at + THESIS.positions[:, None] * DIRECTION)
    pose = solve_pose(edges[None], THESIS.positions, CAMERA)[0]
    assert pose.answered
    return pose


def changed(frame: torch.Tensor) -> torch.Tensor:
    return (frame != GREY).any(0)


def below_text(mask: torch.Tensor) -> torch.Tensor:
    return mask[60:]


def test_what_is_drawn_lies_where_the_catheter_is():
    pose = seen_at([-0.08, 0.03, 0.5])
    drawn = overlay(GREY, pose, CAMERA, THESIS)
    assert drawn.shape == GREY.shape and drawn.dtype == torch.uint8 and bool((GREY == 90).all())
    marks = changed(drawn)
    for along in torch.linspace(0, 0.25, 26).tolist():  # the axis, from the tip on, which no band shows
        x, y = CAMERA.project(pose.point(along)).round().long().tolist()
        if 0 <= x < SIZE[1] and 60 <= y < SIZE[0]:
            assert marks[y, x]
    x, y = CAMERA.project(pose.tip).round().long().tolist()
    assert marks[y - 4, x] and marks[y + 4, x] and marks[y, x - 4]  # the cross
    for edge in THESIS.edges:
        x, y = CAMERA.project(pose.point(edge)).round().long().tolist()
        assert not 60 <= y < SIZE[0] or bool((drawn[:, y - 1 : y + 2, x - 1 : x + 2].float().mean((-2, -1)) > 90).all())
    away = marks.clone()
    rows, columns = torch.nonzero(below_text(away), as_tuple=True)
    points = torch.stack([columns, rows + 60], -1).double()
    line = CAMERA.project(pose.point(torch.linspace(-0.02, 0.35, 400)))
    line = line[line.isfinite().all(-1)]
    spot, covariance = ellipse_px(pose, CAMERA)
    reach = max(8.0, 2 + math.sqrt(ELLIPSE * float(torch.linalg.eigvalsh(covariance)[-1])))
    assert float(torch.cdist(points, torch.cat([line, spot[None]])).amin(-1).max()) <= reach


def test_the_ellipse_holds_95_percent_of_the_tips_that_the_covariance_means():
    pose = seen_at([-0.02, 0.03, 0.6])
    root = torch.linalg.cholesky(pose.covariance[:3, :3])
    tips = pose.tip + torch.randn(20000, 3, dtype=torch.float64) @ root.T
    spot, covariance = ellipse_px(pose, CAMERA)
    offset = CAMERA.project(tips) - spot
    inside = (offset @ torch.linalg.inv(covariance) * offset).sum(-1) <= ELLIPSE
    # Standard error of the share 0.0015; the projection's bend over a few mm adds less.
    assert float(inside.double().mean()) == pytest.approx(0.95, abs=0.007)


def test_a_refusal_shows_words_and_no_catheter():
    pose = Pose.refused(Status.OUT_OF_FRAME, "edge 4 lies 3 px from the border of the image, so it is no edge – move")
    marks = changed(overlay(GREY, pose, CAMERA, THESIS))
    assert bool(marks[:60].any()) and not bool(marks[150:].any())
    other = overlay(GREY, Pose.refused(Status.OUT_OF_FRAME, ""), CAMERA, THESIS)
    assert int(changed(other).sum()) < int(marks.sum())  # the reason is written out


def test_a_tip_outside_the_image_or_the_camera_is_no_crash():
    for tip in ([-0.6, 0.03, 0.5], [5.0, 5.0, 0.5]):
        at = torch.tensor(tip, dtype=torch.float64)
        whole = torch.eye(6, dtype=torch.float64) * 1e-6
        one = torch.ones((), dtype=torch.float64)
        pose = Pose(at, DIRECTION, whole, one, one, Status.UNVERIFIED, "three edges")
        assert bool(changed(overlay(GREY, pose, CAMERA, THESIS)).any())


def test_frames_of_another_kind_are_refused():
    pose = Pose.refused(Status.BAD_FRAME, "")
    with pytest.raises(TypeError, match="pixels must be uint8, got torch.float32"):
        overlay(GREY.float(), pose, CAMERA, THESIS)
    with pytest.raises(ValueError, match=r"one frame of shape \[3, H, W\], got \[1, 3, 240, 320\]"):
        overlay(GREY[None], pose, CAMERA, THESIS)
    edges = CAMERA.project(seen_at([-0.08, 0.03, 0.5]).point(THESIS.positions))
    with pytest.raises(ValueError, match="each of a batch"):
        overlay(GREY, solve_pose(edges[None], THESIS.positions, CAMERA), CAMERA, THESIS)
