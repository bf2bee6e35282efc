"""Simulated poses of a hand that follows a protocol, to try a measurement without a camera."""

import math

import torch

from holotorch.experiments.measure.config import MeasureSettings
from holotorch.experiments.measure.grid import Grid
from holotorch.tracking import Pose, Status

_RATE = 30.0  # frames per second
_NOISE = 0.1e-3  # metres: standard deviation of the tip along each axis
_REST, _MOVE = 30, 12  # frames at a point, and on the way to the next
_TILT = math.radians(50)  # of the grid's plane about the camera's x axis


def synthetic_poses(settings: MeasureSettings) -> list[tuple[float, Pose]]:
    """Capture times in seconds and poses of a simulated run: noise of 0.1 mm along each axis, and no bias.

    Raises:
        KeyError: There is no simulation of this protocol.
    """
    generator = torch.Generator().manual_seed(0)
    tips = torch.zeros(300, 3, dtype=torch.float64) if settings.protocol == "still" else _visits(settings)
    tips = tips + torch.tensor([0.02, -0.03, 0.45], dtype=torch.float64)
    tips = tips + _NOISE * torch.randn(tips.shape, generator=generator, dtype=torch.float64)
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    covariance = torch.eye(6, dtype=torch.float64)
    covariance[:3, :3] *= _NOISE**2
    one = torch.ones((), dtype=torch.float64)
    return [(i / _RATE, Pose(tip, direction, covariance, one, one, Status.OK)) for i, tip in enumerate(tips)]


def _visits(settings: MeasureSettings) -> torch.Tensor:
    """Tips [frames, 3] in metres of a hand that rests at each point of the grid, relative to its first point."""
    right, up = Grid.of(settings).points.unbind(-1)
    points = torch.stack([right, -up * math.cos(_TILT), up * math.sin(_TILT)], -1)
    share = torch.arange(1, _MOVE + 1, dtype=torch.float64)[:, None] / (_MOVE + 1)
    parts = []
    for start, end in zip(points, [*points[1:], points[-1]], strict=True):
        parts += [start.expand(_REST, 3), start + share * (end - start)]
    return torch.cat(parts)
