"""Statistics over pictures of one scene with different random phases, and image errors corrected for speckle."""

from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import at_least_single
from holotorch.metrics.speckle import root_ratio


class SeedStatistics(NamedTuple):
    """Statistics over pictures of one scene, each with the random phase of another seed.

    Attributes:
        mean: Mean over the seeds, an estimate of the speckle-free picture, [..., H, W].
        variance: Unbiased variance of each pixel over the seeds, [..., H, W].
        contrast: Speckle contrast of a single picture, [...]: rms of the speckle / rms of the speckle-free picture.
        noise: Expected mean square, over the pixels, of the speckle that remains in ``mean``, [...].
    """

    mean: Tensor
    variance: Tensor
    contrast: Tensor
    noise: Tensor


def seed_statistics(pictures: Tensor) -> SeedStatistics:
    """Statistics of ``pictures`` [S, ..., H, W] of one scene with S >= 2 independent seeds.

    Averaging S pictures divides the variance of the speckle by S. The remaining variance is subtracted from the mean
    square of the average, so that ``contrast`` does not depend on S except for noise (thesis Sec. 6.4.2). It is 0 for a
    black scene. TypeError for pictures that are not real floating-point, ValueError for fewer than two seeds.
    """
    checks.real("pictures", pictures)
    if pictures.ndim < 3 or pictures.shape[0] < 2:
        raise ValueError(f"pictures must be [S, ..., H, W] with two seeds or more, got {tuple(pictures.shape)}")
    variance, mean = torch.var_mean(at_least_single(pictures), 0)
    noise = variance.mean((-2, -1)) / pictures.shape[0]
    contrast = root_ratio(noise * pictures.shape[0], mean.square().mean((-2, -1)) - noise)
    return SeedStatistics(mean, variance, contrast, noise)


def squared_blur(pictures: Tensor, references: Tensor) -> Tensor:
    """Unbiased estimate [...] of the mean square difference between two speckle-free pictures, as a measure of blur.

    The speckle expected to remain in the two means is subtracted from the mean square of their difference. The estimate
    can be negative. Raises as :func:`seed_statistics`, and ValueError for unequal shapes [..., H, W].

    Args:
        pictures: Pictures with S >= 2 seeds, [S, ..., H, W].
        references: Pictures with R >= 2 other seeds, [R, ..., H, W]; with shared seeds, too much is subtracted.
    """
    first, second = seed_statistics(pictures), seed_statistics(references)
    if pictures.shape[1:] != references.shape[1:]:
        shapes = f"{tuple(pictures.shape)} and {tuple(references.shape)}"
        raise ValueError(f"pictures and references must match except in seeds, got {shapes}")
    return (first.mean - second.mean).square().mean((-2, -1)) - first.noise - second.noise


def squared_error(picture: Tensor, references: Tensor) -> Tensor:
    """Unbiased estimate [...] of the mean square error of a ``picture`` [..., H, W], due to both speckle and blur.

    The picture is compared with the mean of ``references`` [R, ..., H, W], which have R >= 2 other seeds. The speckle
    expected to remain in this mean is subtracted. ``references`` are checked as in :func:`seed_statistics`; ValueError
    if the shape of ``picture`` differs.
    """
    reference = seed_statistics(references)
    if picture.shape != references.shape[1:]:
        raise ValueError(f"picture must be {tuple(references.shape[1:])} as the references, got {tuple(picture.shape)}")
    return (picture - reference.mean).square().mean((-2, -1)) - reference.noise
