"""The tracker with things that are not the catheter, and with other catheters and cameras."""

import math
from dataclasses import replace

import pytest
import torch
from tracked import SIZE, TRACKER, WORLD, at, refused, right, scenes, truth

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.pose.status import Status
from holotorch.tracking.simulation.render import Look
from holotorch.tracking.simulation.varied import VariedWorld
from holotorch.tracking.simulation.world import World, synthetic_camera

RED, GREEN, BLUE = THESIS.colours
SIX = Catheter((0.050, 0.062, 0.080, 0.090, 0.108, 0.120, 0.135), (RED, GREEN, BLUE) * 2, 1.5e-3, 0.3)
STRONG = Camera(
    torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.35, 0.15, 2e-3, -1e-3, -0.02])
)

FULL = World()

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


@pytest.mark.parametrize("seed", [376, 644, 987])
def test_bands_in_another_order_of_which_one_is_not_seen_are_refused(seed):
    """Three edges at the right distances: one more is outside, and bare tube is where the missing band should be."""
    world = VariedWorld()
    trial = world.negative(seed, "wrong order")
    pose = CatheterTracker(trial.camera, world.catheter, channels=ChannelOrder.RGB)(trial.frame()[None])[0]
    refused(pose, Status.INCONSISTENT)
    assert "another colour" in pose.reason


@pytest.mark.parametrize("seed", [2, 4, 8, 15, 30])
def test_a_band_that_leaves_the_frame_keeps_its_colour(seed):
    world = VariedWorld()
    trial = world.trial(seed, "partial view")
    pose = CatheterTracker(trial.camera, world.catheter, channels=ChannelOrder.RGB)(trial.frame()[None])[0]
    assert pose.status is Status.UNVERIFIED, pose.reason
    assert float((pose.tip - torch.as_tensor(trial.tip)).norm()) < 5 * float(pose.tip_sd)


@pytest.mark.parametrize("roll", [25, 100])
@pytest.mark.parametrize("depth", [0.4, 0.52, 0.7])
@pytest.mark.parametrize("times", [1.5, 1.6, 1.8, 2.0])
def test_a_stick_half_as_thick_again_is_refused_for_it(times, depth, roll):
    """Bands in their order and lengths: the width alone tells, of 4 to 7 px at least 2 too many."""
    pose = FULL.pose(depth, 0.2, math.radians(roll))
    case = FULL.case(f"thick {times} {depth} {roll}", pose, shown=replace(THESIS, radius=times * THESIS.radius))
    found = CatheterTracker(FULL.camera, THESIS)(case.frame()[None])[0]
    refused(found, Status.INCONSISTENT)
    assert "wide" in found.reason or "thicker" in found.reason


def across(pose: tuple[torch.Tensor, torch.Tensor], path: float) -> tuple[float, float]:
    """A movement of ``path`` pixels at right angles to the bands' image."""
    ends = FULL.camera.project(pose[0] + THESIS.positions[[0, -1], None] * pose[1])
    x, y = ((ends[1] - ends[0]) / (ends[1] - ends[0]).norm()).tolist()
    return -path * y, path * x


BLURRED = {  # times as thick, depth, roll, defocus, movement across; what it is that tells
    "a movement that leaves the sides unclear": (1.6, 0.7, 100, 0.7, 5),
    "sides that are too unclear to show one": (2.0, 0.7, 25, 0.7, 5),
    "sides too sharp for so long a way": (1.5, 0.4, 25, 0.7, 10),
    "more than a tube so blurred may be off": (2.5, 0.4, 100, 2.0, 0),
}


@pytest.mark.parametrize("kind", BLURRED)
def test_a_thicker_stick_that_is_blurred_is_refused_while_its_width_can_be_told(kind):
    times, depth, roll, blur, path = BLURRED[kind]
    pose = FULL.pose(depth, 0.3, math.radians(roll))
    shown, moved = replace(THESIS, radius=times * THESIS.radius), across(pose, path)
    case = FULL.case(f"{kind}, thick", pose, shown=shown, blur_px=blur, motion_px=moved)
    found = CatheterTracker(FULL.camera, THESIS)(case.frame()[None])[0]
    refused(found, Status.INCONSISTENT, Status.EDGES_UNCLEAR)


@pytest.mark.parametrize(("depth", "roll", "blur"), [(0.52, 100, 3.0), (0.7, 25, 2.0)])
def test_blurred_by_more_than_its_width_the_catheter_is_still_itself(depth, roll, blur):
    """Width and blur are hard to tell apart then; their sum is not."""
    case = FULL.case(f"soft {depth} {roll}", FULL.pose(depth, 0.3, math.radians(roll)), blur_px=blur)
    pose = CatheterTracker(FULL.camera, THESIS)(case.frame()[None])[0]
    assert pose.answered, pose.reason
    assert float((pose.tip - truth(case)[0]).norm()) < 3 * float(pose.tip_sd)


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
