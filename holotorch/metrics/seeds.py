"""Statistics over pictures of one scene with several random phases, and errors corrected for residual speckle."""

from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import at_least_single


class SeedStatistics(NamedTuple):
    """Statistics over pictures of independent seeds.

    Attributes:
        mean: Estimate of the speckle-free picture, [..., H, W].
        variance: Unbiased variance of a single picture about the true mean, per pixel, [..., H, W].
        contrast: Speckle contrast of a single picture, [...]: root of the mean variance over the mean square of the
            true mean.
        noise: Expected mean square of the speckle left in ``mean``, [...].
    """

    mean: Tensor
    variance: Tensor
    contrast: Tensor
    noise: Tensor


def seed_statistics(pictures: Tensor) -> SeedStatistics:
    """Statistics of ``pictures`` [S, ..., H, W], S >= 2 of independent seeds.

    The mean of S pictures keeps 1 / S of their variance, which biases its mean square. This bias is subtracted, so that
    ``contrast`` does not depend on S (Sec. 6.4.2). The contrast of a black scene is 0. Computed in float32 at least.

    Raises:
        TypeError: Pictures that are not real floating-point.
        ValueError: Fewer than two seeds.
    """
    checks.real("pictures", pictures)
    if pictures.ndim < 3 or pictures.shape[0] < 2:
        raise ValueError(f"pictures must be [S, ..., H, W] with two seeds or more, got {tuple(pictures.shape)}")
    variance, mean = torch.var_mean(at_least_single(pictures), 0)
    noise = variance.mean((-2, -1)) / pictures.shape[0]
    true = mean.square().mean((-2, -1)) - noise
    defined = (true > 0) & (noise > 0)
    ratio = torch.where(defined, noise * pictures.shape[0], 1.0) / torch.where(defined, true, 1.0)
    return SeedStatistics(mean, variance, torch.where(defined, torch.sqrt(ratio), 0.0), noise)


def squared_blur(pictures: Tensor, references: Tensor) -> Tensor:
    """Unbiased estimate of the mean square difference of two speckle-free scenes from a few seeds of each: [...].

    It is mean |mean(pictures) - mean(references)|^2 less the noise of both means, and can be negative for equal scenes.

    Args:
        pictures: [S, ..., H, W] with S >= 2, such as those under a wide spectrum.
        references: [R, ..., H, W] with R >= 2, of other seeds than ``pictures``: with shared seeds the noise would not
            be independent and too much would be subtracted.
    """
    first, second = seed_statistics(pictures), seed_statistics(references)
    if pictures.shape[1:] != references.shape[1:]:
        shapes = f"{tuple(pictures.shape)} and {tuple(references.shape)}"
        raise ValueError(f"pictures and references must match except in seeds, got {shapes}")
    return (first.mean - second.mean).square().mean((-2, -1)) - first.noise - second.noise


def squared_error(picture: Tensor, references: Tensor) -> Tensor:
    """Unbiased mean square error of one ``picture`` [..., H, W] against the true speckle-free scene: [...].

    It is the error against the mean of ``references`` [R, ..., H, W], of R >= 2 other seeds, less the noise of that
    mean. Speckle of the picture and its blur both count.
    """
    reference = seed_statistics(references)
    if picture.shape != references.shape[1:]:
        raise ValueError(f"picture must be {tuple(references.shape[1:])} as the references, got {tuple(picture.shape)}")
    return (picture - reference.mean).square().mean((-2, -1)) - reference.noise
