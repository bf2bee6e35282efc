"""show: pictures of fields and intensities, as matplotlib figures."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.optics.picture import tone_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUANTITIES = ("amplitude", "phase", "intensity", "colour")
_FAINT = 1e-5  # amplitude, of the largest one, below which phases are mostly rounding
_MOST = 24  # largest number of panels


def show(
    values: Tensor, grid: Grid | None = None, *, what: str | Sequence[str] | None = None, names: Sequence[str] = ()
) -> "Figure":
    """Draw fields or intensities [..., H, W], with a column for each item and a row for each quantity.

    Args:
        values: Complex fields or real values, on any device.
        grid: Sampling, for axes in millimetres; by default the axes count pixels.
        what: "amplitude", "phase", "intensity" or "colour", or several of them. "phase" is blank where the light is
            fainter than 1e-10 of the brightest. "colour" takes three channels as linear red, green and blue. By default
            amplitude and phase of a complex field, and the intensity of real values.
        names: Titles of the columns, one for each.

    Returns:
        A matplotlib figure; ``figure.savefig("field.png")`` writes it, and a notebook shows it.

    Raises:
        TypeError: The values are no tensor.
        ValueError: No image axes, an unknown quantity, "amplitude" or "phase" of real values, "colour" of other than
            three channels, another number of names than columns, or more than 24 panels.
    """
    from matplotlib.figure import Figure

    checks.tensor("values", values)
    if values.ndim < 2 or 0 in values.shape:
        raise ValueError(f"values must end in (H, W) and not be empty, got {tuple(values.shape)}")
    chosen = [what] if isinstance(what, str) else what or (QUANTITIES[:2] if values.is_complex() else QUANTITIES[2:3])
    rows = [(name, _panels(name, values.detach().cpu())) for name in chosen]
    columns = max(len(panels) for _, panels in rows)
    if columns * len(rows) > _MOST:
        raise ValueError(f"values make {columns * len(rows)} panels, more than {_MOST}; show a part of them")
    if names and len(names) != columns:
        colour = "; what='colour' shows three channels as one picture" if columns == 3 * len(names) else ""
        raise ValueError(f"expected {columns} names, one for each panel, got {len(names)}: {list(names)}{colour}")
    figure = Figure(figsize=(3.4 * columns, 3.0 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for row, (name, panels) in enumerate(rows):
        for column in range(columns):
            panel = axes[row][column]
            if column >= len(panels):
                panel.set_axis_off()
                continue
            _draw(figure, panel, name, panels[column], grid)
            panel.set_title(f"{names[column]}\n{name}" if names else name, fontsize=10)
    return figure


def _panels(name: str, values: Tensor) -> Tensor:
    """Panels [N, H, W], or [N, 3, H, W] for colour, of one quantity."""
    if name not in QUANTITIES:
        raise ValueError(f"what must be among {', '.join(QUANTITIES)}, got {name!r}")
    if name in ("amplitude", "phase"):
        if not values.is_complex():
            raise ValueError(f"{name} needs a complex field, got {values.dtype}")
        values = values.reshape(-1, *values.shape[-2:])
        size = values.abs()
        if name == "amplitude":
            return size
        return torch.where(size > _FAINT * size.amax((-2, -1), keepdim=True), torch.angle(values), math.nan)
    light = intensity(values) if values.is_complex() else values
    if name == "intensity":
        return light.reshape(-1, *light.shape[-2:])
    if light.ndim < 3 or light.shape[-3] != 3:
        raise ValueError(f"colour needs three channels, (..., 3, H, W), got {tuple(light.shape)}")
    return light.reshape(-1, *light.shape[-3:])


def _draw(figure: "Figure", axes, name: str, values: Tensor, grid: Grid | None) -> None:
    from matplotlib import colormaps

    extent = None
    if grid is not None:
        (height, width), (y, x) = grid.shape, (1e3 * pitch for pitch in grid.pitch)
        left, top = -(width // 2 + 0.5) * x, -(height // 2 + 0.5) * y
        extent = (left, left + width * x, top + height * y, top)
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    if name == "colour":
        encoded = tone_map(values.double(), gamma=1 / 2.2).movedim(0, -1)
        axes.imshow(encoded.float().numpy(), extent=extent, interpolation="nearest")
        return
    options: dict[str, Any] = {"cmap": "gray"}
    if name == "phase":
        blank = colormaps["twilight"].with_extremes(bad="0.85")
        options = {"cmap": blank, "vmin": -math.pi, "vmax": math.pi}
    drawn = axes.imshow(values.float().numpy(), extent=extent, interpolation="nearest", **options)
    figure.colorbar(drawn, ax=axes, shrink=0.8, label="rad" if name == "phase" else None)
