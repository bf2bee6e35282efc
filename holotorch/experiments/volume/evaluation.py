"""Evaluation of a volume's hologram: refocused pictures compared with the rendering of the volume."""

import math
from typing import Any
from warnings import catch_warnings

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.volume.experiment import REFOCUSING, VolumeExperiment
from holotorch.hologram import refocused
from holotorch.metrics import SSIM_WINDOW, ssim

_BRIGHT = 0.25  # fraction of the brightest pixel of the rendering above which the speckle of a pixel is measured
VISIBLE = 0.05  # opacity above which a ray shows part of the volume


class VolumeEvaluation:
    """Pictures refocused at F depths, averaged over realisations, and the rendering that they are compared with.

    Attributes:
        depths: Depths in metres at which the hologram is refocused.
        rendering: Direct volume rendering along the rays, a channel for each wavelength, [C, h, w].
        opacity: Opacity of each ray, [h, w].
        depth: Mean depth of the light of each ray, in metres, [h, w].
        visible: Whether each ray shows part of the volume, bool [h, w].
        sums: Sum of refocused intensities over realisations, averaged over the pixels of each ray, [F, C, h, w].
        count: Number of realisations in ``sums``.
    """

    def __init__(self, experiment: VolumeExperiment):
        self.experiment = experiment
        self.rendering, self.opacity = experiment.rendering()
        self.depth = experiment.depth_map()
        self.visible = self.opacity > VISIBLE
        self.depths = experiment.refocus or self._quantiles()
        self.sums = torch.zeros(len(self.depths), *self.rendering.shape)
        self.count = 0

    def add(self, hologram: Tensor) -> None:
        """Refocus the hologram [C, H, W] of another realisation and add its pictures to the sums."""
        experiment, stride = self.experiment, self.experiment.stride
        tolerance = experiment.budget.share(REFOCUSING)
        for f, depth in enumerate(self.depths):
            for colour, wavelength in enumerate(experiment.settings.wavelengths):
                with catch_warnings(action="ignore", category=SamplingWarning):  # the plan states the error
                    field = refocused(hologram[colour], experiment.grid, wavelength, depth, tolerance=tolerance)
                self.sums[f, colour] += pooled(intensity(field), stride).cpu()
        self.count += 1

    @property
    def pictures(self) -> Tensor:
        """Mean refocused pictures [F, C, h, w], with each colour scaled to fit the rendering best."""
        mean = self.sums / max(1, self.count)
        return mean * best_scale(self.sharpest(mean), self.rendering)[:, None, None]

    def sharpest(self, pictures: Tensor) -> Tensor:
        """Picture [C, h, w] that takes each ray from the one of ``pictures`` refocused nearest to the ray's depth."""
        return pictures.gather(0, self._nearest().expand(1, *pictures.shape[1:]))[0]

    def numbers(self) -> dict[str, Any]:
        """Scores of the mean so far: SSIM, speckle contrast, and the error of each part of the scene by focus."""
        pictures, reference = self.pictures, self.rendering.clamp(0, 1)
        numbers: dict[str, Any] = {"realisations": self.count}
        if not self.visible.any():
            numbers["nothing_visible"] = True  # a black picture is like any other black one
        elif min(reference.shape[-2:]) >= SSIM_WINDOW:
            in_focus, *at_depth = (
                ssim(picture.clamp(0, 1), reference, data_range=1.0).mean().item()
                for picture in (self.sharpest(pictures), *pictures)
            )
            numbers |= {"ssim_in_focus": in_focus, "ssim_at_depth": at_depth}
        numbers["speckle_contrast"] = self._speckle_contrast(pictures)
        numbers["error_of_band_at_depth"] = self._errors(pictures)
        return numbers

    def _quantiles(self) -> list[float]:
        """The 10, 50 and 90 % quantiles of the depths of the visible rays, or the volume's middle if there are none."""
        if not self.visible.any():
            return [self.experiment.distance]
        depths = self.depth[self.visible].sort().values
        return [depths[round(share * (len(depths) - 1))].item() for share in (0.1, 0.5, 0.9)]

    def _nearest(self) -> Tensor:
        """Index [h, w] of the entry of ``depths`` nearest to each ray's depth; the middle entry for invisible rays."""
        depths = torch.tensor(self.depths, dtype=self.depth.dtype)
        depth = torch.where(self.visible, self.depth, depths[len(depths) // 2])
        return (depth - depths[:, None, None]).abs().argmin(0)

    def _errors(self, pictures: Tensor) -> list[list[float | None]]:
        """Relative error of the rays nearest to each depth (rows), in the picture refocused at each depth (columns)."""
        nearest = self._nearest()
        table = []
        for f in range(len(self.depths)):
            mask = (nearest == f) & self.visible
            power = self.rendering[:, mask].square().sum().item()
            errors = [(picture - self.rendering)[:, mask].square().sum().item() for picture in pictures]
            table.append([math.sqrt(error / power) if power > 0 else None for error in errors])
        return table

    def _speckle_contrast(self, pictures: Tensor) -> float | None:
        """Standard deviation over mean of the ratio of the sharpest picture to the rendering, at bright pixels."""
        bright = self.rendering > _BRIGHT * self.rendering.max()
        if not bright.any():
            return None
        ratio = self.sharpest(pictures)[bright] / self.rendering[bright]
        return (ratio.std() / ratio.mean()).item()


def pooled(image: Tensor, stride: int) -> Tensor:
    """Mean of ``image`` [H, W] over ``stride`` x ``stride`` pixels around each ray; ray i is at pixel stride * i."""
    if stride == 1:
        return image
    height, width = image.shape
    before = stride // 2
    cells = torch.nn.functional.pad(torch.stack([image, torch.ones_like(image)]), (before, 0, before, 0))
    cells = cells[:, :height, :width].reshape(2, height // stride, stride, width // stride, stride).sum((2, 4))
    return cells[0] / cells[1]
