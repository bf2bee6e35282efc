"""What troubles a tracker most, on frames of full size: movement, defocus, and cloth of a band's colour behind it."""

from functools import cache

import pytest
from torch import Tensor

from holotorch.experiments.tracking_benchmark.methods import as_camera, before
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.trials import conditions
from holotorch.tracking.simulation.world import Case, World

WORLD = World()
TRACKER = CatheterTracker(WORLD.camera, WORLD.catheter)
CASES = {case.name: case for case in conditions(WORLD)}
HARD = ["plain", "motion along 20 px", "motion across 10 px", "defocus 3 px"]
CLOTHS = [f"cloth as band {i}" for i in (1, 2, 3)]
# The pose 1/30 s earlier: where it is, and 4 mm and 0.6 degrees off to either side.
EARLIER = {
    "the same": ((0.0, 0.0, 0.0), 0.0),
    "here": ((2e-3, -1.5e-3, 3e-3), 0.01),
    "there": ((-2e-3, 1.5e-3, -3e-3), -0.01),
}


@cache
def seen(name: str) -> tuple[Case, Tensor]:
    """A case and its frame [1, 3, H, W], as a camera's memory holds it."""
    case = CASES[name]
    return case, as_camera(case.frame())[None]


def right(pose: Pose, case: Case) -> None:
    """Answered, and the tip within 3 stated deviations (of all three axes; they are passed once in 1000) and 2 mm."""
    assert pose.answered, (case.name, pose.reason)
    assert case.tip is not None
    away = float((pose.tip - case.tip).norm())
    assert away < min(3 * float(pose.tip_sd), 2e-3), (case.name, away, float(pose.tip_sd))


@pytest.mark.parametrize("name", HARD + CLOTHS)
def test_it_is_found_everywhere(name):
    case, frame = seen(name)
    right(TRACKER(frame)[0], case)


@pytest.mark.parametrize("earlier", EARLIER)
@pytest.mark.parametrize("name", HARD + CLOTHS)
def test_it_is_found_near_where_it_was(name, earlier):
    case, frame = seen(name)
    right(TRACKER(frame, [before(case, *EARLIER[earlier])])[0], case)
    assert TRACKER.times["colour"] == 0


@pytest.mark.parametrize("name", HARD)
def test_where_nothing_but_movement_and_lens_blur_it_all_edges_are_checked(name):
    case, frame = seen(name)
    for pose in (TRACKER(frame)[0], TRACKER(frame, [before(case)])[0]):
        assert pose.status is Status.OK and float(pose.freedom) == 1, (pose.status, pose.reason)


@pytest.mark.parametrize("name", HARD[1:])
def test_what_is_blurred_is_said_to_be_less_sure(name):
    """Fewer pixels see an edge or a side of it clearly; a movement across leaves the edges a fifth of their light."""
    plain, blurred = (TRACKER(seen(which)[1])[0] for which in ("plain", name))
    assert float(blurred.tip_sd) > 1.1 * float(plain.tip_sd)


@pytest.mark.parametrize("name", [name for name in CASES if "out of frame" in name])
@pytest.mark.parametrize("earlier", [None, *EARLIER])
def test_three_edges_in_the_frame_tell_a_pose_though_the_fourth_lies_beyond_it(name, earlier):
    """Nothing checks it; that from the bands far from the tip has 2 mm, which is refused by default. Two tell none."""
    case, frames = seen(name)
    bold = CatheterTracker(WORLD.camera, WORLD.catheter, most_sd=5e-3)
    pose = bold(frames, None if earlier is None else [before(case, *EARLIER[earlier])])[0]
    if case.answerable:
        assert pose.status is Status.UNVERIFIED
        assert case.tip is not None and (pose.tip - case.tip).norm() < 3 * pose.tip_sd
    else:
        assert pose.status in (Status.OUT_OF_FRAME, Status.BANDS_MISSING)
