"""Rests: finds where a moving tip is held still, pose by pose, so that a live camera can guide the hand."""

import math
from collections import deque
from dataclasses import dataclass, replace

import torch

from holotorch.core import checks
from holotorch.tracking import Pose

_MOVED = 3.0  # spread of a resting tip, as a multiple of the tracker's standard deviation, that is still a rest
_AWAY = 3  # consecutive poses elsewhere that end a rest: one or two may be wrong poses


@dataclass(frozen=True)
class Rest:
    """A place where the tip was held.

    Attributes:
        tip: Mean tip (x, y, z) in metres over the calmest part of the stay that is long enough.
        sd: Root mean square distance of the tips from it in metres, with n - 1 degrees of freedom.
        frames: Number n of poses in the mean.
        start, end: Times of the first and the last of them in seconds.
        touches: How often the tip came to this place in succession; the last time counts.
    """

    tip: tuple[float, float, float]
    sd: float
    frames: int
    start: float
    end: float
    touches: int = 1


class Rests:
    """Detector of rests, called with each pose in the order of time.

    The tip rests if, over at least ``frames`` poses and ``seconds``, its root mean square distance from its mean is at
    most ``spread`` or, for a less certain tracker, 3 times the stated deviation of the tip, but then no more than half
    of ``apart``. The next rest begins only after the tip has moved by ``apart``, for 3 poses. Refused frames
    are ignored.

    Args:
        apart: Least distance of two rests in metres: half the spacing of a grid. A rest nearer to the one before is
            the same point, touched again, and replaces it.
        seconds: Least duration of a rest.
        frames: Least number of poses in it, 3 or more.
        spread: Largest spread in metres.

    Attributes:
        completed: The rests so far, in the order of time.
    """

    def __init__(self, apart: float, *, seconds: float = 0.5, frames: int = 10, spread: float = 0.5e-3):
        self.apart, self.spread = checks.positive("apart", apart, "m"), checks.positive("spread", spread, "m")
        self.seconds, self.frames = checks.positive("seconds", seconds, "s"), checks.whole("frames", frames, 3)
        self.completed: list[Rest] = []
        self._window: deque[_Sample] = deque()
        self._away: list[_Sample] = []
        self._resting = False

    def __call__(self, seconds: float, pose: Pose) -> bool:
        """Take the pose of a frame captured at ``seconds``. Returns whether a rest has just become complete."""
        if not pose.answered:
            return False
        x, y, z = pose.tip.tolist()
        sample = _Sample(seconds, (x, y, z), float(pose.tip_sd))
        if self._resting and math.dist(sample.tip, self.completed[-1].tip) > self.apart:
            self._away.append(sample)
            if len(self._away) < _AWAY:
                return False
            self._resting, self._window = False, deque(self._away)
        else:
            self._window.append(sample)
        self._away = []
        window = self._window
        # The shortest part of the window that still is long enough.
        while len(window) > self.frames and seconds - window[1].seconds >= self.seconds - 1e-9:
            window.popleft()
        if len(window) < self.frames or seconds - window[0].seconds < self.seconds - 1e-9:
            return False
        rest, stated = _rest(window)
        if rest.sd > max(self.spread, min(_MOVED * stated, self.apart / 2)):
            return False
        return self._take(rest)

    def _take(self, rest: Rest) -> bool:
        last = self.completed[-1] if self.completed else None
        if last is not None and self._resting:
            if rest.sd < last.sd:  # the calmest part is free of the arrival and the departure
                self.completed[-1] = replace(rest, touches=last.touches)
            return False
        if last is not None and math.dist(last.tip, rest.tip) <= self.apart:
            self.completed[-1] = replace(rest, touches=last.touches + 1)
        else:
            self.completed.append(rest)
        self._resting = True
        return True


@dataclass(frozen=True)
class _Sample:
    seconds: float
    tip: tuple[float, float, float]
    sd: float  # stated by the tracker, metres


def _rest(window: deque[_Sample]) -> tuple[Rest, float]:
    """The rest of these samples, if it is one, and the root mean square of their stated deviations in metres."""
    tips = torch.tensor([sample.tip for sample in window], dtype=torch.float64)
    mean, count = tips.mean(0), len(window)
    spread = math.sqrt(float((tips - mean).square().sum()) / (count - 1))
    stated = math.sqrt(sum(sample.sd**2 for sample in window) / count)
    x, y, z = mean.tolist()
    return Rest((x, y, z), spread, count, window[0].seconds, window[-1].seconds), stated
