"""Plots of a study's answers as in thesis Figs. 2.3 to 2.7, and of its statistical power, as bytes of PNG files."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from holotorch.experiments.perception.analysis.curves import Curves, Times
from holotorch.experiments.perception.analysis.statistics import Array, Line
from holotorch.experiments.runs.figures import figure_png

Lines = Sequence[tuple[str, Line]]  # target perception times in words, each with the line of its scales
_SLICES = ((5.0, "#c0392b"), (10.0, "#e08e0b"), (20.0, "#2867b2"))  # sizes in degrees, and the colours of their lines
_LINE_COLOURS = ("#e63b2e", "#ff9d2e", "#ffe14a", "#ffffff", "#9be37c", "#f29bd4")
_COLOURS = "viridis"


def surface(times: Times, shares: Sequence[float]) -> tuple[Array, Array]:
    """Sizes [N] in degrees, and quantiles over participants of their times in ms, [len(shares), E, N].

    E is the number of eccentricities. Times are interpolated linearly in the logarithm of the size; they are NaN beyond
    the sizes that were shown at an eccentricity.
    """
    fine = np.linspace(times.sizes[0], times.sizes[-1], 64)
    fine = np.unique(np.concatenate([fine, times.sizes, [s for s, _ in _SLICES if fine[0] <= s <= fine[-1]]]))
    result = np.full((len(shares), len(times.eccentricities), len(fine)), np.nan)
    for e in range(len(times.eccentricities)):
        shown = np.isfinite(times.seconds[:, e]).any(0)
        if shown.any():
            values = np.nanquantile(times.seconds[:, e, shown], shares, axis=0)
            x = np.log(times.sizes[shown])
            result[:, e] = [np.interp(np.log(fine), x, 1e3 * row, left=np.nan, right=np.nan) for row in values]
    return fine, result


def _slices(sizes: Array) -> list[tuple[int, float, str]]:
    """Index, size in degrees and colour of each slice at one of the ``sizes``."""
    near = [(np.flatnonzero(np.isclose(sizes, size)), size, colour) for size, colour in _SLICES]
    return [(int(index[0]), size, colour) for index, size, colour in near if len(index)]


def time_surface(times: Times) -> bytes:
    """Fig. 2.3: surfaces of the quartiles over all participants, and the median with lines at three sizes."""
    sizes, quartiles = surface(times, (0.25, 0.5, 0.75))
    figure = Figure(figsize=(11, 4.6), layout="constrained", dpi=110)
    scale = {"cmap": _COLOURS, "vmin": np.nanmin(quartiles), "vmax": np.nanmax(quartiles)}
    across, along = np.meshgrid(times.eccentricities, sizes, indexing="ij")
    for panel, (which, title) in enumerate((((0, 1, 2), "25 %, 50 % and 75 % of the participants"), ((1,), "median"))):
        axes: Any = figure.add_subplot(1, 2, panel + 1, projection="3d")
        for k in which:
            alpha = 0.9 if k == 1 and panel == 0 else 0.55
            axes.plot_surface(across, along, quartiles[k], **scale, alpha=alpha, rstride=1, cstride=2, lw=0.2)
        if panel == 1:
            for index, size, colour in _slices(sizes):
                line = times.eccentricities, np.full(len(times.eccentricities), size), quartiles[1, :, index]
                axes.plot(*line, color=colour, lw=2.5, label=f"{size:g}°", zorder=9)
            axes.legend(title="size", fontsize=8)
        axes.set(xlabel="eccentricity (deg)", ylabel="size (deg)", zlabel="perception time (ms)")
        axes.set_title(title, fontsize=10)
        axes.view_init(22, -128)
        axes.set_box_aspect((1.3, 1, 0.8), zoom=1.0)
    return _png(figure, "Perception time", times)


def time_map(times: Times, lines: Lines, fitted: tuple[float, float], tested: tuple[float, float]) -> bytes:
    """Fig. 2.4: the median time as colour, the conditions as dots, and lines of equal time over ``fitted`` deg."""
    sizes, (median,) = surface(times, (0.5,))
    figure = Figure(figsize=(7.6, 4.8), layout="constrained", dpi=110)
    axes = figure.add_subplot()
    # Each eccentricity is one column, without interpolation between eccentricities.
    drawn = axes.pcolormesh(times.eccentricities, sizes, median.T, cmap=_COLOURS, shading="nearest")
    figure.colorbar(drawn, ax=axes, label="median perception time (ms)")
    e, s = np.nonzero(np.isfinite(times.seconds).any(0))
    axes.plot(times.eccentricities[e], times.sizes[s], ".", color="black", ms=3)
    ends = np.array(fitted)
    for k, (target, line) in enumerate(lines):
        if not line.refused:
            scale = line.alpha * ends + line.beta
            axes.plot(ends, scale, color="black", lw=4)
            axes.plot(ends, scale, color=_LINE_COLOURS[k % len(_LINE_COLOURS)], lw=2.4, label=target)
    axes.set_facecolor("#dddddd")
    axes.set(xlabel="eccentricity (deg)", ylabel="size (deg)", ylim=(0, max(tested[1], sizes[-1]) + 4))
    if not all(line.refused for _, line in lines):
        axes.legend(title="as fast as", fontsize=8, loc="upper left", facecolor="#bbbbbb")
    return _png(figure, "Median perception time and scales of equal time", times)


def single_participant(times: Times, curves: Curves, index: int) -> bytes:
    """Fig. 2.5: times of one participant over the size at the last four eccentricities, and T(S) = a ln S + b."""
    last = curves.eccentricities[-4:]
    figure = Figure(figsize=(3.1 * len(last), 3.3), layout="constrained", dpi=110)
    fine = np.geomspace(times.sizes[0], times.sizes[-1], 100)
    first = None
    for k, angle in enumerate(last):
        axes = figure.add_subplot(1, len(last), k + 1, sharey=first)
        first = first or axes
        (e,) = np.flatnonzero(times.eccentricities == angle)
        axes.plot(times.sizes, 1e3 * times.seconds[index, e], "o", color="#2867b2", ms=4)
        a, b = 1e3 * curves.a[index, -len(last) + k], 1e3 * curves.b[index, -len(last) + k]
        title = f"{angle:g}°: too few sizes"
        if np.isfinite(a):
            axes.plot(fine, a * np.log(fine) + b, color="#c0392b")
            title = f"{angle:g}°: T = {a:.0f} ln S {b:+.0f} ms"
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("size (deg)")
        axes.grid(alpha=0.3)
        if k == 0:
            axes.set_ylabel("perception time (ms)")
    return _png(figure, f"Participant {times.participants[index]}", times)


def time_slices(times: Times) -> bytes:
    """Fig. 2.6: median and interquartile range of the time over the eccentricity, for patterns of three sizes."""
    sizes, quartiles = surface(times, (0.25, 0.5, 0.75))
    figure = Figure(figsize=(6.4, 4.2), layout="constrained", dpi=110)
    axes = figure.add_subplot()
    for index, size, colour in _slices(sizes):
        low, middle, high = quartiles[:, :, index]
        axes.plot(times.eccentricities, middle, "o-", color=colour, ms=4, label=f"{size:g}° pattern")
        axes.fill_between(times.eccentricities, low, high, color=colour, alpha=0.12, lw=0)
    axes.set(xlabel="eccentricity (deg)", ylabel="perception time (ms)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9, title="median and middle half")
    return _png(figure, "Perception time over eccentricity", times)


def scale_lines(
    times: Times, lines: Lines, fitted: tuple[float, float], tested: tuple[float, float], confidence: float
) -> bytes:
    """Fig. 2.7: median scales with intervals and, over the eccentricities ``fitted``, their line.

    ``tested`` is the range of the sizes that were shown, in degrees.
    """
    columns = min(len(lines), 3)
    rows = math.ceil(len(lines) / columns)
    figure = Figure(figsize=(4.2 * columns, 3.7 * rows), layout="constrained", dpi=110)
    for k, (target, line) in enumerate(lines):
        axes = figure.add_subplot(rows, columns, k + 1)
        axes.axhspan(*tested, color="#27864a", alpha=0.1, lw=0, label="sizes tested")
        _points(axes, line, fitted, confidence)
        axes.set_title(f"as fast as {target}", fontsize=10)
        axes.set(xlabel="eccentricity (deg)", ylabel="scale (deg)", ylim=(0, 62))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="upper left")
    return _png(figure, "Equal-efficiency scales", times)


def power_curves(rows: Sequence[dict[str, Any]], confidence: float) -> bytes:
    """Share of simulated studies that detect a slope, over the number of participants."""
    figure = Figure(figsize=(6.2, 4), layout="constrained", dpi=110)
    axes = figure.add_subplot()
    for alpha in dict.fromkeys(row["alpha"] for row in rows):
        results = [row for row in rows if row["alpha"] == alpha]
        people, power, error = zip(*((row["participants"], row["power"], row["error"]) for row in results), strict=True)
        axes.errorbar(people, power, 2 * np.array(error), fmt="o-", ms=4, capsize=2, label=f"{alpha:g}")
    axes.axhline(0.8, color="grey", lw=1, ls="--")
    axes.set(xlabel="participants", ylabel=f"studies whose {100 * confidence:g} % interval excludes 0", ylim=(0, 1.03))
    axes.grid(alpha=0.3)
    axes.legend(title="slope (deg/deg)", fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return _png(figure, "Power of the study (simulated participants)")


def _points(axes: Axes, line: Line, fitted: tuple[float, float], confidence: float) -> None:
    where = line.eccentricities
    inside = (where >= fitted[0]) & (where <= fitted[1])
    below, above = line.median_intervals
    for part, colour, words in ((inside, "#2867b2", ""), (~inside, "#999999", ", outside the range")):
        if not part.any():
            continue
        bars = np.stack([line.medians - below, above - line.medians])[:, part]  # NaN for too few participants
        label = "median" + (f" and {100 * confidence:g} % interval" if np.isfinite(bars).any() else "") + words
        style = {"fmt": "o", "color": colour, "ms": 4, "capsize": 3, "label": label}
        axes.errorbar(where[part], line.medians[part], np.maximum(bars, 0), **style)
    if not line.refused:
        ends = np.array(fitted)
        label = f"{line.alpha:.3g} E {line.beta:+.3g}"
        axes.plot(ends, line.alpha * ends + line.beta, color="#c0392b", label=label)


def _png(figure: Figure, title: str, times: Times | None = None) -> bytes:
    figure.suptitle(title + (" (simulated participants)" if times and times.simulated else ""), fontsize=11)
    return figure_png(figure)
