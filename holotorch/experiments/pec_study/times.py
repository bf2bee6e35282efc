"""Picture of the study of times: seconds by the width of the heat, and by the resolution of the array."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from holotorch.experiments.runs.figures import figure_png


def times_picture(rows: Sequence[dict[str, Any]], title: str) -> bytes:
    """PNG of seconds on a log axis, a line per method: thesis Figs. 4.10 (by sigma) and 4.11 (by resolution).

    Bars span the rounds of measurement, whose longest over shortest is ``seconds_spread``, around their median.
    """
    base, sigma = rows[0]["setting"], rows[-1]["sigma_px"]
    sizes = [row for row in rows if row["sigma_px"] == sigma]
    panels = (
        ("sigma in px", [row for row in rows if row["setting"] == base], lambda row: row["sigma_px"]),
        ("pixels along each axis", sizes, lambda row: int(row["setting"].split()[0])),
    )
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    for i, (label, chosen, position) in enumerate(panels):
        axes = figure.add_subplot(1, 2, i + 1)
        for k, method in enumerate(dict.fromkeys(row["method"] for row in chosen)):
            curve = {position(row): row for row in chosen if row["method"] == method}  # the last of equal cases
            x = sorted(curve)
            seconds = [curve[key]["seconds"] for key in x]
            half = [curve[key]["seconds_spread"] ** 0.5 for key in x]
            bars = [[s - s / h for s, h in zip(seconds, half, strict=True)]]
            bars.append([s * h - s for s, h in zip(seconds, half, strict=True)])
            axes.errorbar(x, seconds, bars, fmt="os^v"[k % 4] + "-", label=method, markersize=5, capsize=3)
        axes.set(xlabel=label, ylabel="seconds", yscale="log")
        if i:
            axes.set_xscale("log", base=2)
            axes.set_xticks(x := sorted({position(row) for row in chosen}), [str(value) for value in x])
        axes.set_title(f"{title}, {base}" if i == 0 else f"sigma {sigma:g} px", fontsize=9)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    return figure_png(figure)
