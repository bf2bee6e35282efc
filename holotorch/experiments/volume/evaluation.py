"""Evaluation of a volume's hologram: refocused pictures compared with the rendering of the volume."""

import math
from typing import Any

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.volume.experiment import VolumeExperiment
from holotorch.hologram import refocused
from holotorch.metrics import SSIM_WINDOW, ssim

_TOLERANCE = 3e-3  # relative L2 error of the propagation to the refocused pictures
_BRIGHT = 0.25  # speckle is measured on pixels brighter than this fraction of the brightest pixel of the rendering
VISIBLE = 0.05  # opacity above which a ray shows part of the volume


class VolumeEvaluation:
    """Refocused pictures, averaged over realisations, and the rendering that they are compared with.

    Attributes:
        depths: Depths in metres at which the hologram is refocused.
        rendering: Direct volume rendering along the rays, red, green, blue [3, h, w].
        opacity: Opacity of each ray, [h, w].
        depth: Mean depth of the light of each ray, in metres, [h, w].
        visible: Rays that show part of the volume, [h, w].
        sums: Sum of refocused intensities over realisations, averaged over the pixels of each ray, [F, 3, h, w].
        count: Number of realisations in ``sums``.
    """

    def __init__(self, experiment: VolumeExperiment):
        self.experiment = experiment
        sampler = experiment.sampler()
        with torch.no_grad():
            self.rendering, self.opacity = (part.cpu() for part in sampler.render(experiment.volume))
            self.depth = sampler.depth_map(experiment.volume).cpu()
        self.visible = self.opacity > VISIBLE
        self.depths = experiment.refocus or self._typical()
        self.sums = torch.zeros(len(self.depths), *self.rendering.shape)
        self.count = 0

    def add(self, hologram: Tensor) -> None:
        """Refocus another realisation [3, H, W] and add its pictures."""
        experiment, stride = self.experiment, self.experiment.stride
        for f, depth in enumerate(self.depths):
            for colour, wavelength in enumerate(experiment.settings.wavelengths):
                field = refocused(hologram[colour], experiment.grid, wavelength, depth, tolerance=_TOLERANCE)
                self.sums[f, colour] += pooled(intensity(field), stride).cpu()
        self.count += 1

    @property
    def pictures(self) -> Tensor:
        """Mean refocused pictures [F, 3, h, w]; each colour is scaled to fit the rendering best."""
        mean = self.sums / max(1, self.count)
        return mean * best_scale(self.sharpest(mean), self.rendering)[:, None, None]

    def sharpest(self, pictures: Tensor) -> Tensor:
        """Compose a picture [3, h, w]: each ray is taken from the picture refocused nearest to the depth of the ray."""
        chosen = self._nearest()[None, None].expand(1, *pictures.shape[1:])
        return pictures.gather(0, chosen)[0]

    def numbers(self) -> dict[str, Any]:
        """Scores of the mean so far: SSIM, speckle contrast, and the error of each part of the scene by focus."""
        pictures = self.pictures
        shown, wanted = self.sharpest(pictures).clamp(0, 1), self.rendering.clamp(0, 1)
        numbers: dict[str, Any] = {"realisations": self.count}
        if min(shown.shape[-2:]) >= SSIM_WINDOW:
            numbers["ssim_in_focus"] = ssim(shown, wanted, data_range=1.0).mean().item()
            numbers["ssim_at_depth"] = [ssim(p.clamp(0, 1), wanted, data_range=1.0).mean().item() for p in pictures]
        numbers["speckle_contrast"] = self._speckle(pictures)
        numbers["error_of_band_at_depth"] = self._bands(pictures)
        return numbers

    def _typical(self) -> list[float]:
        """The 10, 50 and 90 % quantiles of the depths of the visible rays."""
        if not self.visible.any():
            return [self.experiment.distance]
        depths = self.depth[self.visible].sort().values
        return [depths[round(share * (len(depths) - 1))].item() for share in (0.1, 0.5, 0.9)]

    def _nearest(self) -> Tensor:
        """Index of the picture refocused nearest to the depth of a ray; the middle picture for rays without light."""
        depths = torch.tensor(self.depths, dtype=self.depth.dtype)
        depth = torch.where(self.visible, self.depth, depths[len(depths) // 2])
        return (depth - depths[:, None, None]).abs().argmin(0)

    def _bands(self, pictures: Tensor) -> list[list[float | None]]:
        """Relative error of the rays nearest to each depth (rows), in the picture refocused at each depth (columns)."""
        nearest = self._nearest()
        table = []
        for band in range(len(self.depths)):
            mask = (nearest == band) & self.visible
            power = self.rendering[:, mask].square().sum().item()
            errors = [(picture - self.rendering)[:, mask].square().sum().item() for picture in pictures]
            table.append([math.sqrt(error / power) if power > 0 else None for error in errors])
        return table

    def _speckle(self, pictures: Tensor) -> float | None:
        """Standard deviation divided by mean of the ratio of picture to rendering, on bright pixels of the latter."""
        bright = self.rendering > _BRIGHT * self.rendering.max()
        if not bright.any():
            return None
        ratio = self.sharpest(pictures)[bright] / self.rendering[bright]
        return (ratio.std() / ratio.mean()).item()


def pooled(image: Tensor, stride: int) -> Tensor:
    """Mean of the pixels around each ray, [H / stride, W / stride]; ray i is at pixel ``stride * i`` of an axis."""
    if stride == 1:
        return image
    height, width = image.shape
    # Each ray is in the middle of its cell, so the first cells extend beyond the edge of the image.
    before = stride // 2
    cells = torch.nn.functional.pad(torch.stack([image, torch.ones_like(image)]), (before, 0, before, 0))
    cells = cells[:, :height, :width].reshape(2, height // stride, stride, width // stride, stride).sum((2, 4))
    return cells[0] / cells[1]
