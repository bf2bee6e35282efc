"""Threads of a command on a machine that other programs use, too.

The threads of torch wait for each other after every operation. If another program holds one of the processors, each
operation lasts as long as the turn of that program: a transform of 256 x 256 samples 16 ms instead of 0.1 ms.
"""

import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from holotorch.core.fourier import fft2
from holotorch.io.files import read_json

_SIDE, _SECONDS = 512, 0.06  # samples along each side of the transform that is timed, and time spent on it
_GAIN = 1.5  # ratio of times above which fewer threads are taken
_FULL = 0.85  # share of a processor's time below which predicted seconds are said to be too few
_WATCHED = 0.2  # seconds over which that share is measured: other programs take turns of some milliseconds


@contextmanager
def undisturbed(resumed: Path | None = None) -> Iterator[None]:
    """Compute within this block with fewer threads if that is faster now, and say so.

    Where other programs take a part of the processor's time, a line says by how much the predicted seconds, those of an
    idle machine, fall short. OMP_NUM_THREADS, where it is set, is followed, and nothing is measured. A run that is
    ``resumed`` goes on with as many threads as it was begun with, since sums of another number of threads are rounded
    otherwise. The number of before is restored.
    """
    before = torch.get_num_threads()
    chosen, why = before, "other programs use the processors"
    if "OMP_NUM_THREADS" not in os.environ:
        begun = None if resumed is None else _begun(resumed)
        chosen, why = (_fastest(before), why) if begun is None else (begun, "as the run was begun")
    if chosen != before:
        print(f"Threads    {chosen}, not {before}: {why} (OMP_NUM_THREADS={before} before the command changes that)")
    torch.set_num_threads(chosen)  # the comparison has changed it
    if "OMP_NUM_THREADS" not in os.environ and (share := _share()) < _FULL:
        print(f"Busy       this takes about {1 / share:.1f} times the predicted seconds, which are of an idle machine")
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _fastest(most: int) -> int:
    """The number of threads, ``most`` or fewer, with which small operations take the least time now."""
    if most == 1:
        return most
    times = {count: _mean_seconds(count) for count in (most, 1)}
    if times[most] < _GAIN * times[1]:
        return most
    times |= {count: _mean_seconds(count) for count in (most - 1, most // 2) if count > 1}
    return min(times, key=times.__getitem__)


def _mean_seconds(threads: int) -> float:
    """Mean time of a transform with so many threads; not the least, since other programs disturb only some."""
    torch.set_num_threads(threads)
    samples = torch.ones(_SIDE, _SIDE, dtype=torch.complex64)
    fft2(samples)
    began, count = time.perf_counter(), 0
    while (seconds := time.perf_counter() - began) < _SECONDS:
        fft2(samples)
        count += 1
    return seconds / max(1, count)


def _share() -> float:
    """Share of a processor's time that this thread gets now."""
    began, worked = time.perf_counter(), time.thread_time()
    while (seconds := time.perf_counter() - began) < _WATCHED:
        pass
    return (time.thread_time() - worked) / seconds


def _begun(folder: Path) -> int | None:
    """Threads with which the run in a folder was begun; None if it does not say or used a GPU."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        if match := re.fullmatch(r"CPU, (\d+) threads", read_json(folder / "env.json")["device"]):
            return min(max(1, int(match[1])), os.cpu_count() or 1)
    return None
