"""A quick look at a volume: its values, the transfer function over them, and a rendering without any hologram."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.runs.pictures import in_colour
from holotorch.experiments.volume.config import ViewSettings
from holotorch.experiments.volume.experiment import VolumeExperiment

_SIDE = 256  # largest number of pixels of the rendering along each side
_SMALL = 96  # that of the renderings from other sides
_SHARES = (1, 25, 50, 75, 90, 95, 99, 99.9)  # percentiles that are listed


def preview(experiment: VolumeExperiment) -> tuple[bytes, str]:
    """PNG of rendering and histogram, and lines with the percentiles of the values and the visible share."""
    values, air = experiment.counted, experiment.background
    every = round(experiment.volume.values.numel() / len(values))
    border = "the smallest value" if air is None else f"{air:.4g}, where the background ends"
    above, of = values[values > (values.min() if air is None else air)], ""
    if air is not None or 0 < len(above) < len(values) / 2:  # without the air, which would hide all that is in it
        of = f" (of the {100 * len(above) / len(values):.2g} % of voxels above {border})"
    chosen = above if of else values
    levels = np.percentile(chosen, _SHARES)
    with torch.no_grad():
        visible = (experiment.transfer(torch.from_numpy(values).to(experiment.device))[1] > 0).double().mean().item()
        picture = experiment.quick_rendering(_SIDE)
    bright = picture.amax().item()
    of += f", of one voxel in {every}" * (every > 1)
    lines = [
        f"Values     {values.min():.6g} to {values.max():.6g}; percentiles{of}: "
        + ", ".join(f"{level:.6g} at {share:g} %" for share, level in zip(_SHARES, levels, strict=True)),
        f"Visible    {100 * visible:.2g} % of the voxels have an opacity above 0"
        + ("" if bright > 0.02 else "; the rendering is black: move the transfer function to the values of the volume"),
    ]
    return _drawn(experiment, values, picture), "\n".join(lines)


def _standing(experiment: VolumeExperiment) -> dict[str, torch.Tensor]:
    """Renderings of an own scan, unlit, by title: for each ``view.up``, and from behind.

    There is one for ``head`` if the file names the sides of a patient.
    """
    settings, pictures = experiment.settings, dict[str, torch.Tensor]()
    if not settings.volume.path:
        return pictures
    behind = settings.view.azimuth_deg + 180
    changes: dict[str, dict[str, Any]] = {
        f"view.up={up}" + " (above)" * (up == settings.view.up): {"up": up}
        for up in get_args(ViewSettings.model_fields["up"].annotation)
        if up != "head" or experiment.volume.frame not in ("", "xyz")
    } | {f"azimuth_deg={behind:g}": {"azimuth_deg": behind}}
    for title, change in changes.items():
        view = settings.view.model_copy(update={**change, "samples": experiment.samples})
        turned = replace(experiment, settings=settings.model_copy(update={"view": view}))
        pictures[title] = turned.quick_rendering(_SMALL, lit=False)
    return pictures


def _drawn(experiment: VolumeExperiment, values: np.ndarray, picture: torch.Tensor) -> bytes:
    others = _standing(experiment)
    figure = Figure(figsize=(11, 6.6 if others else 4.6), layout="constrained")
    rows = figure.add_gridspec(2, 1, height_ratios=(4.6, 2)) if others else figure.add_gridspec(1, 1)
    upper = rows[0].subgridspec(1, 2, width_ratios=(1, 1.5))
    left, right = figure.add_subplot(upper[0]), figure.add_subplot(upper[1])
    _show(left, experiment, picture, "rendering, brightest pixel white")
    for k, (title, other) in enumerate(others.items()):
        axes = figure.add_subplot(rows[1].subgridspec(1, len(others))[k])
        _show(axes, experiment, other, title)
    counts, edges = np.histogram(values, 256)
    right.stairs(np.maximum(counts, 0.5), edges, fill=True, color="0.75")
    right.set(yscale="log", xlabel="value of the volume", ylabel="voxels (of those counted)")
    middles = torch.from_numpy((edges[1:] + edges[:-1]) / 2).to(experiment.device)
    with torch.no_grad():
        colour, opacity = (part.cpu().double() for part in experiment.transfer(middles))
    wavelengths = experiment.settings.wavelengths
    shown = in_colour(colour[: len(wavelengths), None], wavelengths)[:, 0].T.clamp(0, 1)
    over = right.twinx()
    style = {"s": 9, "edgecolors": "0.4", "linewidths": 0.2}
    over.scatter(middles.cpu().numpy(), opacity.numpy(), c=shown.numpy(), **style)
    over.set(ylabel="opacity of a path of unit_distance, in its colour", ylim=(0, 1.02))
    right.set_title("histogram and transfer function", fontsize=10)
    return figure_png(figure)


def _show(axes: Axes, experiment: VolumeExperiment, picture: torch.Tensor, title: str) -> None:
    """A rendering [C, h, w] as a screen shows it."""
    coloured = in_colour(picture, experiment.settings.wavelengths) / picture.amax().clamp(min=1e-9)
    axes.imshow(coloured.clamp(0, 1).movedim(0, -1).numpy())
    axes.set_title(title, fontsize=10)
    axes.set(xticks=[], yticks=[])
