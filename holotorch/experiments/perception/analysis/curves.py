"""Perception times, curves and equal-efficiency scales of each participant of a study (thesis Sec. 2.4)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.analysis.config import CleaningSettings, TargetTimeSettings
from holotorch.experiments.perception.analysis.fixations import fixated
from holotorch.experiments.perception.analysis.statistics import Array, listed
from holotorch.experiments.perception.study.design import AS_IN_THESIS
from holotorch.experiments.perception.study.log import read_logs
from holotorch.perception.time import PerceptionTime


@dataclass(frozen=True, eq=False)
class Responses:
    """Trials of a study without the practice round: arrays with an entry per trial."""

    participant: NDArray[np.int64]  # number of the participant
    eccentricity_deg: Array
    size_deg: Array
    target: NDArray[np.bool_]  # whether the pattern was the target, which should be answered
    reaction_s: Array  # reaction time; NaN without an answer
    frame_s: Array  # frame interval of the display
    simulated: bool = False  # whether the answers are simulated
    torn: int = 0  # number of logs whose last line is incomplete, because the recording was killed during a trial
    broken: int | None = None  # number of trials left out because fixation was broken; None without an eye tracker
    contrast: Array | None = None  # Weber contrast of the pattern; None: 1 in all trials
    speed_deg_s: Array | None = None  # speed of the pattern in degrees per second; None: 0 in all trials


def read_responses(paths: Iterable[str]) -> Responses:
    """Read the logs of a study: files, or folders with ``*.jsonl`` files.

    Raises:
        ConfigError: A log cannot be read, contains no trials or impossible angles, or was recorded with the mouse in
            place of an eye tracker.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        logs = sorted(path.rglob("*.jsonl")) if path.is_dir() else [path]
        if not logs:
            raise ConfigError([f"logs: {path} holds no *.jsonl files, which 'holotorch study' writes"])
        files += logs
    logs = read_logs(files)
    checked = [(log, *pair) for log in logs for pair in zip(log.trials, fixated(log), strict=True)]
    checked = [(log, trial, held) for log, trial, held in checked if not trial["practice"]]
    rows = [(log, trial) for log, trial, held in checked if held is not False]
    broken = len(checked) - len(rows) if any(log.header.get("gaze") for log in logs) else None
    if checked and not rows:
        raise ConfigError([f"{log.path}: fixation is broken in every trial after the practice round" for log in logs])
    if not rows:
        raise ConfigError([f"{log.path}: the log is empty: no trials after the practice round" for log in logs])
    wrong = {
        f"{log.path}: expected eccentricity_deg in [0, 180] and size_deg in (0, 180], got "
        f"{trial['eccentricity_deg']:g} and {trial['size_deg']:g}"
        for log, trial in rows
        if not (0 <= trial["eccentricity_deg"] <= 180 and 0 < trial["size_deg"] <= 180)
    }
    if wrong:
        raise ConfigError(sorted(wrong))

    def column(key: str, dtype: type = float, default: float | None = None) -> NDArray:
        return np.array([trial.get(key, default) for _, trial in rows], dtype)  # None becomes NaN

    pattern = column("eccentricity_deg"), column("size_deg"), column("target", bool)
    times = column("reaction_s"), column("frame_s")
    return Responses(
        column("participant", int),
        *pattern,
        *times,
        torn=sum(log.torn for log in logs),
        broken=broken,
        contrast=column("contrast", default=AS_IN_THESIS[0]),
        speed_deg_s=column("speed_deg_s", default=AS_IN_THESIS[1]),
    )


@dataclass(frozen=True, eq=False)
class Times:
    """Perception times: the median of the answers of each of P participants in each condition.

    ``seconds`` and ``kept`` are for the first of the ``variants``: the highest contrast, and the lowest speed with it.
    """

    participants: NDArray[np.int64]  # numbers [P]
    eccentricities: Array  # degrees [E], rising
    sizes: Array  # degrees [S], rising
    seconds: Array  # medians [P, E, S]; NaN for conditions that were not shown or have too few valid answers
    kept: NDArray[np.int64]  # number of answers behind each median, [P, E, S]
    counts: dict[str, int]  # number of all trials and of those that each criterion excluded, by name
    simulated: bool = False  # whether the answers are simulated
    variants: tuple[tuple[float, float], ...] = (AS_IN_THESIS,)  # the W pairs of contrast and speed in deg/s
    of_variants: Array | None = None  # medians of all variants [P, E, S, W]; None: W is 1

    @property
    def all_seconds(self) -> Array:
        """Medians of all contrasts and speeds, [P, E, S, W]."""
        return self.seconds[..., None] if self.of_variants is None else self.of_variants

    def of(self, target: TargetTimeSettings) -> Array:
        """The target time of each participant in seconds [P]. ConfigError for a pattern that was not shown."""
        if target.seconds is not None:
            return np.full(len(self.participants), target.seconds)
        size, angle = target.size_deg, target.eccentricity_deg
        assert size is not None and angle is not None  # checked by TargetTimeSettings
        e = np.flatnonzero(np.abs(self.eccentricities - angle) < 1e-6)
        s = np.flatnonzero(np.abs(self.sizes - size) < 1e-6)
        seconds = self.seconds[:, e][:, :, s]  # [P, 0 or 1, 0 or 1]
        if not np.isfinite(seconds).any():
            shown = listed(self.sizes[np.isfinite(self.seconds[:, e]).any((0, 1))])
            available = f"sizes there: {shown or 'none'}" if len(e) else f"at {listed(self.eccentricities)} deg"
            raise ConfigError([f"targets: no answers to a pattern of {target}; there are some with {available}"])
        return seconds[:, 0, 0]


def perception_times(responses: Responses, rule: CleaningSettings) -> Times:
    """Remove the answers that ``rule`` excludes, and compute the medians.

    A condition is an eccentricity and a size, with a contrast and a speed.

    Raises:
        ConfigError: No valid answer remains, or no condition has enough of them.
    """
    target, time = responses.target, responses.reaction_s
    answered = target & np.isfinite(time)
    early, late = answered & (time < rule.fastest), answered & (time > rule.slowest)
    valid = answered & ~early & ~late
    counts = {
        "trials": len(target),
        "targets": int(target.sum()),
        "missed targets": int((target & ~answered).sum()),
        "answered distractions": int((~target & np.isfinite(time)).sum()),
        "too early": int(early.sum()),
        "too late": int(late.sum()),
    }
    if not valid.any():
        why = ", ".join(f"{counts[key]} {key}" for key in ("missed targets", "too early", "too late"))
        raise ConfigError([f"no answers to analyse in {counts['targets']} trials with a target: {why}"])
    participants, p = np.unique(responses.participant, return_inverse=True)
    eccentricities, e = np.unique(responses.eccentricity_deg, return_inverse=True)
    sizes, s = np.unique(responses.size_deg, return_inverse=True)
    variants, w = _variants(responses)
    shape = (len(participants), len(eccentricities), len(sizes), len(variants))
    condition, conditions = np.ravel_multi_index((p, e, s, w), shape), math.prod(shape)
    kept = np.flatnonzero(valid)
    logarithm = np.log(np.maximum(time[kept], 1e-6))
    middle = _medians(condition[kept], logarithm, conditions)[condition[kept]]
    deviation = np.abs(logarithm - middle)
    # 1.4826 is the ratio of a Gaussian's standard deviation to its median absolute deviation.
    spread = 1.4826 * _medians(p[kept], deviation, shape[0])[p[kept]]
    # Coarse frames can make all times equal; the spread is therefore at least half a frame.
    spread = np.maximum(spread, responses.frame_s[kept] / (2 * np.exp(middle)))
    outlier = deviation > rule.deviations * spread
    counts["outliers"] = int(outlier.sum())
    kept = kept[~outlier]
    number = np.bincount(condition[kept], minlength=conditions)
    seconds = _medians(condition[kept], time[kept], conditions)
    shown = np.bincount(condition[target], minlength=conditions) > 0
    missing = shown & (number < rule.responses)
    seconds[missing] = np.nan
    counts["conditions"] = int(shown.sum())
    counts["missing conditions"] = int(missing.sum())
    counts["unfinished trials"] = responses.torn
    if responses.broken is not None:
        counts["broken fixations"] = responses.broken
    if not np.isfinite(seconds).any():
        most = int(number.max())
        raise ConfigError([f"no condition has {rule.responses} answers (cleaning.responses); {most} at most"])
    seconds, number = seconds.reshape(shape), number.reshape(shape)[..., 0]
    first = seconds[..., 0]
    return Times(participants, eccentricities, sizes, first, number, counts, responses.simulated, variants, seconds)


def _variants(responses: Responses) -> tuple[tuple[tuple[float, float], ...], NDArray[np.int64]]:
    """Pairs of contrast (falling) and speed (rising), and the index of the pair of each trial."""
    trials = len(responses.target)
    contrast = np.full(trials, AS_IN_THESIS[0]) if responses.contrast is None else responses.contrast
    speed = np.full(trials, AS_IN_THESIS[1]) if responses.speed_deg_s is None else responses.speed_deg_s
    pairs, index = np.unique(np.stack([-contrast, speed], -1), axis=0, return_inverse=True)
    return tuple((-first, second) for first, second in pairs.tolist()), index.reshape(-1)


def _medians(group: NDArray[np.int64], values: Array, groups: int) -> Array:
    """Median of the values of each group; NaN for an empty group."""
    result = np.full(groups, np.nan)
    present = np.unique(group)
    result[present] = ndimage.median(values, group, present)
    return result


@dataclass(frozen=True, eq=False)
class Curves:
    """The curves T(S) = a ln S + b of P participants at K peripheral eccentricities (thesis Eq. 2.3).

    All arrays [P, K] are NaN where too few sizes have a time.
    """

    eccentricities: Array  # degrees [K]
    a: Array  # seconds [P, K]
    b: Array  # seconds [P, K]
    middle_size: Array  # geometric mean of the sizes of the fit, in degrees, [P, K]
    a_deviation: Array  # standard error of a in seconds, [P, K]; NaN for two sizes


def fit_curves(times: Times, from_deg: float, least_sizes: int) -> Curves:
    """Fit each participant's times at each eccentricity of ``from_deg`` or more.

    Raises:
        ConfigError: No such eccentricity was shown, or no participant has times of enough sizes at any of them.
    """
    peripheral = times.eccentricities >= from_deg
    if not peripheral.any():
        shown = listed(times.eccentricities)
        raise ConfigError([f"no eccentricity of {from_deg:g} deg or more; there are {shown} deg"])
    seconds = times.seconds[:, peripheral]
    measured = np.isfinite(seconds)
    enough = measured.sum(-1) >= least_sizes
    if not enough.any():
        needed = f"a curve T(S) needs times of {least_sizes} sizes (cleaning.sizes) at an eccentricity"
        raise ConfigError([f"{needed}, got {int(measured.sum(-1).max())} at most"])
    fit = PerceptionTime.fit(
        torch.from_numpy(times.sizes), torch.from_numpy(seconds[enough]), seen=torch.from_numpy(measured[enough])
    )
    assert fit.covariance is not None
    a, b, middle, deviation = (np.full(enough.shape, np.nan) for _ in range(4))
    a[enough], b[enough] = fit.slope.numpy(), fit.intercept.numpy()
    deviation[enough] = fit.covariance[..., 0, 0].sqrt().numpy()
    middle[enough] = np.exp((measured[enough] * np.log(times.sizes)).sum(-1) / measured[enough].sum(-1))
    return Curves(times.eccentricities[peripheral], a, b, middle, deviation)


@dataclass(frozen=True, eq=False)
class Scales:
    """Equal-efficiency scales S = exp((T - b) / a) of P participants at K eccentricities (thesis Sec. 2.4.3).

    If times do not fall with the size (a >= 0), no size has the target time and the scale is undefined. For medians,
    it still has a rank: above all other scales if the participant's times exceed the target time, below them otherwise.
    Leaving these participants out would make the line too flat.
    """

    degrees: Array  # scales [P, K], clipped to the limits; NaN if a time is missing
    defined: NDArray[np.bool_]  # whether a < 0 and no time is missing, [P, K]
    limited: NDArray[np.bool_]  # whether a defined scale was clipped to a limit, [P, K]

    @property
    def defined_degrees(self) -> Array:
        """The defined scales, for analyses of variance; NaN elsewhere."""
        return np.where(self.defined, self.degrees, np.nan)


def equal_efficiency(curves: Curves, target_s: Array, limits_deg: tuple[float, float]) -> Scales:
    """The scales of all participants for their target times in seconds [P]."""
    target = target_s[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = np.isfinite(curves.a) & np.isfinite(target)
        defined = measured & (curves.a < 0)
        slow = curves.a * np.log(curves.middle_size) + curves.b > target
        exponent = np.where(defined, (target - curves.b) / curves.a, np.where(slow, np.inf, -np.inf))
    low, high = np.log(limits_deg)
    # exp(ln 60) is slightly below 60, so that clipped values are set to the limits themselves.
    degrees = np.exp(np.clip(exponent, low, high))
    degrees = np.where(exponent >= high, limits_deg[1], np.where(exponent <= low, limits_deg[0], degrees))
    degrees = np.where(measured, degrees, np.nan)
    limited = defined & ((exponent < low) | (exponent > high))
    return Scales(degrees, defined, limited)
