"""Icons and labels over a wide field, scaled so that each has the perception time of the target pattern."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.perception import angles
from holotorch.perception.geometry import eccentricity_of
from holotorch.perception.scale import TESTED_DEG, EqualEfficiencyScale


@dataclass(frozen=True, eq=False)
class ScaledLayout:
    """A scaled layout of N items, in the given order.

    Attributes:
        size_deg: (height, width) of each item, [N, 2]; the larger is its size.
        eccentricity_deg: Eccentricity of each item's centre, [N].
        fitted: Whether the item lies within the eccentricities of the fitted line, which gives its size, [N] bool.
        extrapolated: Whether the line gives the size beyond these eccentricities, [N] bool.
        tested: Whether the larger side is within the sizes tested in the study, 5 .. 26 deg, [N] bool.
    """

    size_deg: Tensor
    eccentricity_deg: Tensor
    fitted: Tensor
    extrapolated: Tensor
    tested: Tensor

    @property
    def kept(self) -> Tensor:
        """Whether an item keeps its original size, because the line was not used, [N] bool."""
        return ~(self.fitted | self.extrapolated)


def scale_layout(
    centres_deg: Any, size_deg: Any, scale: EqualEfficiencyScale, *, extrapolate: bool = False
) -> ScaledLayout:
    """Scale each item to the size S(E) with the perception time of the scale's target, at constant aspect ratio.

    Items nearer than ``scale.low_deg`` always keep their size, because the lines of Table 2.2 have no meaning there:
    they fall below zero at 13 to 33 deg.

    Args:
        centres_deg: (elevation, azimuth) of each item, [N, 2]; azimuths to the left are negative.
        size_deg: (height, width) of each item, [N, 2]. The larger side becomes S(E); the
            patterns of the study were as high as wide.
        scale: Scale of the sizes, such as a row of Table 2.2; the result is differentiable in its parameters.
        extrapolate: Use the line beyond ``scale.high_deg`` too; otherwise such items keep their size.

    Raises:
        ValueError: A shape is not [N, 2], a size is not above zero, or an angle exceeds 90 deg (elevation) or 180 deg
            (azimuth).
    """
    centres, sizes = _items(centres_deg, size_deg)
    where = eccentricity_of(centres[:, 0], centres[:, 1])
    fitted = scale.inside(where)
    beyond = ~fitted & (where > scale.high_deg) & extrapolate
    used = fitted | beyond
    # Unused items are evaluated at a valid eccentricity, so that they cause neither errors nor gradients.
    target_size = scale(torch.where(used, where, torch.full_like(where, scale.high_deg)), extrapolate=extrapolate)
    factor = torch.where(used, target_size / sizes.amax(-1), torch.ones_like(target_size))
    scaled = sizes * factor[:, None]
    largest = scaled.detach().amax(-1)
    tested = (largest >= TESTED_DEG[0]) & (largest <= TESTED_DEG[1])
    return ScaledLayout(scaled, where, fitted, beyond, tested)


def overlaps(centres_deg: Any, size_deg: Any) -> tuple[Tensor, Tensor]:
    """Find pairs of items that overlap, as boxes in elevation and azimuth.

    A width of w degrees at elevation e spans w / cos e of azimuth. Boxes that only touch do not overlap.

    Args:
        centres_deg: (elevation, azimuth), [N, 2].
        size_deg: (height, width), [N, 2].

    Returns:
        Indices of the pairs [K, 2], the lower index first, and the overlap of each pair [K]: the smallest shift in
        degrees, along elevation or azimuth, that separates the boxes.
    """
    centres, sizes = _items(centres_deg, size_deg)
    first, second = torch.triu_indices(len(centres), len(centres), 1, device=centres.device)
    level = centres[:, 0].deg2rad().cos().clamp(min=1e-6)
    height, width = sizes[:, 0], (sizes[:, 1] / level).clamp(max=360)
    apart = (centres[first, 1] - centres[second, 1] + 180).remainder(360) - 180  # wrapped at 180 deg
    free_y = (height[first] + height[second]) / 2 - (centres[first, 0] - centres[second, 0]).abs()
    free_x = ((width[first] + width[second]) / 2 - apart.abs()) * torch.minimum(level[first], level[second])
    depth = torch.minimum(free_y, free_x)
    covered = depth > 1e-9
    return torch.stack([first, second], -1)[covered], depth[covered]


def _items(centres_deg: Any, size_deg: Any) -> tuple[Tensor, Tensor]:
    centres, sizes = angles.as_tensor("centres_deg", centres_deg), angles.size(size_deg)
    if centres.ndim != 2 or centres.shape[-1] != 2 or sizes.shape != centres.shape:
        shapes = f"{tuple(centres.shape)} and {tuple(sizes.shape)}"
        raise ValueError(f"centres_deg and size_deg must both be [N, 2], (y, x), got {shapes}")
    limits = centres.new_tensor([90.0, 180.0])
    if (bad := centres.abs() > limits).any():
        got = angles.first(centres, bad)
        raise ValueError(f"centres_deg must be within 90 degrees of elevation and 180 of azimuth, got {got:g}")
    return centres, sizes
