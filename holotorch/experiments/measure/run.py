"""Runs of a measurement: tracks or reads its sources, guides the hand at a live camera, and writes the results."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure.calibration import open_photographs
from holotorch.experiments.measure.config import GRIDS, SYNTHETIC, MeasureSettings
from holotorch.experiments.measure.grid import Grid
from holotorch.experiments.measure.protocols import PROTOCOLS, new_rests
from holotorch.experiments.measure.sheet import chessboard, sheet_rotation
from holotorch.experiments.measure.source import Source, Track, open_source, read_reference
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.runs.saving import Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.tracking.report import COLUMNS, Log, Tracked
from holotorch.io.files import without_nan, write_bytes
from holotorch.tracking import Pose

_LOOKS = 10  # frames at the beginning in which the chessboard of the sheet is searched, which takes up to a second each


@dataclass(frozen=True, eq=False)
class Measurement:
    """Settings of a measurement and its opened sources."""

    settings: MeasureSettings
    sources: list[Source]


class Guide:
    """Tells the hand at a live camera which point comes next, and rings the bell of the terminal at each rest."""

    def __init__(self, settings: MeasureSettings, grid: Grid):
        self.grid, self._rests = grid, new_rests(settings, grid)
        self._tell()

    def __call__(self, seconds: float, pose: Pose) -> bool:
        """Take a pose. Returns whether all points have been visited."""
        if self._rests(seconds, pose):
            print("\a", end="")
            if not (complete := len(self._rests.completed) >= len(self.grid)):
                self._tell()
            return complete
        return False

    def _tell(self) -> None:
        point = len(self._rests.completed)
        tqdm.write(f"point {point + 1} of {len(self.grid)}: {self.grid.name(point)}; hold still")


def build_measurement(settings: MeasureSettings) -> Measurement:
    """Open the sources of a configuration, and check the files that the evaluation will need.

    Raises:
        ConfigError: A source or file cannot be used, or the reference is no point of the grid.
    """
    if settings.protocol in GRIDS:
        Grid.of(settings)
        chessboard(settings.grid.board)
    if settings.reference_log is not None:
        read_reference(Path(settings.reference_log))
    if settings.protocol == "tone":
        return Measurement(settings, [open_photographs(settings)])
    sources: list[Source] = []
    with ExitStack() as stack:
        for name in settings.source:
            sources.append(source := open_source(settings, name))
            if source.inputs:
                stack.callback(source.inputs.frames.__exit__)
        stack.pop_all()  # the run closes them
    return Measurement(settings, sources)


def plan_measurement(experiment: Measurement) -> RunPlan:
    """Describe the protocol and the sources."""
    settings = experiment.settings
    grid = f": {Grid.of(settings)}" if settings.protocol in GRIDS else ""
    lines = [f"Protocol   {settings.protocol}{grid}"]
    for source in experiment.sources:
        if settings.protocol == "tone":
            count = f"{len(settings.exposures)} photographs"
        elif source.inputs is None:
            count = f"{len(source.recorded)} poses"
        else:
            total = source.inputs.frames.total
            count = "without end; Ctrl-C ends it" if source.live else f"{total or 'an unknown number of'} frames"
        lines.append(f"Source     {source.name}: {count}")
        lines += [f"Note       {remark}" for remark in source.remarks]
    return RunPlan("\n".join(lines))


def run_measurement(experiment: Measurement, folder: RunFolder) -> bool:
    """Track or read the sources, evaluate them and fill the run folder. Returns whether the run is complete.

    The run writes a table of its protocol, a figure, the corrected file of edges and tone, ``summary.json`` and the
    page, and for a source of frames also its ``poses.csv`` and copies of its YAML files. Ctrl-C ends the frames of a
    camera, and what they show is evaluated.

    Raises:
        ConfigError: The poses do not show what the protocol needs. The poses that were tracked are kept.
    """
    settings, files = experiment.settings, Results()
    if settings.protocol == "tone":  # photographs, which show no catheter
        tracks = [Track(source, Log(folder.path / "images")) for source in experiment.sources]
    else:
        tracks = [_tracked(settings, source, folder, files, i) for i, source in enumerate(experiment.sources)]
    summary: dict[str, Any] = {"experiment": "measure", "status": "", "protocol": settings.protocol}
    summary |= {"sources": [source.name for source in experiment.sources]}
    summary |= {"frames": sum(len(track.poses) for track in tracks)}
    summary |= {"answered": sum(pose.answered for track in tracks for pose in track.poses)}
    try:
        result = PROTOCOLS[settings.protocol](settings, tracks)
    except ConfigError as error:
        kept = [track.source.path for track in tracks if track.source.inputs]
        text = f"the poses are kept, to be measured again without tracking: {', '.join(map(str, kept))}"
        raise ConfigError([*error.mistakes, *([text] if kept else [])]) from None
    announced = [note for source in experiment.sources for note in source.remarks]
    summary |= result.summary | {"caption": result.figure[1]}
    summary["notes"] = list(dict.fromkeys([*announced, *result.notes]))
    files.write(write_table, folder.path / result.table[0], result.table[1])
    files.write(write_bytes, folder.path / "images" / "measure.png", result.figure[0])
    for name, save in result.saved.items():
        files.write(save, folder.path / name)
    complete = conclude(folder, without_nan(summary), files, done=True)
    for note in result.notes:
        if note not in announced:
            print(f"Note       {note}", flush=True)
    return complete


def _tracked(settings: MeasureSettings, source: Source, folder: RunFolder, files: Results, number: int) -> Track:
    """The track of a source; its poses and YAML files are written if they were tracked from frames."""
    track = Track(source, Log(folder.path / "images"))
    guide = Guide(settings, Grid.of(settings)) if source.live and settings.protocol in GRIDS else None
    total = source.inputs.frames.total if source.inputs else len(source.recorded)
    try:
        with tqdm(total=total, unit="frame", desc=settings.protocol, dynamic_ncols=True) as bar:
            for item in _looked(settings, source, track):
                with deferred(folder.signals):
                    track.take(item)
                    bar.update()
                    done = guide is not None and guide(item.frame.seconds, item.pose)
                if done or folder.signals:
                    break
    except KeyboardInterrupt:
        pass  # whether it ends the run is decided below
    finally:
        if source.inputs is not None:
            with deferred(folder.signals):
                source.inputs.frames.__exit__()
                _keep(track, folder.path, files, f"{number + 1}" if len(settings.source) > 1 else "")
    if not track.poses or (folder.signals and not source.live):
        raise KeyboardInterrupt
    return track


def _keep(track: Track, folder: Path, files: Results, suffix: str) -> None:
    """Write the poses of tracked frames and copies of the files of camera and catheter."""
    if track.source.inputs is None or not track.cells:
        return
    for name, path in track.source.inputs.paths.items():
        files.write(write_bytes, folder / name, path.read_bytes())
    track.source.path = folder / f"poses{suffix}.csv"
    files.write(write_table, track.source.path, [dict(zip(COLUMNS, cells, strict=True)) for cells in track.cells])


def _looked(settings: MeasureSettings, source: Source, track: Track) -> Iterator[Tracked]:
    """The frames of a source; in the first ones, the chessboard of a sheet is searched."""
    board = chessboard(settings.grid.board) if settings.protocol == "grid2d" else None
    for item in source:
        if board and source.inputs and track.board is None and item.number < _LOOKS and item.frame.pixels is not None:
            track.board = sheet_rotation([item.frame.pixels], board, source.inputs.camera)
        yield item


def restart_measurement(folder: Path, config: dict[str, Any]) -> str | None:
    """What to do instead of going on with the interrupted run of a camera; None if its sources can be read again."""
    from holotorch.io.video import is_camera

    names = config.get("source")
    names = names if isinstance(names, list | tuple) else [names]
    if not any(isinstance(name, str | int) and str(name) != SYNTHETIC and is_camera(str(name)) for name in names):
        return None
    return f"the frames of a camera are gone; poses that it has found are in {folder / 'poses.csv'}: measure those"
