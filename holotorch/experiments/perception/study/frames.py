"""How finely the reaction times of a study are known: to the frames of its display."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Quantisation:
    """How finely reaction times are known, from the frame intervals that the browser measured.

    Attributes:
        trials: Trials that it is taken from.
        frame_s: Median frame interval in seconds: patterns appear in steps of this.
        least_s: The shortest.
        most_s: The longest.
        deviation_s: Standard deviation that the steps add to a reaction time, frame / sqrt(12).
    """

    trials: int
    frame_s: float
    least_s: float
    most_s: float
    deviation_s: float

    def __str__(self) -> str:
        text = (
            f"frames of {1e3 * self.frame_s:.1f} ms ({1 / self.frame_s:.0f} Hz) over {self.trials} trials: reaction "
            f"times are known to one frame, which adds a deviation of {1e3 * self.deviation_s:.1f} ms to each"
        )
        if self.most_s > 1.5 * self.least_s:
            text += f"; the interval went from {1e3 * self.least_s:.1f} to {1e3 * self.most_s:.1f} ms"
        return text


def quantisation(frames: Sequence[float]) -> Quantisation | None:
    """The quantisation of reaction times from the frame intervals of trials in seconds; None where there are none."""
    if not frames:
        return None
    median = statistics.median(frames)
    return Quantisation(len(frames), median, min(frames), max(frames), median / math.sqrt(12))
