"""Trackers side by side on synthetic frames with exact truth: what each says of each frame, and how long it takes."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.tracking_benchmark.thesis_opencv import ThesisOpenCV
from holotorch.io.images import load_image
from holotorch.tracking.detection import stations
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.world import Case, World

BASE, COLD, PRIOR, FEWER = "thesis, OpenCV", "ours, cold", "ours, prior", "ours, fewer stations"
LITERAL = "thesis, OpenCV, maps anew"
STATIONS = 6  # of the one with fewer
WRONG = 5e-3  # metres from the truth
# Photographs for backgrounds: a folder beside the checkout, or else those that scikit-image brings.
PHOTOGRAPHS = Path(__file__).parents[3] / "shared" / "data" / "images"
_BUNDLED = ("astronaut", "coffee", "chelsea")

Method = Callable[[Tensor, Case], Pose]


class Answer(NamedTuple):
    """What one method said of one frame, and in how many seconds.

    Plain numbers: of thousands, tensors between the frames of a case would keep the memory of all of them.

    Attributes:
        name, answerable: The case's.
        truth: Of the tip in metres; None where the frame shows no catheter.
        tip: In metres; NaN where refused.
        covariance: Of the tip, three rows of three, in m^2.
    """

    method: str
    name: str
    answerable: bool
    truth: list[float] | None
    status: Status
    reason: str
    tip: list[float]
    covariance: list[list[float]]
    seconds: float

    @staticmethod
    def of(method: str, case: Case, pose: Pose, seconds: float) -> "Answer":
        """Of a pose that is one and no batch."""
        assert isinstance(pose.status, Status) and isinstance(pose.reason, str)
        truth, told = None if case.tip is None else case.tip.tolist(), (pose.status, pose.reason)
        tip, covariance = pose.tip.tolist(), pose.covariance[:3, :3].tolist()
        return Answer(method, case.name, case.answerable, truth, *told, tip, covariance, seconds)

    @property
    def answered(self) -> bool:
        """Not refused."""
        return self.status.answered

    @property
    def error(self) -> float:
        """Of the tip in metres; NaN where refused or without a catheter."""
        return math.nan if self.truth is None else math.dist(self.tip, self.truth)

    @property
    def right(self) -> bool:
        """Answered, a catheter there, and near enough."""
        return self.error <= WRONG

    @property
    def wrong(self) -> bool:
        """Answered, and too far away or with no catheter there."""
        return self.answered and not self.right


def photographs() -> tuple[Tensor, ...]:
    """Photographs uint8 [3, h, w] for the world's backgrounds."""
    found: list[Any] = sorted(path for path in PHOTOGRAPHS.glob("*") if path.suffix in (".png", ".jpg"))
    images = [load_image(source) for source in found or _BUNDLED]
    return tuple((255 * image).round().to(torch.uint8) for image in images if len(image) == 3)


def methods(world: World, names: Sequence[str] = (BASE, LITERAL, COLD, PRIOR, FEWER)) -> dict[str, Method]:
    """Trackers by name, each as a function of one frame [3, H, W] and its case (whose truth only the prior reads)."""
    camera, catheter = world.camera, world.catheter
    thesis, ours = ThesisOpenCV(camera, catheter), CatheterTracker(camera, catheter, channels=ChannelOrder.RGB)
    literal = ThesisOpenCV(camera, catheter, literal=True)
    expected = lru_cache(maxsize=16)(before)  # made once for a frame, so that its making is not the tracker's time

    def fewer(frame: Tensor, _: Case) -> Pose:
        # The tracker has no option for this: nothing but this comparison wants it.
        with mock.patch.object(stations, "_STATIONS", STATIONS):
            return ours(frame[None])[0]

    known: dict[str, Method] = {
        BASE: lambda frame, _: thesis(frame[None])[0],
        LITERAL: lambda frame, _: literal(frame[None])[0],
        COLD: lambda frame, _: ours(frame[None])[0],
        PRIOR: lambda frame, case: ours(frame[None], [expected(case)])[0],
        FEWER: fewer,
    }
    return {name: known[name] for name in names}


def before(case: Case, moved: tuple[float, float, float] = (2e-3, -1.5e-3, 3e-3), turned: float = 0.01) -> Pose:
    """The pose that a tracker may have found 1/30 s earlier: 4 mm off, at 120 mm/s, and turned by 0.6 degrees."""
    if case.tip is None or case.direction is None:
        return Pose.refused(Status.NO_CATHETER, "no catheter was there")
    direction = case.direction + turned * torch.tensor([0.6, -0.6, 0.5], dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    tip = case.tip + torch.tensor(moved, dtype=torch.float64)
    return Pose(tip, direction / direction.norm(), 1e-6 * torch.eye(6, dtype=torch.float64), zero, zero + 1, Status.OK)


def answers(cases: Iterable[Case], trackers: dict[str, Method], label: str = "frames") -> Iterator[Answer]:
    """What each method says of each frame, with a bar; a frame lives only as long as it is looked at."""
    for case in tqdm(list(cases), desc=label, unit="frame", dynamic_ncols=True):
        frame = as_camera(case.frame())
        for name, track in trackers.items():
            started = time.perf_counter()
            pose = track(frame, case)
            yield Answer.of(name, case, pose, time.perf_counter() - started)


def as_camera(frame: Tensor) -> Tensor:
    """The same frame [3, H, W] with the memory of a camera's, [H, W, 3]."""
    return frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)


def tips_of(own: Sequence[Answer]) -> Tensor:
    """[n, 3] in metres; NaN where refused."""
    return torch.tensor([answer.tip for answer in own], dtype=torch.float64)


def truth_of(own: Sequence[Answer]) -> Tensor:
    """[n, 3] in metres, of frames with a catheter."""
    return torch.tensor([answer.truth for answer in own if answer.truth is not None], dtype=torch.float64)
