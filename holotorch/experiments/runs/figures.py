"""Figures of a run, drawn without any global state of matplotlib."""

import io
import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from holotorch.experiments.runs.signals import delayed


def channel_maps(values: Tensor, names: Sequence[str], label: str, colormap: str, limits=(None, None)) -> bytes:
    """PNG of maps [C, H, W] side by side, each with a colour bar; ``label`` names the quantity and its unit."""
    figure = Figure(figsize=(3.6 * len(names), 3.2), layout="constrained")
    for i, (name, panel) in enumerate(zip(names, values.numpy(), strict=True)):
        axes = figure.add_subplot(1, len(names), i + 1)
        drawn = axes.imshow(panel, cmap=colormap, vmin=limits[0], vmax=limits[1], interpolation="nearest")
        axes.set_title(name, fontsize=10)
        axes.set(xticks=[], yticks=[])
        figure.colorbar(drawn, ax=axes, label=label, shrink=0.85)
    return figure_png(figure)


def pixel_lines(image: Tensor) -> bytes:
    """PNG of an image [3, H, W], uint8, at about twice its size, with lines that tell the positions of its pixels."""
    height, width = image.shape[-2:]
    spacing = next((step for step in (5, 10, 20, 50, 100, 200, 500) if max(height, width) <= 20 * step), 1000)
    wide, high = width / 50 + 1, height / 50 + 1  # inches, with half an inch of margin on each side
    figure = Figure(figsize=(wide, high), dpi=min(100.0, 100 * 2000 / max(height, width)))
    axes = figure.add_axes((0.5 / wide, 0.5 / high, 1 - 1 / wide, 1 - 1 / high))
    axes.imshow(image.movedim(0, -1).numpy(), interpolation="nearest")
    axes.set(xticks=range(0, width, spacing), yticks=range(0, height, spacing))
    axes.minorticks_on()
    axes.tick_params(which="both", top=True, right=True, labeltop=True, labelright=True)
    axes.grid(color="white", linewidth=0.6, alpha=0.6)
    return figure_png(figure)


def fitted_pictures(pictures: dict[str, Tensor]) -> bytes:
    """PNG of grey pictures [..., H, W] side by side by name, each scaled to fit the first one best."""
    figure = Figure(figsize=(2.7 * len(pictures), 3.0), layout="constrained")
    (target, *_), names = pictures.values(), list(pictures)
    panels = figure.subplots(1, len(pictures))
    for axes, name, picture in zip(panels, names, pictures.values(), strict=True):
        gain = (picture * target).sum() / picture.square().sum()
        shown = (gain * picture).detach().reshape(picture.shape[-2:])
        axes.imshow(shown.numpy(), cmap="gray", vmin=0, vmax=target.max().item())
        axes.set_title(name, fontsize=9)
        axes.set(xticks=[], yticks=[])
    return figure_png(figure)


def visual_field(values: Tensor, eccentricity: Tensor, field_deg: float, rings: Sequence[float], label: str) -> bytes:
    """PNG of a map [H, W], ``field_deg`` degrees wide, with lines at the eccentricities ``rings``, in degrees."""
    height, width = values.shape
    x, y = field_deg / 2, field_deg / 2 * height / width
    figure = Figure(figsize=(7.2, 1.0 + 6.0 * height / width), layout="constrained")
    axes = figure.add_subplot()
    drawn = axes.imshow(values.numpy(), cmap="magma", extent=(-x, x, -y, y), interpolation="nearest")
    inside = [ring for ring in rings if eccentricity.min() < ring < eccentricity.max()]
    if inside:
        columns, rows = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (width, height))  # pixel centres, in -1 .. 1
        style = {"colors": "white", "linewidths": 1, "linestyles": ":"}
        lines = axes.contour(x * columns, -y * rows, eccentricity.numpy(), inside, **style)
        axes.clabel(lines, fmt=lambda ring: f"{ring:g} deg", fontsize=8)
    axes.set(xlabel="right of the middle (deg)", ylabel="above the middle (deg)")
    axes.set_title("Dotted: eccentricities between which the report's zones lie", fontsize=9)
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.85)
    return figure_png(figure)


def comparison(images: Sequence[Tensor], captions: Sequence[str]) -> bytes:
    """PNG of pictures [C, H, W] in [0, 1] side by side with captions; a score in a caption gets its own line."""
    titles = []
    for caption in captions:
        description, _, score = caption.partition(", SSIM ")
        titles.append(textwrap.fill(description, 38) + (f"\nSSIM {score}" if score else ""))
    wide, gap, top = 3.1, 0.1, 0.14 + 0.18 * max(title.count("\n") + 1 for title in titles)  # inches
    tall = wide * images[0].shape[-2] / images[0].shape[-1]
    size = (wide + gap) * len(images) + gap, tall + gap + top
    figure = Figure(figsize=size, dpi=120)
    for i, (image, title) in enumerate(zip(images, titles, strict=True)):
        left = gap + i * (wide + gap)
        axes = figure.add_axes((left / size[0], gap / size[1], wide / size[0], tall / size[1]))
        pixels = image.clamp(0, 1).permute(1, 2, 0).squeeze(-1).numpy()
        axes.imshow(pixels, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set(xticks=[], yticks=[])  # matplotlib lays ticks out even where the axes are off
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    return figure_png(figure)


def picture_table(rows: dict[str, Tensor], titles: Sequence[str]) -> bytes:
    """PNG of pictures [C, V, H, W]: a row for each entry of ``rows``, a column for each V."""
    count = len(titles)
    figure = Figure(figsize=(1.9 * count, 2.05 * len(rows)), dpi=100, layout="constrained")
    for i, (label, pictures) in enumerate(rows.items()):
        for v in range(count):
            axes = figure.add_subplot(len(rows), count, i * count + v + 1)
            pixels = pictures[:, v].permute(1, 2, 0).squeeze(-1).numpy()
            axes.imshow(pixels, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            if v == 0:
                axes.set_ylabel("\n".join(label.split(", ")), fontsize=7)
            if i == 0:
                axes.set_title(titles[v], fontsize=8)
    return figure_png(figure)


def convergence(losses: Tensor, names: Sequence[str], checked: Sequence[tuple[int, float]], metric: str) -> bytes:
    """PNG of the loss of each colour [steps + 1, C] relative to its start, and of a metric at the steps ``checked``."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.add_subplot()
    relative = np.maximum((losses / losses[0].clamp(min=1e-30)).cpu().numpy(), 1e-16)
    stage, steps = _next_stage(relative), np.arange(len(relative))
    for i, name in enumerate(names):
        colour = ("#c0392b", "#27864a", "#2867b2")[i] if len(names) <= 3 else f"C{i}"
        style = {"linewidth": 1.2, "color": colour}
        axes.semilogy(steps[:stage], relative[:stage, i], label=name, **style)
        if stage:
            axes.semilogy(steps[stage:], relative[stage:, i], **style)
    if stage:
        axes.axvline(stage - 0.5, color="0.4", linewidth=1, linestyle=":")
        label = "the error of the amplitude; from there on that of the intensity, and what a limit adds if there is one"
        axes.set_title(f"The loss up to step {stage - 1} (dotted) is {label}", fontsize=8)
    axes.set(xlabel="step", ylabel="loss / loss at the start")
    axes.grid(alpha=0.3)
    if checked:
        right = axes.twinx()
        right.plot(*zip(*checked, strict=True), "k--", linewidth=1.2, label=metric.upper())
        right.set_ylabel(f"mean {metric.upper()}")
        if metric == "ssim":
            right.set_ylim(0, 1.02)
    figure.legend(loc="outside upper center", ncols=len(names) + 1, fontsize=8, frameon=False)
    return figure_png(figure)


def _next_stage(losses: np.ndarray) -> int | None:
    """First step whose losses [steps + 1, C] belong to a second objective, or None.

    L-BFGS first minimises the error of the amplitude and then that of the intensity. At the change, the losses of all
    colours rise in the same step, after falling in every step before. With Adam, whose momentum makes the losses of
    single colours rise from the start, there is no second objective.
    """
    change = losses[1:] / losses[:-1]
    jumps = np.flatnonzero((change > 1.5).all(1))
    falls_before = len(jumps) > 0 and jumps[0] > 4 and bool((change[: jumps[0]] < 1.01).all())
    return int(jumps[0]) + 1 if falls_before else None


def curves(rows: Sequence[dict[str, Any]], title: str) -> bytes:
    """PNG of SSIM against the swept setting of a study: a line per method, a panel per kind of propagation."""
    scored = [row for row in rows if row["ssim"] != ""]
    kinds = list(dict.fromkeys(row["kind"] for row in scored))
    figure = Figure(figsize=(7.5 * len(kinds), 4.2), layout="constrained")
    for i, kind in enumerate(kinds):
        axes = figure.add_subplot(1, len(kinds), i + 1)
        selected = [row for row in scored if row["kind"] == kind]
        # The study sweeps a setting if it has one, otherwise sigma.
        if len({row["setting"] for row in selected}) == 1:
            selected.sort(key=lambda row: row["sigma_px"])
        positions = list(dict.fromkeys((row["setting"], row["sigma_px"]) for row in selected))
        for k, method in enumerate(dict.fromkeys(row["method"] for row in selected)):
            curve = [row for row in selected if row["method"] == method]
            x = [positions.index((row["setting"], row["sigma_px"])) for row in curve]
            y = [row["ssim"] for row in curve]
            gaps = [i for i in range(1, len(x)) if not _swept(curve[i - 1], curve[i])]
            x, y = np.insert(np.array(x, float), gaps, np.nan), np.insert(y, gaps, np.nan)
            axes.plot(x, y, "os^vD*PhX"[k % 9] + "-", label=method, markersize=5)
        many, step = len(positions) > 12, math.ceil(len(positions) / 48)
        comma = ", " if many else "\n"
        labels = [f"{setting}{comma}{sigma:g} px" if setting else f"{sigma:g} px" for setting, sigma in positions]
        ticks = range(0, len(positions), step)
        axes.set_xticks(ticks, labels[::step], fontsize=6 if many else 7, rotation=90 if many else 0)
        axes.set(ylim=(0, 1.02), ylabel="mean SSIM")
        axes.set_title(f"{title}, {kind}", fontsize=9)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    return figure_png(figure)


def _swept(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether a line leads from one row of a study to another: sigma alone differs, or a number in the setting."""
    kinds = [re.sub(r"[-+]?[\d.]+", "", row["setting"]) for row in (one, other)]
    return one["setting"] == other["setting"] or (one["sigma_px"] == other["sigma_px"] and kinds[0] == kinds[1])


def pareto_front(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those of the points (time, error) that no other point beats in both, from the fastest to the most accurate."""
    front: list[tuple[float, float]] = []
    for seconds, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((seconds, error))
    return front


def draw_front(axes: Axes, points: Iterable[tuple[float, float]], label: str = "Pareto front") -> None:
    """Grey steps through the Pareto front of points (time, error), behind the points themselves."""
    axes.step(*zip(*pareto_front(points), strict=True), where="post", color="0.6", linewidth=1, zorder=0, label=label)


def mark_choice(axes: Axes, points: Iterable[tuple[float, float]], label: str = "automatic choice") -> None:
    """A black ring around each point (time, error) of an automatic choice."""
    style = {"markersize": 14, "markerfacecolor": "none", "markeredgecolor": "black", "zorder": 1}
    axes.plot(*zip(*points, strict=True), "o", label=label, **style)


def figure_png(figure: Figure) -> bytes:
    """Render a figure as PNG, without any global state of matplotlib.

    Signals wait until it is drawn: the compiled part of matplotlib replaces their exception by a ValueError.
    """
    buffer = io.BytesIO()
    with delayed():
        FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()
