"""Tracking a catheter through a video, pictures or a camera: poses, overlay, timing, and a recording to replay."""

import csv
import io
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import IO, Any, TypeVar

import torch
import yaml
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.environment import environment
from holotorch.experiments.runs.folder import claim
from holotorch.experiments.runs.signals import deferred, interruptible
from holotorch.experiments.tracking.report import COLUMNS, Log, Tracked, known, row, summarised, verdict, write_page
from holotorch.experiments.tracking.source import Tracker, TrackingInputs, opened
from holotorch.experiments.tracking.synthetic import compared, errors, read_truth
from holotorch.io.files import append, replacing, write_bytes, write_json, write_text
from holotorch.io.recording import Recorder, free_bytes, recording_bytes
from holotorch.io.video import Frame, Frames, replacing_video
from holotorch.tracking import Pose, Status
from holotorch.tracking.pose.overlay import overlay
from holotorch.tracking.streaming.packet import now

Entered = TypeVar("Entered")


def follow(frames: Iterable[Frame], tracker: Tracker) -> Iterator[Tracked]:
    """Track frame by frame, each with the pose of the frame before; with none after a refusal.

    ``tracker`` is called as ``tracker(frames [1, 3, H, W], previous)``. A dict ``times`` of the tracker is taken as the
    seconds of each stage of its last call.
    """
    previous: list[Pose] | None = None
    for number, frame in enumerate(frames):
        if frame.pixels is None:
            previous = None
            yield Tracked(number, frame, Pose.refused(Status.BAD_FRAME, frame.problem), 0.0, {})
            continue
        started = time.perf_counter()
        pose = tracker(frame.pixels[None], previous)[0]
        seconds = time.perf_counter() - started
        previous = [pose] if pose.answered else None
        yield Tracked(number, frame, pose, seconds, dict(getattr(tracker, "times", {})))


def run_tracking(
    source: str | Path,
    camera: Path | None = None,
    catheter: Path | None = None,
    out: Path | None = None,
    *,
    method: str = "ours",
    record: bool = False,
    video: bool = True,
    still: bool = False,
    rate: float | None = None,
) -> tuple[Path, bool]:
    """Track a source and fill a folder: ``out``, or the next free ``runs/track-001``.

    The folder gets ``poses.csv`` (a line per frame, ``COLUMNS``), ``overlay.mp4``, ``report.html``, copies of the two
    YAML files, ``recording`` if asked for, and ``summary.json`` last. Ctrl-C, as SIGTERM and a closed terminal, saves
    what there is, and is the ordinary end of a camera. A killed process (``kill -9``) leaves what it had written
    under hidden names: ``.poses.csv.PID.partial``, whole but for its last line, and an overlay that no player may open;
    its recording can be tracked.

    Args:
        source: A video, a folder of pictures, a folder of a recording, or the number of a camera.
        camera: YAML file; that of the recording by default.
        catheter: The same.
        out: New or empty folder.
        method: ours or thesis.
        record: Keep every frame, losslessly.
        video: Write the overlay.
        still: The catheter is held still; measure its stability, Eq. 3.13.
        rate: Frames per second where the source has no times.

    Returns:
        The folder, and whether the source was tracked to its end.

    Raises:
        ConfigError: A source, file or method that cannot be used, a truth.csv of a recording that cannot be read, a
            folder in use, or no room for the recording.
    """
    with opened(source, camera, catheter, method, rate) as given:
        truth = read_truth(Path(source))
        for line in [*_announced(given.frames, out, record), *given.frames.notes]:
            print(line, flush=True)
        settings = {
            "experiment": "track",
            "source": str(source),
            "method": method,
            "record": record,
            "video": video,
            "still": still,
            "rate_hz": rate,
        }
        return _fill(claim(out, "track"), given, settings, truth)


def live(
    sources: Sequence[str], camera: Path | None, catheter: Path | None, rate: float | None = None
) -> Iterator[tuple[float, Pose]]:
    """Times on the packets' clock and poses of one source, as its frames come; see :func:`run_tracking`.

    Frames of a file come at the pace of its times: those of their poses are when each is due, and may be still to come.
    The source and its files are opened, and refused, when this is called; frames are read as poses are asked for.
    """
    if len(sources) != 1:
        raise ConfigError([f"expected one source to track and stream, got {len(sources)}"])
    stack = ExitStack()
    return _live(stack, stack.enter_context(opened(sources[0], camera, catheter, "ours", rate)))


def _live(stack: ExitStack, given: TrackingInputs) -> Iterator[tuple[float, Pose]]:
    with stack:
        frames, tracker = given.frames, given.tracker
        for note in frames.notes:
            print(note, flush=True)
        said, began = len(frames.notes), None
        for item in follow(frames, tracker):
            began = now() - item.frame.seconds if began is None else began
            # The camera took the frame before the tracker's time.
            yield (now() - item.seconds if frames.live else began + item.frame.seconds), item.pose
        for note in frames.notes[said:]:
            print(note, flush=True)


def _fill(
    folder: Path, given: TrackingInputs, settings: dict[str, Any], truth: dict[str, list[float]]
) -> tuple[Path, bool]:
    frames, log, failure, recorder = given.frames, Log(folder / "images"), None, None
    said = len(frames.notes)
    with interruptible() as pressed:
        parts: list[ExitStack] = []  # each to be closed, whatever happens to the others
        try:
            for name, path in given.paths.items():
                write_bytes(folder / name, path.read_bytes())
            write_text(folder / "config.yaml", yaml.safe_dump(settings, sort_keys=False))
            write_json(folder / "env.json", environment(0, torch.device("cpu")))
            (folder / "images").mkdir(exist_ok=True)
            table = _entered(parts, replacing(folder / "poses.csv", buffering=0))
            _append(table, COLUMNS)
            movie, came = None, iter(frames)
            if settings["video"]:
                movie = _entered(parts, replacing_video(folder / "overlay.mp4", frames.shape, frames.rate))
            if settings["record"]:
                recorder = Recorder(folder / "recording", frames.shape, frames.rate, frames.name, given.paths)
                came = _recorded(came, _entered(parts, recorder), pressed)
            bar = _entered(parts, tqdm(total=frames.total, unit="frame", desc="tracking", dynamic_ncols=True))
            for item in follow(came, given.tracker):
                with deferred(pressed):
                    _append(table, row(item))
                    drawn = _drawn(item, given) if movie or log.wants(item) else None
                    if movie and drawn is not None:
                        movie.write(drawn)
                    log.take(item, drawn)
                    bar.set_postfix_str(f"{item.status.name}, {1e3 * item.seconds:.1f} ms", refresh=False)
                    bar.update()
                if pressed:
                    break
        except KeyboardInterrupt:
            pass
        except Exception as error:  # what was found until now is kept
            failure = error
        with deferred(pressed):
            for part in reversed(parts):
                try:
                    part.close()
                except OSError as error:
                    failure = failure or error
            if not log.statuses:
                if (recorder is None or not recorder.frames) and not _poses(folder):
                    shutil.rmtree(folder)  # claimed empty a moment ago, and without a frame or a pose
                    raise failure or KeyboardInterrupt
                print(f"no frame was tracked to its end; what there is of the first is in {folder}", file=sys.stderr)
                if failure is not None:
                    raise failure
                return folder, False
            complete = failure is None and (not pressed or frames.live)
            summary = summarised(log, frames, settings["method"], settings["still"])
            if found := errors(folder / "poses.csv", truth):
                summary["truth"] = found
            summary["status"] = "complete" if complete else "interrupted"
            if failure is not None:
                summary["failure"] = f"{type(failure).__name__}: {failure}"
            write_page(folder, summary, log)
            write_json(folder / ("summary.json" if complete else "interrupted.json"), known(summary))
    lines = [verdict(summary), *summary["notes"][said:]]
    print("\n".join(lines + ([compared(summary["truth"])] if "truth" in summary else [])), flush=True)
    if failure is not None:
        print(f"failed; what was found until then is in {folder}", file=sys.stderr)
        raise failure
    return folder, complete


def _entered(parts: list[ExitStack], context: AbstractContextManager[Entered]) -> Entered:
    """Enter a context of its own, to be closed with ``parts``."""
    parts.append(ExitStack())
    return parts[-1].enter_context(context)


def _recorded(frames: Iterator[Frame], recorder: Recorder, pressed: list[int]) -> Iterator[Frame]:
    """The frames, each kept before anything is done with it."""
    for frame in frames:
        with deferred(pressed):
            recorder.write(frame)
        yield frame


def _drawn(item: Tracked, given: TrackingInputs) -> Tensor:
    pixels = item.frame.pixels
    if pixels is None:
        pixels = torch.zeros(3, *given.frames.shape, dtype=torch.uint8)
    return overlay(pixels, item.pose, given.camera, given.catheter)


def _append(table: IO[bytes], cells: Sequence[str]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    append(table, text.getvalue().encode("utf-8", "replace"))


def _poses(folder: Path) -> bool:
    """Whether there is a pose, or the refusal of one, in the table."""
    path = folder / "poses.csv"
    return path.is_file() and path.read_bytes().count(b"\n") > 1


def _announced(frames: Frames, out: Path | None, record: bool) -> list[str]:
    """What will be done, in words; ConfigError where there is no room for it."""
    height, width = frames.shape
    count = "an unknown number of frames" if frames.total is None else f"{frames.total} frames"
    count = "without end; Ctrl-C ends it" if frames.live else count
    lines = [f"Source     {frames.name}: {width} x {height} px, {frames.rate:g} per second, {count}"]
    if not record:
        return lines
    free = free_bytes(out or Path())
    if frames.total is None:
        size = recording_bytes(frames.shape, 1) * frames.rate
        return [*lines, f"Recording  {size / 1e6:.1f} MB per second; {free / 1e9:.1f} GB free, {free / size:.0f} s"]
    size = recording_bytes(frames.shape, frames.total)
    if size > free:
        raise ConfigError([f"the recording takes {size / 1e9:.2f} GB and {free / 1e9:.2f} GB are free; choose --out"])
    return [*lines, f"Recording  {size / 1e9:.3f} GB; {free / 1e9:.1f} GB free"]
