"""What the tracker is called with and what it leaves behind: poses before that are none, wrong types, memory, work."""

import gc
import math
import weakref
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor
from tracked import SIZE, TRACKER, WORLD, at, refused, right, scenes, truth

from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection import tracker as tracker_module
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.detection.coarse import Segment
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.refinement.photometric import PhotometricFit

SHORTER = replace(THESIS, edges=(0.070, 0.108, 0.127, 0.165))  # bands that no pose explains


def same(one: Pose, other: Pose) -> bool:
    """To the last bit, NaN as NaN."""
    pairs = ((getattr(one, name), getattr(other, name)) for name in ("tip", "direction", "covariance", "chi_square"))
    return one.status is other.status and all(torch.equal(a.nan_to_num(7), b.nan_to_num(7)) for a, b in pairs)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["tip", "direction"])
def test_a_pose_before_that_is_not_finite_is_as_none(field, bad):
    """In a batch too, where the frames around it keep the poses that they came with."""
    frames = torch.stack([scenes()[name][1] for name in ("roll 0", "plain", "far")])
    cold = TRACKER(frames)
    value = getattr(cold[1], field).clone()
    value[1] = bad
    before = [cold[0], replace(cold[1], **{field: value}), cold[2]]
    found = TRACKER(frames, before)
    assert same(found[1], cold[1])
    for i in (0, 2):
        warm = TRACKER(frames[i : i + 1], [cold[i]])[0]
        assert same(found[i], warm) and not same(warm, cold[i])


@pytest.mark.parametrize("name", ["forward", "one number", "beside the camera", "behind it", "at it", "far away"])
def test_a_pose_before_that_no_camera_sees_gets_a_refusal(name):
    frame, cold = scenes()["plain"][1], TRACKER(scenes()["plain"][1][None])[0]
    tips = {
        "forward": (0.0, 0.0, 0.5),
        "one number": (0.0, 0.0, 0.0),
        "beside the camera": (0.1, 0.1, 0.0),
        "behind it": (-0.1, 0.02, -0.5),
        "at it": (1e-200, 1e-200, 1e-200),
        "far away": (1e200, 1e200, 1e200),
    }
    wrong = replace(cold, tip=torch.tensor(tips[name], dtype=torch.float64))
    if name == "forward":
        wrong = replace(wrong, direction=torch.tensor([0.0, 0, 1], dtype=torch.float64))
    refused(TRACKER(frame[None], [wrong])[0], Status.NO_AXIS, Status.BANDS_MISSING, Status.OUTSIDE_CAMERA)


def test_previous_poses_are_poses():
    _, frame = scenes()["plain"]
    for wrong in (["x"], [None], "x"):
        with pytest.raises(TypeError, match="previous must hold a Pose for each frame"):
            TRACKER(frame[None], wrong)  # type: ignore[arg-type]


def test_a_batch_of_previous_poses_is_its_poses():
    frames = torch.stack([scenes()[name][1] for name in ("plain", "after")])
    single = TRACKER(frames)
    fields = ("tip", "direction", "covariance", "chi_square", "freedom")
    stacked = (torch.stack([getattr(pose, name) for pose in single]) for name in fields)
    batch = Pose(*stacked, status=tuple(pose.status for pose in single))  # type: ignore[arg-type]
    for one, other in zip(TRACKER(frames, batch), TRACKER(frames, single), strict=True):
        assert torch.equal(one.tip, other.tip) and one.answered


def test_floating_frames_are_levels():
    """As kornia has them: 0 to 1. A gradient would be cut off by the rounding, so it is refused by name."""
    _, frame = scenes()["plain"]
    assert isinstance(TRACKER, torch.nn.Module)
    light = frame[None].float() / 255
    assert torch.equal(TRACKER(light)[0].tip, TRACKER(frame[None])[0].tip)
    with pytest.raises(TypeError, match="require a gradient .* PhotometricFit"):
        TRACKER(light.requires_grad_())
    with pytest.raises(ValueError, match="from 0 to 1, got 38 to 229"):
        TRACKER(frame[None].float())


@pytest.mark.parametrize(
    "frames", [np.zeros((1, 3, 64, 64), np.uint8), [torch.zeros(3, 64, 64, dtype=torch.uint8)], None], ids=type
)
def test_what_is_no_tensor_is_said_to_be_none(frames):
    name = type(frames).__name__
    with pytest.raises(TypeError, match=rf"torch tensor of shape \[B, 3, H, W\], got {name}"):
        TRACKER(frames)


@pytest.fixture
def samplers(monkeypatch):
    """References to all samplers that a tracker makes; it alone holds them."""
    made: list[weakref.ref[Sampler]] = []

    def kept(*given) -> Sampler:
        sampler = Sampler(*given)
        made.append(weakref.ref(sampler))
        return sampler

    monkeypatch.setattr(tracker_module, "Sampler", kept)
    return made


def looked_at() -> dict[str, tuple[Tensor, list[Pose] | None]]:
    frame, zeros = scenes()["plain"][1], torch.zeros(3, *SIZE, dtype=torch.uint8)
    cold = TRACKER(frame[None])
    shorter = WORLD.case("shorter", at(), shown=SHORTER).frame()
    return {"answered": (frame, None), "nothing": (zeros, None), "shorter": (shorter, None), "lost": (zeros, cold)}


@pytest.mark.parametrize("kind", ["answered", "nothing", "shorter", "lost"])
def test_no_frame_outlives_its_call(samplers, kind):
    """A refusal that is kept holds the calls it came through, and they the frame: 25 MB of each, until gc runs."""
    frame, before = looked_at()[kind]
    samplers.clear()
    gc.collect()
    gc.disable()
    try:
        pose = TRACKER(frame[None], before)[0]
        assert pose.answered == (kind == "answered")
        assert len(samplers) == 1 and samplers[0]() is None
    finally:
        gc.enable()


def segment_of(pose: tuple[Tensor, Tensor]) -> Segment:
    """Where the coloured part of a catheter at a pose begins and ends."""
    ends = WORLD.camera.project(pose[0] + THESIS.positions[[0, -1], None] * pose[1]).tolist()
    return Segment(complex(*ends[0]), complex(*ends[1]))


EMPTY = [Segment(60 + 60j, 300 + 80j), Segment(700 + 480j, 900 + 500j)]


def test_lines_without_bands_do_not_use_up_those_that_are_measured(monkeypatch):
    case, frame = scenes()["plain"]
    there = segment_of(truth(case))
    monkeypatch.setattr(tracker_module, "find_segments", lambda *_, **__: [*EMPTY, there])
    right(TRACKER(frame[None])[0], case)
    monkeypatch.setattr(tracker_module, "find_segments", lambda *_, **__: EMPTY)
    refused(TRACKER(frame[None])[0], Status.NO_AXIS, Status.BANDS_MISSING)


def test_the_work_for_a_frame_is_bounded(monkeypatch):
    """Of lines that show bands one is measured, and the refusal is its own."""
    frame = WORLD.case("shorter", at(), shown=SHORTER).frame()
    there, looked = segment_of(at()), []
    monkeypatch.setattr(tracker_module, "find_segments", lambda *_, **__: [there, EMPTY[0], there, there, there])
    monkeypatch.setattr(tracker_module, "halfway", lambda *given: looked.append(1) or given[-1])
    refused(TRACKER(frame[None])[0], Status.INCONSISTENT)
    assert len(looked) == 1
    monkeypatch.setattr(tracker_module, "find_segments", lambda *_, **__: [there, *EMPTY])
    refused(TRACKER(frame[None])[0], Status.INCONSISTENT)


@pytest.mark.parametrize(("factor", "status"), [(1.0, Status.OK), (8.0, Status.INCONSISTENT)])
def test_a_refinement_far_from_the_pose_of_the_edges_is_refused(factor, status):
    """It starts from this pose, and may converge to another one where the background is like an edge."""
    pose = TRACKER(scenes()["plain"][1][None])[0]
    deviation = (2 * pose.covariance[:3, :3].diagonal()).sqrt()
    other = replace(pose, tip=pose.tip + factor * deviation * torch.tensor([0.0, 0.0, 1.0]))
    fit = cast(PhotometricFit, lambda *_: SimpleNamespace(poses=lambda: [other]))
    tracker = CatheterTracker(WORLD.camera, THESIS, channels=ChannelOrder.RGB)
    tracker.refinement = fit
    fitted = tracker(scenes()["plain"][1][None])[0]
    assert fitted.status is status
    assert fitted.answered or "the fit to the pixels moves the tip by" in fitted.reason


def test_a_refinement_fits_all_poses_of_a_batch_at_once():
    """Refusals stay as they are, a batch is its frames, and the fit's own shift is within what both state."""
    tracker = CatheterTracker(
        WORLD.camera, THESIS, channels=ChannelOrder.RGB, refinement=PhotometricFit(WORLD.camera, THESIS)
    )
    names = ("plain", "roll 135")
    frames = torch.stack([*(scenes()[name][1] for name in names), WORLD.desk()])
    poses, rough = tracker(frames), TRACKER(frames)
    assert tracker.times["refinement"] > 0
    for name, pose, before, frame in zip(names, poses, rough, frames, strict=False):
        right(pose, scenes()[name][0])
        assert pose.status is Status.OK and float(pose.freedom) == 1
        assert 0 < float((pose.tip - before.tip).norm()) < 3 * (float(pose.tip_sd) + float(before.tip_sd))
        torch.testing.assert_close(
            tracker(frame[None])[0].tip, pose.tip, rtol=0, atol=1e-7
        )  # a fit ends before its last step is nil
    assert poses[-1].status is rough[-1].status is Status.NO_CATHETER
