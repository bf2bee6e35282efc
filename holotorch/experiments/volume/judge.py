"""How a volume's hologram is judged: refocused by the planned propagation, against the rendering of the same volume."""

import math
from typing import Any

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.volume.experiment import VolumeExperiment
from holotorch.hologram import refocused
from holotorch.metrics import SSIM_WINDOW, ssim

_SEEN = 0.05  # opacity above which a ray shows something


class VolumeJudge:
    """Mean of refocused pictures over realisations, and what they are compared with.

    Attributes:
        depths: At which the hologram is refocused, in metres.
        rendering: Red, green, blue [3, h, w] of the volume as the rays see it.
        opacity: [h, w].
        depth: Mean depth of what each ray sees [h, w], in metres.
        sums: Sum of refocused intensities [F, 3, h, w], each ray's pixels averaged.
        count: Realisations in it.
    """

    def __init__(self, experiment: VolumeExperiment):
        self.experiment = experiment
        sampler = experiment.sampler()
        with torch.no_grad():
            self.rendering, self.opacity = (part.cpu() for part in sampler.render(experiment.volume))
            self.depth = sampler.depth_map(experiment.volume).cpu()
        self.seen = self.opacity > _SEEN
        self.depths = experiment.refocus or self._typical()
        self.sums = torch.zeros(len(self.depths), *self.rendering.shape)
        self.count = 0

    def add(self, hologram: Tensor) -> None:
        """Refocus one more realisation [3, H, W]."""
        experiment, stride = self.experiment, self.experiment.stride
        for f, depth in enumerate(self.depths):
            for colour, wave in enumerate(experiment.settings.wavelengths):
                field = refocused(hologram[colour], experiment.grid, wave, depth, tolerance=3e-3)
                self.sums[f, colour] += pooled(intensity(field), stride).cpu()
        self.count += 1

    @property
    def pictures(self) -> Tensor:
        """Refocused pictures [F, 3, h, w] at the scale that fits the rendering best, one per colour."""
        mean = self.sums / max(1, self.count)
        sharp = self.sharpest(mean)
        scale = best_scale(sharp, self.rendering)
        return mean * scale[:, None, None]

    def sharpest(self, pictures: Tensor) -> Tensor:
        """Each ray from the picture whose depth is nearest to what it sees, [3, h, w]."""
        chosen = self._nearest()[None, None].expand(1, *pictures.shape[1:])
        return pictures.gather(0, chosen)[0]

    def numbers(self) -> dict[str, Any]:
        """Scores of the mean so far: SSIM of what is in focus, and where each part of the scene is most itself."""
        pictures = self.pictures
        shown = self.sharpest(pictures).clamp(0, 1)
        numbers: dict[str, Any] = {"realisations": self.count}
        if min(shown.shape[-2:]) >= SSIM_WINDOW:
            numbers["ssim_in_focus"] = ssim(shown, self.rendering.clamp(0, 1), data_range=1.0).mean().item()
            numbers["ssim_at_depth"] = [
                ssim(picture.clamp(0, 1), self.rendering.clamp(0, 1), data_range=1.0).mean().item()
                for picture in pictures
            ]
        numbers["speckle_contrast"] = self._speckle(pictures)
        numbers["error_of_band_at_depth"] = self._bands(pictures)
        return numbers

    def _typical(self) -> list[float]:
        """Depths nearer than which a tenth, half and nine tenths of the rays see something."""
        if not self.seen.any():
            return [self.experiment.distance]
        depths = self.depth[self.seen].sort().values
        return [depths[round(part * (len(depths) - 1))].item() for part in (0.1, 0.5, 0.9)]

    def _nearest(self) -> Tensor:
        """Number of the picture whose depth is nearest to what a ray sees; the middle one's where it sees nothing."""
        depths = torch.tensor(self.depths, dtype=self.depth.dtype)
        depth = torch.where(self.seen, self.depth, depths[len(depths) // 2])
        return (depth - depths[:, None, None]).abs().argmin(0)

    def _bands(self, pictures: Tensor) -> list[list[float | None]]:
        """Relative error of the rays that see something near each depth (rows), refocused at each depth (columns)."""
        nearest = self._nearest()
        table = []
        for band in range(len(self.depths)):
            mask = (nearest == band) & self.seen
            power = self.rendering[:, mask].square().sum().item()
            errors = [(picture - self.rendering)[:, mask].square().sum().item() for picture in pictures]
            table.append([math.sqrt(error / power) if power > 0 else None for error in errors])
        return table

    def _speckle(self, pictures: Tensor) -> float | None:
        """Standard deviation over mean of the picture in focus, relative to the rendering, where that is bright."""
        bright = self.rendering > 0.25 * self.rendering.max()
        if not bright.any():
            return None
        ratio = self.sharpest(pictures)[bright] / self.rendering[bright]
        return (ratio.std() / ratio.mean()).item()


def pooled(image: Tensor, stride: int) -> Tensor:
    """Mean of the pixels around each ray, [H / stride, W / stride]; the ray lies on pixel ``stride * i``."""
    if stride == 1:
        return image
    height, width = image.shape
    # Cells are shifted so that each ray is in the middle of its own; the first ones reach over the edge.
    before = stride // 2
    cells = torch.nn.functional.pad(torch.stack([image, torch.ones_like(image)]), (before, 0, before, 0))
    cells = cells[:, :height, :width].reshape(2, height // stride, stride, width // stride, stride).sum((2, 4))
    return cells[0] / cells[1]
