"""Charts of speed against accuracy: every method on the same work in one process, turn by turn."""

import csv
import io
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from holotorch.experiments.errors import ConfigError
from holotorch.io.files import write_bytes, write_text

ROUNDS = 5
# The second table of each chart; that of tracking is one of several, which it names itself.
_SECOND = {
    "eye": "tradeoff",
    "pec": "comparison",
    "propagation": "prediction",
    "tracking": "grids",
    "volume": "scaling",
}


def interleaved(calls: dict[str, Callable[[], Any]], rounds: int = ROUNDS) -> dict[str, float]:
    """Median seconds of each call over rounds in which all of them take one turn; one round before warms up."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            started = time.perf_counter()
            call()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if turn:
                times[name].append(time.perf_counter() - started)
    return {name: statistics.median(values) for name, values in times.items()}


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """CSV of rows that share their keys, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def chart(subject: str, out: Path) -> list[str]:
    """Draw the chart of a subject into the folder ``out`` and return its verdict, line by line."""
    if subject == "propagation":
        from holotorch.experiments.chart_propagation import propagation as draw
    elif subject == "pec":
        from holotorch.experiments.chart_pec import pec as draw
    elif subject == "volume":
        from holotorch.experiments.chart_volume import volume as draw
    elif subject == "eye":
        from holotorch.experiments.chart_eye import eye as draw
    elif subject == "tracking":
        from holotorch.experiments.chart_tracking import tracking as draw
    else:
        raise ConfigError([f"no chart of {subject!r}; known: {', '.join(_SECOND)}"])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    rows, compared, pictures, verdict = draw()
    write_table(out / "chart.csv", rows)
    for name, table in (compared if isinstance(compared, dict) else {_SECOND[subject]: compared}).items():
        write_table(out / f"{name}.csv", table)
    for name, data in pictures.items():
        write_bytes(out / f"{name}.png", data)
    write_text(out / "verdict.txt", "\n".join(verdict) + "\n")
    return verdict
