"""Pictures of one scene under several random phases: the speckle-free mean, and errors freed of its residual noise."""

from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import at_least_single


class SeedStatistics(NamedTuple):
    """What independent seeds say together.

    Attributes:
        mean: Speckle-free picture as far as known, [..., H, W].
        variance: Of a single picture about the true mean, per pixel and without bias, [..., H, W].
        contrast: Of a single picture, [...]: root of mean variance over mean squared true mean.
        noise: Expected mean square of what speckle is left in ``mean``, [...].
    """

    mean: Tensor
    variance: Tensor
    contrast: Tensor
    noise: Tensor


def seed_statistics(pictures: Tensor) -> SeedStatistics:
    """Statistics of ``pictures`` [S, ..., H, W], S >= 2 of independent seeds.

    The mean of S pictures keeps 1 / S of their variance, which would count as brightness in mean squared: that is
    subtracted, so that ``contrast`` does not depend on S (6.4.2). 0 for a black scene. In float32 at least.

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
    some = (true > 0) & (noise > 0)
    ratio = torch.where(some, noise * pictures.shape[0], 1.0) / torch.where(some, true, 1.0)
    return SeedStatistics(mean, variance, torch.where(some, torch.sqrt(ratio), 0.0), noise)


def squared_blur(pictures: Tensor, references: Tensor) -> Tensor:
    """Mean square difference of the two speckle-free scenes, estimated without bias from few seeds of each: [...].

    mean |mean(pictures) - mean(references)|^2 less the noise of both means. Being an estimate, it can come out below 0
    where the scenes are alike.

    Args:
        pictures: [S, ..., H, W] with S >= 2, such as those under a wide spectrum.
        references: [R, ..., H, W] with R >= 2, of seeds other than those of ``pictures``: shared ones are not
            independent, and the noise subtracted would be too much.
    """
    ours, theirs = seed_statistics(pictures), seed_statistics(references)
    if pictures.shape[1:] != references.shape[1:]:
        shapes = f"{tuple(pictures.shape)} and {tuple(references.shape)}"
        raise ValueError(f"pictures and references must match but in seeds, got {shapes}")
    return (ours.mean - theirs.mean).square().mean((-2, -1)) - ours.noise - theirs.noise


def squared_error(picture: Tensor, references: Tensor) -> Tensor:
    """Mean square error of one ``picture`` [..., H, W] against the true speckle-free scene, without bias: [...].

    The error against the mean of ``references`` [R, ..., H, W], R >= 2 seeds other than the picture's, less that mean's
    own noise. Speckle of the picture and its blur both count.
    """
    theirs = seed_statistics(references)
    if picture.shape != references.shape[1:]:
        raise ValueError(f"picture must be {tuple(references.shape[1:])} as the references, got {tuple(picture.shape)}")
    return (picture - theirs.mean).square().mean((-2, -1)) - theirs.noise
