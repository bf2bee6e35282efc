"""Statistics over pictures of a scene with several random phases, and errors with the residual speckle subtracted."""

from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import at_least_single
from holotorch.metrics.speckle import root_ratio


class SeedStatistics(NamedTuple):
    """Statistics over pictures of independent seeds.

    Attributes:
        mean: Mean over the seeds, an estimate of the speckle-free picture, [..., H, W].
        variance: Unbiased variance of each pixel over the seeds, [..., H, W].
        contrast: Speckle contrast of a single picture, [...]: rms of the speckle over rms of the speckle-free picture.
        noise: Expected mean square of the speckle left in ``mean``, [...].
    """

    mean: Tensor
    variance: Tensor
    contrast: Tensor
    noise: Tensor


def seed_statistics(pictures: Tensor) -> SeedStatistics:
    """Statistics of ``pictures`` [S, ..., H, W] of S >= 2 independent seeds.

    The mean of S pictures keeps 1 / S of their variance, which increases its mean square. That share is subtracted, so
    that ``contrast`` does not depend on S (thesis Sec. 6.4.2). It is 0 for a black scene. Computed in float32 at least.
    TypeError for pictures that are not real floating-point, ValueError for fewer than two seeds.
    """
    checks.real("pictures", pictures)
    if pictures.ndim < 3 or pictures.shape[0] < 2:
        raise ValueError(f"pictures must be [S, ..., H, W] with two seeds or more, got {tuple(pictures.shape)}")
    variance, mean = torch.var_mean(at_least_single(pictures), 0)
    noise = variance.mean((-2, -1)) / pictures.shape[0]
    contrast = root_ratio(noise * pictures.shape[0], mean.square().mean((-2, -1)) - noise)
    return SeedStatistics(mean, variance, contrast, noise)


def squared_blur(pictures: Tensor, references: Tensor) -> Tensor:
    """Unbiased estimate of the mean square difference of two speckle-free scenes from a few seeds of each: [...].

    The expected noise of both means is subtracted from the mean square of their difference, which can give a negative
    number for equal scenes.

    Args:
        pictures: [S, ..., H, W] with S >= 2, such as those under a wide spectrum.
        references: [R, ..., H, W] with R >= 2, of other seeds than ``pictures``: with shared seeds the noise of the
            means is correlated, and too much is subtracted.
    """
    first, second = seed_statistics(pictures), seed_statistics(references)
    if pictures.shape[1:] != references.shape[1:]:
        shapes = f"{tuple(pictures.shape)} and {tuple(references.shape)}"
        raise ValueError(f"pictures and references must match except in seeds, got {shapes}")
    return (first.mean - second.mean).square().mean((-2, -1)) - first.noise - second.noise


def squared_error(picture: Tensor, references: Tensor) -> Tensor:
    """Unbiased estimate of the mean square error of one ``picture`` [..., H, W] against the speckle-free scene: [...].

    The scene is estimated by the mean of ``references`` [R, ..., H, W] of R >= 2 other seeds, and the expected noise of
    that mean is subtracted. Both the speckle and the blur of the picture contribute to the error.
    """
    reference = seed_statistics(references)
    if picture.shape != references.shape[1:]:
        raise ValueError(f"picture must be {tuple(references.shape[1:])} as the references, got {tuple(picture.shape)}")
    return (picture - reference.mean).square().mean((-2, -1)) - reference.noise
