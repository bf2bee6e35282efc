"""Layouts of icons over a wide field, scaled for equal perception time: picture and tables (thesis Fig. 2.8)."""

import io
import math
from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.layout.config import ItemSettings, LayoutSettings
from holotorch.experiments.perception.layout.icons import draw_ground, draw_icon
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.saving import Results
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import write_bytes
from holotorch.perception import (
    FITTED_DEG,
    TABLE_2_1,
    EqualEfficiencyScale,
    ScaledLayout,
    check_display,
    overlaps,
    scale_layout,
)

_HALO = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.7}
_ROUNDING_DEG = 1e-9  # rounding tolerance, so that an icon that touches the edge of the field does not count as cut
_FITTED, _KEPT, _BEYOND, _UNTESTED, _ENDS = "#1b5e20", "#555555", "#d35400", "#b000b0", "#1a4a8a"
_STYLES = {
    (_FITTED, "-"): "scaled by Table 2.2, 40 to 70 deg",
    (_UNTESTED, "-"): "scaled by Table 2.2, size outside the tested 5 to 26 deg",
    (_KEPT, ":"): "not scaled: outside 40 to 70 deg (size of the target)",
    (_BEYOND, "--"): "* extrapolated beyond 70 deg",
}


@dataclass(frozen=True)
class Layouts:
    """A configuration, and for each of its targets the description and the scaled layout."""

    settings: LayoutSettings
    scaled: list[tuple[str, ScaledLayout]]


def build_layouts(settings: LayoutSettings) -> Layouts:
    """Scale the icons for all targets. ConfigError for a target that Table 2.2 does not contain."""
    layouts = []
    for i, target in enumerate(settings.targets):
        try:
            scale = EqualEfficiencyScale.from_table(target.size_deg, target.eccentricity_deg)
        except ValueError as error:
            raise ConfigError([f"targets.{i}: {error}"]) from None
        size = torch.full((len(settings.items), 2), target.size_deg, dtype=torch.float64)
        layout = scale_layout(_centres(settings), size, scale, extrapolate=settings.extrapolate)
        layouts.append((target.name, layout))
    return Layouts(settings, layouts)


def layout_text(layouts: Layouts) -> str:
    """Describe the scaled layouts, one line per target."""
    lines = []
    for name, layout in layouts.scaled:
        sizes = layout.size_deg.amax(-1)[~layout.kept].tolist()
        span = f"{min(sizes):.1f} to {max(sizes):.1f} deg; " if sizes else ""
        fitted, kept = int(layout.fitted.sum()), int(layout.kept.sum())
        parts = [f"{fitted} icons scaled by Table 2.2", f"{kept} with the size of the target"]
        if layout.extrapolated.any():
            parts.append(f"{int(layout.extrapolated.sum())} extrapolated")
        if untested := int((~layout.tested).sum()):
            parts.append(f"{untested} of a size that was not tested")
        pairs = len(overlaps(_centres(layouts.settings), layout.size_deg)[0])
        parts.append(f"{pairs} pairs of icons overlap" if pairs else "no icons overlap")
        cut = [_name(layouts.settings.items[i]) for i in _cut(layouts.settings, layout).nonzero()[:, 0].tolist()]
        edge = "cut by the edge of the field"
        parts.append(f"{len(cut)} {edge} ({', '.join(cut)})" if cut else f"none {edge}")
        lines.append(f"Perceived as soon as {name}: {span}{', '.join(parts)}")
    return "\n".join(lines)


def run_layout(layouts: Layouts, opened: RunFolder) -> bool:
    """Draw the layouts and write all files of the run folder. Returns whether the run is complete."""
    settings = layouts.settings
    folder, files, text = opened.path, Results(), layout_text(layouts)
    rows = [row for title, layout in layouts.scaled for row in _rows(settings, title, layout)]
    files.write(write_table, folder / "layout.csv", rows)
    picture = _picture(settings, layouts.scaled)
    files.write(write_bytes, folder / "images" / "layout.png", picture)
    displays = _displays(settings)
    files.write(write_table, folder / "displays.csv", displays)
    flags = {
        title: {
            "fitted": int(layout.fitted.sum()),
            "kept": int(layout.kept.sum()),
            "extrapolated": int(layout.extrapolated.sum()),
            "untested_size": int((~layout.tested).sum()),
            "overlaps": overlaps(_centres(settings), layout.size_deg)[0].tolist(),
            "cut": _cut(settings, layout).nonzero()[:, 0].tolist(),
        }
        for title, layout in layouts.scaled
    }
    summary = {
        "experiment": settings.experiment,
        "status": "",
        "targets": flags,
        "items": rows,
        "lines": text.splitlines(),
    }
    complete = conclude(opened, summary, files, done=True)
    print(text)
    return complete


def _centres(settings: LayoutSettings) -> Tensor:
    return torch.tensor([[item.elevation_deg, item.azimuth_deg] for item in settings.items], dtype=torch.float64)


def _name(item: ItemSettings) -> str:
    return item.label or item.icon.replace("_", " ")


def _cut(settings: LayoutSettings, layout: ScaledLayout) -> Tensor:
    """Whether a part of each icon lies outside the field of the picture, [N] bool."""
    half_field = torch.tensor(settings.field_deg, dtype=torch.float64) / 2
    return (_centres(settings).abs() + layout.size_deg / 2 > half_field + _ROUNDING_DEG).any(-1)


def _note(layout: ScaledLayout, i: int, cut: bool) -> str:
    """Warnings about an icon's size; empty if Table 2.2 gives the size, the study tested it and the icon is not cut."""
    parts = []
    if layout.extrapolated[i]:
        parts.append("extrapolated beyond 70 deg")
    elif layout.kept[i]:
        near = layout.eccentricity_deg[i] < FITTED_DEG[0]
        parts.append(
            "not scaled: nearer than 40 deg" if near else "not scaled: beyond 70 deg it would need extrapolation"
        )
    if not layout.tested[i]:
        parts.append("size not tested")
    if cut:
        parts.append("cut by the edge of the field")
    return "; ".join(parts)


def _rows(settings: LayoutSettings, title: str, layout: ScaledLayout) -> list[dict[str, Any]]:
    cut = _cut(settings, layout).tolist()
    return [
        {
            "target": title,
            "icon": item.icon,
            "label": item.label,
            "azimuth_deg": item.azimuth_deg,
            "elevation_deg": item.elevation_deg,
            "eccentricity_deg": round(layout.eccentricity_deg[i].item(), 3),
            "size_deg": round(layout.size_deg[i].max().item(), 3),
            "note": _note(layout, i, cut[i]),
        }
        for i, item in enumerate(settings.items)
    ]


def _displays(settings: LayoutSettings) -> list[dict[str, Any]]:
    """For each display of Table 2.1, the greatest eccentricity at which it can show each target's sizes."""
    ends = torch.tensor(FITTED_DEG, dtype=torch.float64)
    rows = []
    for display in TABLE_2_1:
        row: dict[str, Any] = {"display": display.name, "half_field_deg": display.half_field_deg}
        for target in settings.targets:
            scale = EqualEfficiencyScale.from_table(target.size_deg, target.eccentricity_deg)
            resolved = check_display(display, scale, ends).resolved
            grid = torch.linspace(*FITTED_DEG, 301, dtype=torch.float64)
            covered = grid[check_display(display, scale, grid).covered].tolist()
            resolution = "resolution unknown" if resolved is None else ("" if resolved.all() else "too coarse")
            limit = f"to {math.floor(max(covered) + 1e-9)} deg" if covered else "not at 40 deg"
            diagonal = " at most (diagonal)" if covered and display.axis == "diagonal" else ""
            row[target.name] = limit + diagonal + (f", {resolution}" if resolution else "")
        rows.append(row)
    return rows


def _picture(settings: LayoutSettings, layouts: list[tuple[str, ScaledLayout]]) -> bytes:
    high, wide = settings.field_deg[0] / 2, settings.field_deg[1] / 2
    panels = Figure(figsize=(13, 13 * high / wide * len(layouts) + 1.2), dpi=110)
    panels.set_layout_engine("constrained", h_pad=0.1)
    for k, ((name, layout), target) in enumerate(zip(layouts, settings.targets, strict=True)):
        axes = panels.add_subplot(len(layouts), 1, k + 1)
        draw_ground(axes, settings.field_deg)
        for edge in FITTED_DEG:
            for side in (-edge, edge):
                axes.axvline(side, color=_ENDS, linewidth=1.2, linestyle=":", zorder=5)
        for i, item in enumerate(settings.items):
            size: tuple[float, float] = tuple(layout.size_deg[i].tolist())  # type: ignore[assignment]
            centre = item.azimuth_deg, item.elevation_deg
            draw_icon(axes, item.icon, centre, size, 10 + i)
            _frame(axes, item, size, layout, i)
            if abs(layout.eccentricity_deg[i].item() - target.eccentricity_deg) < 0.05:
                # 0.4 deg around the target, whose size differs from that of the fitted line at 40 deg.
                _box(axes, centre, (target.size_deg + 0.8, target.size_deg + 0.8), "#d00000", "--")
        axes.plot(0, 0, "k+", markersize=11, zorder=400)
        axes.set(xlim=(-wide, wide), ylim=(-high, high), aspect="equal")
        axes.set_title(
            f"Perceived as soon as a pattern of {name} of eccentricity (dashed red box around it)", fontsize=11
        )
        axes.set_ylabel("elevation (deg)", fontsize=9)
        ticks = range(-int(wide // 10) * 10, int(wide) + 1, 10)
        axes.set_xticks(ticks, [str(abs(tick)) for tick in ticks])
    panels.axes[-1].set_xlabel("eccentricity to the left and to the right (deg); + is fixated")
    panels.legend(handles=_legend(layouts), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    FigureCanvasAgg(panels).print_png(buffer)
    return buffer.getvalue()


def _frame(axes: Axes, item: ItemSettings, size: tuple[float, float], layout: ScaledLayout, i: int) -> None:
    centre = item.azimuth_deg, item.elevation_deg
    colour, style = _style(layout, i)
    _box(axes, centre, size, colour, style)
    words = f"{max(size):.1f} deg" + (" *" if layout.extrapolated[i] else "")
    position = centre[0], centre[1] - max(size[0] / 2, 3.0) - 0.4  # below the box of the target
    label = f"{_name(item)}\n{words}"
    axes.text(*position, label, ha="center", va="top", fontsize=7.5, color=colour, zorder=301, bbox=_HALO)


def _style(layout: ScaledLayout, i: int) -> tuple[str, str]:
    """Colour and line style of an icon's frame."""
    if layout.extrapolated[i]:
        return _BEYOND, "--"
    if layout.kept[i]:
        return _KEPT, ":"
    return (_FITTED if layout.tested[i] else _UNTESTED), "-"


def _legend(layouts: list[tuple[str, ScaledLayout]]) -> list[Artist]:
    """Legend entries of the frame styles that occur in the picture."""
    used = {_style(layout, i) for _, layout in layouts for i in range(len(layout.kept))}
    frames = [
        Rectangle((0, 0), 1, 1, fill=False, edgecolor=key[0], linestyle=key[1], label=words)
        for key, words in _STYLES.items()
        if key in used
    ]
    ends = f"{FITTED_DEG[0]:g} and {FITTED_DEG[1]:g} deg: where the lines of Table 2.2 begin and end"
    return [*frames, Line2D([], [], color=_ENDS, linestyle=":", label=ends)]


def _box(axes: Axes, centre: tuple[float, float], size: tuple[float, float], colour: str, style: str) -> None:
    corner = centre[0] - size[1] / 2, centre[1] - size[0] / 2
    shape = Rectangle(
        corner, size[1], size[0], fill=False, edgecolor=colour, linestyle=style, linewidth=1.5, zorder=300
    )
    axes.add_patch(shape)
