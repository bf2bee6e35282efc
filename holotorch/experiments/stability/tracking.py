"""Sweeps of tracking: poses from points, and frames that are tilted, blurred, noisy, far away or occluded.

A pose states its own standard deviation. A point is silent if the tip is off by more than 10 of them, and in a frame
also if it is off by more than 5 mm.
"""

import math
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from holotorch.experiments.stability import reference
from holotorch.experiments.stability.sweep import DOCUMENTED, Answer, Refused, Sweep, absolute
from holotorch.tracking import CatheterTracker, ChannelOrder, Pose, Status, solve_pose
from holotorch.tracking.simulation.trials import occlusions
from holotorch.tracking.simulation.world import Case, World

WORLD = World((540, 960))
WRONG = 5e-4  # metres: a tenth of the error that makes an answer wrong
NOISE = 0.1  # pixels: error of the points, 1 sigma, as ``solve_pose`` assumes
DRAWS = 64  # noise draws of one pose
DEPTH, TILT = 0.45, math.radians(20)  # of the catheter, metres and radians

Truth = Callable[..., Case]


def sweeps() -> list[Sweep]:
    """All sweeps of tracking."""
    covered = tuple(case.name for case in occlusions(WORLD) if case.name.startswith(("over", "within")))
    return [
        _points("tilt (deg)", (0.0, 30.0, 60.0, 80.0, 86.0, 89.0), lambda d: _pose(tilt=d)),
        _points("depth (m)", (0.1, 0.3, 1.0, 3.0, 8.0), lambda z: _pose(depth=z)),
        _frames("tilt (deg)", (0.0, 20.0, 40.0, 60.0, 70.0, 80.0, 86.0), lambda d: _case(pose=_pose(tilt=d))),
        _frames("depth (m)", (0.15, 0.25, 0.45, 0.8, 1.4, 2.5), lambda z: _case(pose=_pose(depth=z))),
        _frames("blur (px)", (0.3, 1.0, 2.0, 3.0, 5.0, 8.0), lambda b: _case(blur_px=b)),
        _frames("motion (px)", (0.0, 4.0, 10.0, 20.0, 40.0), lambda m: _case(motion_px=(0.6 * m, 0.8 * m))),
        _frames("noise (8-bit levels)", (0.5, 3.0, 8.0, 15.0, 30.0), lambda n: _case(noise_dn=n)),
        _frames("light (of normal)", (0.02, 0.1, 0.3, 1.0, 2.0, 4.0), lambda g: _case(gain=g)),
        _frames("occlusion", covered, lambda name: next(case for case in occlusions(WORLD) if case.name == name)),
    ]


def _pose(depth: float = DEPTH, tilt: float | None = None) -> tuple[Tensor, Tensor]:
    """Tip in metres and direction, for a ``tilt`` towards the line of sight in degrees."""
    return WORLD.pose(depth, TILT if tilt is None else math.radians(tilt))


def _case(pose: tuple[Tensor, Tensor] | None = None, **look: object) -> Case:
    return WORLD.case("stability", pose or _pose(), None, **look)  # type: ignore[arg-type]


def _points(swept: str, values: tuple[float, ...], pose_of: Callable[..., tuple[Tensor, Tensor]]) -> Sweep:
    """Sweep of ``solve_pose`` over noise draws: rms error of the tip against the stated rms deviation, in metres."""
    positions = torch.tensor(WORLD.catheter.edges, dtype=torch.float64)

    def answer(value: float) -> Answer:
        tip, direction = pose_of(value)
        exact = WORLD.camera.project(tip + positions[:, None] * direction)
        off = NOISE * reference.noise((DRAWS, len(positions), 2), dtype=torch.float64)
        pose = solve_pose(exact + off, positions, WORLD.camera, along_px=NOISE, across_px=NOISE)
        known = pose.tip.isfinite().all(-1)
        if not known.any():
            raise Refused(f"all refused: {pose.status[0].name if isinstance(pose.status, tuple) else pose.status}")
        stated = _deviation(pose)[known].square().mean().sqrt().item()
        return Answer((pose.tip - tip)[known] / math.sqrt(int(known.sum())), stated, tolerance=stated)

    return Sweep(
        "solve_pose", swept, values, answer, lambda _: torch.zeros(3, dtype=torch.float64), NOISE, DOCUMENTED, absolute
    )


def _frames(swept: str, values: tuple, case_of: Truth) -> Sweep:
    """Sweep of ``CatheterTracker`` over single frames; errors of the tip in metres."""

    def answer(value: float | str) -> Answer:
        case = case_of(value)
        pose = _tracker()(case.frame()[None])[0]
        assert isinstance(pose.status, Status)
        if not pose.status.answered:
            raise Refused(f"{pose.status.name}: {pose.reason}")
        stated = _deviation(pose).item()
        return Answer(pose.tip, stated, pose.status.name, min(WRONG, stated))

    def exact(value: float | str) -> Tensor:
        tip = case_of(value).tip
        assert tip is not None
        return tip

    return Sweep("CatheterTracker", swept, values, answer, exact, WRONG, DOCUMENTED, absolute)


def _deviation(pose: Pose) -> Tensor:
    """Stated standard deviation of the tip [...] in metres, over all directions."""
    return pose.covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()


@cache
def _tracker() -> CatheterTracker:
    return CatheterTracker(WORLD.camera, WORLD.catheter, channels=ChannelOrder.RGB)
