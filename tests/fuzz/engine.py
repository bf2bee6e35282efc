"""Mutated inputs for one parser at a time, in a child process that may crash, hang or grow without harming its parent.

A target's inputs are numbered: seed and number make an input again. A child works through them in one folder and tells
its parent of each; the parent watches its time and memory, and starts another one where it ends before its time.
"""

import contextlib
import faulthandler
import json
import os
import re
import select
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

Input = dict[str, bytes]  # the files of an input by their paths in its folder

LONGEST = 10.0  # seconds of the processor for one input
LARGEST = 2 << 30  # bytes that one input may add to the resident memory
FULL = 1 << 20  # bytes of an input at most
_PATIENCE = 90.0  # seconds for one input, however busy the machine


class Refused(Exception):
    """What a command line says of an input that it cannot use; its exit status was 2."""


@dataclass(frozen=True)
class Target:
    """A parser with what it is fed.

    Attributes:
        name: Of the target.
        samples: Makes valid inputs, given an empty folder to work in.
        mutate: Another input, of two valid ones.
        read: Runs the parser on a folder that holds the input; fails where what it accepts is no valid result.
        refusals: The kinds of exceptions that tell of a bad input, without those derived from them.
    """

    name: str
    samples: Callable[[Path], list[Input]]
    mutate: Callable[[Random, Input, Input], Input]
    read: Callable[[Path], None]
    refusals: tuple[type[Exception], ...] = (ValueError,)

    def input(self, samples: Sequence[Input], seed: int, number: int) -> Input:
        """Input of this number: the valid ones come first."""
        if number < len(samples):
            return samples[number]
        rng = Random(f"{seed}/{self.name}/{number}")
        made = self.mutate(rng, dict(rng.choice(samples)), rng.choice(samples))
        return {name: data[:FULL] for name, data in made.items()}


@dataclass
class Count:
    """What became of the inputs of a target; ``failures`` by the number of the input."""

    refused: int = 0
    accepted: int = 0
    failures: dict[int, str] = field(default_factory=dict)

    @property
    def inputs(self) -> int:
        """How many there were."""
        return self.refused + self.accepted + len(self.failures)


def fuzz(
    target: Target, folder: Path, *, seconds: float, inputs: int | None = None, seed: int = 0, first: int = 0
) -> Count:
    """Feed a target from input ``first`` on for ``seconds``, or with so many inputs; inputs that fail are kept.

    A failure is any exception but the target's refusals, a refusal without a word, a valid sample that is refused, a
    crash of the process, ``LONGEST`` or ``LARGEST`` exceeded. ``folder/failures/NAME-NUMBER`` gets the input.
    """
    work = folder / f"work-{target.name}"
    shutil.rmtree(work, ignore_errors=True)
    (work / "made").mkdir(parents=True)
    samples = target.samples(work / "made")
    _warm(target, samples[0], work)
    end, number, count = time.monotonic() + seconds, first, Count()
    last = sys.maxsize if inputs is None else first + inputs
    while number < last and time.monotonic() < end:
        number = _watch(target, samples, work, seed, (number, last), end, count)
    for failed, symptom in count.failures.items():
        kept = folder / "failures" / f"{target.name}-{failed}"
        shutil.rmtree(kept, ignore_errors=True)
        with contextlib.suppress(Exception):  # one that cannot be made
            write(kept, target.input(samples, seed, failed))
        kept.mkdir(parents=True, exist_ok=True)
        (kept / "SYMPTOM.txt").write_text(f"seed {seed}, input {failed}\n{symptom}\n")
    shutil.rmtree(work)
    return count


def write(folder: Path, made: Input) -> None:
    """Put the files of an input into a folder."""
    for name, data in made.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _warm(target: Target, sample: Input, work: Path) -> None:
    """Read a valid input once in this process, so that no child has to load its modules again."""
    write(work / "first", sample)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        attempt(target, work / "first")


def _watch(
    target: Target, samples: list[Input], work: Path, seed: int, numbers: tuple[int, int], end: float, count: Count
) -> int:
    """Start a child at an input and follow it to its end; the number of the input to go on with."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        status = 0
        try:
            _work(target, samples, work, seed, numbers, end, writing)
        except BaseException:
            status = 1
            (work / "own.txt").write_text(traceback.format_exc())
        finally:
            os._exit(status)
    os.close(writing)
    number, begun, spent, base, told, symptom = numbers[0], time.monotonic(), _used(child), _resident(child), b"", ""
    while True:
        if select.select([reading], [], [], 0.05)[0]:
            data = os.read(reading, 1 << 16)
            if not data:
                break
            *lines, told = (told + data).split(b"\n")
            for line in lines:
                done, outcome, text = json.loads(line)
                _take(count, done, outcome, text, done < len(samples))
                number, begun, spent = done + 1, time.monotonic(), _used(child)
        if _used(child) - spent > LONGEST or time.monotonic() - begun > _PATIENCE:
            os.kill(child, signal.SIGUSR1)  # it writes down where it is
            time.sleep(0.3)
            symptom = f"takes longer than {LONGEST:g} s"
        elif _resident(child) - base > LARGEST:
            os.kill(child, signal.SIGUSR1)
            time.sleep(0.1)
            symptom = f"takes more than {LARGEST >> 20} MB"
        if symptom:
            os.kill(child, signal.SIGKILL)
            break
    os.close(reading)
    status = os.waitpid(child, 0)[1]
    where = work / "where.txt"
    if os.WIFSIGNALED(status) and not symptom:
        symptom = f"the process was ended by {signal.Signals(os.WTERMSIG(status)).name}"
    elif status and not symptom:
        symptom = f"the input cannot be made: {(work / 'own.txt').read_text()}"
    if symptom:
        found = where.read_text(errors="replace") if where.is_file() else ""
        count.failures[number] = f"{symptom}\n{found}"
        return number + 1
    return number


def _take(count: Count, number: int, outcome: str, text: str, sample: bool) -> None:
    if outcome == "failed" or (sample and outcome == "refused"):
        count.failures[number] = text if outcome == "failed" else f"a valid input is refused: {text}"
    elif outcome == "refused":
        count.refused += 1
    else:
        count.accepted += 1


def _work(
    target: Target, samples: list[Input], work: Path, seed: int, numbers: tuple[int, int], end: float, writing: int
) -> None:
    """The child: input after input, a line for each."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # libraries write there by themselves
    os.dup2(nowhere, 2)
    os.chdir(work)
    with open(work / "where.txt", "wb", buffering=0) as where:
        faulthandler.enable(where)
        faulthandler.register(signal.SIGUSR1, where)
        base = _resident(os.getpid())
        for number in range(*numbers):
            if time.monotonic() > end:
                return
            place = work / "input"
            shutil.rmtree(place, ignore_errors=True)
            write(place, target.input(samples, seed, number))
            _forget_peak()
            outcome, text = attempt(target, place)
            if _peak() - base > LARGEST:
                outcome, text = "failed", f"takes more than {LARGEST >> 20} MB"
            os.write(writing, json.dumps([number, outcome, text]).encode() + b"\n")


def attempt(target: Target, folder: Path) -> tuple[str, str]:
    """Run the parser: accepted, refused or failed, and the message or the traceback."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(folder)
    except BaseException as error:
        # What is derived from a refusal, as UnicodeDecodeError is from ValueError, has only leaked through.
        if type(error) in target.refusals and str(error).strip():
            return "refused", str(error)[:500]
        return "failed", "".join(traceback.format_exception(error))[-6000:]
    return "accepted", ""


def _used(pid: int) -> float:
    """Seconds of the processor that a process has used."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> int:
    """Bytes in memory that are its own: mapped files can be given back at any time."""
    return _status(pid, "RssAnon")


def _peak() -> int:
    """Largest resident memory since :func:`_forget_peak`, without what is mapped from files now."""
    return _status(os.getpid(), "VmHWM") - _status(os.getpid(), "RssFile")


def _status(pid: int, name: str) -> int:
    try:
        match = re.search(rf"{name}:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return 0
    return 1024 * int(match[1]) if match else 0


def _forget_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return  # then the peak is that of all inputs so far
