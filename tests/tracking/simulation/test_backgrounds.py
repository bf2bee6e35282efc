"""What lies behind the tube leaks into the outer rows of its image, where it must not cost the edges."""

import pytest
import torch

from holotorch.experiments.tracking_benchmark.methods import before
from holotorch.io.images import load_image
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.status import Status
from holotorch.tracking.simulation.trials import conditions
from holotorch.tracking.simulation.world import World


@pytest.fixture(scope="module")
def astronaut():
    """A world whose tube lies across a photograph: stripes of a flag, a face, a dark suit."""
    picture = (255 * load_image("astronaut")).round().to(torch.uint8)
    world = World(photographs=(picture,), seed=2)
    case = next(case for case in conditions(world) if case.name == "photograph 0")
    return world, case, case.frame()[None]


def test_all_edges_are_measured_over_a_photograph(astronaut):
    """An uneven background passed for an edge that is mixed with something else; the middle rows show it is none."""
    world, case, frame = astronaut
    pose = CatheterTracker(world.camera, world.catheter)(frame)[0]
    assert pose.status is Status.OK and float(pose.freedom) == 1
    assert float((pose.tip - case.tip).norm()) < 3 * float(pose.tip_sd) < 2e-3


def test_a_previous_pose_that_is_a_little_off_leaves_no_trace():
    """How far rings bulge is taken from it; what that was wrong by is set right, without a second look."""
    world = World()
    case = next(case for case in conditions(world) if case.name == "plain")
    tracker, frame = CatheterTracker(world.camera, world.catheter), case.frame()[None]
    exact = tracker(frame, [before(case, (0.0, 0.0, 0.0), 0.0)])[0]
    for moved, turned in (((2e-3, -1.5e-3, 3e-3), 0.01), ((-2e-3, 1.5e-3, -3e-3), -0.01)):
        pose = tracker(frame, [before(case, moved, turned)])[0]
        assert pose.answered and float((pose.tip - exact.tip).norm()) < 0.2 * float(exact.tip_sd)
