"""The tracker with things that are not the catheter, and with other catheters and cameras."""

from dataclasses import replace

import pytest
import torch
from tracked import SIZE, TRACKER, WORLD, at, refused, right, scenes

from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import THESIS, Catheter
from holotorch.tracking.render import Look
from holotorch.tracking.status import Status
from holotorch.tracking.tracker import CatheterTracker
from holotorch.tracking.world import World, synthetic_camera

RED, GREEN, BLUE = THESIS.colours
SIX = Catheter((0.050, 0.062, 0.080, 0.090, 0.108, 0.120, 0.135), (RED, GREEN, BLUE) * 2, 1.5e-3, 0.3)
STRONG = Camera(
    torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.35, 0.15, 2e-3, -1e-3, -0.02])
)

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
