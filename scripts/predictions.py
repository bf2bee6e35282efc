"""Predictions of whole commands beside what is measured: seconds on an idle machine, or with --memory the peak memory.

OMP_NUM_THREADS=1 python scripts/predictions.py [--memory | --charts] [--out FILE]

--charts draws in full every chart that states its memory, in an hour or more, and compares the peak with that.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from holotorch.experiments.chart import CHARTS

# Name and words of ``holotorch run``.
RUNS = {
    "pec fourier": ["configs/pec/fourier.yaml", "report.baselines=[]"],
    "pec fourier, baselines": ["configs/pec/fourier.yaml"],
    "pec fourier, 48 px": ["configs/pec/fourier.yaml", "grid.shape=[48, 48]"],
    "pec fourier, 512 px": ["configs/pec/fourier.yaml", "grid.shape=[512, 512]", "solver.max_steps=40"],
    "pec capped": ["configs/pec/capped.yaml", "report.baselines=[]"],
    "pec capped, baselines": ["configs/pec/capped.yaml"],
    "pec fresnel": ["configs/pec/fresnel.yaml", "report.baselines=[]"],
    "pec depths": ["configs/pec/depths.yaml"],
    "pec peripheral": ["configs/pec/peripheral.yaml"],
    "volume c60": ["configs/volume/c60.yaml", "scale=4"],
    "volume c60, finer": ["configs/volume/c60.yaml", "scale=2"],
    "volume engine": ["configs/volume/engine.yaml", "volume={phantom: shells}", "scale=4"],
    "eye, laser": [
        "configs/eye/teapot.yaml",
        "scene={config: configs/volume/c60.yaml, change: ['hologram={shape: [256, 256], pitch: 3.74 um, "
        "distance: 30 mm, depths: 29, rays: 128}']}",
        "light={sources: [laser]}",
        "seeds=1",
    ],
    "joint c60": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "report.baselines=[]", "steps=20"],
    "joint c60, baselines": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "steps=20"],
    "joint c60, 48 px": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "display.shape=[48, 48]", "frames=5"],
}

LARGE_VOLUME = "hologram={shape: [2048, 2048], pitch: 3.74 um, distance: 60 mm, depths: 24, rays: 1024}"
LARGE_VIEW = (
    "scene={config: configs/volume/c60.yaml, change: ['hologram={shape: [1024, 1024], pitch: 3.74 um, distance: 30 mm, "
    "depths: 29, rays: 256}']}"
)
FAST = ["report.baselines=[none]"]  # without those that take minutes
# The same for memory: few steps and planes, on which the peak does not depend, and sizes with large arrays.
MEMORY_RUNS = {
    "demo, correction": ["configs/demo.yaml", "solver.max_steps=5"],
    "demo, volume": ["configs/demo_volume.yaml", "report.seeds=1"],
    "pec fourier": ["configs/pec/fourier.yaml", "solver.max_steps=5"],
    "pec capped": ["configs/pec/capped.yaml", "solver.max_steps=5"],
    "pec fresnel": ["configs/pec/fresnel.yaml", "solver.max_steps=5"],
    "pec depths": ["configs/pec/depths.yaml", "solver.max_steps=5"],
    "pec peripheral": ["configs/pec/peripheral.yaml", "solver.max_steps=5"],
    "pec fourier, 1024 px": ["configs/pec/fourier.yaml", "grid.shape=[1024, 1024]", "solver.max_steps=3"],
    "pec capped, 512 px": ["configs/pec/capped.yaml", "grid.shape=[512, 512]", "solver.max_steps=5", *FAST],
    "pec fresnel, 512 px": ["configs/pec/fresnel.yaml", "grid.shape=[512, 512]", "solver.max_steps=3", *FAST],
    "pec depths, 512 px": ["configs/pec/depths.yaml", "grid.shape=[512, 512]", "solver.max_steps=5", *FAST],
    **{
        f"volume {name}": [f"configs/volume/{name}.yaml", *(["volume={phantom: shells}"] * (name != "c60")), "scale=8"]
        for name in ("tooth", "c60", "teapot", "engine", "hand", "bonsai")
    },
    "volume c60, 1024 px": ["configs/volume/c60.yaml", "scale=2"],
    "volume hand, 2048 px": ["configs/volume/hand.yaml", "volume={phantom: shells}", LARGE_VOLUME],
    "eye, laser": RUNS["eye, laser"],
    "eye, laser, 1024 px": [
        *("configs/eye/teapot.yaml", LARGE_VIEW, "light={sources: [laser]}", "seeds=1", "focus=[30 mm]")
    ],
    "joint c60": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "steps=3"],
    "joint c60, 48 px": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "display.shape=[48, 48]", "steps=3"],
    "joint c60, 256 px": [
        *("configs/joint/teapot.yaml", "volume={phantom: c60}", "display.shape=[256, 256]", "steps=3"),
        "report.baselines=[]",
    ],
}


def _carry_out(words: list[str], out: Path) -> tuple[float, resource.struct_rusage]:
    """Seconds that the command ``holotorch`` takes with these words, and what it and its processes use."""
    started = time.perf_counter()
    command = [sys.executable, "-m", "holotorch", *words, "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return time.perf_counter() - started, used


def _run(words: list[str]) -> tuple[dict, float, resource.struct_rusage]:
    """Plan of ``holotorch run`` with these words, seconds that the command takes, and what it uses."""
    with tempfile.TemporaryDirectory() as folder:
        seconds, used = _carry_out(["run", *words], Path(folder) / "run")
        return json.loads((Path(folder) / "run" / "plan.json").read_text()), seconds, used


def _seconds(words: list[str]) -> tuple[str, float]:
    """Words about the seconds of a run, and measured / predicted; on a busy machine the processor works for fewer."""
    plan, measured, used = _run(words)
    ratio = measured / max(plan["predicted_seconds"], 1e-3)
    worked = used.ru_utime + used.ru_stime
    return f"{plan['predicted_seconds']:.3g}, {measured:.3g} ({worked:.3g}), {ratio:.2f}", ratio


def _memory(words: list[str]) -> tuple[str, float]:
    """Words about the peak memory of a run, and stated / measured."""
    plan, _, used = _run(words)
    return _stated(plan["predicted_peak_bytes"], used)


def _chart(words: list[str]) -> tuple[str, float]:
    """Words about the peak memory of a chart, and stated / measured."""
    with tempfile.TemporaryDirectory() as folder:
        _, used = _carry_out(["chart", *words], Path(folder))
    return _stated((CHARTS[words[0]].gigabytes or 0.0) * 1e9, used)


def _stated(stated: float, used: resource.struct_rusage) -> tuple[str, float]:
    measured = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    ratio = stated / measured
    return f"{stated / 1e9:.3f}, {measured / 1e9:.3f}, {ratio:.2f}", ratio


def main() -> None:
    """Run each configuration in a process of its own and print a line for it, then the factors between the two."""
    parser = argparse.ArgumentParser(description=__doc__)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--memory", action="store_true", help="measure the peak memory instead of the seconds")
    what.add_argument("--charts", action="store_true", help="measure the peak memory of the charts, in hours")
    parser.add_argument("--out", type=Path, help="file to write the lines to as well")
    parser.add_argument("--only", default="", help="only runs whose name begins like this")
    options = parser.parse_args()
    runs, compare = (MEMORY_RUNS, _memory) if options.memory else (RUNS, _seconds)
    if options.charts:
        runs, compare = {f"chart {name}": [name] for name, subject in CHARTS.items() if subject.gigabytes}, _chart
    title = "run: predicted s, measured s (of which the processor worked), measured / predicted"
    lines = [title if compare is _seconds else "run: stated GB, measured GB at the peak, stated / measured"]
    ratios, chosen = [], {name: words for name, words in runs.items() if name.startswith(options.only)}
    if not chosen:
        parser.error(f"--only {options.only}: expected the beginning of one of {', '.join(runs)}")
    for name, words in chosen.items():
        said, ratio = compare(words)
        ratios.append(ratio)
        lines.append(f"{name}: {said}")
        print(lines[-1], flush=True)
    factors = [max(ratio, 1 / ratio) for ratio in ratios]
    lines.append(f"median of the factor between them: {statistics.median(factors):.2f} over {len(ratios)} runs")
    if compare is not _seconds:
        lines.append(f"largest factor between them: {max(factors):.2f}")
    print("\n".join(lines[len(ratios) + 1 :]))
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
