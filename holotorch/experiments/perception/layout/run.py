"""Layouts of icons over a wide field, scaled for equal perception time: picture and tables (thesis Fig. 2.8)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.layout.config import ICONS, ItemSettings, LayoutSettings, TargetPatternSettings
from holotorch.experiments.perception.layout.icons import draw_ground, draw_icon, draw_picture
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.saving import Results
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import write_bytes
from holotorch.io.images import load_image, with_channels
from holotorch.perception import (
    FITTED_DEG,
    TABLE_2_1,
    EqualEfficiencyScale,
    ScaledLayout,
    WideDisplay,
    check_display,
    overlaps,
    scale_layout,
)

_ROUNDING_DEG = 1e-9  # tolerance for rounding errors of icons that touch the edge of the field
_LIMITS = "#1a4a8a"  # colour of the vertical lines at 40 and 70 deg
# Frames of the icons: colour, line style and legend text.
_FITTED = ("#1b5e20", "-", "scaled by Table 2.2, 40 to 70 deg")
_UNTESTED = ("#b000b0", "-", "scaled by Table 2.2, size outside the tested 5 to 26 deg")
_KEPT = ("#555555", ":", "not scaled: outside 40 to 70 deg (size of the target)")
_EXTRAPOLATED = ("#d35400", "--", "* extrapolated beyond 70 deg")


@dataclass(frozen=True)
class Layouts:
    """The settings, for each target pattern the layout that is scaled to it, and pictures of the user's own icons."""

    settings: LayoutSettings
    scaled: list[tuple[TargetPatternSettings, ScaledLayout]]
    pictures: dict[str, Tensor]  # [3, h, w] from 0 to 1, by path


def build_layouts(settings: LayoutSettings) -> Layouts:
    """Scale the icons for each target. ConfigError for a target that Table 2.2 does not contain, or a wrong picture."""
    scaled, pictures = [], {}
    for i, item in enumerate(settings.items):
        if item.icon not in ICONS and item.icon not in pictures:
            try:
                pictures[item.icon] = with_channels(load_image(item.icon), 3)
            except (ValueError, OSError) as error:
                raise ConfigError([f"items.{i}.icon: {error}"]) from None
    for i, target in enumerate(settings.targets):
        try:
            scale = EqualEfficiencyScale.from_table(target.size_deg, target.eccentricity_deg)
        except ValueError as error:
            raise ConfigError([f"targets.{i}: {error}"]) from None
        size = torch.full((len(settings.items), 2), target.size_deg, dtype=torch.float64)
        scaled.append((target, scale_layout(_centres(settings), size, scale, extrapolate=settings.extrapolate)))
    return Layouts(settings, scaled, pictures)


def layout_text(layouts: Layouts) -> str:
    """Describe the scaled layouts, one line per target."""
    lines = []
    for target, layout in layouts.scaled:
        sizes = layout.size_deg.amax(-1)[~layout.kept].tolist()
        span = f"{min(sizes):.1f} to {max(sizes):.1f} deg; " if sizes else ""
        flags = _flags(layouts.settings, layout)
        parts = [f"{flags['fitted']} icons scaled by Table 2.2", f"{flags['kept']} with the size of the target"]
        if flags["extrapolated"]:
            parts.append(f"{flags['extrapolated']} extrapolated")
        if flags["untested_size"]:
            parts.append(f"{flags['untested_size']} of a size that was not tested")
        pairs = len(flags["overlaps"])
        parts.append(f"{pairs} pairs of icons overlap" if pairs else "no icons overlap")
        cut = [_name(layouts.settings.items[i]) for i in flags["cut"]]
        edge = "cut by the edge of the field"
        parts.append(f"{len(cut)} {edge} ({', '.join(cut)})" if cut else f"none {edge}")
        lines.append(f"Perceived as soon as {target.name}: {span}{', '.join(parts)}")
    return "\n".join(lines)


def run_layout(layouts: Layouts, opened: RunFolder) -> bool:
    """Draw the layouts and write all files of the run folder. Returns whether the run is complete."""
    settings, files, text = layouts.settings, Results(), layout_text(layouts)
    flags = {target.name: _flags(settings, layout) for target, layout in layouts.scaled}
    rows = [row for target, layout in layouts.scaled for row in _rows(settings, target.name, layout)]
    files.write(write_table, opened.path / "layout.csv", rows)
    files.write(write_bytes, opened.path / "images" / "layout.png", _picture(layouts))
    files.write(write_table, opened.path / "displays.csv", list(_displays(settings)))
    summary = {
        "experiment": settings.experiment,
        "status": "",
        "targets": flags,
        "items": rows,
        "lines": text.splitlines(),
    }
    return conclude(opened, summary, files, done=True)


def _centres(settings: LayoutSettings) -> Tensor:
    return torch.tensor([[item.elevation_deg, item.azimuth_deg] for item in settings.items], dtype=torch.float64)


def _name(item: ItemSettings) -> str:
    return item.label or Path(item.icon).stem.replace("_", " ")


def _flags(settings: LayoutSettings, layout: ScaledLayout) -> dict[str, Any]:
    """Counts of icons by the origin of their size; indices of overlapping pairs and of icons cut by the edge."""
    centres, half_field = _centres(settings), torch.tensor(settings.field_deg, dtype=torch.float64) / 2
    cut = (centres.abs() + layout.size_deg / 2 > half_field + _ROUNDING_DEG).any(-1)
    return {
        "fitted": int(layout.fitted.sum()),
        "kept": int(layout.kept.sum()),
        "extrapolated": int(layout.extrapolated.sum()),
        "untested_size": int((~layout.tested).sum()),
        "overlaps": overlaps(centres, layout.size_deg)[0].tolist(),
        "cut": cut.nonzero()[:, 0].tolist(),
    }


def _note(layout: ScaledLayout, i: int, cut: bool) -> str:
    """Remarks on the size of icon ``i``; empty if it is scaled by Table 2.2 to a tested size and is not cut."""
    near = layout.eccentricity_deg[i] < FITTED_DEG[0]
    notes = {
        "extrapolated beyond 70 deg": layout.extrapolated[i],
        "not scaled: nearer than 40 deg": layout.kept[i] & near,
        "not scaled: beyond 70 deg it would need extrapolation": layout.kept[i] & ~near,
        "size not tested": ~layout.tested[i],
        "cut by the edge of the field": cut,
    }
    return "; ".join(note for note, applies in notes.items() if applies)


def _rows(settings: LayoutSettings, title: str, layout: ScaledLayout) -> list[dict[str, Any]]:
    cut = _flags(settings, layout)["cut"]
    return [
        {
            "target": title,
            "icon": item.icon,
            "label": item.label,
            "azimuth_deg": item.azimuth_deg,
            "elevation_deg": item.elevation_deg,
            "eccentricity_deg": round(layout.eccentricity_deg[i].item(), 3),
            "size_deg": round(layout.size_deg[i].max().item(), 3),
            "note": _note(layout, i, i in cut),
        }
        for i, item in enumerate(settings.items)
    ]


def _displays(settings: LayoutSettings) -> Iterator[dict[str, Any]]:
    """A row for each display, the user's first: the greatest eccentricity at which it shows each target's sizes."""
    grid = torch.linspace(*FITTED_DEG, 301, dtype=torch.float64)
    own = settings.display
    pixel = None if own is None or own.arcmin is None else (own.arcmin, own.arcmin)
    mine = [] if own is None else [WideDisplay(own.name, own.field_deg, arcmin=pixel)]
    for display in (*mine, *TABLE_2_1):
        row: dict[str, Any] = {"display": display.name, "half_field_deg": display.half_field_deg}
        for target in settings.targets:
            scale = EqualEfficiencyScale.from_table(target.size_deg, target.eccentricity_deg)
            check = check_display(display, scale, grid)
            covered = grid[check.covered].tolist()
            limit = f"to {math.floor(max(covered) + 1e-9)} deg" if covered else "not at 40 deg"
            if covered and display.axis == "diagonal":
                limit += " at most (diagonal)"
            if check.resolved is None:
                limit += ", resolution unknown"
            elif not check.resolved.all():
                limit += ", too coarse"
            row[target.name] = limit
        yield row


def _picture(layouts: Layouts) -> bytes:
    items, field = layouts.settings.items, layouts.settings.field_deg
    high, wide = field[0] / 2, field[1] / 2
    panels = Figure(figsize=(13, 13 * high / wide * len(layouts.scaled) + 1.2), dpi=110)
    panels.set_layout_engine("constrained", h_pad=0.1)
    for k, (target, layout) in enumerate(layouts.scaled):
        axes = panels.add_subplot(len(layouts.scaled), 1, k + 1)
        draw_ground(axes, field)
        for edge in FITTED_DEG:
            for side in (-edge, edge):
                axes.axvline(side, color=_LIMITS, linewidth=1.2, linestyle=":", zorder=5)
        for i, item in enumerate(items):
            size: tuple[float, float] = tuple(layout.size_deg[i].tolist())  # type: ignore[assignment]
            centre = item.azimuth_deg, item.elevation_deg
            if item.icon in ICONS:
                draw_icon(axes, item.icon, centre, size, 10 + i)
            else:
                draw_picture(axes, layouts.pictures[item.icon], centre, size, 10 + i)
            colour, style, _ = _frame(layout, i)
            _box(axes, centre, size, colour, style)
            label = f"{_name(item)}\n{max(size):.1f} deg" + (" *" if layout.extrapolated[i] else "")
            position = centre[0], centre[1] - max(size[0] / 2, 3.0) - 0.4  # below the icon and the dashed box
            halo = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.7}
            axes.text(*position, label, ha="center", va="top", fontsize=7.5, color=colour, zorder=301, bbox=halo)
            if abs(layout.eccentricity_deg[i].item() - target.eccentricity_deg) < 0.05:
                # The box is 0.4 deg larger than the target on each side; an icon at 40 deg is scaled to another size.
                _box(axes, centre, (target.size_deg + 0.8, target.size_deg + 0.8), "#d00000", "--")
        axes.plot(0, 0, "k+", markersize=11, zorder=400)
        axes.set(xlim=(-wide, wide), ylim=(-high, high), aspect="equal")
        title = f"Scaled icons: perceived as soon as a pattern of {target.name} of eccentricity (dashed red boxes)"
        axes.set_title(title, fontsize=11)
        axes.set_ylabel("elevation (deg)", fontsize=9)
        ticks = range(-int(wide // 10) * 10, int(wide) + 1, 10)
        axes.set_xticks(ticks, [str(abs(tick)) for tick in ticks])
    panels.axes[-1].set_xlabel("eccentricity to the left and to the right (deg); + is fixated")
    panels.legend(handles=_legend(layouts), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure_png(panels)


def _frame(layout: ScaledLayout, i: int) -> tuple[str, str, str]:
    """Colour, line style and legend text of the frame of icon ``i``."""
    if layout.extrapolated[i]:
        return _EXTRAPOLATED
    if layout.kept[i]:
        return _KEPT
    return _FITTED if layout.tested[i] else _UNTESTED


def _legend(layouts: Layouts) -> list[Artist]:
    """Legend entries of the frames in the picture, and of the lines at 40 and 70 deg."""
    used = {_frame(layout, i) for _, layout in layouts.scaled for i in range(len(layout.kept))}
    entries: list[Artist] = [
        Rectangle((0, 0), 1, 1, fill=False, edgecolor=colour, linestyle=style, label=label)
        for colour, style, label in (_FITTED, _UNTESTED, _KEPT, _EXTRAPOLATED)
        if (colour, style, label) in used
    ]
    ends = f"{FITTED_DEG[0]:g} and {FITTED_DEG[1]:g} deg: where the lines of Table 2.2 begin and end"
    return [*entries, Line2D([], [], color=_LIMITS, linestyle=":", label=ends)]


def _box(axes: Axes, centre: tuple[float, float], size: tuple[float, float], colour: str, style: str) -> None:
    (x, y), (height, width) = centre, size
    frame = {"fill": False, "edgecolor": colour, "linestyle": style, "linewidth": 1.5, "zorder": 300}
    axes.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, **frame))
