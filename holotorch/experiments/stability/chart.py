"""Chart of stability: errors and warnings of every method at and beyond the limits of its validity."""

import math
import statistics
from collections import Counter
from dataclasses import replace
from importlib import import_module
from typing import Any

import torch
from tqdm import tqdm

from holotorch.experiments.stability.picture import draw
from holotorch.experiments.stability.sweep import SILENT, Point, Sweep

# Modules of this package whose function ``sweeps`` lists sweeps.
SYSTEMS = ("propagation", "propagators", "heat", "holograms", "retinas", "light", "scene", "tracking")


def all_sweeps() -> list[Sweep]:
    """The sweeps of all systems."""
    return [sweep for name in SYSTEMS for sweep in import_module(f"holotorch.experiments.stability.{name}").sweeps()]


def stability(quick: bool = False) -> tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]:
    """Table rows of all points, further tables (none), PNG pictures by name, and lines of text.

    The quick form takes the first, middle and last value of each sweep.
    """
    sweeps = all_sweeps()
    if quick:
        sweeps = [replace(sweep, values=sweep.values[:: max(1, (len(sweep.values) - 1) // 2)]) for sweep in sweeps]
    points = [point for sweep in tqdm(sweeps, desc="stability", unit="sweep") for point in sweep.points()]
    rows, pictures = [row(point) for point in points], {"chart": draw(points)}
    return rows, {}, pictures, verdict(points)


def row(point: Point) -> dict[str, Any]:
    """Table row of a point."""
    return {
        "method": point.method,
        "swept": point.swept,
        "value": point.value if isinstance(point.value, str) else f"{point.value:.4g}",
        "tolerance": f"{point.tolerance:.2e}",
        "tolerance_from": point.tolerance_from,
        "predicted": _number(point.predicted),
        "measured": _number(point.measured),
        "said": point.said,
        "ok": point.ok,
        "words": point.words,
    }


def verdict(points: list[Point]) -> list[str]:
    """Numbers of points, silent failures by name, and how predictions compare with true errors."""
    counts, sweeps = Counter(point.said for point in points), {(p.method, p.swept) for p in points}
    silent = [point for point in points if not point.ok]
    sources = Counter(point.tolerance_from for point in points)
    said = ", ".join(f"{counts[outcome]} {outcome}" for outcome in ("nothing", "switched", "warned", "refused"))
    lines = [
        f"torch {torch.__version__}; {len(points)} points of {len(sweeps)} sweeps; said: {said}",
        "tolerances: " + ", ".join(f"{count} {source}" for source, count in sources.items()),
        f"silent failures (an error above {SILENT} tolerances without a word): {len(silent)}",
    ]
    lines += [f"silent: {point.label}: error {point.measured:.1e} for {point.tolerance:.1e}" for point in silent]
    ratios = [p.predicted / p.measured for p in points if _both(p)]
    if len(ratios) > 1:
        low, middle, high = (statistics.quantiles(ratios, n=20)[i] for i in (0, 9, 18))
        lines.append(
            f"predicted / measured error: median {middle:.2f}, 5 % below {low:.2f} and 5 % above {high:.2g}, over "
            f"{len(ratios)} points"
        )
    return lines


def _both(point: Point) -> bool:
    """Whether the point has a prediction, and an error above rounding."""
    return 0 < point.predicted < math.inf and 1e-9 < point.measured < math.inf


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3e}"
