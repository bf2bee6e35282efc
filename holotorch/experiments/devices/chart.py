"""Chart of times on this machine's processor and on its GPU: holograms, correction, retina and tracking."""

import gc
import statistics
import warnings
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.core.checks import SamplingWarning
from holotorch.experiments.devices.tasks import FULL, QUICK, Task, tasks
from holotorch.experiments.runs.environment import device_name
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.timing import timed

NOT_MEASURED = "not measured"
_LONG = 1.0  # seconds


def devices(quick: bool = False) -> tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]:
    """Rows of every task and device, no further table, the picture, and the verdict."""
    warnings.simplefilter("ignore", SamplingWarning)  # times are charted here, and the errors by other charts
    amount = QUICK if quick else FULL
    available, rows = computing_devices(), []
    for task in (bar := tqdm([*tasks(amount)], desc="devices", unit="task")):
        bar.set_postfix_str(task.name)
        rows += _rows(task, available, amount.rounds)
    return rows, {}, {"chart": _draw(rows)}, _verdict(rows, available)


def computing_devices() -> list[torch.device]:
    """The processor, and a GPU if torch finds one."""
    return [torch.device("cpu"), *([torch.device("cuda")] if torch.cuda.is_available() else [])]


def _rows(task: Task, available: list[torch.device], rounds: tuple[int, int]) -> list[dict[str, Any]]:
    """One row for each device; without a GPU, one that says that it was not measured there."""
    rows, wanted, base = [], None, 0.0
    for device, count in zip(available, rounds, strict=False):
        result, seconds, memory = _measure(task, device, count)
        wanted, base = (result, statistics.median(seconds)) if wanted is None else (wanted, base)
        rows.append(
            {
                "task": task.name,
                "method": task.method,
                "seconds_of": task.unit,
                "device": device_name(device),
                "seconds": f"{statistics.median(seconds):.4g}",
                "fastest": f"{min(seconds):.4g}",
                "slowest": f"{max(seconds):.4g}",
                "rounds": len(seconds),
                "over_processor": f"{base / statistics.median(seconds):.3g}",
                "difference": f"{_difference(result, wanted):.1e}",
                "memory_GB": "" if memory is None else f"{memory / 1e9:.2f}",
                "thesis_seconds": "" if task.thesis is None else task.thesis,
            }
        )
    if len(available) == 1:
        rows.append({"task": task.name, "method": task.method, "seconds_of": task.unit, "device": NOT_MEASURED})
    return rows


def _measure(task: Task, device: torch.device, rounds: int) -> tuple[Tensor, list[float], int | None]:
    """Result of a task on the CPU, its seconds in each of ``rounds`` after one that warms up, and peak memory of a GPU.

    On the processor, a call of more than a second is not repeated. The memory is that of the task with all that it
    keeps, in bytes; None on the processor.
    """
    gpu = device.type == "cuda"
    if gpu:
        torch.cuda.reset_peak_memory_stats(device)
    call = task.build(device)
    result, first = timed(call)
    times = [first] if first > _LONG and not gpu else [timed(call)[1] for _ in range(rounds)]
    seconds = [task.times * each for each in times]
    memory = torch.cuda.max_memory_allocated(device) if gpu else None
    del call
    gc.collect()  # what refers to itself would keep its memory for the next task
    return result.cpu(), seconds, memory


def _difference(result: Tensor, wanted: Tensor) -> float:
    """Relative L2 difference, of a tracker's positions where both have one."""
    both = result.isfinite() & wanted.isfinite()
    return ((result - wanted)[both].norm() / wanted[both].norm()).item()


def _verdict(rows: list[dict[str, Any]], available: list[torch.device]) -> list[str]:
    names = [device_name(device) for device in available]
    lines = [f"torch {torch.__version__}; {', '.join(names)}; medians, each task on one device after the other"]
    for row in rows:
        if row["device"] == NOT_MEASURED or len(available) > 1 and row["device"] == names[0]:
            continue
        what = ", ".join(part for part in (row["task"], row["method"]) if part)
        line = f"{what}: {row['seconds']} s a {row['seconds_of']} on {row['device']}"
        if len(available) > 1:
            line += f", {row['over_processor']} times as fast as the processor, results differ by {row['difference']}"
        if row["thesis_seconds"]:
            line += f"; the thesis's GPU {row['thesis_seconds']} s"
        lines.append(line)
    if len(available) == 1:
        lines.append("GPU: not measured, since torch finds no CUDA device here")
    return lines


def _draw(rows: list[dict[str, Any]]) -> bytes:
    measured = [row for row in rows if row["device"] != NOT_MEASURED]
    labels = list(dict.fromkeys((row["task"], row["method"]) for row in measured))
    figure = Figure(figsize=(10, 1.5 + 0.35 * len(labels)), layout="constrained")
    axes = figure.subplots()
    for k, device in enumerate(dict.fromkeys(row["device"] for row in measured)):
        own = [row for row in measured if row["device"] == device]
        heights = [labels.index((row["task"], row["method"])) for row in own]
        axes.semilogx([float(row["seconds"]) for row in own], heights, "os"[k], color=f"C{k}", label=device)
    thesis = {labels.index((r["task"], r["method"])): r["thesis_seconds"] for r in measured if r["thesis_seconds"]}
    if thesis:
        axes.semilogx(
            [float(seconds) for seconds in thesis.values()], [*thesis], "kx", label="the thesis's GPU, as stated"
        )
    axes.set_yticks(range(len(labels)), [", ".join(part for part in label if part) for label in labels], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("seconds of a hologram in three colours, of a step or of a frame")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    return figure_png(figure)
