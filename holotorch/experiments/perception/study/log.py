"""Log of a study: one line of JSON per trial, on the disk before the next trial begins.

The first line is a header, ``{"format": "holotorch-trials", "version": 1, ...}``; each other line is a trial. Lines are
only ever appended, each in one write followed by fsync, so that whatever ends the program costs the trial on the screen
at most. What a crash leaves of a line has no line end; readers leave it out and say so, and ``TrialLog`` cuts it off.
"""

import contextlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import position
from holotorch.io.files import read_bytes

FORMAT, VERSION = "holotorch-trials", 1
_NUMBERS = ("eccentricity_deg", "size_deg", "onset_s", "frame_s")
_COUNTS = ("participant", "round", "trial")
_FLAGS = ("target", "practice", "responded")
_TEXTS = ("design", "time_utc")


@dataclass
class Trials:
    """What a log holds.

    Attributes:
        path: The file.
        header: Its first line.
        trials: The others, as dictionaries, in order.
        torn: Whether an unfinished line at the end was left out.
        size: Bytes up to the end of the last whole line.
    """

    path: Path
    header: dict[str, Any]
    trials: list[dict[str, Any]] = field(default_factory=list)
    torn: bool = False
    size: int = 0


def read_log(path: Path) -> Trials:
    """Read and check a log.

    Raises:
        ConfigError: It cannot be read, is empty, has no header, or has lines that are no trials: all of them, a line
            each, as ``file:line:column``.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise ConfigError([f"{path}: cannot read the log: {error.strerror}"]) from None
    whole, _, rest = data.rpartition(b"\n")
    lines = whole.split(b"\n") if whole else []
    if not lines:
        raise ConfigError([f"{path}:1:1: the log is empty; expected a header and trials written by 'holotorch study'"])
    mistakes: list[str] = []
    found = [_parse(path, number, line, mistakes) for number, line in enumerate(lines, 1)]
    header = found[0]
    if header is not None and (header.get("format") != FORMAT or header.get("version") != VERSION):
        raise ConfigError(
            [f"{path}:1:1: not a log of a study: expected a header of format {FORMAT}, version {VERSION}"]
        )
    if header is not None and not _is_whole(header.get("participant")):
        mistakes.append(f"{path}:1:1: participant: expected a whole number, got {_short(header.get('participant'))}")
    seen: dict[tuple[int, int], int] = {}
    for number, trial in enumerate(found[1:], 2):
        if trial is None:
            continue
        if problem := _problem(trial):
            mistakes.append(f"{path}:{number}:1: not a trial: {problem}")
            continue
        key = (trial["round"], trial["trial"])
        if key in seen:
            mistakes.append(f"{path}:{number}:1: round {key[0]}, trial {key[1]} stands in line {seen[key]} already")
        elif header is not None and trial["participant"] != (owner := header.get("participant")):
            mistakes.append(f"{path}:{number}:1: participant {trial['participant']} in the log of {_short(owner)}")
        seen.setdefault(key, number)
    if mistakes:
        raise ConfigError(sorted(mistakes, key=position))
    return Trials(path, found[0] or {}, [trial for trial in found[1:] if trial], bool(rest), len(data) - len(rest))


def read_logs(paths: Iterable[Path]) -> list[Trials]:
    """Read several logs; ConfigError lists what is wrong with all of them, and a number that two participants have."""
    logs: list[Trials] = []
    mistakes: list[str] = []
    for path in paths:
        try:
            logs.append(read_log(path))
        except ConfigError as error:
            mistakes += error.mistakes
    owner: dict[Any, Path] = {}
    for log in logs:
        number = log.header.get("participant")
        if number in owner:
            mistakes.append(
                f"{log.path}:1:1: participant {number} is in {owner[number]} too; two people need two numbers"
            )
        owner.setdefault(number, log.path)
    if not logs and not mistakes:
        mistakes.append("no logs: expected files such as participant-001.jsonl, written by 'holotorch study'")
    if mistakes:
        raise ConfigError(mistakes)
    return logs


class TrialLog:
    """Appends trials to a log, new or begun before; a context that closes it.

    Only one program at a time can have a log open, where the system has file locks (not on Windows).
    """

    def __init__(self, path: Path, header: dict[str, Any]):
        """Open a log.

        Args:
            path: The file; its folder must be there.
            header: What the first line says; must hold ``participant``. A log that was begun must say the same.

        Raises:
            ConfigError: Another program has it open, it cannot be read, or it was begun with another header.
            OSError: It cannot be written.
        """
        self.path = path
        # As it reads back: tuples become lists.
        self.header = json.loads(json.dumps({"format": FORMAT, "version": VERSION, **header}, allow_nan=False))
        self.trials: list[dict[str, Any]] = []
        self._size = 0  # of the whole lines, in bytes
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)  # answers of a person
        try:
            self._lock()
            # A crash may have come before the header was whole.
            if b"\n" in path.read_bytes():
                self._continue()
            else:
                self._write(self.header)
                _sync_folder(path.parent)
        except BaseException:
            os.close(self._file)
            raise

    def append(self, trial: dict[str, Any]) -> None:
        """Write a trial to the disk; ValueError for what is not a trial."""
        if problem := _problem(trial):
            raise ValueError(f"not a trial: {problem}")
        self._write(trial)
        self.trials.append(trial)

    def close(self) -> None:
        """Close the file; what is appended from then on is refused with OSError."""
        os.close(self._file)
        self._file = -1

    def __enter__(self) -> "TrialLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            number = self.header.get("participant")
            raise ConfigError(
                [f"{self.path}: participant {number} is being recorded by another program; two people need two numbers"]
            ) from None

    def _continue(self) -> None:
        log = read_log(self.path)
        for key in sorted(self.header.keys() | log.header.keys()):
            if self.header.get(key) != log.header.get(key):
                raise ConfigError(
                    [
                        f"{self.path}:1:1: this log was begun with another {key}: {_short(log.header.get(key))}, now "
                        f"{_short(self.header.get(key))}; restore the configuration, or choose another participant "
                        "or another folder"
                    ]
                )
        os.ftruncate(self._file, log.size)
        self.trials, self._size = log.trials, log.size

    def _write(self, value: dict[str, Any]) -> None:
        line = memoryview(json.dumps(value, allow_nan=False, ensure_ascii=False).encode() + b"\n")
        end = self._size + len(line)
        try:
            os.ftruncate(self._file, self._size)  # what a failure left of a line, and could not cut off
            while line:  # a single call may write less
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:  # a full disk: leave whole lines only
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._size)
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self._size = end


def _parse(path: Path, number: int, line: bytes, mistakes: list[str]) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except json.JSONDecodeError as error:
        mistakes.append(f"{path}:{number}:{error.colno}: not a line of JSON: {error.msg}")
    except UnicodeDecodeError as error:
        mistakes.append(f"{path}:{number}:{error.start + 1}: not UTF-8 text")
    except (ValueError, RecursionError):  # a number of thousands of digits; brackets without end
        mistakes.append(f"{path}:{number}:1: not a line of JSON that can be read")
    else:
        if isinstance(value, dict):
            return value
        mistakes.append(f"{path}:{number}:1: expected {{...}}, got {_short(value)}")
    return None


def _problem(trial: dict[str, Any]) -> str:
    """What is wrong with a trial, or nothing."""
    wanted = {
        **{name: (is_number, "a finite number") for name in _NUMBERS},
        **{name: (_is_whole, "a whole number") for name in _COUNTS},
        **{name: (lambda v: isinstance(v, bool), "true or false") for name in _FLAGS},
        **{name: (lambda v: isinstance(v, str), "text") for name in _TEXTS},
        "pattern": (lambda v: v in ("cross", "circle"), "cross or circle"),
        **{name: (lambda v: v is None or is_number(v), "a number or null") for name in ("response_s", "reaction_s")},
    }
    for name, (right, words) in wanted.items():
        if name not in trial:
            return f"{name} is missing"
        if not right(trial[name]):
            return f"{name}: expected {words}, got {_short(trial[name])}"
    if trial["responded"] == (trial["reaction_s"] is None) or trial["responded"] == (trial["response_s"] is None):
        return "response_s and reaction_s: expected numbers where responded is true, and null where it is false"
    if trial["frame_s"] <= 0 or (trial["responded"] and trial["reaction_s"] < 0):
        return "expected frame_s above 0 and reaction_s not below 0"
    return ""


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number, as true and false are not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _sync_folder(folder: Path) -> None:
    """Make a new file's name as lasting as its content; folders cannot be opened everywhere."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
