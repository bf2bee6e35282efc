"""Chart of one run on several processes: measured on two processes here, and a model of many GPUs."""

import statistics
from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.figure import Figure

from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.scaling.measurement import COUNT, Case, Measured, load, measure
from holotorch.experiments.scaling.model import Cluster, Link
from holotorch.experiments.scaling.tasks import Display, tasks

MODEL = "model, not measured"
_PHANTOM = "volume={phantom: shells, samples: 64}"
_HOLOGRAM = "hologram={{shape: [{0}, {0}], pitch: 3.74 um, distance: {1} mm, depths: {2}, rays: {3}}}"
_SOLVER = "solver={kind: lbfgs, max_steps: 6, patience: 1000}"


@dataclass(frozen=True)
class Amount:
    """Size of the measurement, and of the model."""

    cases: tuple[Case, ...]
    repetitions: int = 7
    counts: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)  # GPUs


FULL = Amount(
    (
        Case("volume, 58 planes", "configs/volume/c60.yaml", (_PHANTOM, _HOLOGRAM.format(512, 10, 58, 256)), 1),
        Case("pec, 4 frames", "configs/pec/capped.yaml", ("grid.shape=[256,256]", _SOLVER), 6),
        Case("joint, 8 frames, 5 views", "configs/joint/teapot.yaml", (_PHANTOM, "steps=3"), 3),
    )
)
QUICK = Amount(
    (
        Case("volume, 8 planes", "configs/volume/c60.yaml", (_PHANTOM, _HOLOGRAM.format(64, 3, 8, 32)), 1),
        Case("pec, 4 frames", "configs/pec/capped.yaml", ("grid.shape=[32,32]", _SOLVER), 6),
    ),
    2,
    (1, 8, 64),
)


def scaling(quick: bool = False) -> tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]:
    """Rows of the measurement, of the model and of its assumptions, the picture, and the verdict."""
    amount, cluster, before = QUICK if quick else FULL, Cluster(), load()
    measured, link = measure(amount.cases, amount.repetitions)
    rows = [row for task in measured for row in _rows(task, link)]
    model = _model(cluster, amount.counts)
    verdict = _verdict(measured, link, model, (before, load()))
    return rows, {"model": model, "assumptions": cluster.table()}, {"chart": _draw(measured, link, model)}, verdict


def predicted(task: Measured, link: Link, count: int) -> float:
    """Seconds of a measured task on ``count`` processes of an idle machine, predicted from one process and the link."""
    return sum(task.work.seconds(count, link).values())


def _rows(task: Measured, link: Link) -> list[dict[str, Any]]:
    rows = []
    for count, times, worked in ((1, task.alone, task.working[0]), (COUNT, task.together, task.working[1])):
        rows.append(
            {
                "task": task.work.name,
                "processes": count,
                "largest_share": task.work.largest(count) / task.work.units,
                "seconds": f"{statistics.median(times):.4g}",
                "fastest": f"{min(times):.4g}",
                "slowest": f"{max(times):.4g}",
                "speedup": f"{task.speedup if count > 1 else 1:.3f}",
                "processor_seconds": f"{worked:.4g}",
                "processor_speedup": f"{task.working[0] / worked:.3f}",
                "model_seconds": f"{predicted(task, link, count):.4g}",
                "model_speedup": f"{predicted(task, link, 1) / predicted(task, link, count):.3f}",
                "difference": f"{task.error if count > 1 else 0:.1e}",
            }
        )
    return rows


def _model(cluster: Cluster, counts: tuple[int, ...]) -> list[dict[str, Any]]:
    rows = []
    for work in tasks(cluster, Display()):
        alone = sum(work.seconds(1, cluster.link(1), cluster).values())
        for count in counts:
            parts = work.seconds(count, cluster.link(count), cluster)
            total = sum(parts.values())
            row = {"task": work.name, "gpus": count, "largest_share": f"{work.largest(count) / work.units:.4g}"}
            row |= {f"{name}_s": f"{seconds:.4g}" for name, seconds in parts.items()}
            rows.append(row | {"seconds": f"{total:.4g}", "speedup": f"{alone / total:.3g}", "what": MODEL})
    return rows


def _verdict(
    measured: list[Measured], link: Link, model: list[dict[str, Any]], loads: tuple[float, float]
) -> list[str]:
    lines = [
        f"torch {torch.__version__}, one thread in each process; one and two processes in alternation, medians; load "
        f"of the machine {loads[0]:.1f} before and {loads[1]:.1f} after"
    ]
    for task in measured:
        ratios = sorted(one / two for one, two in zip(task.alone, task.together, strict=True))
        here = predicted(task, link, 1) / predicted(task, link, COUNT)
        lines.append(
            f"{task.work.name}: two processes {task.speedup:.2f} times as fast as one ({ratios[0]:.2f} to "
            f"{ratios[-1]:.2f} in {len(ratios)} repetitions), {task.working[0] / task.working[1]:.2f} by the time that "
            f"the processors worked, model {here:.2f}; results differ by {task.error:.1e}"
        )
    lines.append(f"sums over both processes: {link.bandwidth / 1e9:.2f} GB/s, latency {1e6 * link.latency:.0f} us")
    for name in dict.fromkeys(row["task"] for row in model):
        own = [row for row in model if row["task"] == name]
        best = max(own, key=lambda row: float(row["speedup"]))
        speedups = ", ".join(f"{row['speedup']} on {row['gpus']}" for row in own)
        lines.append(f"{MODEL}: {name}: {speedups}; fastest on {best['gpus']} GPUs")
    return lines


def _draw(measured: list[Measured], link: Link, model: list[dict[str, Any]]) -> bytes:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for index, task in enumerate(measured):
        ratios = [one / two for one, two in zip(task.alone, task.together, strict=True)]
        left.plot([index] * len(ratios), ratios, ".", color="0.7", label=None if index else "repetitions")
        left.plot(index, task.speedup, "o", color="C0", label=None if index else "measured, median")
        ratio = predicted(task, link, 1) / predicted(task, link, COUNT)
        worked = task.working[0] / task.working[1]
        left.plot(index, worked, "s", color="C2", label=None if index else "by the time that the processors worked")
        left.plot(index, ratio, "_", color="C3", markersize=24, label=None if index else "model")
    left.axhline(COUNT, color="k", linestyle=":", linewidth=1)
    left.set_xticks(range(len(measured)), [task.work.name for task in measured], fontsize=8)
    left.set_xlim(-0.5, len(measured) - 0.5)
    left.set_ylim(0, 1.3 * COUNT)
    left.set_ylabel("speed of two processes over that of one")
    left.set_title("Measured on this machine")
    left.legend(fontsize=8, loc="lower right")
    for name in dict.fromkeys(row["task"] for row in model):
        own = [row for row in model if row["task"] == name]
        right.loglog([row["gpus"] for row in own], [float(row["speedup"]) for row in own], "o--", base=2, label=name)
    counts = sorted({row["gpus"] for row in model})
    right.loglog(counts, counts, "k:", linewidth=1, base=2, label="as many times as GPUs")
    right.set_xlabel("GPUs")
    right.set_ylabel("speed over that of one GPU")
    right.set_title(f"2048 x 2048 px: {MODEL}")
    right.legend(fontsize=8)
    return figure_png(figure)
