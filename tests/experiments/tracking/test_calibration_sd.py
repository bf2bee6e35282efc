"""What the deviations of a calibration mean at the tip."""

import pytest
import torch

from holotorch.experiments.tracking.devices import CameraSettings, EvidenceSettings, build_camera, calibration_sd
from holotorch.experiments.tracking.report import camera_line
from holotorch.tracking import THESIS, Pose, solve_pose

DEVIATIONS = {"fx": 1.5, "fy": 1.7, "cx": 2.0, "cy": 1.0, "k1": 0.01, "k2": 0.09}
EVIDENCE = EvidenceSettings(deviations=DEVIATIONS, rms_px=0.2, views={}, cells=1, radius=1, tilts=(0, 1), between=1)
CAMERA = CameraSettings(fx=1400, fy=1401, cx=640, cy=360, size=(720, 1280), calibration=EVIDENCE)


def pose() -> Pose:
    tip, direction = torch.tensor([[0.02, -0.03, 0.5], [-0.6, 0.5, 0.62]], dtype=torch.float64)
    return solve_pose(
        edges(build_camera(CAMERA), tip, direction / direction.norm()), THESIS.positions, build_camera(CAMERA)
    )[0]


def edges(camera, tip, direction):
    return camera.project(tip + THESIS.positions[:, None] * direction)[None]


def test_it_is_the_spread_of_the_tips_over_cameras_that_the_calibration_cannot_tell_apart():
    fitted = pose()
    observed, generator, tips = (
        edges(build_camera(CAMERA), fitted.tip, fitted.direction),
        torch.Generator().manual_seed(3),
        [],
    )
    for _ in range(400):
        shift = torch.randn(4, generator=generator).tolist()
        names = ("fx", "fy", "cx", "cy")
        other = {name: getattr(CAMERA, name) + DEVIATIONS[name] * x for name, x in zip(names, shift, strict=True)}
        tips.append(solve_pose(observed, THESIS.positions, build_camera(CAMERA.model_copy(update=other))).tip[0])
    spread = float(torch.stack(tips).var(0).sum().sqrt())
    added = calibration_sd(CAMERA, THESIS, fitted)
    assert added == pytest.approx(spread, rel=0.1) and 5e-4 < spread < 5e-3


def test_none_without_a_calibration_and_none_to_print():
    assert calibration_sd(CAMERA.model_copy(update={"calibration": None}), THESIS, pose()) is None
    known = {"tip_sd_mm": {"median": 0.43}}
    assert camera_line(known) == camera_line(known | {"calibration_sd_mm": None}) == []
    (line,) = camera_line(known | {"calibration_sd_mm": 1.3456})
    assert "about 1.3 mm" in line and "0.43 mm" in line
