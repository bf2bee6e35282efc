"""From the answers of a perception study to times, curves and equal-efficiency scales per participant (Sec. 2.4)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.analysis.config import CleaningSettings, TargetTimeSettings
from holotorch.experiments.perception.study.log import read_logs
from holotorch.perception.time import PerceptionTime

Array = NDArray[np.float64]
_CONSISTENT = 1.4826  # standard deviations of a Gaussian per median absolute deviation


@dataclass(frozen=True, eq=False)
class Responses:
    """Trials of a study without its practice, one entry each.

    Attributes:
        participant: Number of the participant.
        eccentricity_deg: Of the pattern.
        size_deg: Of the pattern.
        target: Whether it was to be answered.
        reaction_s: Time to the answer in seconds; NaN where there was none.
        frame_s: Interval of the display's frames.
        simulated: Whether no human being gave these answers.
        torn: Trials that were on the screen when a recording was killed.
    """

    participant: NDArray[np.int64]
    eccentricity_deg: Array
    size_deg: Array
    target: NDArray[np.bool_]
    reaction_s: Array
    frame_s: Array
    simulated: bool = False
    torn: int = 0


def read_responses(paths: Iterable[str]) -> Responses:
    """Read the logs of a study: files, or folders with ``*.jsonl`` files.

    Raises:
        ConfigError: Logs that cannot be read, hold no trials, or angles that are none.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        found = sorted(path.rglob("*.jsonl")) if path.is_dir() else [path]
        if not found:
            raise ConfigError([f"logs: {path} holds no *.jsonl files, which 'holotorch study' writes"])
        files += found
    logs = read_logs(files)
    rows = [(log, trial) for log in logs for trial in log.trials if not trial["practice"]]
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
    trials = [trial for _, trial in rows]
    return Responses(
        np.array([trial["participant"] for trial in trials]),
        np.array([trial["eccentricity_deg"] for trial in trials], dtype=float),
        np.array([trial["size_deg"] for trial in trials], dtype=float),
        np.array([trial["target"] for trial in trials]),
        np.array([np.nan if trial["reaction_s"] is None else trial["reaction_s"] for trial in trials], dtype=float),
        np.array([trial["frame_s"] for trial in trials], dtype=float),
        torn=sum(log.torn for log in logs),
    )


@dataclass(frozen=True, eq=False)
class Times:
    """Perception times: the median of each participant's answers in each condition.

    Attributes:
        participants: Numbers [P].
        eccentricities: Degrees [E], rising.
        sizes: Degrees [S], rising.
        seconds: [P, E, S]; NaN where a condition was not shown, or too few answers were left.
        kept: Answers that a median is of, [P, E, S].
        counts: What the rule of :class:`CleaningSettings` left out, by name.
        simulated: As in :class:`Responses`.
    """

    participants: NDArray[np.int64]
    eccentricities: Array
    sizes: Array
    seconds: Array
    kept: NDArray[np.int64]
    counts: dict[str, int]
    simulated: bool = False

    def of(self, target: TargetTimeSettings) -> Array:
        """The target time of each participant [P]; ConfigError for a pattern that was not shown."""
        if target.seconds is not None:
            return np.full(len(self.participants), target.seconds)
        size, angle = target.size_deg, target.eccentricity_deg
        assert size is not None and angle is not None  # as the settings have checked
        e = np.flatnonzero(np.abs(self.eccentricities - angle) < 1e-6)
        s = np.flatnonzero(np.abs(self.sizes - size) < 1e-6)
        if not (len(e) and len(s)) or not np.isfinite(self.seconds[:, e[0], s[0]]).any():
            shown = (
                ", ".join(f"{x:g}" for x in self.sizes[np.isfinite(self.seconds[:, e]).any((0, 1))]) if len(e) else ""
            )
            known = f"sizes there: {shown or 'none'}" if len(e) else f"at {_list(self.eccentricities)} deg"
            raise ConfigError([f"targets: no answers to a pattern of {target}; there are some with {known}"])
        return self.seconds[:, e[0], s[0]]


def perception_times(responses: Responses, rule: CleaningSettings) -> Times:
    """Clean the answers by the rule and take medians.

    Raises:
        ConfigError: No answer is left, because all targets were missed or all times are outside the bounds.
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
    shape = (len(participants), len(eccentricities), len(sizes))
    cell = np.ravel_multi_index((p, e, s), shape)
    kept = np.flatnonzero(valid)
    logarithm = np.log(np.maximum(time[kept], 1e-6))
    middle = _medians(cell[kept], logarithm, int(np.prod(shape)))
    away = np.abs(logarithm - middle[cell[kept]])
    spread = _CONSISTENT * _medians(p[kept], away, shape[0])[p[kept]]
    # Equal times, as coarse frames can make them, have no spread to measure by: half a frame is the least.
    spread = np.maximum(spread, responses.frame_s[kept] / (2 * np.exp(middle[cell[kept]])))
    outlier = away > rule.deviations * spread
    counts["outliers"] = int(outlier.sum())
    kept = kept[~outlier]
    number = np.bincount(cell[kept], minlength=int(np.prod(shape)))
    seconds = _medians(cell[kept], time[kept], int(np.prod(shape)))
    asked = np.bincount(cell[target], minlength=len(number)) > 0
    missing = asked & (number < rule.responses)
    seconds[missing] = np.nan
    counts["conditions"] = int(asked.sum())
    counts["missing conditions"] = int(missing.sum())
    counts["unfinished trials"] = responses.torn
    if not np.isfinite(seconds).any():
        raise ConfigError(
            [f"no condition has {rule.responses} answers (cleaning.responses); {int(number.max())} at most"]
        )
    return Times(
        participants,
        eccentricities,
        sizes,
        seconds.reshape(shape),
        number.reshape(shape),
        counts,
        responses.simulated,
    )


def _medians(group: NDArray[np.int64], values: Array, groups: int) -> Array:
    """Median of the values of each group; NaN for a group without."""
    order = np.lexsort((values, group))
    group, values = group[order], values[order]
    number = np.bincount(group, minlength=groups)
    start = np.cumsum(number) - number
    result = np.full(groups, np.nan)
    some = number > 0
    low, high = (number[some] - 1) // 2, number[some] // 2
    result[some] = (values[start[some] + low] + values[start[some] + high]) / 2
    return result


@dataclass(frozen=True, eq=False)
class Curves:
    """T(S) = a ln S + b of each participant at each far eccentricity (Eq. 2.3).

    Attributes:
        eccentricities: Degrees [K].
        a: Seconds [P, K]; NaN where too few sizes have a time.
        b: Seconds [P, K].
        middle_size: Geometric mean of the sizes of the fit, in degrees, [P, K].
        a_deviation: Standard error of a in seconds, [P, K]; NaN for two sizes.
    """

    eccentricities: Array
    a: Array
    b: Array
    middle_size: Array
    a_deviation: Array


def fit_curves(times: Times, from_deg: float, least_sizes: int) -> Curves:
    """Fit each participant's times at each eccentricity from ``from_deg`` on.

    Raises:
        ConfigError: No eccentricity there, or nobody has times of enough different sizes at one.
    """
    far = times.eccentricities >= from_deg
    if not far.any():
        raise ConfigError([f"no eccentricity of {from_deg:g} deg or more; there are {_list(times.eccentricities)} deg"])
    seconds = times.seconds[:, far]
    there = np.isfinite(seconds)
    enough = there.sum(-1) >= least_sizes
    if not enough.any():
        most = int(there.sum(-1).max())
        raise ConfigError(
            [f"a curve T(S) needs times of {least_sizes} sizes (cleaning.sizes) at an eccentricity, got {most} at most"]
        )
    fit = PerceptionTime.fit(
        torch.from_numpy(times.sizes), torch.from_numpy(seconds[enough]), seen=torch.from_numpy(there[enough])
    )
    assert fit.covariance is not None
    a, b, middle, deviation = (np.full(enough.shape, np.nan) for _ in range(4))
    a[enough], b[enough] = fit.slope.numpy(), fit.intercept.numpy()
    deviation[enough] = fit.covariance[..., 0, 0].sqrt().numpy()
    middle[enough] = np.exp((there[enough] * np.log(times.sizes)).sum(-1) / there[enough].sum(-1))
    return Curves(times.eccentricities[far], a, b, middle, deviation)


@dataclass(frozen=True, eq=False)
class Scales:
    """Equal-efficiency scales S = exp((T - b) / a) of each participant (Sec. 2.4.3).

    Where times do not fall with the size (a >= 0), no size has the target time and the scale is undefined. It still
    has a place in the order of participants, which medians need: above all others where patterns take longer than the
    target time, below them where they take less. Without those people the line would be too flat.

    Attributes:
        eccentricities: Degrees [K].
        degrees: [P, K], within the limits; NaN where a time is missing.
        defined: Whether a < 0, [P, K].
        limited: Whether a defined scale was outside the limits, [P, K].
    """

    eccentricities: Array
    degrees: Array
    defined: NDArray[np.bool_]
    limited: NDArray[np.bool_]

    @property
    def known(self) -> Array:
        """Defined scales alone, others NaN: what the analysis of variance is of."""
        return np.where(self.defined, self.degrees, np.nan)


def equal_efficiency(curves: Curves, target_s: Array, limits_deg: tuple[float, float]) -> Scales:
    """Scales at which each participant takes their target time [P]."""
    target = target_s[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        there = np.isfinite(curves.a) & np.isfinite(target)
        defined = there & (curves.a < 0)
        slow = curves.a * np.log(curves.middle_size) + curves.b > target
        exponent = np.where(defined, (target - curves.b) / curves.a, np.where(slow, np.inf, -np.inf))
    low, high = np.log(limits_deg)
    # The limits themselves, as exp(ln 60) is a little below 60.
    degrees = np.exp(np.clip(exponent, low, high))
    degrees = np.where(exponent >= high, limits_deg[1], np.where(exponent <= low, limits_deg[0], degrees))
    degrees = np.where(there, degrees, np.nan)
    limited = defined & ((exponent < low) | (exponent > high))
    return Scales(curves.eccentricities, degrees, defined, limited)


def _list(values: Array) -> str:
    return ", ".join(f"{value:g}" for value in values)
