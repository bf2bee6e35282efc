"""Frames that several tests of trackers look at, and what they ask of every answer and refusal."""

import math
from functools import cache

import pytest
import torch
from torch import Tensor

from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.world import Case, World

SIZE = (540, 960)
WORLD = World(SIZE)
TRACKER = CatheterTracker(WORLD.camera, THESIS)
NEAR = 0.27  # metres: as wide as at 0.54 m on 1080 lines


def at(depth=NEAR, tilt=12.0, roll=25.0, place=(0.0, 0.0), world=WORLD):
    return world.pose(depth, math.radians(tilt), math.radians(roll), place)


@cache
def scenes() -> dict[str, tuple[Case, Tensor]]:
    """Frames that several tests look at."""
    poses = {f"roll {roll}": at(roll=roll) for roll in (0, 90, 135, 205, 300)}
    poses |= {"near": at(0.19, 5, 10), "far": at(0.42, 20, 10), "slanted": at(0.26, 45, 25), "plain": at()}
    poses["after"] = at(NEAR + 0.004, 13, 27, (0.01, -0.005))
    cases = {name: WORLD.case(name, pose) for name, pose in poses.items()}
    return {name: (case, case.frame()) for name, case in cases.items()}


def truth(case: Case) -> tuple[Tensor, Tensor]:
    assert case.tip is not None and case.direction is not None
    return case.tip, case.direction


def right(pose: Pose, case: Case) -> None:
    """Within 4 stated deviations and half a millimetre, and a covariance that can be one."""
    assert pose.answered, (case.name, pose.reason)
    tip, direction = truth(case)
    away = float((pose.tip - tip).norm())
    assert away < min(5e-4, 4 * float(pose.tip_sd)), (case.name, away, float(pose.tip_sd))
    assert float(pose.direction @ direction) > math.cos(math.radians(1)), case.name
    assert float(pose.direction.norm()) == pytest.approx(1, abs=1e-12)
    sane(pose)


def sane(pose: Pose) -> None:
    """Symmetric, of rank 5: the direction's length does not vary."""
    covariance = pose.covariance
    torch.testing.assert_close(covariance, covariance.mT, rtol=1e-9, atol=0)
    values = torch.linalg.eigvalsh(covariance / torch.outer(scale := covariance.diagonal().sqrt(), scale))
    assert values[0].abs() < 1e-6 and values[1] > 0
    assert 1e-6 < float(pose.tip_sd) < 1.5e-3


def refused(pose: Pose, *expected: Status) -> None:
    assert not pose.answered and pose.reason
    assert pose.status in expected, (pose.status, pose.reason)
    assert pose.tip.isnan().all() and pose.covariance.isnan().all()
