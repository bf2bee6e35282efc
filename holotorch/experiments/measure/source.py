"""Sources of a measurement: poses that a tracker finds now, that a run has written, or that are simulated."""

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure.config import SYNTHETIC, MeasureSettings
from holotorch.experiments.measure.synthetic import synthetic_poses
from holotorch.experiments.streaming.stream import TimedPose, read_poses
from holotorch.experiments.tracking.report import Log, Tracked, row, summarise
from holotorch.experiments.tracking.run import follow
from holotorch.experiments.tracking.source import TrackingInputs, open_inputs
from holotorch.io.files import read_json
from holotorch.io.video import Frame, Frames
from holotorch.tracking import Pose


class Reference(NamedTuple):
    """The log of a reference tracker."""

    times: list[float]  # seconds
    tips: list[list[float]]  # metres, in any frame; NaN where there is none


@dataclass(eq=False)
class Source:
    """A source that has been opened and checked.

    Attributes:
        name: For the user.
        inputs: Frames and tracker, to be read once; None if there are poses already.
        recorded: Capture times in seconds and poses; empty if there are frames.
        path: The poses.csv; None if there is no file of them yet.
        notes: Remarks for the user.
    """

    name: str
    inputs: TrackingInputs | None = None
    recorded: list[TimedPose] = field(default_factory=list)
    path: Path | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user, of the frames if there are any."""
        return self.inputs.frames.notes if self.inputs else self.notes

    @property
    def live(self) -> bool:
        """Whether the source is a camera, which does not end."""
        return self.inputs is not None and self.inputs.frames.live

    def __iter__(self) -> Iterator[Tracked]:
        if self.inputs is not None:
            yield from follow(self.inputs.frames, self.inputs.tracker)
        for i, (seconds, pose) in enumerate(self.recorded):
            yield Tracked(i, Frame(seconds, None), pose, 0.0, {})


@dataclass(eq=False)
class Track:
    """The poses of one source, in the order of time.

    Attributes:
        source: Where they come from.
        log: Times, tips, statuses and times of stages.
        poses: Pose or refusal of each frame.
        cells: Lines for a poses.csv.
        edges: Pixels [N, 2] of the band edges in each frame, if the tracker has measured them.
        board: Rotation [3, 3] from a board on the sheet to the camera, if the first frames showed one.
    """

    source: Source
    log: Log
    poses: list[Pose] = field(default_factory=list)
    cells: list[list[str]] = field(default_factory=list)
    board: Any = None
    edges: list[Tensor | None] = field(default_factory=list)

    def take(self, item: Tracked) -> None:
        """Add a frame."""
        self.log.take(item, None)
        self.poses.append(item.pose)
        self.cells.append(row(item))
        measured = getattr(self.source.inputs.tracker, "edges_px", ()) if self.source.inputs else ()
        self.edges.append(measured[0] if len(measured) == 1 and item.frame.pixels is not None else None)

    def summary(self, *, still: bool = False) -> dict[str, Any]:
        """What ``holotorch track`` says of these frames: counts, times, stages and, if ``still``, the stability."""
        source = self.source
        frames = source.inputs.frames if source.inputs else None
        frames = frames or Frames(source.name, (0, 0), len(self.poses), 0.0, iter(()), list(source.notes))
        summary = summarise(self.log, frames, "ours", still)
        return summary | _timing(source.path)


def open_source(settings: MeasureSettings, name: str) -> Source:
    """Open one source of a configuration.

    Raises:
        ConfigError: It does not exist, cannot be read, or lacks the files of its camera and catheter.
    """
    path = Path(name)
    if name == SYNTHETIC:
        try:
            return Source(name, recorded=synthetic_poses(settings), notes=["simulated poses, not measured ones"])
        except KeyError:
            text = "simulated poses are for still, grid2d and grid3d"
            raise ConfigError([f"source: {text}, not {settings.protocol}; expected a file, folder or camera"]) from None
    if path.is_dir() and (path / "poses.csv").is_file():
        path = path / "poses.csv"
    if path.suffix.lower() == ".csv":
        return Source(str(path), recorded=read_poses(path), path=path)
    camera, catheter = (Path(given) if given else None for given in (settings.camera, settings.catheter))
    inputs = open_inputs(name, camera, catheter, "ours", settings.rate_hz)
    return Source(inputs.frames.name, inputs)


def read_reference(path: Path) -> Reference:
    """Read the log of a reference tracker, with the columns time_s, x_m, y_m, z_m; empty cells where it lost the tool.

    Raises:
        ConfigError: The file cannot be read, a column is missing, or a line is no time and place.
    """
    columns = ("time_s", "x_m", "y_m", "z_m")
    times, tips = [], []
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            table = csv.DictReader(stream)
            if not set(columns) <= set(table.fieldnames or ()):
                got = ", ".join(table.fieldnames or ["nothing"])
                raise ConfigError([f"{path}:1: expected the columns {', '.join(columns)}, got {got}"])
            for line in table:
                try:
                    seconds, *tip = (float(line[name] or math.nan) for name in columns)
                    if not math.isfinite(seconds) or (times and seconds <= times[-1]):
                        raise ValueError
                except (TypeError, ValueError):
                    got = ",".join(str(line[name]) for name in columns)
                    text = "a time in seconds later than that of the line before, and a place in metres"
                    raise ConfigError([f"{path}:{table.line_num}: expected {text}, got {got}"]) from None
                times.append(seconds)
                tips.append(tip)
    except (UnicodeDecodeError, csv.Error):
        raise ConfigError([f"{path}: not a table in UTF-8 text; expected the columns {', '.join(columns)}"]) from None
    except OSError as error:
        raise ConfigError([f"{path}: cannot read the reference tracker's log: {error.strerror}"]) from None
    if not times:
        raise ConfigError([f"{path}: the reference tracker's log is empty"])
    return Reference(times, tips)


def _timing(path: Path | None) -> dict[str, Any]:
    """Times of the tracker in ms from the summary beside a poses.csv; empty if there is none or it tells none."""
    beside = path.parent / "summary.json" if path else None
    if beside is None or not beside.is_file():
        return {}
    try:
        summary = read_json(beside)
        return {name: summary[name] for name in ("milliseconds", "stages") if name in summary}
    except (OSError, ValueError, TypeError):
        return {}
