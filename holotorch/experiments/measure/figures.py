"""Figures of a measurement, each as a PNG."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from torch import Tensor

from holotorch.experiments.measure.grid import Grid, Visited, fitted
from holotorch.experiments.runs.figures import figure_png


def grid_figure(faces: Mapping[str, Visited], grid: Grid) -> bytes:
    """Points of the grid and the tips after the best rigid fit, one panel for each face, as Fig. 3.10 shows them."""
    figure = Figure(figsize=(4.6 * len(faces), 4.8), layout="constrained")
    panels = figure.subplots(1, len(faces), squeeze=False)[0]
    designed = 1e3 * grid.points
    for axes, (name, visited) in zip(panels, faces.items(), strict=True):
        matrix, _ = fitted(visited.tips, grid)
        tips = 1e3 * (visited.tips @ matrix[:3, :3].mT + matrix[:3, 3])
        axes.plot(*designed.mT.tolist(), "o", color="#c0392b", markerfacecolor="none", label="points of the grid")
        axes.plot(*tips[:, :2].mT.tolist(), "x", color="#2867b2", label="tips, after the best rigid fit")
        axes.plot(*designed[grid.reference].tolist(), "s", color="0.3", markerfacecolor="none", markersize=12)
        axes.set(xlabel="right (mm)", ylabel="up (mm)", aspect="equal")
        axes.set_title(f"{name}; square: reference", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure_png(figure)


def curves_figure(curves: Mapping[str, tuple[Sequence[float] | Tensor, Sequence[float] | Tensor]], label: str) -> bytes:
    """Curves over time in seconds by name; ``label`` names the quantity and its unit."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name, (seconds, values) in curves.items():
        axes.plot(list(map(float, seconds)), list(map(float, values)), ".-", markersize=2, linewidth=0.8, label=name)
    axes.set(xlabel="time (s)", ylabel=label)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure_png(figure)


def edges_figure(changes: Sequence[float], deviations: Sequence[float]) -> bytes:
    """Changes of the positions of edges 0, 1, ... with bars of two standard deviations, all in mm."""
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.errorbar(range(len(changes)), changes, [2 * deviation for deviation in deviations], fmt="o", capsize=4)
    axes.axhline(0, color="0.6", linewidth=0.8)
    axes.set(xlabel="edge", ylabel="measured - nominal (mm)", xticks=range(len(changes)))
    return figure_png(figure)


def tone_figure(curves: Mapping[str, Tensor]) -> bytes:
    """Tone curves [256] by name."""
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.add_subplot()
    for name, light in curves.items():
        axes.plot(range(256), light.tolist(), label=name)
    axes.set(xlabel="level", ylabel="light")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure_png(figure)


def track_figure(log: Any) -> bytes:
    """The tip over time, as ``holotorch track`` draws it."""
    from holotorch.experiments.tracking.report import drawn_track

    return figure_png(drawn_track(log))
