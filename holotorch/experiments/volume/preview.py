"""A quick look at a volume: its values, the transfer function over them, and a rendering without any hologram."""

import numpy as np
import torch
from matplotlib.figure import Figure

from holotorch.core.grid import Grid
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.volume.experiment import VolumeExperiment
from holotorch.scene.sampler import DVRSampler

_SIDE = 256  # pixels of the rendering along each side at most
_SAMPLE = 1_000_000  # voxels that are counted at most
_SHARES = (1, 25, 50, 75, 90, 95, 99, 99.9)  # percentiles that are told


def preview(experiment: VolumeExperiment) -> tuple[bytes, str]:
    """PNG of rendering and histogram, and lines with the percentiles of the values and the visible share."""
    values = experiment.volume.values.detach().flatten()
    values = values[:: max(1, len(values) // _SAMPLE)].double().cpu()
    levels = np.percentile(values.numpy(), _SHARES)
    with torch.no_grad():
        visible = (experiment.transfer(values.to(experiment.device))[1] > 0).double().mean().item()
        picture = _rendered(experiment)
    bright = picture.amax().item()
    lines = [
        f"Values     {values.min():.6g} to {values.max():.6g}; percentiles "
        + ", ".join(f"{share:g} %: {level:.6g}" for share, level in zip(_SHARES, levels, strict=True)),
        f"Visible    {100 * visible:.2g} % of the voxels have an opacity above 0"
        + ("" if bright > 0.02 else "; the rendering is black: move the transfer function to the values of the volume"),
    ]
    return _drawn(experiment, values.numpy(), (picture / max(bright, 1e-9)).clamp(0, 1)), "\n".join(lines)


def _rendered(experiment: VolumeExperiment) -> torch.Tensor:
    """Picture [3, h, w] of the scene as the run renders it, on at most 256 pixels along each side."""
    rays = experiment.rays
    step = max(1, -(-max(rays.shape) // _SIDE))
    height, width = (max(1, n // step) for n in rays.shape)
    exact = experiment.sampler()
    few = DVRSampler(
        experiment.transfer,
        Grid((height, width), (rays.pitch[0] * step, rays.pitch[1] * step)),
        experiment.depths,
        width=experiment.width,
        distance=experiment.distance,
        rotation=experiment.rotation,
        lighting=exact.lighting,
    )
    few.checks_slabs = False  # the plan tells their error
    return few.render(experiment.volume)[0].cpu()


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
        colour, opacity = (part.cpu().double().numpy() for part in experiment.transfer(middles))
    over = right.twinx()
    over.scatter(middles.cpu().numpy(), opacity, s=9, c=np.clip(colour.T, 0, 1), edgecolors="0.4", linewidths=0.2)
    over.set(ylabel="opacity of a path of unit_distance, in its colour", ylim=(0, 1.02))
    right.set_title("histogram and transfer function", fontsize=10)
    return figure_png(figure)
