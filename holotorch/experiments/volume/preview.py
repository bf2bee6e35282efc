"""A quick look at a volume: its values, the transfer function over them, and a rendering without any hologram."""

import numpy as np
import torch
from matplotlib.figure import Figure

from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.runs.pictures import in_colour
from holotorch.experiments.volume.experiment import VolumeExperiment

_SIDE = 256  # largest number of pixels of the rendering along each side
_SAMPLE = 1_000_000  # largest number of voxels in the histogram
_SHARES = (1, 25, 50, 75, 90, 95, 99, 99.9)  # percentiles that are listed


def preview(experiment: VolumeExperiment) -> tuple[bytes, str]:
    """PNG of rendering and histogram, and lines with the percentiles of the values and the visible share."""
    values = experiment.volume.values.detach().flatten()
    every = max(1, len(values) // _SAMPLE)
    values = values[::every].double().cpu()
    lowest, chosen, of = values.min(), values, ""
    if 0.5 < (share := (values == lowest).double().mean().item()) < 1:  # air, which would hide all that is in it
        chosen, of = values[values > lowest], f" (of the {100 * (1 - share):.2g} % of voxels above the smallest value)"
    levels = np.percentile(chosen.numpy(), _SHARES)
    with torch.no_grad():
        visible = (experiment.transfer(values.to(experiment.device))[1] > 0).double().mean().item()
        picture = experiment.quick_rendering(_SIDE)
    bright = picture.amax().item()
    picture = in_colour(picture, experiment.settings.wavelengths)
    lines = [
        f"Values     {lowest:.6g} to {values.max():.6g}; percentiles{of}{f', of one voxel in {every}' * (every > 1)}: "
        + ", ".join(f"{level:.6g} at {share:g} %" for share, level in zip(_SHARES, levels, strict=True)),
        f"Visible    {100 * visible:.2g} % of the voxels have an opacity above 0"
        + ("" if bright > 0.02 else "; the rendering is black: move the transfer function to the values of the volume"),
    ]
    return _drawn(experiment, values.numpy(), (picture / max(bright, 1e-9)).clamp(0, 1)), "\n".join(lines)


def _drawn(experiment: VolumeExperiment, values: np.ndarray, picture: torch.Tensor) -> bytes:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.5))
    left.imshow(picture.movedim(0, -1).numpy())
    left.set_title("rendering, brightest pixel white", fontsize=10)
    left.set(xticks=[], yticks=[])
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
