"""Errors of a pose that is shown late, with and without prediction to the time at which it is shown."""

from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.pose.smoothing import OneEuro
from holotorch.tracking.pose.status import Pose

# Limits of the prediction, those of the page of ``holotorch stream --view``.
LONGEST_GAP = 0.25  # seconds between the two poses that give a speed
LONGEST_AHEAD = 0.1  # seconds; a later display shows the prediction for this time
_LONGEST_STEP = 2.5  # longest gap across which a true tip is interpolated, in median intervals
METHODS = ("none", "constant velocity", "one euro")


def prediction_errors(
    times: Tensor, poses: Sequence[Pose], delay: float, smoothing: OneEuro | None = None
) -> tuple[Tensor, Tensor]:
    """Distances between the tip that each method shows and the tip that is measured at that time.

    Each pose is shown ``delay`` seconds after its capture: as it is ("none"), moved on at the velocity from it and the
    pose before ("constant velocity"), or predicted by a filter ("one euro"). A velocity is never taken across a refusal
    or a gap above 0.25 s; there both show their last pose. The later tip is interpolated linearly, never across a
    refusal. It is measured with the same noise, which is thus part of all errors.

    Args:
        times: [n] capture times in seconds, increasing.
        poses: n poses or refusals.
        delay: Time from capture to display in seconds, 0 or more.
        smoothing: The filter, which is reset first; by default ``OneEuro()``.

    Returns:
        Capture times [k] of the poses whose error is known, and the errors [k, 3] in metres, in the order of
        ``METHODS``. All methods have the same poses.

    Raises:
        ValueError: No pose can be compared, or times and poses do not fit together.
    """
    delay = checks.nonnegative("delay", delay, "seconds")
    times = times.detach().to(torch.float64)
    if times.shape != (len(poses),) or bool((times.diff() <= 0).any()):
        raise ValueError(f"times must rise, one for each of {len(poses)} poses, got {list(times.shape)}")
    truth = _interpolated(times, poses, times + delay)
    smoothing = smoothing or OneEuro()
    smoothing.reset()
    ahead = min(delay, LONGEST_AHEAD)
    captured, errors = [], []
    before: tuple[float, Pose] | None = None
    for seconds, pose, true in zip(times.tolist(), poses, truth, strict=True):
        smooth = smoothing(pose, seconds)
        if pose.answered and bool(true.isfinite().all()):
            predicted = smoothing.predict(seconds + ahead, longest=2 * LONGEST_AHEAD)
            moved = pose.tip
            if before is not None and seconds - before[0] <= LONGEST_GAP:
                moved = pose.tip + ahead / (seconds - before[0]) * (pose.tip - before[1].tip)
            shown = torch.stack([pose.tip, moved, predicted.tip if predicted.answered else smooth.tip])
            captured.append(seconds)
            errors.append((shown - true).norm(dim=-1))
        before = (seconds, pose) if pose.answered else None
    if not errors:
        raise ValueError(
            f"no pose of {len(poses)} has measured ones {1e3 * delay:g} ms later, before and after that time; record "
            "longer, with fewer refusals"
        )
    return torch.tensor(captured, dtype=torch.float64), torch.stack(errors)


def _interpolated(times: Tensor, poses: Sequence[Pose], wanted: Tensor) -> Tensor:
    """Tips [m, 3] at the times ``wanted`` [m]; NaN beside refusals, in long gaps, and after the last frame."""
    tips = torch.stack([pose.tip.to(torch.float64) for pose in poses])  # NaN where refused
    if len(times) < 2:
        return torch.full((len(wanted), 3), torch.nan, dtype=torch.float64)
    after = torch.searchsorted(times, wanted).clamp(1, len(times) - 1)
    interval = times[after] - times[after - 1]
    share = ((wanted - times[after - 1]) / interval)[:, None]
    # At the time of a frame, its neighbour has no weight and may have been refused.
    value = torch.where(share == 1, tips[after], tips[after - 1] + share * (tips[after] - tips[after - 1]))
    value = torch.where(share == 0, tips[after - 1], value)
    known = (wanted <= times[-1]) & ((interval <= _LONGEST_STEP * times.diff().median()) | (share[:, 0] == 1))
    return torch.where(known[:, None], value, torch.nan)
