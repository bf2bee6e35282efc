"""Quantisation of the reaction times of a study by the frames of the display."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Quantisation:
    """Quantisation of reaction times, from the frame intervals measured by the browser."""

    trials: int
    frame_s: float  # median frame interval; patterns can only appear at multiples of it
    least_s: float  # shortest frame interval
    most_s: float  # longest frame interval
    deviation_s: float  # standard deviation of the quantisation error of a reaction time, frame / sqrt(12)

    def __str__(self) -> str:
        text = (
            f"frames of {1e3 * self.frame_s:.1f} ms ({1 / self.frame_s:.0f} Hz) over {self.trials} trials: reaction "
            f"times are known to one frame, which adds a deviation of {1e3 * self.deviation_s:.1f} ms to each"
        )
        if self.most_s > 1.5 * self.least_s:
            text += f"; the interval went from {1e3 * self.least_s:.1f} to {1e3 * self.most_s:.1f} ms"
        return text


def quantisation(frames: Sequence[float]) -> Quantisation | None:
    """Compute the quantisation from the frame intervals of all trials, in seconds; None if there are no trials."""
    if not frames:
        return None
    median = statistics.median(frames)
    return Quantisation(len(frames), median, min(frames), max(frames), median / math.sqrt(12))
