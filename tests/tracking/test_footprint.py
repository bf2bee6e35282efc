"""What a pose makes of the tube on a line, against the outline of a cylinder by cones of tangent planes in numpy."""

import math

import numpy as np
import pytest
import torch

from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import THESIS
from holotorch.tracking.footprint import width_px
from holotorch.tracking.status import Pose, Status
from holotorch.tracking.strips import Line

CAMERA = Camera(torch.tensor([[1400.0, 0, 960], [0, 1400, 540], [0, 0, 1]]), torch.zeros(5))


def outline(tip, direction, radius):
    """Normals [2, 3] of the two planes through the camera that touch an infinite cylinder."""
    foot = tip - (tip @ direction) * direction
    far = np.linalg.norm(foot)
    toward = foot / far
    side = np.cross(direction, toward)
    sine = radius / far
    return [sign * math.sqrt(1 - sine**2) * side + sine * -toward for sign in (1, -1)]


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.0, 0.2), (0.0, 0.33), (0.4, -0.25)])
@pytest.mark.parametrize("direction", [(1.0, 0.1, -0.3), (0.4, 0.9, 0.2)])
def test_width_is_that_of_the_outline(place, direction):
    """Of an outline of a thin tube; what is left is of second order in radius over distance: 2e-6 here."""
    depth, direction = 0.5, np.array(direction) / np.linalg.norm(direction)
    tip = np.array([place[0] * depth, place[1] * depth, depth])
    positions = THESIS.positions.numpy()
    points = tip + positions[[0, -1], None] * direction
    line = Line.between(CAMERA, torch.from_numpy(points[:, :2] / points[:, 2:]))
    zero = torch.zeros((), dtype=torch.float64)
    pose = Pose(torch.from_numpy(tip), torch.from_numpy(direction), torch.eye(6), zero, zero, Status.OK)
    near, taper = width_px(pose, THESIS, line)
    for t in (-100.0, 0.0, 100.0):
        # Where the line across at t meets the images of the two planes, n . (x, y, 1) = 0.
        start = line.plane(torch.tensor(t), torch.tensor(0.0)).numpy()
        across = line.across.numpy()
        u = [-(n[:2] @ start + n[2]) / (n[:2] @ across) for n in outline(tip, direction, THESIS.radius)]
        assert near + taper * t == pytest.approx(1400 * abs(u[0] - u[1]), rel=1e-5)
