"""Speed as ratios: contenders take turns in one process, and each time is divided by the baseline's of the same round.

Usage: python scripts/bench.py [--against CHECKOUT | --json FILE | --compare FILE] [SUBJECT ...]; without a subject, all
of them. With ``--against``, every contender of this checkout takes turns with the same one of another, whose times are
the baseline. ``--json`` writes the machine, the commit and the median and quartiles of every ratio to a file.
``--compare`` measures again, names the contenders whose ratio grew since that file was written, and then exits with 1.
"""

import argparse
import datetime
import importlib.util
import json
import os
import platform
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from ratios import FACTOR, Ratio, faster, from_json, missing, ratios, slower, to_json
from torch.nn import functional

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.fourier import convolve
from holotorch.hologram import AxialHologram, ConvolutionHologram, plan_hologram
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import AngularSpectrum, Display, Eye, Propagator, Retina, propagate

ROUNDS = 15
WARM_UP = 2  # rounds before those that count
Contenders = dict[str, Callable[[], object]]


def crosstalk() -> Iterator[tuple[str, Contenders]]:
    """Heat spreading, forward and backward, three colours: conv2d is the baseline."""
    for size in (128, 256, 512):
        module, learned = ThermalCrosstalk(0.66, 7), ThermalCrosstalk(0.66, 7, learnable=True)
        kernel = module.kernel.float()[None, None]
        phase = torch.rand(3, 1, size, size, requires_grad=True)

        def backward(spread: torch.Tensor, phase: torch.Tensor = phase) -> object:
            return torch.autograd.grad(spread.sum(), phase)

        yield (
            f"{size} px, forward and backward",
            {
                "conv2d": lambda p=phase, k=kernel, b=backward: b(functional.conv2d(p, k, padding=3)),
                "ThermalCrosstalk": lambda p=phase, m=module, b=backward: b(m(p)),
                "ThermalCrosstalk, sigma learned": lambda p=phase, m=learned, b=backward: b(m(p)),
            },
        )
    phase = torch.rand(3, 256, 256)
    for taps in (15, 31, 61):
        wide = ThermalCrosstalk(2.0, taps)
        kernel = wide.kernel.float()
        yield (
            f"256 px, Gaussian of {taps} taps",
            {
                "FFT": lambda k=kernel: convolve(phase, k),
                "ThermalCrosstalk": lambda m=wide: m(phase),
            },
        )


def propagation() -> Iterator[tuple[str, Contenders]]:
    """Two FFTs on twice the window with a ready complex64 kernel are the baseline for everything planned."""
    for size in (256, 512, 1024):
        grid, distance = Grid(size, 8e-6), 0.1
        field = torch.randn(size, size, dtype=torch.complex64)
        traced = field.clone().requires_grad_()
        kernel = torch.randn(2 * size, 2 * size, dtype=torch.complex64)
        module, near = Propagator(grid, 530e-9, distance), Propagator(grid, 530e-9, 5e-3, tolerance=1e-2)
        unpadded = AngularSpectrum(grid, 530e-9, 5e-3)

        def bare(field: torch.Tensor = field, kernel: torch.Tensor = kernel, size: int = size) -> torch.Tensor:
            # Not scaled: torch's own scaling is wrong at 2048 x 2048 on some CPUs (see holotorch.core.fourier).
            spectrum = torch.fft.fft2(field, s=kernel.shape[-2:])
            return torch.fft.ifft2(spectrum * kernel, norm="forward")[..., :size, :size]

        def both(module: Propagator = module, traced: torch.Tensor = traced) -> object:
            return torch.autograd.grad(intensity(module(traced[None])).sum(), traced)

        yield (
            f"{size} px",
            {
                "bare FFTs, pad 2": bare,
                "AngularSpectrum": lambda m=unpadded, f=field: m(f[None]),
                "planned, 100 mm": lambda m=module, f=field: m(f[None]),
                "planned, forward and backward": both,
                "propagate, plan and kernel remembered": lambda f=field, g=grid, z=distance: propagate(f, g, 530e-9, z),
                "planned, 5 mm, 1e-2": lambda m=near, f=field: m(f[None]),
            },
        )


def learning() -> Iterator[tuple[str, Contenders]]:
    """Forward and backward in a training loop; a fixed Propagator is the baseline."""
    warnings.simplefilter("ignore", SamplingWarning)
    distance = 0.05
    for size in (64, 256, 512):
        grid = Grid(size, 8e-6)
        field = torch.randn(1, size, size, dtype=torch.complex64, requires_grad=True)
        fixed, learned = (Propagator(grid, 530e-9, distance, learnable=each) for each in (False, True))
        z = torch.tensor(distance, dtype=torch.float64, requires_grad=True)
        moved = lambda f, g=grid, z=z: propagate(f, g, 530e-9, z)  # noqa: E731
        planned = lambda f, g=grid, p=fixed.plan: propagate(f, g, 530e-9, distance, plan=p)  # noqa: E731
        plain = lambda f, g=grid: propagate(f, g, 530e-9, distance)  # noqa: E731
        yield (
            f"{size} px, one call",
            {
                "Propagator": lambda m=fixed, f=field: m(f),
                "propagate with plan=": lambda m=planned, f=field: m(f),
                "propagate, remembered": lambda m=plain, f=field: m(f),
            },
        )
        yield (
            f"{size} px, one step",
            {
                "Propagator": lambda m=fixed, f=field: intensity(m(f)).sum().backward(),
                "Propagator, distance learned": lambda m=learned, f=field: intensity(m(f)).sum().backward(),
                "propagate, distance learned": lambda m=moved, f=field: intensity(m(f)).sum().backward(),
            },
        )
    grid, wavelengths = Grid(256, 8e-6), (640e-9, 520e-9, 450e-9)
    field = torch.randn(3, 256, 256, dtype=torch.complex64, requires_grad=True)
    propagator = Propagator(grid, wavelengths, 0.05)
    flat = Retina(grid, wavelengths, Display.planar(0.25), Eye(accommodation=0.25))
    magnified = Retina(grid, wavelengths, Display(0.05, 0.05, 0.05), Eye(accommodation=1.0))
    yield (
        "256 px, three colours, one step",
        {
            "Propagator": lambda: intensity(propagator(field)).sum().backward(),
            "Retina, planar display": lambda: flat(field).sum().backward(),
            "Retina, eyepiece": lambda: magnified(field).sum().backward(),
        },
    )


def distances() -> Iterator[tuple[str, Contenders]]:
    """Eight distances in one call; eight calls are the baseline."""
    for size in (256, 512):
        grid, field = Grid(size, 8e-6), torch.randn(size, size, dtype=torch.complex64)
        eight = torch.linspace(0.05, 0.4, 8, dtype=torch.float64)

        def one_by_one(f: torch.Tensor = field, g: Grid = grid, z: torch.Tensor = eight) -> object:
            return [propagate(f, g, 530e-9, distance) for distance in z.tolist()]

        together = {"together": lambda f=field, g=grid, z=eight: propagate(f[None], g, 530e-9, z)}
        yield f"{size} px", {"one by one": one_by_one, **together}


def peer() -> Iterator[tuple[str, Contenders]]:
    """Torchoptics (extra ``bench``) at 512 px and every distance; the planned way, tolerance 1e-3, is the baseline."""
    try:
        from torchoptics import Field  # type: ignore[import-not-found]
    except ImportError:
        sys.exit("peer needs torchoptics: pip install torchoptics")
    field = torch.randn(512, 512, dtype=torch.complex64)
    for pitch in (8e-6, 3.74e-6):
        for distance in (1e-3, 5e-3, 20e-3, 60e-3, 200e-3, 2.0):
            module = Propagator(Grid(512, pitch), 530e-9, distance)

            def theirs(pitch: float = pitch, distance: float = distance) -> object:
                return Field(field, wavelength=530e-9, z=0, spacing=pitch).propagate_to_z(distance)

            case = f"{pitch * 1e6:g} um, {distance * 1e3:g} mm"
            yield case, {"planned": lambda m=module: m(field[None]), "torchoptics": theirs}


def tracking() -> Iterator[tuple[str, Contenders]]:
    """Catheters on synthetic 1080p frames; the thesis's pipeline in OpenCV is the baseline."""
    from holotorch.experiments.tracking_benchmark.methods import as_camera, methods
    from holotorch.tracking.simulation.trials import conditions
    from holotorch.tracking.simulation.world import World

    world = World()
    trackers = methods(world)
    for case in (case for case in conditions(world) if case.name in ("plain", "cloth as band 3", "heavy clutter")):
        frame = as_camera(case.frame())
        yield case.name, {name: lambda t=track, f=frame, c=case: t(f, c) for name, track in trackers.items()}


def holograms() -> Iterator[tuple[str, Contenders]]:
    """Holograms of 16 planes of sources; one convolution per plane is the baseline."""
    for size, depths in ((128, (0.02, 0.03)), (256, (0.05, 0.06))):
        grid, listed = Grid(size, 8e-6), torch.linspace(*depths, 16, dtype=torch.float64).tolist()
        sources = torch.randn(16, size, size, dtype=torch.complex64)
        convolution, axial = ConvolutionHologram(grid, 530e-9, listed), AxialHologram(grid, 530e-9, listed)
        yield (
            f"{size} px, 16 planes",
            {
                "convolution": lambda m=convolution, s=sources: m(s),
                "axial nodes": lambda m=axial, s=sources: m(s),
                "plan": lambda g=grid, z=listed, n=size: plan_hologram(g, 530e-9, z, (n, n)),
            },
        )


SUBJECTS = {
    "crosstalk": crosstalk,
    "propagation": propagation,
    "learning": learning,
    "distances": distances,
    "peer": peer,
    "holograms": holograms,
    "tracking": tracking,
}


def seconds(call: Callable[[], object]) -> float:
    """Of one call."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def measure(contenders: Contenders) -> dict[str, list[float]]:
    """Seconds of each contender in each of ROUNDS rounds, in which all of them take one turn."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(WARM_UP + ROUNDS):
        for name, call in contenders.items():
            taken = seconds(call)
            if turn >= WARM_UP:
                times[name].append(taken)
    return times


def measured(names: list[str]) -> Iterator[list[Ratio]]:
    """The ratios of each case of the subjects in turn, printed as they come."""
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads; medians of {ROUNDS} interleaved rounds")
    for name in names:
        for case, contenders in SUBJECTS[name]():
            found = ratios(name, case, measure(contenders))
            for each in found:
                of_baseline = f"{each.milliseconds:9.3f} ms  {each.median:6.3f} of the baseline"
                print(f"{name:12} {case:30} {each.contender:30} {of_baseline}", flush=True)
            yield found


def machine() -> dict[str, Any]:
    """What the times depend on besides the code."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    cpu = {"cpu": model or platform.processor() or platform.machine(), "cores": os.cpu_count()}
    return cpu | {"torch": torch.__version__, "threads": torch.get_num_threads()}


def about() -> dict[str, Any]:
    """Machine, commit and date of a file of ratios."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        commit = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:  # no git
        commit = ""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"machine": machine(), "commit": commit, "date": now, "rounds": ROUNDS}


def compare_file(names: list[str], path: Path, factor: float) -> int:
    """Measure again, and print which contenders became slower since the file was written; 1 if any did.

    A suspect's subject is measured a second time, and only what is slower in both counts: other work on the machine
    that comes and goes can slow one contender of a case during a few rounds.
    """
    content = json.loads(path.read_text())
    before = from_json(content)
    known = {each.subject for each in before}
    if differs := [key for key, value in machine().items() if content["machine"].get(key) != value]:
        print(f"{path} is of another machine: {', '.join(differs)} differ, so that ratios may, too")
    names = [name for name in names if name in known]
    if not names:
        sys.exit(f"{path} has only the subjects {', '.join(sorted(known))}")
    after = [each for case in measured(names) for each in case]
    suspects = slower(before, after, factor)
    if suspects:
        again = list(dict.fromkeys(change.after.subject for change in suspects))
        print(f"measured once more, since something seems slower: {', '.join(again)}")
        both = {each.after.key for each in slower(before, [r for case in measured(again) for r in case], factor)}
        suspects = [change for change in suspects if change.after.key in both]
    for change in faster(before, after, factor):
        print(f"faster, or its baseline is slower: {change}")
    for key in missing(before, after):
        print(f"only in one of both: {', '.join(key)}")
    for change in suspects:
        print(f"slower: {change}")
    print(f"{len(suspects)} of {len(after)} ratios grew by more than {factor:g} and beyond their quartiles")
    return 1 if suspects else 0


def answer(names: list[str]) -> None:
    """Serve :func:`compare`: state every contender, then time one call of it for every line that comes."""
    for name in names:
        for case, contenders in SUBJECTS[name]():
            for contender, call in contenders.items():
                print(f"{name}\t{case}\t{contender}", flush=True)
                for line in sys.stdin:
                    if line == "next\n":
                        break
                    print(seconds(call), flush=True)


def compare(names: list[str], other: Path) -> None:
    """Print one line per contender and case: its time here, and that over its time in the other checkout."""
    checkouts = (Path(__file__).resolve().parents[1], other.resolve())
    sides = []
    for checkout in checkouts:
        command = [sys.executable, __file__, "--answer", *names]
        environment = os.environ | {"PYTHONPATH": str(checkout)}
        sides.append(
            subprocess.Popen(command, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        )
    print(
        f"torch {torch.__version__}; medians of {ROUNDS} rounds in which {checkouts[0]} and {checkouts[1]} take turns"
    )

    def ask(side: subprocess.Popen[str], what: str) -> str:
        assert side.stdin is not None and side.stdout is not None
        side.stdin.write(what)
        side.stdin.flush()
        return side.stdout.readline()

    ratios = []
    stated = [ask(side, "") for side in sides]
    while all(stated):
        if stated[0] != stated[1]:
            sys.exit(f"the checkouts' contenders differ: {stated[0]!r} and {stated[1]!r}")
        rounds = [[float(ask(side, "go\n")) for side in sides] for _ in range(WARM_UP + ROUNDS)][WARM_UP:]
        here, there = (statistics.median(times) for times in zip(*rounds, strict=True))
        ratios.append(statistics.median(one / two for one, two in rounds))
        name, case, contender = stated[0].rstrip("\n").split("\t")
        print(
            f"{name:12} {case:30} {contender:30} {here * 1e3:9.3f} ms, {there * 1e3:9.3f} ms there: {ratios[-1]:6.3f}",
            flush=True,
        )
        stated = [ask(side, "next\n") for side in sides]
    print(f"median of {len(ratios)} ratios: {statistics.median(ratios):.3f}")


def main() -> None:
    """Print one line per contender and case."""
    parser = argparse.ArgumentParser(description="Speed as ratios.")
    parser.add_argument("subjects", nargs="*", help=f"of {', '.join(SUBJECTS)}; all of them by default")
    ways = parser.add_mutually_exclusive_group()
    ways.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout of this project")
    ways.add_argument("--json", type=Path, metavar="FILE", help="write machine, commit, date and all ratios")
    ways.add_argument("--compare", type=Path, metavar="FILE", help="measure again; exit 1 if a ratio of FILE grew")
    about_factor = f"by how much it must have grown, with --compare (default: {FACTOR:g})"
    parser.add_argument("--factor", type=float, default=FACTOR, help=about_factor)
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    # Without the package of the peer, all subjects are all others.
    installed = importlib.util.find_spec("torchoptics") is not None
    names = asked.subjects or [name for name in SUBJECTS if name != "peer" or installed]
    unknown = [name for name in names if name not in SUBJECTS]
    if unknown:
        sys.exit(f"unknown subject {', '.join(unknown)}; known: {', '.join(SUBJECTS)}")
    if asked.answer:
        return answer(names)
    if asked.against:
        if not (asked.against / "holotorch").is_dir():
            sys.exit(f"--against expects a checkout with a folder holotorch, got {asked.against}")
        return compare(names, asked.against)
    if asked.compare:
        if not asked.compare.is_file():
            sys.exit(f"--compare expects a file that --json wrote, got {asked.compare}")
        sys.exit(compare_file(names, asked.compare, asked.factor))
    found = [each for case in measured(names) for each in case]
    if asked.json:
        asked.json.write_text(json.dumps(to_json(found, about()), indent=2) + "\n")


if __name__ == "__main__":
    main()
