"""Frames without the catheter get no pose, whatever they show; `holotorch chart tracking` asks a thousand."""

import math

import pytest

from holotorch.tracking.detection import tracker
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.simulation.trials import negatives, occlusions
from holotorch.tracking.simulation.world import World

TRACKER = CatheterTracker(World().camera, THESIS)


def test_nothing_is_found_where_nothing_is():
    world = World((540, 960), seed=5)
    tracker = CatheterTracker(world.camera, THESIS)
    for case in negatives(world, 30):
        pose = tracker(case.frame()[None])[0]
        assert not pose.answered and pose.reason, case.name
        assert math.isnan(float(pose.tip[0]))


@pytest.mark.parametrize("number", [205, 415])
def test_sketches_behind_the_camera_are_refused(number):
    """Clutter whose edges a first, rough pose explains only with a width that is no width."""
    case = negatives(World(), number + 1)[number]
    assert not TRACKER(case.frame()[None])[0].answered


def test_a_thick_stick_seen_in_one_part_of_it_is_refused():
    """Between its border and a shadow along it the strip is as wide as the catheter; the bands go on in the shadow."""
    case = negatives(World(), 569)[568]
    assert not TRACKER(case.frame()[None])[0].answered


def test_fingers_are_no_obstacle_and_no_lie():
    """One pose, every occlusion: where three edges are left the tip is right, and where not there is no pose."""
    for case in occlusions(World(seed=3)):
        pose = TRACKER(case.frame()[None])[0]
        assert pose.answered or not case.answerable, (case.name, pose.reason)
        if pose.answered:
            assert case.tip is not None
            assert float((pose.tip - case.tip).norm()) < min(5e-3, 5 * float(pose.tip_sd)), case.name


def test_clutter_without_a_tube_costs_no_measurement_of_its_width(monkeypatch):
    """What such a line looked like at another width would be refused all the same, ten calls later."""

    def looked(*_):
        raise AssertionError("the width was measured")

    monkeypatch.setattr(tracker, "measure_width", looked)
    frame = negatives(World(seed=1), 6)[5].frame()
    assert not TRACKER(frame[None])[0].answered
    with pytest.raises(AssertionError, match="measured"):  # as it is wherever a tube is seen
        TRACKER(World().still(0.5, 0.3, 1)[0].frame()[None])
