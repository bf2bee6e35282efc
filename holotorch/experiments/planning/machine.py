"""Speed of this machine relative to the one on which the constants of plans were measured; measured once, then cached.

Only predicted seconds depend on it. No method is chosen by it, so that results are the same on all machines.

The constants of all plans, here and beside the kinds of runs, are seconds on one core (OMP_NUM_THREADS=1) of the
reference machine, an idle x86-64 server with torch 2.13.0. With other numbers of threads the machine is measured anew.
"""

import hashlib
import json
import math
import os
import platform
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from holotorch.core.complex import phasor
from holotorch.core.fourier import fft2
from holotorch.experiments.planning.duration import duration
from holotorch.io.files import cache_folder, read_json, write_json

_VERSION = 1  # of the file; raised when a measurement or a reference time changes
_SMALL, _LARGE = 256, 1024  # sides of the squares that are transformed, in samples
_ELEMENTS = 1 << 18  # samples of the arithmetic element by element
_COPIED = 1 << 22  # float32 samples that are copied, 16 MiB
_LOOPS = 20_000  # rounds of the interpreter
_ROUNDS, _SECONDS = 5, 0.06  # least number of rounds and least time spent on each measurement; the fastest round counts
_WAITS = 3  # times that a measurement is taken again that other programs have disturbed
_DISTURBED = 5.0  # ratio of transforms to Python code above which they have waited for other programs
_PLAUSIBLE = 1e-4, 1e4  # ratios outside are those of a damaged file
# Seconds on one core of the reference machine: times that correspond to a ratio of 1.
_REFERENCE = {"small_fft": 2.0e-4, "large_fft": 5.2e-3, "elementwise": 7.6e-4, "copy": 8.3e-4, "interpreter": 7.5e-4}
_START = 2.5  # seconds on the reference machine from the start of a command to the first computation, and for its page
_FIGURE = 0.45  # seconds on the reference machine to draw one figure
_SCORE = 7e-8, 3e-7  # seconds per score of a float32 value, for pictures that fit into a cache and for larger ones
_CACHED = 1 << 18  # values of pictures that fit into a cache, at most


@dataclass(frozen=True)
class Machine:
    """Times of this machine over those of the reference machine, for the same work; above 1 is slower.

    Attributes:
        small_fft: Fourier transform of 256 x 256 samples, which fit into a cache.
        large_fft: Fourier transform of 1024 x 1024 samples.
        elementwise: exp(i phase) of many samples.
        copy: Copy of 16 MiB.
        interpreter: Python code, which also stands for start-up and figures.
    """

    small_fft: float = 1.0
    large_fft: float = 1.0
    elementwise: float = 1.0
    copy: float = 1.0
    interpreter: float = 1.0

    def fft(self, samples: float) -> float:
        """Ratio for a transform of ``samples`` in total, interpolated between the two measured sizes."""
        small, large = (2 * math.log2(side) for side in (_SMALL, _LARGE))
        share = min(1.0, max(0.0, (math.log2(max(samples, 2)) - small) / (large - small)))
        return self.small_fft ** (1 - share) * self.large_fft**share

    def around(self, figures: int) -> float:
        """Seconds of a command besides its computation: start-up, loading of inputs, ``figures``, and the page."""
        return self.interpreter * (_START + _FIGURE * figures)

    def score(self, values: int, *, double: bool) -> float:
        """Seconds to compare pictures of ``values`` in total with their targets, by SSIM and PSNR."""
        return (2 if double else 1) * values * _SCORE[values > _CACHED] * self.elementwise

    def __str__(self) -> str:
        speeds = ", ".join(f"{name.replace('_', ' ')} {value:.2f}" for name, value in asdict(self).items())
        return f"times relative to the reference machine: {speeds}"


def seconds_in_words(seconds: dict[str, float]) -> str:
    """Parts of predicted seconds for the line of a plan."""
    return "on an idle machine: " + ", ".join(f"{duration(value)} {name}" for name, value in seconds.items())


_known: dict[str, Machine] = {}  # by name of the file


def machine_speed(device: torch.device | str = "cpu") -> Machine:
    """The speed of a device of this machine, from the user's cache folder, or measured within a second or two.

    A file that is missing, damaged, of another version, or of another machine, device, torch or number of threads is
    not used, nor is what was measured while other programs slowed the machine down: a transform takes less than half of
    that time now. If the folder cannot be written, each process measures anew. Random numbers are not touched.
    """
    path = speed_file(device)
    if path.name not in _known:
        stored = _stored(path)
        if stored and stored.small_fft > 2 * _transform(torch.device(device)):
            stored = None
        _known[path.name] = stored or _measure(torch.device(device))
        if stored is None:
            with suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
                write_json(path, {"version": _VERSION, **_identity(device), "ratios": asdict(_known[path.name])})
    return _known[path.name]


def speed_file(device: torch.device | str = "cpu") -> Path:
    """The file in the user's cache folder that holds the speed; without it the speed is measured anew."""
    digest = hashlib.sha256(json.dumps(_identity(device), sort_keys=True).encode()).hexdigest()
    return cache_folder() / f"speed-{digest[:16]}.json"


def _identity(device: torch.device | str) -> dict[str, Any]:
    """What the speed depends on: a home folder may be shared by machines, and a machine by several set-ups."""
    cuda = torch.device(device).type == "cuda"
    return {
        "machine": [platform.node(), platform.machine(), _processor(), os.cpu_count()],
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if cuda else "cpu",
    }


def _processor() -> str:
    with suppress(OSError):
        if match := re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M):
            return match[1]
    return platform.processor()


def _stored(path: Path) -> Machine | None:
    """The speed in a file, or None if the file cannot be used."""
    try:
        content = read_json(path)
        if content["version"] != _VERSION:
            return None
        ratios = {field.name: float(content["ratios"][field.name]) for field in fields(Machine)}
    except (OSError, ValueError, TypeError, KeyError):
        return None
    low, high = _PLAUSIBLE
    return Machine(**ratios) if all(low < value < high for value in ratios.values()) else None


def _measure(device: torch.device) -> Machine:
    """Measure the ratios; each is that of the fastest of several rounds, which other programs disturb least.

    Threads that wait for each other on a busy machine can take a hundred times as long: such a measurement is repeated.
    """
    small, large = (torch.ones(side, side, dtype=torch.complex64, device=device) for side in (_SMALL, _LARGE))
    phases, copied = torch.linspace(0, 6, _ELEMENTS, device=device), torch.ones(_COPIED, device=device)
    work: dict[str, Callable[[], object]] = {
        "small_fft": lambda: fft2(small),
        "large_fft": lambda: fft2(large),
        "elementwise": lambda: phasor(phases),
        "copy": copied.clone,
        "interpreter": lambda: sum(i * i for i in range(_LOOPS)),
    }
    ratios = {name: math.inf for name in work}
    for again in range(1 + _WAITS):
        time.sleep(0.2 * again)
        ratios = {name: min(ratios[name], _fastest(call, device) / _REFERENCE[name]) for name, call in work.items()}
        if max(ratios.values()) < _DISTURBED * ratios["interpreter"]:
            break
    return Machine(**ratios)


def _transform(device: torch.device) -> float:
    """The ratio ``small_fft`` alone, within milliseconds."""
    small = torch.ones(_SMALL, _SMALL, dtype=torch.complex64, device=device)
    return _fastest(lambda: fft2(small), device, 0.0) / _REFERENCE["small_fft"]


def _fastest(call: Callable[[], object], device: torch.device, seconds: float = _SECONDS) -> float:
    call()  # the first call allocates memory and plans the transform
    start, times = time.perf_counter(), []
    while len(times) < _ROUNDS or (times and time.perf_counter() - start < seconds):
        started = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - started)
    return max(min(times), 1e-7)
