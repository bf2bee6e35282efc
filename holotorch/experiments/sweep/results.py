"""The table, the picture and the page of a sweep, from the folders of its runs."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from matplotlib.figure import Figure

from holotorch.experiments.report import write_report
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.sweep.points import Point
from holotorch.io.files import read_json, write_bytes

TABLE, PICTURE, PAGE = "sweep.csv", "sweep.png", "report.html"
# Quantities to draw, by the last part of a column's name, and what they are: the first of these that vary between runs.
_MERITS = {
    "ssim_mean": "SSIM, mean",
    "ssim": "SSIM",
    "psnr_mean": "PSNR in dB, mean",
    "psnr": "PSNR in dB",
    "psnr_db": "PSNR in dB",
    "contrast": "speckle contrast",
    "error": "error",
    "loss": "loss",
    "seconds": "seconds",
}
_PANELS = 3


def write_results(out: Path, points: Sequence[Point], statuses: dict[str, str]) -> list[dict[str, Any]]:
    """Write the table of all points, and picture and page of the complete runs; returns the rows of the table."""
    summaries = {point.name: _summary(out / point.name) for point in points}
    names = list(dict.fromkeys(name for each in summaries.values() for name in each))
    varied = [name for name in names if len({str(each.get(name, "")) for each in summaries.values() if each}) > 1]
    rows: list[dict[str, Any]] = []
    for point in points:
        numbers = {name: summaries[point.name].get(name, "") for name in varied}
        rows.append(point.values | {"folder": point.name, "status": statuses.get(point.name, "missing")} | numbers)
    write_table(out / TABLE, rows)
    complete = [point for point in points if summaries[point.name]]
    more = {f"Table of {len(rows)} runs": TABLE}
    if complete and (data := draw(out, complete, summaries)):
        write_bytes(out / PICTURE, data)
        more["Picture of the sweep"] = PICTURE
    if complete:
        write_report([out / point.name for point in complete], out / PAGE, more)
    return rows


def draw(out: Path, points: Sequence[Point], summaries: dict[str, dict[str, Any]]) -> bytes | None:
    """PNG of up to three quantities against the first swept key, with a line for each value of the others, or None."""
    key = next(iter(points[0].values))
    values = [_number(out / point.name, key) for point in points]
    ticks = list(dict.fromkeys(point.values[key] for point in points))
    x = [
        ticks.index(point.values[key]) if None in values else value or 0.0
        for point, value in zip(points, values, strict=True)
    ]
    merits = _merits([summaries[point.name] for point in points])
    if not merits:
        return None
    figure = Figure(figsize=(5.2 * len(merits), 4.2), layout="constrained")
    for i, merit in enumerate(merits):
        axes = figure.add_subplot(1, len(merits), i + 1)
        lines: dict[str, list[tuple[float, float]]] = {}
        for point, place in zip(points, x, strict=True):
            label = ", ".join(f"{k.rpartition('.')[2]} {v}" for k, v in point.values.items() if k != key)
            value = summaries[point.name].get(merit)
            if isinstance(value, (int, float)):
                lines.setdefault(label, []).append((place, value))
        for k, (label, line) in enumerate(lines.items()):
            axes.plot(*zip(*sorted(line), strict=True), "os^vD*PhX"[k % 9] + "-", label=label or None, markersize=5)
        if None in values:
            axes.set_xticks(range(len(ticks)), ticks, fontsize=8)
        elif min(x) > 0 and max(x) / min(x) >= 30:
            axes.set_xscale("log")
        axes.set(xlabel=key, ylabel=f"{_MERITS[merit.rpartition('.')[2]]}\n({merit} in {TABLE})")
        axes.grid(alpha=0.3)
        if any(lines) and len(lines) <= 12:
            axes.legend(fontsize=7)
    return figure_png(figure)


def finished(folder: Path) -> bool:
    """Whether a folder holds a complete run."""
    return (folder / "summary.json").is_file()


def _summary(folder: Path) -> dict[str, Any]:
    """Numbers and words of a complete run by dotted name; empty for a run that is not complete."""
    return dict(_flat(read_json(folder / "summary.json"))) if finished(folder) else {}


def _flat(value: Any, name: str = "") -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [pair for key, each in value.items() for pair in _flat(each, f"{name}.{key}" if name else key)]
    return [(name, value)] if isinstance(value, (int, float, str, bool)) else []


def _merits(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Columns to draw: one for each of ``_MERITS`` that varies, of the result rather than of a baseline."""
    merits = []
    for ending in _MERITS:
        named = [name for name in summaries[0] if name.rpartition(".")[2] == ending]
        named.sort(key=lambda name: (not re.search(r"corrected|joint", name), name.count(".")))
        merits += [name for name in named[:1] if len({str(summary.get(name)) for summary in summaries}) > 1]
    return merits[:_PANELS]


def _number(folder: Path, key: str) -> float | None:
    """The value of a key, in SI units, in the configuration of a run; None if it is no number."""
    value: Any = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
