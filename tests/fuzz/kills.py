"""Runs of every kind that a signal ends at a random moment, and what must be true of them then.

A case is a number: with its seed it gives the kind, the signals and their moments again. The runs are forks of one
process that has loaded everything, which takes a hundredth of the time of a new one; the first moments of a real
process, while Python loads modules, are not among them.
"""

import contextlib
import csv
import io
import json
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
import yaml
from stand_in import CAMERA, SIZE, StandIn
from tiny_runs import RUNS, command, results

from holotorch.cli import main
from holotorch.experiments.eye import run as eye_run
from holotorch.experiments.pec import progress
from holotorch.experiments.runs import figures
from holotorch.experiments.tracking import source as track_source
from holotorch.experiments.tracking.devices import save_camera, save_catheter
from holotorch.io.images import encode_png
from holotorch.io.recording import open_recording
from holotorch.tracking import THESIS

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)
KINDS = (*RUNS, "track")
_LONGEST = 60.0  # seconds for any of the runs, which take one
_EARLY = 97  # exit status of a child that KeyboardInterrupt ends outside of the command, as it ends Python itself
_LEVELS = [9, 12, 0, 15, 18, 21, 24, 0, 27, 30]  # grey levels of the frames that are tracked


@dataclass(frozen=True)
class Shot:
    """When a signal comes: after ``seconds``, or before or after the file number ``write`` takes its name.

    ``number`` 0 is none.
    """

    number: int = 0
    seconds: float | None = None
    write: int = 0
    before: bool = False

    def __str__(self) -> str:
        place = f"file {self.write} {'begins' if self.before else 'has'} its name"
        when = place if self.seconds is None else f"{self.seconds:.3f} s"
        return f"{signal.Signals(self.number).name} at {when}" if self.number else "no signal"


@dataclass(frozen=True)
class Whole:
    """A run without a signal.

    Attributes:
        found: What no interruption may change.
        seconds: It takes.
        writes: Files that it has named.
    """

    found: dict[str, object]
    seconds: float
    writes: int


class Failed(AssertionError):
    """What must be true is not."""


class Kills:
    """Cases of kills, in a folder that keeps those that fail.

    Args:
        folder: To work in.
        seed: Of all cases.
    """

    def __init__(self, folder: Path, seed: int = 0):
        self.folder, self.seed, self.wholes = folder, seed, dict[str, Whole]()
        folder.mkdir(parents=True, exist_ok=True)
        save_camera(folder / "camera.yaml", CAMERA, SIZE)
        save_catheter(folder / "catheter.yaml", THESIS)
        (folder / "frames").mkdir(exist_ok=True)
        for number, level in enumerate(_LEVELS):
            cv2.imwrite(str(folder / "frames" / f"{number}.png"), np.full((*SIZE, 3), level, np.uint8))

    def case(self, number: int, kind: str | None = None) -> tuple[str, list[Shot]]:
        """Kind and signals of a case: one, or a chain in which resuming is ended as well."""
        rng = Random(f"{self.seed}/{number}")
        kind = kind or rng.choice(KINDS)
        whole = self.whole(kind)
        return kind, [self._shot(rng, whole) for _ in range(rng.choice((1, 1, 1, 2, 3)))]

    def run(self, number: int, kind: str | None = None) -> str | None:
        """Carry a case out; what is wrong, or None. The folder of one that fails is kept as ``failed-NUMBER``."""
        kind, shots = self.case(number, kind)
        place = self.folder / f"case-{number}"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        try:
            with _quick():
                (self._track if kind == "track" else self._resumable)(kind, shots, place, Random(number))
        except Failed as error:
            kept = self.folder / f"failed-{number}"
            shutil.rmtree(kept, ignore_errors=True)
            place.rename(kept)
            return f"{kind}, {', then '.join(map(str, shots))}: {error}"
        shutil.rmtree(place)
        return None

    def whole(self, kind: str) -> Whole:
        """The run of a kind without a signal."""
        if kind not in self.wholes:
            place = self.folder / f"whole-{kind}"
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            with _quick():
                self._load(kind, place / "warm")
                began = time.perf_counter()
                status = self._carried(kind, place / "a", Shot(), place)
                seconds = time.perf_counter() - began
            assert status == 0, (place / "log.txt").read_text()
            found = _poses(place / "a") if kind == "track" else results(place / "a")
            self.wholes[kind] = Whole(found, seconds, int((place / "writes.txt").read_text()))
        return self.wholes[kind]

    def _load(self, kind: str, out: Path) -> None:
        """Load what a run loads late into this process, so that none of its forks does; tracking starts threads."""
        words = self._words(kind, out)
        if kind == "track":
            self._carried(kind, out, Shot(), out.parent)
            return
        with open(os.devnull, "w") as none, contextlib.redirect_stdout(none), contextlib.redirect_stderr(none):
            assert main(words) == 0

    def _shot(self, rng: Random, whole: Whole) -> Shot:
        number = rng.choice(SIGNALS)
        if rng.random() < 0.5:
            return Shot(number, seconds=rng.uniform(0, 1.05 * whole.seconds))
        # The last files are written at once, when a moment in time seldom falls between them.
        return Shot(number, write=rng.randint(1, whole.writes + 1), before=rng.random() < 0.5)

    def _words(self, kind: str, out: Path) -> list[str]:
        if kind != "track":
            return command(kind, out)
        files = ["--camera", str(self.folder / "camera.yaml"), "--catheter", str(self.folder / "catheter.yaml")]
        return ["track", str(self.folder / "frames"), *files, "--record", "--out", str(out)]

    def _carried(self, kind: str, out: Path, shot: Shot, place: Path) -> int:
        return _exit(self._words(kind, out), shot, place)

    def _resumable(self, kind: str, shots: list[Shot], place: Path, rng: Random) -> None:
        out, before, status = place / "a", dict[str, Any](), 1
        words = self._words(kind, out)
        for shot in shots:
            status = _exit(words, shot, place)
            _check_end(status, shot, out, place)
            # What an earlier SIGKILL has left is removed by a run that goes on, not by one that ends before.
            tidy = status == 0 or (status == 130 and "before it went on" not in _log(place))
            before = _check_folder(out, before, tidy=tidy)
            if status == 0 or (out / "summary.json").is_file():
                break
            # A folder without these two holds no run yet, as the command says.
            begun = (out / "config.yaml").is_file() and (out / "env.json").is_file()
            words = ["resume", str(out)] if begun and rng.random() < 0.6 else self._words(kind, out)
        if status:
            complete = (out / "summary.json").is_file()
            status = _exit(["resume", str(out)] if complete else words, Shot(), place)
            if status:
                raise Failed(f"going on ends with status {status}: {_log(place)}")
            _check_folder(out, before, tidy=True)
        if any(path.name.startswith(".") or path.name == "checkpoint.pt" for path in out.rglob("*")):
            raise Failed("a complete run has left files behind")
        found, wanted = results(out), self.whole(kind).found
        for name in sorted(found.keys() ^ wanted.keys()):
            raise Failed(f"{name} is {'new' if name in found else 'missing'}")
        for name in wanted.keys() & found.keys():
            if found[name] != wanted[name]:
                raise Failed(f"{name} differs from that of a run without a signal")

    def _track(self, kind: str, shots: list[Shot], place: Path, rng: Random) -> None:
        """Tracking is not resumed: what was found must be a part of the whole, and the frames kept can be tracked."""
        out, wanted = place / "a", self.whole(kind).found
        status = self._carried(kind, out, shots[0], place)
        _check_end(status, shots[0], out, place)
        _check_folder(out, {}, tidy=status in (0, 130))
        found = _poses(out) if (out / "poses.csv").is_file() else {}
        if any(wanted.get(name) != value for name, value in found.items()):
            raise Failed("poses differ from those of a run without a signal")
        if status == 0 and found != wanted:
            raise Failed("a complete run lacks poses")
        kept = out / "recording"
        if (kept / "times.csv").is_file() and (kept / "recording.json").is_file():
            self._tracked_anew(kept, place)

    def _tracked_anew(self, kept: Path, place: Path) -> None:
        try:
            with open_recording(kept) as frames:
                levels = [int(frame.pixels[0, 0, 0]) for frame in frames if frame.pixels is not None]
        except ValueError as error:
            if "no complete frame" in str(error):
                return
            raise Failed(f"the frames that were kept cannot be replayed: {error}") from None
        if levels != _LEVELS[: len(levels)]:
            raise Failed(f"other frames than those that came: {levels}")


@contextlib.contextmanager
def _quick() -> Iterator[None]:
    """Runs within draw no figures, save often, and track without looking at pixels but one."""
    dot = encode_png(torch.zeros(1, 2, 2))
    with contextlib.ExitStack() as stack:
        for name in ("comparison", "channel_maps", "convergence", "visual_field"):
            stack.enter_context(patch.object(figures, name, lambda *_, **__: dot))
        for module in (progress, eye_run):
            stack.enter_context(patch.object(module, "_SAVE_EVERY", 0.02))
        stack.enter_context(patch.object(track_source, "make_tracker", lambda *_: StandIn()))
        yield


def _exit(words: list[str], shot: Shot, place: Path) -> int:
    """Run a command in a child that gets the signal; its exit status, negative for the signal that has ended it."""
    (place / "log.txt").write_bytes(b"")  # a signal may come before the child has opened it
    child = os.fork()
    if child == 0:
        _child(words, shot, place)
    began = time.monotonic()
    if shot.seconds is not None:
        time.sleep(shot.seconds)
        with contextlib.suppress(ProcessLookupError):  # it has ended already
            os.kill(child, shot.number)
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() - began > _LONGEST:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise Failed(f"takes longer than {_LONGEST:g} s: {_log(place)}")
        time.sleep(0.002)


def _child(words: list[str], shot: Shot, place: Path) -> None:
    status = 98
    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        log = os.open(place / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.stdout, sys.stderr = (open(each, "w", buffering=1, closefd=False) for each in (1, 2))  # noqa: SIM115
        with _noticed(shot, place):
            status = main(words)
    except KeyboardInterrupt:
        status = _EARLY
    except SystemExit as error:
        status = int(error.code or 0)
    except BaseException:
        traceback.print_exc()
        status = 1
    finally:
        os._exit(status)


@contextlib.contextmanager
def _noticed(shot: Shot, place: Path) -> Iterator[None]:
    """Count the files that take their names, and send the signal at one of them."""
    replace, calls = os.replace, [0]

    def counted(source: Any, target: Any) -> None:
        calls[0] += 1
        if calls[0] == shot.write and shot.before:
            os.kill(os.getpid(), shot.number)
        replace(source, target)
        if calls[0] == shot.write and not shot.before:
            os.kill(os.getpid(), shot.number)

    with patch.object(os, "replace", counted):
        yield
    (place / "writes.txt").write_text(str(calls[0]))


def _check_end(status: int, shot: Shot, out: Path, place: Path) -> None:
    """Exit status and message: 0 complete, 130 interrupted and saved, or the signal itself before there was a run."""
    text = (place / "log.txt").read_text(errors="replace")
    if "Traceback" in text:
        raise Failed(f"a traceback: {text[-3000:]}")
    complete, begun = (out / "summary.json").is_file(), (out / "config.yaml").is_file()
    if status == 0:
        if not complete:
            raise Failed("status 0 without summary.json")
    elif status == 130:
        if complete:
            raise Failed("status 130 of a complete run")
        if begun and not ("holotorch resume" in text or (out / "interrupted.json").is_file()):
            raise Failed(f"status 130 does not say how to go on: {text[-1000:]}")
    elif status in (_EARLY, -shot.number) and shot.number != signal.SIGKILL:
        if begun and not complete and text.strip():  # an earlier run's folder, of which nothing was done yet
            raise Failed(f"{shot} is not handled, status {status}: {text[-1000:]}")
    elif status != -shot.number:
        raise Failed(f"status {status}: {text[-3000:]}")


def _log(place: Path) -> str:
    return (place / "log.txt").read_text(errors="replace")[-3000:]


def _check_folder(out: Path, before: dict[str, Any], *, tidy: bool) -> dict[str, Any]:
    """Whole files under their names, and all that was there before; what is there now, for the next time.

    ``tidy``: the run has ended by itself, and has left no half files under hidden names.
    """
    now: dict[str, Any] = {}
    for path in sorted(out.rglob("*")) if out.is_dir() else ():
        if path.is_dir():
            continue
        name = str(path.relative_to(out))
        if path.name.startswith("."):
            if tidy:
                raise Failed(f"{name} is left behind")
            continue
        try:
            now[name] = _READERS.get(path.suffix, Path.read_bytes)(path)
        except Exception as error:
            raise Failed(f"{name} is not whole: {type(error).__name__}: {error}") from None
    gone = before.keys() - now.keys()
    if "summary.json" in now:
        gone -= {"checkpoint.pt", "interrupted.json"}
        status = now["summary.json"]["status"]
        if status != "complete":
            raise Failed(f"summary.json says {status}")
    if "config.yaml" not in before:  # no run had begun, and a new one writes it anew
        gone -= {"env.json"}
    if gone:
        raise Failed(f"{', '.join(sorted(gone))} is gone")
    if "checkpoint.pt" in before and "checkpoint.pt" in now:
        was, is_ = (_progress(each["checkpoint.pt"]) for each in (before, now))
        if is_ < was:
            raise Failed(f"the checkpoint has gone back from {was} to {is_}")
    return now


def _progress(content: dict[str, Any]) -> int:
    """How far a checkpoint is: realisations, cases, or steps."""
    parts = [len(content[name]) for name in ("rows", "seen") if name in content]
    return sum(parts) + int(content.get("cases", 0)) + int(content.get("references", 0)) + int(content.get("count", 0))


def _table(path: Path) -> list[list[str]]:
    text = path.read_bytes().decode()
    assert text.endswith("\n"), "its last line has no end"
    rows = list(csv.reader(io.StringIO(text)))
    assert len({len(row) for row in rows}) == 1, "rows of different lengths"
    return rows


def _image(path: Path) -> Any:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, "no picture"
    return pixels.shape


def _page(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count("<html") == text.count("</html>") and text.strip().endswith(">")


_READERS: dict[str, Callable[[Path], Any]] = {
    ".npy": lambda path: np.load(path).shape,
    ".json": lambda path: json.loads(path.read_text(encoding="utf-8")),
    ".yaml": lambda path: yaml.safe_load(path.read_text(encoding="utf-8")),
    ".csv": _table,
    ".png": _image,
    ".html": _page,
    ".pt": lambda path: torch.load(path, weights_only=True),
}


def _poses(out: Path) -> dict[str, object]:
    """Rows of poses.csv by their frames, without the time that they took."""
    with open(out / "poses.csv", newline="") as stream:
        return {row.pop("frame"): {**row, "milliseconds": ""} for row in csv.DictReader(stream)}
