"""Statistics over pictures of one scene whose random phases have different seeds, and speckle-corrected errors."""

from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import at_least_single
from holotorch.metrics.speckle import root_ratio


class SeedStatistics(NamedTuple):
    """Statistics over pictures of one scene, each with the random phase of a different seed.

    Attributes:
        mean: Mean over the seeds, an estimate of the speckle-free picture, [..., H, W].
        variance: Unbiased variance of each pixel over the seeds, [..., H, W].
        contrast: Speckle contrast of a single picture, [...]: rms of the speckle / rms of the speckle-free picture.
        noise: Mean over the pixels of the expected squared speckle that remains in ``mean``, [...].
    """

    mean: Tensor
    variance: Tensor
    contrast: Tensor
    noise: Tensor


def seed_statistics(pictures: Tensor) -> SeedStatistics:
    """Statistics of ``pictures`` [S, ..., H, W] of one scene with S >= 2 independent seeds.

    Averaging S pictures divides the variance of the speckle by S. For ``contrast``, this remaining variance is
    subtracted from the mean square of the average, so that the estimate does not depend systematically on S (thesis
    Sec. 6.4.2). The contrast of a black scene is 0. TypeError for pictures that are not real floating-point, ValueError
    for fewer than two seeds.
    """
    checks.real("pictures", pictures)
    if pictures.ndim < 3 or pictures.shape[0] < 2:
        raise ValueError(f"pictures must be [S, ..., H, W] with two seeds or more, got {tuple(pictures.shape)}")
    variance, mean = torch.var_mean(at_least_single(pictures), 0)
    speckle = variance.mean((-2, -1))
    noise = speckle / pictures.shape[0]
    contrast = root_ratio(speckle, mean.square().mean((-2, -1)) - noise)
    return SeedStatistics(mean, variance, contrast, noise)


def squared_blur(pictures: Tensor, references: Tensor) -> Tensor:
    """Mean square difference [...] between two scenes without their speckle, a measure of blur; an unbiased estimate.

    Each scene is averaged over its seeds. The speckle expected to remain in the two averages is subtracted from the
    mean square of their difference, so the estimate can be negative.

    Args:
        pictures: Pictures with S >= 2 seeds, [S, ..., H, W].
        references: Pictures with R >= 2 other seeds, [R, ..., H, W]; with shared seeds, too much is subtracted.

    Raises:
        TypeError: Pictures that are not real floating-point.
        ValueError: Fewer than two seeds, or unequal shapes [..., H, W].
    """
    first, second = seed_statistics(pictures), seed_statistics(references)
    if pictures.shape[1:] != references.shape[1:]:
        shapes = f"{tuple(pictures.shape)} and {tuple(references.shape)}"
        raise ValueError(f"pictures and references must match except in the number of seeds, got {shapes}")
    return (first.mean - second.mean).square().mean((-2, -1)) - first.noise - second.noise


def squared_error(picture: Tensor, references: Tensor) -> Tensor:
    """Mean square error [...] of a single ``picture`` [..., H, W], due to its speckle and blur; an unbiased estimate.

    The picture is compared with the mean of ``references`` [R, ..., H, W], which have R >= 2 other seeds. The speckle
    expected to remain in this mean is subtracted. TypeError for references that are not real floating-point, ValueError
    for fewer than two seeds, or if the shape of ``picture`` differs.
    """
    reference = seed_statistics(references)
    if picture.shape != references.shape[1:]:
        raise ValueError(
            f"picture must be {tuple(references.shape[1:])} like the references, got {tuple(picture.shape)}"
        )
    return (picture - reference.mean).square().mean((-2, -1)) - reference.noise
