"""Log of a study: one line of JSON per trial, which is saved before the next trial begins.

The first line is a header, ``{"format": "holotorch-trials", "version": 1, ...}``; each other line is a trial. Lines are
only ever appended, and each is followed by fsync, so that a crash loses at most the trial on the screen. A line
that a crash cut off has no line end: readers ignore it and set ``torn``, and ``TrialLog`` removes it.
"""

import contextlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError, short
from holotorch.experiments.config.messages import position
from holotorch.experiments.perception.study.records import FORMAT, VERSION, LogHeader, TrialRecord, parse_record
from holotorch.io.files import read_bytes


@dataclass(frozen=True)
class Trials:
    """The content of a log."""

    path: Path
    header: dict[str, Any]  # the first line of the file
    trials: list[dict[str, Any]]  # the other lines in order
    torn: bool  # whether an unfinished line at the end was ignored
    size: int  # bytes up to the end of the last complete line


def read_log(path: Path) -> Trials:
    """Read and check a log.

    Raises:
        ConfigError: The file cannot be read, is empty, has no header, or has lines that are not trials. Every mistake
            is listed as ``file:line:column``.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise ConfigError([f"{path}: cannot read the log: {error.strerror}"]) from None
    complete, _, torn = data.rpartition(b"\n")
    if not complete:
        raise ConfigError([f"{path}:1:1: the log is empty; expected a header and trials written by 'holotorch study'"])
    mistakes: list[str] = []
    header, *trials = [_parse(path, number, line, mistakes) for number, line in enumerate(complete.split(b"\n"), 1)]
    if header is not None:
        if header.get("format") != FORMAT or header.get("version") != VERSION:
            expected = f"expected a header of format {FORMAT}, version {VERSION}"
            raise ConfigError([f"{path}:1:1: not a log of a study: {expected}"])
        try:
            parse_record(LogHeader, header)
        except ValueError as error:
            mistakes.append(f"{path}:1:1: {error}")
    first_lines: dict[tuple[int, int, int], int] = {}  # line number of the first line of each (round, trial, attempt)
    for number, trial in enumerate(trials, 2):
        if trial is None:
            continue
        try:
            record = parse_record(TrialRecord, trial)
        except ValueError as error:
            mistakes.append(f"{path}:{number}:1: not a trial: {error}")
            continue
        key = (record.round, record.trial, record.attempt)
        if key in first_lines:
            mistakes.append(f"{path}:{number}:1: round {key[0]}, trial {key[1]} is already in line {first_lines[key]}")
        elif header is not None and record.participant != (owner := header.get("participant")):
            mistakes.append(f"{path}:{number}:1: participant {record.participant} in the log of {short(owner)}")
        first_lines.setdefault(key, number)
    if mistakes:
        raise ConfigError(sorted(mistakes, key=position))
    return Trials(path, header or {}, [trial for trial in trials if trial], bool(torn), len(data) - len(torn))


def read_logs(paths: Iterable[Path]) -> list[Trials]:
    """Read several logs. ConfigError lists the mistakes in all of them, and participant numbers that occur twice."""
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
            other = f"participant {number} is in {owner[number]} too"
            mistakes.append(f"{log.path}:1:1: {other}; two people need two numbers")
        owner.setdefault(number, log.path)
    if not logs and not mistakes:
        mistakes.append("no logs: expected files such as participant-001.jsonl, written by 'holotorch study'")
    if mistakes:
        raise ConfigError(mistakes)
    return logs


class TrialLog(contextlib.AbstractContextManager["TrialLog"]):
    """Appends trials to a new or existing log; a context manager that closes the log.

    On systems with ``fcntl`` file locks (not Windows), only one program at a time can have a log open.

    Args:
        path: The file; its folder must exist.
        header: Content of the first line, with the key ``participant``. An existing log must have the same header.

    Raises:
        ConfigError: The log is open in another program, cannot be read, or has another header.
        OSError: The log cannot be written.
    """

    def __init__(self, path: Path, header: dict[str, Any]):
        self.path = path
        # The round trip through JSON turns tuples into lists, so that the header equals the one read from the file.
        self.header = json.loads(json.dumps({"format": FORMAT, "version": VERSION, **header}, allow_nan=False))
        self.trials: list[dict[str, Any]] = []
        self._size = 0  # bytes of all complete lines
        # Only the owner can read the file, since it contains personal data.
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
        try:
            self._lock()
            # After a crash, the header itself may be incomplete.
            if b"\n" in path.read_bytes():
                self._continue()
            else:
                self._write(self.header)
                _sync_folder(path.parent)
        except BaseException:
            os.close(self._file)
            raise

    def append(self, trial: dict[str, Any]) -> None:
        """Write a trial to the disk. ValueError for a dictionary that is not a trial."""
        try:
            parse_record(TrialRecord, trial)
        except ValueError as error:
            raise ValueError(f"not a trial: {error}") from None
        self._write(trial)
        self.trials.append(trial)

    def close(self) -> None:
        """Close the file; ``append`` then raises OSError."""
        os.close(self._file)
        self._file = -1

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
            busy = f"participant {self.header.get('participant')} is being recorded by another program"
            raise ConfigError([f"{self.path}: {busy}; two people need two numbers"]) from None

    def _continue(self) -> None:
        log = read_log(self.path)
        for key in sorted(self.header.keys() | log.header.keys()):
            begun, now = log.header.get(key), self.header.get(key)
            if begun != now:
                change = f"this log was begun with another {key}: {short(begun)}, now {short(now)}"
                cure = "restore the configuration, or choose another participant or another folder"
                raise ConfigError([f"{self.path}:1:1: {change}; {cure}"])
        os.ftruncate(self._file, log.size)
        self.trials, self._size = log.trials, log.size

    def _write(self, value: dict[str, Any]) -> None:
        line = memoryview(json.dumps(value, allow_nan=False, ensure_ascii=False).encode() + b"\n")
        end = self._size + len(line)
        try:
            os.ftruncate(self._file, self._size)  # removes an incomplete line of an earlier failure
            while line:  # os.write may write only a part
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:  # such as a full disk: only complete lines are kept
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
    except (ValueError, RecursionError):  # a number has thousands of digits, or brackets are nested too deeply
        mistakes.append(f"{path}:{number}:1: not a line of JSON that can be read")
    else:
        if isinstance(value, dict):
            return value
        mistakes.append(f"{path}:{number}:1: expected {{...}}, got {short(value)}")
    return None


def _sync_folder(folder: Path) -> None:
    """Write the folder's entry for a new file to the disk, on systems that can open folders."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
