"""The trackers to compare, and their answers to synthetic frames with exact ground truth, with the time of each."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.timing import timed
from holotorch.experiments.tracking_benchmark.thesis_opencv import ThesisOpenCV
from holotorch.io.images import load_image
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.detection.stations import StationPlan
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.rolling_shutter import READOUT
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.refinement.photometric import FitPlan, PhotometricFit
from holotorch.tracking.simulation.world import Case, World

BASE, COLD, PRIOR, FEWER = "thesis, OpenCV", "ours, cold", "ours, prior", "ours, fewer stations"
FIT = "ours, cold, photometric fit"
LITERAL = "thesis, OpenCV, maps anew"
FEWER_STATIONS = StationPlan(most=6)  # cross-sections of the tube that the method FEWER uses
WRONG = 5e-3  # metres: error of the tip above which an answer counts as wrong
_BUNDLED = ("astronaut", "coffee", "chelsea")  # colour photographs that scikit-image contains

Method = Callable[[Tensor, Case], Pose]


class Answer(NamedTuple):
    """Answer of one method to one frame.

    It holds plain numbers, because thousands of small tensors between the frames would fragment the memory.
    """

    method: str  # name of the method
    name: str  # name of the case
    answerable: bool  # whether the frame determines a pose
    truth: list[float] | None  # true position [3] of the tip in metres; None if the frame shows no catheter
    status: Status  # status of the pose
    reason: str  # reason of a refusal or of an unverified pose; may be empty
    tip: list[float]  # [3] in metres; NaN for a refusal
    covariance: list[list[float]]  # [3, 3] of the tip in m^2
    seconds: float  # time that the method took

    @staticmethod
    def of(method: str, case: Case, pose: Pose, seconds: float) -> "Answer":
        """Create the answer from a single pose, not a batch."""
        assert isinstance(pose.status, Status)
        truth = None if case.tip is None else case.tip.tolist()
        tip, covariance = pose.tip.tolist(), pose.covariance[:3, :3].tolist()
        return Answer(method, case.name, case.answerable, truth, pose.status, pose.reason, tip, covariance, seconds)

    @property
    def answered(self) -> bool:
        """Whether the method gave a pose."""
        return self.status.answered

    @property
    def error(self) -> float:
        """Error of the tip in metres; NaN for a refusal or a frame without a catheter."""
        return math.nan if self.truth is None else math.dist(self.tip, self.truth)

    @property
    def right(self) -> bool:
        """Whether the method gave a pose of a visible catheter, with a small error."""
        return self.error <= WRONG

    @property
    def wrong(self) -> bool:
        """Whether the method gave a pose with a large error, or without a catheter in the frame."""
        return self.answered and not self.right


def photographs(folder: Path | None = None) -> tuple[Tensor, ...]:
    """Colour photographs uint8 [3, h, w] for backgrounds: PNG and JPEG files of ``folder``, or three of scikit-image.

    Raises:
        ValueError: ``folder`` holds no colour photograph.
    """
    files = sorted(path for path in folder.glob("*") if path.suffix in (".png", ".jpg")) if folder else _BUNDLED
    images = [load_image(source) for source in files]
    if not any(len(image) == 3 for image in images):
        raise ValueError(f"{folder} must hold colour photographs, PNG or JPEG files, got none")
    return tuple((255 * image).round().to(torch.uint8) for image in images if len(image) == 3)


def methods(
    world: World, names: Sequence[str] = (BASE, LITERAL, COLD, PRIOR, FEWER), *, readout: float = READOUT
) -> dict[str, Method]:
    """Trackers by name, each a function of one frame [3, H, W] and its case; only PRIOR uses the truth of the case.

    ``readout`` is that of :class:`CatheterTracker`: 0 if it is known that all rows are exposed at the same time.
    """
    camera, catheter = world.camera, world.catheter
    thesis, literal = ThesisOpenCV(camera, catheter), ThesisOpenCV(camera, catheter, literal=True)
    create = partial(CatheterTracker, camera, catheter, channels=ChannelOrder.RGB, readout=readout)
    ours, fewer = create(), create(stations=FEWER_STATIONS)
    fitted = create(refinement=PhotometricFit(camera, catheter, plan=FitPlan(readout=readout)))
    expected = lru_cache(maxsize=16)(before)  # cached, so that its computation does not count as time of the tracker
    known: dict[str, Method] = {
        BASE: lambda frame, _: thesis(frame[None])[0],
        LITERAL: lambda frame, _: literal(frame[None])[0],
        COLD: lambda frame, _: ours(frame[None])[0],
        PRIOR: lambda frame, case: ours(frame[None], [expected(case)])[0],
        FEWER: lambda frame, _: fewer(frame[None])[0],
        FIT: lambda frame, _: fitted(frame[None])[0],
    }
    return {name: known[name] for name in names}


def before(case: Case, moved: tuple[float, float, float] = (2e-3, -1.5e-3, 3e-3), turned: float = 0.01) -> Pose:
    """Pose of the catheter 1/30 s before a case: moved by 4 mm (a speed of 120 mm/s) and rotated by 0.6 degrees.

    ``moved`` is the displacement of the tip in metres, and ``turned`` scales the change of direction.
    """
    if case.tip is None or case.direction is None:
        return Pose.refused(Status.NO_CATHETER, "no catheter was there")
    direction = case.direction + turned * torch.tensor([0.6, -0.6, 0.5], dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    tip = case.tip + torch.tensor(moved, dtype=torch.float64)
    return Pose(tip, direction / direction.norm(), 1e-6 * torch.eye(6, dtype=torch.float64), zero, zero + 1, Status.OK)


def answers(cases: Iterable[Case], trackers: dict[str, Method], label: str | None = "frames") -> Iterator[Answer]:
    """Answers of all methods to all frames, with a progress bar if it has a label; one frame at a time is in memory."""
    for case in tqdm(list(cases), desc=label, unit="frame", dynamic_ncols=True, disable=label is None):
        frame = as_camera(case.frame())
        for name, track in trackers.items():
            yield Answer.of(name, case, *timed(partial(track, frame, case)))


def as_camera(frame: Tensor) -> Tensor:
    """The same frame [3, H, W] in the memory layout of a camera, [H, W, 3]."""
    return frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)


def tips_of(own: Sequence[Answer]) -> Tensor:
    """Tips [n, 3] of answers in metres; NaN for refusals."""
    return torch.tensor([answer.tip for answer in own], dtype=torch.float64)


def truth_of(own: Sequence[Answer]) -> Tensor:
    """True tips [n, 3] in metres of the answers to frames with a catheter."""
    return torch.tensor([answer.truth for answer in own if answer.truth is not None], dtype=torch.float64)
