"""Gaze samples of an eye tracker, and the check whether a participant looked at the fixation point.

A sample is ``{"time": ..., "x_deg": ..., "y_deg": ..., "valid": ...}``:

- ``time``: seconds since 1970 (Unix time) by the clock of the computer of the study, as Python's ``time.time()``.
  The program of a tracker with another clock converts its times.
- ``x_deg``, ``y_deg``: azimuth and elevation of the gaze at the eye, from the fixation point, in degrees; right and up
  are positive. They may be anything, also null, if ``valid`` is false.
- ``valid``: whether the tracker saw the eye.

The tracker's program sends samples to the study's server while it runs, one or a list of up to about 100 in the body of
``POST /gaze``, with the header ``Authorization: Bearer TOKEN``, whose TOKEN is the end of the printed address; or it
writes them to a CSV file with the header ``time,x_deg,y_deg,valid``. Samples that cannot be used are dropped and
counted.
"""

import csv
import math
import os
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.settings import Count, Number, Settings, within

COLUMNS = ("time", "x_deg", "y_deg", "valid")
Seconds = Annotated[Number, within(0.01, 10, "a time between 0.01 and 10 seconds, not milliseconds")]
_KEPT_S = 130.0  # seconds of samples that are kept in memory; a pattern is shown for 60 s at most
_CLOCK_S = 1.0  # greatest difference in seconds between the time of a live sample and the clock of this computer


class GazeSettings(Settings):
    """When a participant counts as looking at the fixation point.

    ``source``: "tracker" sends samples while the study runs; "file": samples are in a CSV file beside the log later;
    "mouse": the mouse stands in for an eye tracker, to try the study out; the analysis refuses its results.
    ``radius_deg``: greatest angle between gaze and fixation point. ``share``: share of the samples that must be within
    it, in the ``before_s`` seconds before a pattern and, separately, from its onset to the answer or its end. Invalid
    samples count as outside it. ``gap_s``: longest time without a sample. ``attempts``: how often a trial is
    shown at most if its fixation is broken; the repeats come at the end of its round.

    The thesis gives none of these numbers. The defaults are assumptions: 3 deg exceeds the errors of a remote tracker,
    about 1 deg, and is well below the 10 deg of the innermost peripheral pattern.
    """

    source: Literal["tracker", "file", "mouse"]
    radius_deg: Annotated[Number, within(0.1, 30, "a radius between 0.1 and 30 deg")] = 3.0
    share: Annotated[Number, Field(gt=0, le=1)] = 0.8
    before_s: Seconds = 0.3
    gap_s: Seconds = 0.15
    attempts: Annotated[Count, Field(le=20)] = 3

    @property
    def live(self) -> bool:
        """Whether samples arrive while the study runs."""
        return self.source != "file"


@dataclass(frozen=True)
class GazeSample:
    """One sample; see the module. ``x_deg`` and ``y_deg`` are NaN if ``valid`` is false."""

    time: float
    x_deg: float
    y_deg: float
    valid: bool

    @property
    def angle_deg(self) -> float:
        """Angle between the gaze and the fixation point; infinite for a sample that is not valid."""
        if not self.valid:
            return math.inf
        x, y = math.radians(self.x_deg), math.radians(self.y_deg)
        # The angle to straight ahead, from its sine and cosine: exact for small angles too.
        return math.degrees(math.atan2(math.hypot(math.cos(y) * math.sin(x), math.sin(y)), math.cos(y) * math.cos(x)))


@dataclass(frozen=True)
class Fixation:
    """Check of one trial: shares of the samples within the radius before and during the pattern, None without samples.

    ``samples``: number of samples in both. ``gap_s``: longest time without one. ``held``: whether fixation was held.
    """

    before: float | None
    during: float | None
    samples: int
    gap_s: float
    held: bool

    def to_json(self) -> dict[str, Any]:
        """The check as JSON data."""
        return asdict(self)


class GazeTrack:
    """The samples of one participant in order of time, and counts of what was dropped.

    Attributes:
        dropped: Number of samples dropped by reason: "malformed", "not finite", "out of order" (not later than the
            sample before) and "clock" (more than a second from this computer's time).
        accepted: Number of the other samples.
    """

    def __init__(self, settings: GazeSettings, kept_s: float = _KEPT_S):
        self.settings, self.dropped, self.accepted = settings, Counter[str](), 0
        self._samples: deque[GazeSample] = deque()
        self._kept_s = kept_s

    @property
    def last(self) -> float:
        """Time of the newest sample; -inf before the first."""
        return self._samples[-1].time if self._samples else -math.inf

    def add(self, value: Any, now: float | None = None) -> list[GazeSample]:
        """Add a sample or a list of samples that came as JSON; return those that were not dropped.

        ``now`` is the time of their arrival; None skips the check of the clock, for samples of a file.
        """
        added = []
        for item in value if isinstance(value, list) else [value]:
            sample = _sample(item)
            if isinstance(sample, str):
                self.dropped[sample] += 1
            elif now is not None and abs(sample.time - now) > _CLOCK_S:
                self.dropped["clock"] += 1
            elif sample.time <= self.last:
                self.dropped["out of order"] += 1
            else:
                self._samples.append(sample)
                added.append(sample)
        while self._samples and self._samples[0].time < self.last - self._kept_s:
            self._samples.popleft()
        self.accepted += len(added)
        return added

    def fixated(self, now: float) -> bool:
        """Whether the fixation point was looked at in the last ``before_s`` seconds up to the newest sample."""
        end = self.last
        if not now - end <= self.settings.gap_s:
            return False
        share, _, gap = self._share(end - self.settings.before_s, end)
        return share is not None and share >= self.settings.share and gap <= self.settings.gap_s

    def check(self, onset: float, end: float) -> Fixation:
        """Check a pattern that appeared at ``onset`` and was answered or removed at ``end``, both in Unix time."""
        before, first, gap = self._share(onset - self.settings.before_s, onset)
        during, second, other = self._share(onset, end)
        gap, enough = max(gap, other), self.settings.share
        held = None not in (before, during) and min(before or 0, during or 0) >= enough and gap <= self.settings.gap_s
        return Fixation(before, during, first + second, gap, held)

    def _share(self, start: float, end: float) -> tuple[float | None, int, float]:
        """Share of the samples within the radius in [start, end], their number, and the longest time without one."""
        inside: list[GazeSample] = []
        for sample in reversed(self._samples):
            if sample.time < start:
                break
            if sample.time <= end:
                inside.append(sample)
        times = [end, *(sample.time for sample in inside), start]
        gap = max(later - earlier for later, earlier in pairwise(times))
        if not inside:
            return None, 0, gap
        near = sum(sample.angle_deg <= self.settings.radius_deg for sample in inside)
        return near / len(inside), len(inside), gap

    def __str__(self) -> str:
        dropped = ", ".join(f"{number} {reason}" for reason, number in sorted(self.dropped.items()))
        return f"{self.accepted} gaze samples" + (f"; dropped: {dropped}" if dropped else "")


class GazeFile:
    """Appends samples to a CSV file that only its owner can read."""

    def __init__(self, path: Path):
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        if not os.fstat(self._file).st_size:
            os.write(self._file, f"{','.join(COLUMNS)}\n".encode())

    def write(self, samples: Iterable[GazeSample]) -> None:
        """Append samples; OSError if the disk is full."""
        lines = (f"{s.time:.6f},{s.x_deg:.4f},{s.y_deg:.4f},{int(s.valid)}\n" for s in samples)
        os.write(self._file, "".join(lines).encode())

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def read_gaze(path: Path, settings: GazeSettings) -> GazeTrack:
    """Read a CSV file of samples; lines that are not samples are dropped and counted, as in a live stream.

    Raises:
        ConfigError: The file cannot be read, or its first line is not ``time,x_deg,y_deg,valid``.
    """
    track = GazeTrack(settings, kept_s=math.inf)
    try:
        with open(path, newline="", encoding="utf-8", errors="replace") as stream:
            rows = csv.reader(line.replace("\0", "?") for line in stream)
            if tuple(next(rows, ())) != COLUMNS:
                raise ConfigError([f"{path}:1:1: expected a first line {','.join(COLUMNS)}"])
            track.add([_from_text(row) for row in rows])
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError([f"{path}: cannot read the gaze samples: {reason}"]) from None
    return track


def _from_text(row: list[str]) -> Any:
    """The sample of a line of a CSV file; None if it has another number of fields or other text."""
    valid = {"1": True, "true": True, "0": False, "false": False}.get(row[-1].strip().lower() if row else "")
    try:
        time, x, y = (float(text) if text.strip() else math.nan for text in row[:-1])
    except ValueError:
        return None
    return {"time": time, "x_deg": x, "y_deg": y, "valid": valid}


def _sample(value: Any) -> GazeSample | str:
    """The sample, or the reason why there is none."""
    if not isinstance(value, dict) or not isinstance(value.get("valid"), bool):
        return "malformed"
    names = ("time", "x_deg", "y_deg") if value["valid"] else ("time",)
    if any(isinstance(value.get(name), bool) or not isinstance(value.get(name), int | float) for name in names):
        return "malformed"
    try:
        numbers = [float(value[name]) for name in names]
    except OverflowError:  # a whole number of hundreds of digits
        return "not finite"
    if not all(map(math.isfinite, numbers)):
        return "not finite"
    time, x, y = numbers if value["valid"] else (numbers[0], math.nan, math.nan)
    if abs(x) > 180 or abs(y) > 90:
        return "malformed"
    return GazeSample(time, x, y, value["valid"])
