"""Small panels of error and prediction against the swept quantity."""

import math

from matplotlib.figure import Figure

from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.stability.sweep import SILENT, Point

_COLUMNS = 6
_LEAST, _MOST = 1e-12, 1e2  # errors are drawn within these
_MARKS = {"nothing": "o", "switched": "s", "warned": "^", "refused": "x"}
_COLOURS = {"nothing": "C0", "switched": "C2", "warned": "C1", "refused": "0.4"}


def draw(points: list[Point]) -> bytes:
    """PNG of all sweeps, a panel each; refusals are drawn at the height of the tolerance, silent points in red."""
    sweeps: dict[tuple[str, str], list[Point]] = {}
    for point in points:
        sweeps.setdefault((point.method, point.swept), []).append(point)
    rows = math.ceil(len(sweeps) / _COLUMNS)
    tall = 2.3 * rows + 0.8  # inches
    figure = Figure(figsize=(2.9 * _COLUMNS, tall))
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    # A constrained layout of so many panels takes longer than many of their sweeps.
    figure.subplots_adjust(0.05, 0.6 / tall, 0.99, 1 - 0.7 / tall, wspace=0.35, hspace=0.65)
    for axes, ((method, swept), own) in zip(panels, sweeps.items(), strict=False):
        _draw_sweep(axes, own)
        axes.set_title(method, fontsize=8)
        axes.set_xlabel(swept, fontsize=7)
        axes.tick_params(which="both", labelsize=6)
    for axes in panels[len(sweeps) :]:
        axes.set_axis_off()
    handles = [panels[0].plot([], [], mark, color=_COLOURS[said], label=said)[0] for said, mark in _MARKS.items()]
    handles += panels[0].plot([], [], "k--", linewidth=1, label="predicted")
    handles += panels[0].plot([], [], "k:", linewidth=1, label="tolerance")
    handles += panels[0].plot([], [], "o", color="r", markersize=9, label=f"silent: beyond {SILENT} tolerances")
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), fontsize=9)
    figure.supylabel("error; a mark says what the method said", fontsize=9)
    return figure_png(figure)


def _draw_sweep(axes, points: list[Point]) -> None:
    """Draw one panel: measured errors as marks, predictions dashed, tolerances dotted."""
    x = _positions(axes, points)
    axes.set_yscale("log")
    axes.plot(x, [_drawn(p.tolerance) for p in points], "k:", linewidth=1)
    axes.plot(x, [_drawn(p.predicted) for p in points], "k--", linewidth=1)
    for place, point in zip(x, points, strict=True):
        height = point.tolerance if point.said == "refused" else point.measured
        if not point.ok:
            axes.plot(place, _drawn(height), "o", color="r", markersize=9)
        axes.plot(place, _drawn(height), _MARKS[point.said], color=_COLOURS[point.said], markersize=5)
    axes.grid(alpha=0.3)


def _positions(axes, points: list[Point]) -> list[float]:
    """Places of the points along x; numbers on a logarithmic axis if they span decades, words in their order."""
    if any(isinstance(point.value, str) for point in points):
        labels = [str(point.value) for point in points]
        few = len(labels) <= _COLUMNS  # more words do not fit; the table has them
        axes.set_xticks(range(len(labels)), labels if few else range(1, len(labels) + 1))
        return [float(i) for i in range(len(points))]
    values = [float(point.value) for point in points]
    sizes = sorted(abs(value) for value in values if value)
    if sizes and sizes[-1] > 30 * sizes[0]:
        axes.set_xscale("symlog", linthresh=sizes[0]) if min(values) <= 0 else axes.set_xscale("log")
    return values


def _drawn(error: float) -> float:
    return error if math.isnan(error) else min(max(error, _LEAST), _MOST)
