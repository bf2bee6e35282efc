"""Frames in another order of channels: which catheters cannot tell, who says so, and what the tracker makes of them."""

import itertools
import math
import warnings
from dataclasses import replace

import cv2
import pytest
import torch
from paths import CONFIGS
from tracked import TRACKER, WORLD, at, refused, right, scenes, truth

from holotorch.experiments.tracking.devices import build_catheter, load_catheter
from holotorch.tracking import THESIS, CatheterTracker, ChannelOrder, Pose, Status, ThesisTracker, ambiguities
from holotorch.tracking.detection.channels import ChannelOrderWarning, ambiguity_text

CONFIG = CONFIGS / "tracking" / "catheter_distinct.yaml"
DISTINCT = build_catheter(load_catheter(CONFIG))
ORDERS = list(ChannelOrder)
OTHERS = ORDERS[1:]


def reordered(frames, order):
    """Frames in RGB as a camera of another order gives them."""
    return frames[..., ["RGB".index(name) for name in order.value], :, :]


def test_orders_are_undone():
    frames = torch.arange(2 * 3 * 4 * 5, dtype=torch.uint8).reshape(2, 3, 4, 5)
    assert len(ORDERS) == 6 and ChannelOrder.RGB.to_rgb(frames) is frames
    for order in ORDERS:
        assert torch.equal(order.to_rgb(reordered(frames, order)), frames)
    assert torch.equal(ChannelOrder.BGR.to_rgb(frames), frames.flip(1))


def test_the_thesis_s_catheter_is_its_own_mirror_image_in_bgr():
    """What the bands do not tell: a pose that is stated to a third of a millimetre, a quarter of a metre off."""
    assert ambiguities(WORLD.camera, THESIS) == (ChannelOrder.BGR,)
    case, frame = scenes()["plain"]
    for order in OTHERS:
        assert not TRACKER(reordered(frame, order)[None])[0].answered
    as_long = replace(THESIS, length=sum(THESIS.edges[:1] + THESIS.edges[-1:]))  # on both sides of the bands
    pose = CatheterTracker(WORLD.camera, as_long)(reordered(frame, ChannelOrder.BGR)[None])[0]
    assert pose.status is Status.OK and float((pose.tip - truth(case)[0]).norm()) > 0.2


def test_the_tube_beyond_the_bands_tells():
    """It is longer behind them, where it lies on the frame: a wrong pose is refused, and a right one is not."""
    for name in ("plain", "far", "roll 0", "roll 205", "slanted"):
        case, frame = scenes()[name]
        right(TRACKER(frame[None])[0], case)
        pose = TRACKER(reordered(frame, ChannelOrder.BGR)[None])[0]
        refused(pose, Status.INCONSISTENT)
        assert "exchanged red and blue channels" in pose.reason and "ChannelOrder" in pose.reason


def test_no_single_sign_of_the_tube_refuses_a_pose():
    """Something in line with the tip, or a hand around the rear: only both together say that the ends are exchanged."""
    case, frame = scenes()["plain"]
    tip, direction = truth(case)
    ahead, behind = (tip + torch.tensor(part)[:, None] * direction for part in ([-0.1, -0.002], [0.2, 0.37]))

    def covered(frame, points, wide, colour):
        (x0, y0), (x1, y1) = WORLD.camera.project(points).round().int().tolist()
        drawn = frame.movedim(0, -1).contiguous().numpy().copy()
        return torch.from_numpy(cv2.line(drawn, (x0, y0), (x1, y1), colour, wide)).movedim(-1, 0)

    wire, hand = covered(frame, ahead, 4, (235, 235, 235)), covered(frame, behind, 60, (205, 150, 125))
    right(TRACKER(wire[None])[0], case)
    right(TRACKER(hand[None])[0], case)
    refused(TRACKER(covered(wire, behind, 60, (205, 150, 125))[None])[0], Status.INCONSISTENT)


@pytest.mark.parametrize("make", [CatheterTracker, ThesisTracker])
def test_an_order_that_is_stated_is_undone(make):
    _, frame = scenes()["plain"]
    expected = make(WORLD.camera, THESIS, channels=ChannelOrder.RGB)(frame[None])[0]
    for order in OTHERS:
        pose = make(WORLD.camera, THESIS, channels=order)(reordered(frame, order)[None])[0]
        assert pose.status is Status.OK and torch.equal(pose.tip, expected.tip), order


def test_a_previous_pose_tells():
    """The bands' sequence is looked for in the direction that is known; that it lies the other way is no movement."""
    case, frame = scenes()["plain"]
    before = TRACKER(frame[None])
    right(TRACKER(frame[None], before)[0], case)
    pose = TRACKER(reordered(frame, ChannelOrder.BGR)[None], before)[0]
    refused(pose, Status.BANDS_MISSING)
    assert pose.reason.startswith("the bands lie along the previous line, in the other direction: bands not named")
    gone = TRACKER(WORLD.desk()[None], before)[0]  # and of a frame without them nothing of the kind is said
    assert not gone.answered and "direction" not in gone.reason


def test_a_catheter_whose_colours_tell_is_never_found_wrongly():
    assert ambiguities(WORLD.camera, DISTINCT) == ()
    tracker, world = CatheterTracker(WORLD.camera, DISTINCT), replace(WORLD, catheter=DISTINCT)
    for i, (depth, tilt, roll) in enumerate([(0.22, 5, 10), (0.27, 12, 25), (0.3, 30, 200), (0.35, -10, 95)]):
        case = world.case(f"distinct {i}", at(depth, tilt, roll))
        frame = case.frame()
        right(tracker(frame[None])[0], case)
        for order in OTHERS:
            pose = tracker(reordered(frame, order)[None])[0]
            refused(pose, Status.NO_CATHETER, Status.BANDS_MISSING, Status.TOO_NARROW)


def test_lengths_alone_do_not_tell():
    """Four edges fit a pose from either end; that the width contradicts it is luck, so the catheter is reported."""
    for edges in ((0.070, 0.090, 0.128, 0.184), (0.070, 0.100, 0.138, 0.184)):
        assert ambiguities(WORLD.camera, replace(THESIS, edges=edges)) == (ChannelOrder.BGR,)


def test_what_is_reported_covers_what_the_tracker_answers_wrongly():
    """Three of four hues in eight sequences: no wrong pose from an exchange that is not reported."""
    hues = {"red": (200, 40, 45), "green": (40, 150, 70), "blue": (40, 70, 190), "cyan": (40, 180, 190)}
    reported, empty = 0, 0
    for colours in list(itertools.permutations(hues.values(), 3))[::3]:
        catheter = replace(THESIS, colours=colours)
        found = ambiguities(WORLD.camera, catheter)
        reported, empty = reported + len(found), empty + (not found)
        case = replace(WORLD, catheter=catheter).case("any", at())
        frame, tracker = case.frame(), CatheterTracker(WORLD.camera, catheter, channels=ChannelOrder.RGB)
        for order in OTHERS:
            pose = tracker(reordered(frame, order)[None])[0]
            wrong = pose.answered and float((pose.tip - truth(case)[0]).norm()) > 5e-3
            assert wrong <= (order in found), (colours, order)
    assert reported > 0 and empty > 0


def test_a_mirrored_frame_is_a_possible_frame_of_any_straight_tube():
    """A limit that is stated: the camera's axis is in the middle, so the mirrored pose is as good."""
    world = replace(WORLD, catheter=DISTINCT)
    case = world.case("mirrored", at())
    pose = CatheterTracker(WORLD.camera, DISTINCT)(case.frame().flip(-1)[None])[0]
    mirrored = truth(case)[0] * torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    assert pose.status is Status.OK and float((pose.tip - mirrored).norm()) < 5e-3


def test_who_has_not_stated_the_order_is_warned_once():
    with pytest.warns(
        ChannelOrderWarning, match=r"order BGR show .* in another pose.*channels=ChannelOrder.RGB"
    ) as seen:
        tracker = CatheterTracker(WORLD.camera, THESIS)
    assert len(seen) == 1 and seen[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracker(scenes()["plain"][1][None])
        CatheterTracker(WORLD.camera, THESIS, channels=ChannelOrder.RGB)
        CatheterTracker(WORLD.camera, DISTINCT)
    assert ambiguity_text(()) == ""
    with pytest.raises(TypeError, match=r"channels must be a ChannelOrder, such as ChannelOrder.BGR, got 'bgr'"):
        CatheterTracker(WORLD.camera, THESIS, channels="bgr")  # type: ignore[arg-type]
    assert isinstance(tracker(scenes()["plain"][1][None])[0], Pose) and math.isfinite(tracker.most_sd)
