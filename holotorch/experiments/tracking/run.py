"""Tracking runs on a video, pictures or a camera: they write poses, an overlay, times, and a recording to replay."""

import csv
import io
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import IO, Any, TypeVar

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.runs.saving import Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.timing import timed
from holotorch.experiments.tracking.config import SYNTHETIC, TrackSettings
from holotorch.experiments.tracking.devices import (
    build_headset,
    calibration_sd,
    headset_covariance,
    load_camera,
    load_headset,
)
from holotorch.experiments.tracking.forecast import range_text
from holotorch.experiments.tracking.report import COLUMNS, Log, Tracked, row, save_figure, summarise, verdict
from holotorch.experiments.tracking.source import Tracker, TrackingInputs, fitting_tracker, open_inputs
from holotorch.experiments.tracking.synthetic import (
    distance_text,
    errors,
    read_truth,
    synthetic_distance,
    synthetic_poses,
    synthetic_world,
    write_synthetic,
)
from holotorch.io.bundled import find_config
from holotorch.io.files import append, replacing, without_nan, write_bytes
from holotorch.io.recording import Recorder, free_bytes, recording_bytes
from holotorch.io.video import Frame, replacing_video
from holotorch.tracking import CatheterTracker, Pose, Status
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.detection.ends import shows_beyond_tip
from holotorch.tracking.pose.alignment import in_frame
from holotorch.tracking.pose.overlay import overlay
from holotorch.tracking.pose.status import BEYOND_TIP
from holotorch.tracking.streaming.packet import now

_CONFIRMED = 3  # number of poses in a row from which on the next frame is searched near the last one

Entered = TypeVar("Entered")


def follow(frames: Iterable[Frame], tracker: Tracker, batch: int = 1) -> Iterator[Tracked]:
    """Track frame by frame, or ``batch`` > 1 frames at a time.

    The tracker is called as ``tracker(frames [B, 3, H, W], previous)``. Frame by frame, ``previous`` holds the pose of
    the previous frame if the last three frames have poses, else it is None: only a search of the whole frame checks
    the width of the tube, and one frame may pass this check by chance with bands that are named in the wrong order. In
    a batch it is None: each frame is searched by itself, so that its pose does not depend on the size of the batch. A
    tracker may have a dict ``times``, the seconds of each stage of its last call. The times of a frame are the mean
    over its batch.
    """
    previous: list[Pose] | None = None
    answered = 0  # number of poses since the last refusal
    numbered = enumerate(frames)
    while group := list(islice(numbered, batch)):
        pixels = [frame.pixels for _, frame in group if frame.pixels is not None]
        poses_left, seconds, times = iter(list[Pose]()), 0.0, dict[str, float]()
        if pixels:
            stacked = pixels[0][None] if len(pixels) == 1 else torch.stack(pixels)  # a single frame is not copied
            poses, whole = timed(partial(tracker, stacked, previous))
            poses_left, seconds = iter(poses), whole / len(pixels)
            times = {stage: time / len(pixels) for stage, time in getattr(tracker, "times", {}).items()}
        for number, frame in group:
            if frame.pixels is None:
                pose = Pose.refused(Status.BAD_FRAME, frame.problem)
                yield Tracked(number, frame, pose, 0.0, {})
            else:
                pose = next(poses_left)
                yield Tracked(number, frame, pose, seconds, dict(times))
            answered = answered + 1 if pose.answered else 0
            previous = [pose] if batch == 1 and answered >= _CONFIRMED else None


def _followed(frames: Iterable[Frame], inputs: TrackingInputs, batch: int = 1) -> Iterator[Tracked]:
    """As :func:`follow`; a pose beyond whose tip the tube goes on is UNVERIFIED."""
    lens = Lens(inputs.camera)
    for item in follow(frames, inputs.tracker, batch):
        pose, pixels = item.pose, item.frame.pixels
        if pixels is not None and pose.answered and shows_beyond_tip(pixels, lens, pose, inputs.catheter):
            item = item._replace(pose=replace(pose, status=Status.UNVERIFIED, reason=BEYOND_TIP))
        yield item


def live(
    sources: Sequence[str],
    camera: Path | None,
    catheter: Path | None,
    rate: float | None = None,
    see: Callable[[Tensor, Pose, float], None] | None = None,
) -> Iterator[tuple[float, Pose]]:
    """Yield the capture time, in seconds of the clock ``packet.now``, and the pose of each frame of one source.

    For a file, the capture time is the time at which the frame is due at the pace of its time stamps, which may be in
    the future. The call opens and checks the source and its files; frames are read when poses are requested. ``see`` is
    called with the pixels, pose and capture time of each frame before its pose is yielded.
    """
    if len(sources) != 1:
        raise ConfigError([f"expected one source to track and stream, got {len(sources)}"])
    return _live(open_inputs(sources[0], camera, catheter, "ours", rate), see)


def _live(inputs: TrackingInputs, see: Callable[[Tensor, Pose, float], None] | None) -> Iterator[tuple[float, Pose]]:
    with inputs.frames as frames:
        for note in frames.notes:
            print(f"Note       {note}", flush=True)
        printed, start = len(frames.notes), None
        for item in _followed(frames, inputs):
            start = now() - item.frame.seconds if start is None else start
            # The capture time of a live frame is approximated by the time at which the tracker began.
            captured = now() - item.seconds if frames.live else start + item.frame.seconds
            if see is not None and item.frame.pixels is not None:
                see(item.frame.pixels, item.pose, captured)
            yield captured, item.pose
        for note in frames.notes[printed:]:
            print(f"Note       {note}", flush=True)


@dataclass(frozen=True, eq=False)
class TrackingExperiment:
    """Settings of a tracking run, with its opened inputs and the true tips."""

    settings: TrackSettings
    inputs: TrackingInputs | None  # None for a synthetic source, which the run renders first
    truth: dict[str, list[float]]  # true tips in metres by frame number; empty if they are unknown
    to_headset: Callable[[Pose], Pose] | None = None  # from the camera's frame to that of a headset


def build_tracking(settings: TrackSettings) -> TrackingExperiment:
    """Open the source of a configuration and the files that it needs.

    Raises:
        ConfigError: A source or file cannot be used, or the truth.csv of a recording cannot be read.
    """
    to_headset = None
    if settings.headset is not None:
        headset = load_headset(settings.headset)
        to_headset = partial(in_frame, matrix=build_headset(headset), covariance=headset_covariance(headset))
    if settings.source == SYNTHETIC:
        _check_synthetic(settings)
        return TrackingExperiment(settings, None, {}, to_headset)
    truth = read_truth(Path(settings.source))
    return TrackingExperiment(settings, _open(settings, settings.source), truth, to_headset)


def _check_synthetic(settings: TrackSettings) -> None:
    """ConfigError for a camera and a catheter that cannot be rendered, or that the tracker refuses."""
    camera, catheter = _files(settings)
    world = synthetic_world(camera, catheter)
    fitting_tracker(settings.method, world.camera, world.catheter, catheter and (find_config(catheter) or catheter))
    synthetic_poses(world, settings.rendered, synthetic_distance(world))


def _open(settings: TrackSettings, source: str | Path) -> TrackingInputs:
    return open_inputs(source, *_files(settings), settings.method, settings.rate_hz, still=settings.still)


def _files(settings: TrackSettings) -> tuple[Path | None, Path | None]:
    """Files of the camera and the catheter."""
    camera, catheter = (Path(name) if name else None for name in (settings.camera, settings.catheter))
    return camera, catheter


def plan_tracking(experiment: TrackingExperiment) -> RunPlan:
    """Describe the source, how far away a tip can be found, and the disk space that a recording needs."""
    settings = experiment.settings
    if experiment.inputs is None:
        world = synthetic_world(*_files(settings))
        (height, width), gigabytes = world.size, recording_bytes(world.size, settings.rendered) / 1e9
        size = f"{width} x {height} px, {gigabytes:.2f} GB"
        text = f"Source     synthetic: {settings.rendered} frames are rendered first, {size}"
        return RunPlan(f"{text}\n{range_text(world.camera, world.catheter)}\n{distance_text(world)}")
    frames = experiment.inputs.frames
    height, width = frames.shape
    count = "an unknown number of frames" if frames.total is None else f"{frames.total} frames"
    count = "without end; Ctrl-C ends it" if frames.live else count
    lines = [f"Source     {frames.name}: {width} x {height} px, {frames.rate:g} per second, {count}"]
    lines.append(range_text(experiment.inputs.camera, experiment.inputs.catheter, frames.coarse_colours))
    if isinstance(experiment.inputs.tracker, CatheterTracker) and (readout := experiment.inputs.tracker.readout):
        lines.append(
            f"Shutter    deviations (sd) allow for a catheter that moves by {1e3 * readout:g} mm while a rolling "
            "shutter reads a frame; `shutter: global` in the camera's file, or still=true for one at rest, leaves "
            "that out"
        )
    if settings.frames is not None:
        lines.append(
            f"Note       frames={settings.frames} is for synthetic recordings; of this source, all are tracked"
        )
    if settings.record:
        free, rate = free_bytes(Path()), recording_bytes(frames.shape, 1) * frames.rate
        text = f"{rate / 1e6:.1f} MB per second; {free / 1e9:.1f} GB free here, {free / rate:.0f} s"
        if frames.total is not None:
            text = f"{recording_bytes(frames.shape, frames.total) / 1e9:.3f} GB; {free / 1e9:.1f} GB free here"
        lines.append(f"Recording  {text}")
    return RunPlan("\n".join([*lines, *(f"Note       {note}" for note in frames.notes)]))


def run_tracking(experiment: TrackingExperiment, folder: RunFolder) -> bool:
    """Track a source and fill the run folder. Returns whether the run is complete.

    The run writes ``poses.csv`` (a line per frame, ``COLUMNS``), with a headset also ``headset_poses.csv``, the same in
    its frame, ``overlay.mp4``, copies of the two YAML files, ``recording`` if requested, and finally ``summary.json``
    and the page. Ctrl-C, SIGTERM and closing the terminal end the run and save the results so far; for a camera, this
    is the normal end. A killed process (``kill -9``) leaves
    files with hidden names: ``.poses.csv.PID.partial``, complete except for its last line, and an overlay that players
    may refuse. Its recording can be tracked.

    Raises:
        ConfigError: The disk has no room for the recording.
        Exception: The tracker or the disk failed; all poses before the error are saved first.
    """
    if experiment.inputs is not None:
        return _tracked(experiment, experiment.inputs, folder)
    settings = experiment.settings
    camera, catheter = _files(settings)
    made = {"camera": camera, "catheter": catheter, "video": settings.video}
    recording = write_synthetic(folder.path / SYNTHETIC, settings.rendered, **made)
    inputs = _open(settings, recording)
    return _tracked(replace(experiment, inputs=inputs, truth=read_truth(recording)), inputs, folder)


def _tracked(experiment: TrackingExperiment, inputs: TrackingInputs, run: RunFolder) -> bool:
    folder, settings, frames = run.path, experiment.settings, inputs.frames
    log, results, failure = Log(folder / "images"), Results(), None
    printed = len(frames.notes)
    size, free = recording_bytes(frames.shape, frames.total or 0), free_bytes(folder)
    if settings.record and size > free:
        raise ConfigError([f"the recording takes {size / 1e9:.2f} GB and {free / 1e9:.2f} GB are free; choose --out"])
    opened: list[AbstractContextManager[Any]] = [frames]
    try:
        _track_all(inputs, experiment, run, log, opened)
    except KeyboardInterrupt:
        pass
    except Exception as error:  # it is raised again after the poses before it are saved
        failure = error
    with deferred(run.signals):
        for context in reversed(opened):  # each is closed as after a success, even if closing another one fails
            try:
                context.__exit__(None, None, None)
            except OSError as error:
                failure = failure or error
        if not log.statuses:
            if not _holds_frames(folder):
                shutil.rmtree(folder)  # created by this run, and without a frame or pose
                raise failure or KeyboardInterrupt
            print(f"no frame was tracked to its end; what there is of the first is in {folder}", file=sys.stderr)
            if failure is not None:
                raise failure
            return False
        summary = summarise(log, frames, settings.method, settings.still)
        if log.first is not None and "camera.yaml" in inputs.paths:
            added = calibration_sd(load_camera(folder / "camera.yaml"), inputs.catheter, log.first)
            summary["calibration_sd_mm"] = None if added is None else 1e3 * added
        if comparison := errors(folder / "poses.csv", experiment.truth):
            summary["truth"] = comparison
        if failure is not None:
            summary["failure"] = f"{type(failure).__name__}: {failure}"
        # After a failure nothing prints the verdict later.
        lines = [verdict(summary)] if failure is not None else []
        lines += [f"Note       {note}" for note in summary["notes"][printed:]]
        print(*lines, sep="\n", end="\n" if lines else "", flush=True)
        results.write(save_figure, folder, log)
        if failure is not None:
            results.failure = None  # only the first failure is reported
        done = failure is None and (not run.signals or frames.live)
        complete = conclude(run, without_nan(summary), results, done=done)
    if failure is not None:
        raise failure
    return complete


def _track_all(
    inputs: TrackingInputs,
    experiment: TrackingExperiment,
    run: RunFolder,
    log: Log,
    opened: list[AbstractContextManager[Any]],
) -> None:
    """Track all frames and write the results until a signal arrives; the files it opens are appended to ``opened``."""
    folder, frames, settings = run.path, inputs.frames, experiment.settings

    def entered(context: AbstractContextManager[Entered]) -> Entered:
        value = context.__enter__()
        opened.append(context)
        return value

    for name, path in inputs.paths.items():
        write_bytes(folder / name, path.read_bytes())
    table = entered(replacing(folder / "poses.csv", buffering=0))
    _append(table, COLUMNS)
    in_headset = entered(replacing(folder / "headset_poses.csv", buffering=0)) if experiment.to_headset else None
    if in_headset:
        _append(in_headset, COLUMNS)
    movie, source = None, iter(frames)
    if settings.video:
        movie = entered(replacing_video(folder / "overlay.mp4", frames.shape, frames.rate))
    if settings.record:
        recorder = Recorder(folder / "recording", frames.shape, frames.rate, frames.name, inputs.paths)
        source = _recorded(source, entered(recorder), run.signals)
    bar = entered(tqdm(total=frames.total, unit="frame", desc="tracking", dynamic_ncols=True))
    for item in _followed(source, inputs, settings.batch):
        with deferred(run.signals):
            _append(table, row(item))
            if in_headset and experiment.to_headset:
                _append(in_headset, row(item._replace(pose=experiment.to_headset(item.pose))))
            drawn = None
            if movie or log.wants(item):
                black = torch.zeros(3, *frames.shape, dtype=torch.uint8)
                pixels = black if item.frame.pixels is None else item.frame.pixels
                drawn = overlay(pixels, item.pose, inputs.camera, inputs.catheter)
            if movie and drawn is not None:
                movie.write(drawn)
            log.take(item, drawn)
            bar.set_postfix_str(f"{item.status.name}, {1e3 * item.seconds:.1f} ms", refresh=False)
            bar.update()
        if run.signals:
            break


def _recorded(frames: Iterator[Frame], recorder: Recorder, signals: list[int]) -> Iterator[Frame]:
    """Record each frame and then yield it."""
    for frame in frames:
        with deferred(signals):
            recorder.write(frame)
        yield frame


def _append(table: IO[bytes], cells: Sequence[str]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    append(table, text.getvalue().encode("utf-8", "replace"))


def _holds_frames(folder: Path) -> bool:
    """Whether the folder contains a pose, a refusal, or a recorded frame."""
    tables = (folder / "poses.csv", folder / "recording" / "times.csv")
    return any(path.is_file() and path.read_bytes().count(b"\n") > 1 for path in tables)
