"""Pose from places on a line against the general solver, which knows of no line, and against what made the places."""

import math

import pytest
import torch
from torch import Tensor

from holotorch.tracking import THESIS, Camera, Status, solve_pose
from holotorch.tracking.resection import pose_on_line
from holotorch.tracking.strips import Line

CAMERA = Camera(torch.tensor([[1400.0, 0, 959.5], [0, 1400, 539.5], [0, 0, 1]]), torch.zeros(5))
SIX = torch.tensor([0.05, 0.062, 0.08, 0.1, 0.12, 0.135], dtype=torch.float64)


def seen(depth: float, tilt: float, positions: Tensor, place=(0.02, -0.03)) -> tuple[Line, Tensor, Tensor, Tensor]:
    """Line through a tool's image, places of its points on it, tip and direction."""
    tip = torch.tensor([*place, depth], dtype=torch.float64)
    angles = math.radians(tilt), math.radians(35)
    flat = math.cos(angles[0])
    values = flat * math.cos(angles[1]), flat * math.sin(angles[1]), -math.sin(angles[0])
    direction = torch.tensor(values, dtype=torch.float64)
    points = tip + positions[:, None] * direction
    plane = points[:, :2] / points[:, 2:]
    line = Line.between(CAMERA, plane[[0, -1]])
    return line, line.place(plane)[0], tip, direction


@pytest.mark.parametrize("positions", [THESIS.positions, THESIS.positions[[0, 2, 3]], SIX], ids=["4", "3", "6"])
@pytest.mark.parametrize("tilt", [0.0, 20.0, -45.0, 80.0])
def test_what_made_the_places_is_found(positions, tilt):
    """Rounding of 1e-13 pixels, times what a pixel moves the tip by: below a metre in all of these."""
    line, t, tip, direction = seen(0.52, tilt, positions)
    pose = pose_on_line(line, t, positions, torch.full_like(t, 0.1), 0.1, 1e-4)
    assert pose.status is (Status.OK if len(t) > 3 else Status.UNVERIFIED) and float(pose.freedom) == len(t) - 3
    torch.testing.assert_close(pose.tip, tip, rtol=0, atol=1e-11)
    torch.testing.assert_close(pose.direction, direction, rtol=0, atol=1e-11)


@pytest.mark.parametrize("tilt", [0.0, 20.0, -45.0])
@pytest.mark.parametrize("positions", [THESIS.positions, SIX], ids=["4", "6"])
def test_the_general_solver_finds_the_same(positions, tilt):
    """With deviations across that amount to the line's; it stops within 1e-9 deviations of the optimum.

    Its spread along the line is that of the places its pose gives, 0.1 px of some 300 from those that were seen.
    """
    line, t, *_ = seen(0.6, tilt, positions)
    generator = torch.Generator().manual_seed(3)
    t = t + 0.1 * torch.randn(t.shape, generator=generator, dtype=t.dtype)
    deviation = 0.05 + 0.1 * torch.rand(t.shape, generator=generator, dtype=t.dtype)
    across = 0.07
    spread = float((t - t.mean()).square().sum())
    pose = pose_on_line(line, t, positions, deviation, across / math.sqrt(len(t)), across / math.sqrt(spread))
    pixels = CAMERA.distort(line.plane(t, torch.zeros_like(t)))
    general = solve_pose(pixels[None], positions, CAMERA, along_px=deviation[None], across_px=across)[0]
    sd = general.covariance.diagonal().sqrt()
    assert ((pose.tip - general.tip).abs() < 1e-6 * sd[:3]).all()
    assert ((pose.direction - general.direction).abs() < 1e-6 * sd[3:]).all()
    scale = torch.outer(sd, sd)
    torch.testing.assert_close(pose.covariance / scale, general.covariance / scale, rtol=0, atol=1e-4)
    torch.testing.assert_close(pose.chi_square, general.chi_square, rtol=1e-6, atol=0)


def test_the_stated_scatter_is_that_of_the_tip():
    """Of 300 poses the scatter is known to 4 %; four times that."""
    line, t, tip, _ = seen(0.5, 20, THESIS.positions)
    generator = torch.Generator().manual_seed(5)
    found, stated = [], 0.0
    for _ in range(300):
        noise = torch.randn(6, generator=generator, dtype=t.dtype)
        moved = line.moved(0.1 * noise[4], 2e-4 * noise[5], float(t.mean()))
        pose = pose_on_line(moved, t - t.mean() + 0.1 * noise[:4], THESIS.positions, torch.full_like(t, 0.1), 0.1, 2e-4)
        found.append(pose.tip - tip)
        stated = float(pose.tip_sd)
    scatter = float(torch.stack(found).square().sum(-1).mean().sqrt())
    assert scatter == pytest.approx(stated, rel=4 * 0.041)


def test_what_no_pose_explains_is_refused():
    line, t, *_ = seen(0.5, 20, THESIS.positions)
    for wrong in (torch.zeros_like(t), t * torch.nan, torch.tensor([0.0, 300.0, -200.0, -100.0], dtype=t.dtype)):
        pose = pose_on_line(line, wrong, THESIS.positions, torch.full_like(t, 0.1), 0.1, 1e-4)
        assert pose.status is Status.INCONSISTENT and pose.reason and pose.tip.isnan().all()
