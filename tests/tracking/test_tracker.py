"""The tracker on synthetic frames: what is answered is right within what is stated, what cannot be told is refused."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import THESIS, Catheter
from holotorch.tracking.render import Look, Occluder
from holotorch.tracking.status import Pose, Status
from holotorch.tracking.tracker import CatheterTracker
from holotorch.tracking.world import Case, World, synthetic_camera

SIZE = (540, 960)
WORLD = World(SIZE)
TRACKER = CatheterTracker(WORLD.camera, THESIS)
NEAR = 0.27  # metres: as wide as at 0.54 m on 1080 lines
RED, GREEN, BLUE = THESIS.colours
SIX = Catheter((0.050, 0.062, 0.080, 0.090, 0.108, 0.120, 0.135), (RED, GREEN, BLUE) * 2, 1.5e-3, 0.3)
STRONG = Camera(
    torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.35, 0.15, 2e-3, -1e-3, -0.02])
)


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


@pytest.mark.parametrize("name", ["roll 0", "roll 90", "roll 135", "roll 205", "roll 300", "near", "far", "slanted"])
def test_poses_are_right_within_what_is_stated(name):
    case, frame = scenes()[name]
    pose = TRACKER(frame[None])[0]
    right(pose, case)
    assert pose.status is Status.OK and pose.reason == "" and float(pose.freedom) == 1


def test_farther_is_less_sure_and_depth_least():
    near, far = (TRACKER(scenes()[name][1][None])[0] for name in ("near", "far"))
    assert near.tip_sd < far.tip_sd
    sight = far.tip / far.tip.norm()
    deep = float(sight @ far.covariance[:3, :3] @ sight)
    assert deep > 0.5 * float(far.tip_sd) ** 2  # of three axes


def test_a_batch_is_its_frames_and_they_stay_as_they_were():
    frames = torch.stack([scenes()[name][1] for name in ("roll 0", "far")] + [torch.zeros(3, *SIZE, dtype=torch.uint8)])
    kept = frames.clone()
    together = TRACKER(frames)
    assert torch.equal(frames, kept)
    for pose, frame in zip(together, frames, strict=True):
        alone = TRACKER(frame[None])[0]
        assert alone.status is pose.status and alone.reason == pose.reason
        for field in ("tip", "direction", "covariance", "chi_square"):  # to the last bit
            torch.testing.assert_close(getattr(pose, field), getattr(alone, field), rtol=0, atol=0, equal_nan=True)
    assert TRACKER(frames[:0]) == []


def test_strided_frames_are_tracked_alike():
    _, frame = scenes()["plain"]
    last = frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)  # as a camera's or a picture's memory lies
    torch.testing.assert_close(TRACKER(last[None])[0].tip, TRACKER(frame[None])[0].tip, rtol=0, atol=0)


def test_the_times_of_each_stage_are_kept():
    tracker = CatheterTracker(WORLD.camera, THESIS)
    assert tracker.times == {}
    pose = tracker(scenes()["plain"][1][None])[0]
    assert list(tracker.times) == ["colour", "axis", "edges", "pose"]
    assert all(seconds > 0 for seconds in tracker.times.values())
    tracker(scenes()["plain"][1][None], [pose])
    assert tracker.times["colour"] == 0 and tracker.times["axis"] > 0  # a window only
    tracker(torch.zeros(1, 3, *SIZE, dtype=torch.uint8))
    assert tracker.times["colour"] > 0 and tracker.times["edges"] == 0


@pytest.mark.parametrize("name", ["roll 0", "roll 90", "roll 135", "roll 205", "far", "slanted"])
def test_with_the_pose_before_the_answer_is_the_same(name):
    """The same frame with its own pose: within a deviation; all that cold frames answer is answered."""
    case, frame = scenes()[name]
    cold = TRACKER(frame[None])[0]
    warm = TRACKER(frame[None], [cold])[0]
    right(warm, case)
    assert float((warm.tip - cold.tip).norm()) < 1.5 * float(cold.tip_sd)
    assert float(warm.tip_sd) == pytest.approx(float(cold.tip_sd), rel=0.3)


def test_the_catheter_may_move_between_frames():
    before, (case, frame) = TRACKER(scenes()["plain"][1][None])[0], scenes()["after"]
    start = WORLD.camera.project(before.point(0.127))
    tip, direction = truth(case)
    end = WORLD.camera.project(tip + 0.127 * direction)
    assert 5 < float((end - start).norm()) < 30
    tracker = CatheterTracker(WORLD.camera, THESIS)
    right(tracker(frame[None], [before])[0], case)
    assert tracker.times["colour"] == 0  # not looked for everywhere


@pytest.mark.parametrize("other", ["roll 90", "near", "roll 205"])
def test_a_pose_before_that_is_far_away_is_forgotten(other):
    """Found everywhere instead: the cold answer, or a window's that is as right."""
    case, frame = scenes()["plain"]
    wrong = TRACKER(scenes()[other][1][None])[0]
    moved = replace(wrong, tip=wrong.tip + torch.tensor([0.03, 0.03, 0.05], dtype=torch.float64))
    for before in (wrong, moved):
        right(TRACKER(frame[None], [before])[0], case)


def test_a_refusal_before_is_as_none():
    case, frame = scenes()["plain"]
    cold = TRACKER(frame[None])[0]
    after = TRACKER(frame[None], [Pose.refused(Status.NO_CATHETER, "nothing")])[0]
    torch.testing.assert_close(after.tip, cold.tip, rtol=0, atol=0)
    refused(TRACKER(torch.zeros(1, 3, *SIZE, dtype=torch.uint8), [cold])[0], Status.NO_CATHETER)


def test_frames_without_a_catheter_are_refused():
    zeros = torch.zeros(3, *SIZE, dtype=torch.uint8)
    rng = torch.Generator().manual_seed(11)
    noise = torch.randint(0, 256, zeros.shape, dtype=torch.uint8, generator=rng)
    stripe = zeros + 90
    stripe[:, 260:266, 200:700] = torch.tensor(RED, dtype=torch.uint8)[:, None, None]
    for pose in TRACKER(torch.stack([zeros, zeros + 128, zeros + 255, stripe, WORLD.desk()])):
        refused(pose, Status.NO_CATHETER)
    refused(TRACKER(noise[None])[0], Status.NO_CATHETER, Status.NO_AXIS, Status.BANDS_MISSING, Status.TOO_NARROW)


@pytest.mark.parametrize("shape", [(31, 200), (200, 31), (1, 1), (8, 8)])
def test_tiny_frames_are_refused(shape):
    refused(TRACKER(torch.zeros(1, 3, *shape, dtype=torch.uint8))[0], Status.BAD_FRAME)


@pytest.mark.parametrize("shape", [(3, 64, 64), (1, 1, 64, 64), (1, 64, 64, 3)], ids=str)
def test_what_is_no_frame_is_an_error(shape):
    frames = [torch.zeros(1, 3, 64, 64, dtype=dtype) for dtype in (torch.float32, torch.int16)]
    for wrong in (torch.zeros(shape, dtype=torch.uint8), *frames):
        with pytest.raises(ValueError, match=r"uint8 of shape \[B, 3, H, W\], got"):
            TRACKER(wrong)


def test_as_many_poses_as_frames():
    pose = Pose.refused(Status.NO_CATHETER, "nothing")
    frames = torch.zeros(2, 3, 64, 64, dtype=torch.uint8)
    with pytest.raises(ValueError, match="2 frames take 2 previous poses, got 1"):
        TRACKER(frames, [pose])
    for bad in (0.0, -1e-3, math.nan):
        with pytest.raises(ValueError, match="most_sd"):
            CatheterTracker(WORLD.camera, THESIS, most_sd=bad)


def test_poses_less_sure_than_is_wanted_are_refused():
    _, frame = scenes()["far"]
    strict = CatheterTracker(WORLD.camera, THESIS, most_sd=0.2 * float(TRACKER(frame[None])[0].tip_sd))
    refused(strict(frame[None])[0], Status.UNCERTAIN)


def hidden(span: tuple[float, float], name: str) -> Case:
    """A flat thing with straight sides across the tube, over ``span`` in metres from the tip."""
    tip, direction = at()
    ends = WORLD.camera.project(tip + torch.tensor(span, dtype=torch.float64)[:, None] * direction)
    along = ends[1] - ends[0]
    across = 60 * torch.stack([-along[1], along[0]]) / along.norm()
    corners = [ends[0] + across, ends[1] + across, ends[1] - across, ends[0] - across]
    occluder = Occluder(tuple((float(x), float(y)) for x, y in corners), (224, 172, 140))
    return WORLD.case(name, (tip, direction), occluders=(occluder,))


@pytest.mark.parametrize(
    ("span", "edges"),
    [((0.122, 0.132), 4), ((0.139, 0.153), 3), ((0.060, 0.074), 3), ((0.176, 0.200), 3)],
    ids=["within a band", "inner edge", "first edge", "last edge"],
)
def test_what_is_partly_hidden_is_right_or_refused(span, edges):
    case = hidden(span, f"hidden {span}")
    pose = TRACKER(case.frame()[None])[0]
    if edges == 4 or pose.answered:  # three edges: right, and said to be unchecked
        right(pose, case)
        assert pose.status is (Status.OK if edges == 4 else Status.UNVERIFIED) and float(pose.freedom) == edges - 3
    else:
        refused(pose, Status.EDGES_UNCLEAR, Status.BANDS_MISSING, Status.INCONSISTENT)


def test_one_band_is_refused():
    pose = TRACKER(hidden((0.105, 0.230), "one band").frame()[None])[0]
    refused(pose, Status.BANDS_MISSING, Status.NO_CATHETER)


@pytest.mark.parametrize("shift", [0.42, 0.55])
def test_half_out_of_the_frame_it_is_right_or_refused(shift):
    case = WORLD.case(f"out {shift}", at(place=(shift, 0.05), roll=0))
    pose = TRACKER(case.frame()[None])[0]
    if pose.answered:
        right(pose, case)
    else:
        refused(pose, Status.OUT_OF_FRAME, Status.BANDS_MISSING, Status.NO_CATHETER)


LOOK_ALIKES = {
    "wrong order": replace(THESIS, colours=(GREEN, RED, BLUE)),
    "longer middle": replace(THESIS, edges=(0.070, 0.108, 0.172, 0.210)),
    "shorter middle": replace(THESIS, edges=(0.070, 0.108, 0.127, 0.165)),
    "thick": replace(THESIS, radius=3.5e-3),
    "other colours": replace(THESIS, colours=((220, 210, 40), (200, 50, 190), (60, 190, 190))),
}


@pytest.mark.parametrize("kind", LOOK_ALIKES)
def test_look_alikes_are_refused(kind):
    case = WORLD.case(kind, at(0.3), shown=LOOK_ALIKES[kind])
    expected = {
        "wrong order": (Status.BANDS_MISSING, Status.NO_CATHETER),
        "thick": (Status.INCONSISTENT, Status.NO_AXIS),
        "other colours": (Status.NO_CATHETER, Status.BANDS_MISSING),
    }
    refused(TRACKER(case.frame()[None])[0], *expected.get(kind, (Status.INCONSISTENT,)))


def test_sheets_in_a_row_are_refused():
    """Papers in the bands' colours and order: their lower side is one straight line, and so is an edge each."""
    frame = WORLD.desk().clone()
    wide = frame.clone()  # a strip far wider than the catheter would be
    for i, colour in enumerate(THESIS.colours):
        for sheet, rows in ((frame, slice(150, 270)), (wide, slice(240, 280))):
            sheet[:, rows, 250 + 150 * i : 400 + 150 * i] = torch.tensor(colour, dtype=torch.uint8)[:, None, None]
    assert not any(pose.answered for pose in TRACKER(torch.stack([frame, wide])))


OTHERS = {
    "six unequal bands": (World(SIZE, catheter=SIX), at(0.25, 15, world=World(SIZE, catheter=SIX))),
    "six, reversed": (World(SIZE, catheter=SIX), at(0.25, 15, 205, world=World(SIZE, catheter=SIX))),
    "linear tone": (World(SIZE, synthetic_camera(SIZE, "linear")), at()),
    "strong distortion": (World(SIZE, STRONG), at(0.28, 12, 30, (0.1, 0.12))),
    "noise and blur": (World(SIZE, look=Look(noise_dn=5.0, blur_px=1.5)), at(0.22)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_cameras_and_catheters(name):
    world, pose = OTHERS[name]
    case = world.case(name, pose)
    found = CatheterTracker(world.camera, world.catheter)(case.frame()[None])[0]
    right(found, case)
    assert float(found.freedom) == len(world.catheter.edges) - 3


def test_where_the_lens_turns_back_it_is_refused():
    """A frame that shows the bands where no ray of this camera goes."""
    _, frame = scenes()["roll 0"]
    far = torch.full_like(frame, 120)
    far[:, :120] = frame[:, 210:330]  # to the upper border, 0.7 of the focal length and more from the middle
    # The distorted radius turns back at 0.41 of the focal length.
    lens = torch.tensor([-0.9, 0.0, 0, 0, 0])
    camera = Camera(torch.tensor([[300.0, 0, 480], [0, 300, 270], [0, 0, 1]]), lens)
    pose = CatheterTracker(camera, THESIS)(far[None])[0]
    refused(pose, Status.OUTSIDE_CAMERA, Status.OUT_OF_FRAME)
