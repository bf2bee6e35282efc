"""Figure of the chart of trackers."""

import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from holotorch.experiments.runs.figures import draw_front, figure_png, mark_choice
from holotorch.experiments.tracking_benchmark.bench import TIP, Row, one
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, FEWER, PRIOR

_STYLE = {BASE: ("tab:gray", "s"), COLD: ("tab:blue", "o"), PRIOR: ("tab:green", "^"), FEWER: ("tab:orange", "v")}


def draw(rows: list[Row], tables: dict[str, list[Row]]) -> bytes:
    """PNG of the chart: error over time, spread at rest with its bounds, and shares of right, refused and wrong."""
    figure = Figure(figsize=(14, 4.6), layout="constrained")
    first, second, third = figure.subplots(1, 3)
    _errors(first, rows)
    _precision(second, tables["still"])
    for axes in (first, second):
        axes.set_title("synthetic frames")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=7)
    _outcomes(third, tables["reliability"])
    return figure_png(figure)


def _errors(axes: Axes, rows: list[Row]) -> None:
    """Error of the tip on the grids over the time per frame: the median, and a line up to the 95th percentile."""
    points, chosen = [], []
    for row in rows:
        if row["method"] not in _STYLE:
            continue
        colour, marker = _STYLE[row["method"]]
        for grid, fill in (("2D", colour), ("3D", "white")):
            if row[f"{grid}_median_mm"] != "":
                ends = [row[f"{grid}_median_mm"], row[f"{grid}_p95_mm"]]
                label = f"{row['method']}, {grid} grid"
                points.append((row["milliseconds"], ends[0]))
                chosen += [points[-1]] if row["method"] == COLD else []
                axes.loglog([row["milliseconds"]] * 2, ends, color=colour, linewidth=0.8)
                axes.loglog(row["milliseconds"], ends[0], marker, color=colour, markerfacecolor=fill, label=label)
    axes.set(xlabel="milliseconds per frame, plain desk", ylabel="tip error: median, line up to p95 (mm)")
    draw_front(axes, points)
    mark_choice(axes, chosen, "default of CatheterTracker")


def _precision(axes: Axes, rows: list[Row]) -> None:
    """Spread of a resting tip by method and pose, with the Cramér-Rao bounds."""
    poses = list(dict.fromkeys((row["depth_mm"], row["tilt_deg"]) for row in rows))

    def column(name: str, method: str) -> list[float]:
        own = [one(rows, depth_mm=depth, tilt_deg=tilt, point=TIP, method=method) for depth, tilt in poses]
        return [row[name] if row[name] != "" else math.nan for row in own]

    for name, (colour, marker) in _STYLE.items():
        axes.semilogy(range(len(poses)), column("sd_mm", name), marker, color=colour, label=name)
    for name, colour, label in (("edges_bound_mm", "gray", ", of edges"), ("bound_mm", "black", ", of all pixels")):
        label = f"Cramér-Rao bound{label}"
        axes.semilogy(range(len(poses)), column(name, BASE), "_", color=colour, markersize=20, label=label)
    axes.set_xticks(range(len(poses)), [f"{depth} mm\n{tilt}°" for depth, tilt in poses])
    axes.set_ylim(top=8 * axes.get_ylim()[1])  # room for the legend
    axes.set(xlabel="distance of the tip and tilt", ylabel="sd of a resting tip, unfiltered (mm)")


def _outcomes(axes: Axes, rows: list[Row]) -> None:
    """Shares of right, refused and wrong frames by kind of frame and method."""
    rows = [row for row in rows if row["frames_of"] in ("conditions", "occlusions", "negatives")]
    kinds = (
        ("right", "tab:green", "within 5 mm"),
        ("refused", "lightgray", "refused, as negatives must be"),
        ("wrong", "tab:red", "wrong or false"),
    )
    left = [0.0] * len(rows)
    for key, colour, label in kinds:
        shares = [100 * row[key] / row["frames"] for row in rows]
        axes.barh(range(len(rows)), shares, left=left, color=colour, label=label)
        left = [a + b for a, b in zip(left, shares, strict=True)]
    for i, row in enumerate(rows):
        box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1}
        axes.text(99, i, f"{row['wrong']} wrong of {row['frames']}", ha="right", va="center", fontsize=7, bbox=box)
    axes.set_yticks(range(len(rows)), [f"{row['frames_of']}\n{row['method']}" for row in rows], fontsize=7)
    axes.set_xlabel("% of synthetic frames")
    axes.invert_yaxis()
    axes.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
