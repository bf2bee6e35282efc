"""Icons and labels over a wide field, scaled so that each has the perception time of a target pattern."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.perception import angles
from holotorch.perception.geometry import eccentricity_of
from holotorch.perception.scale import TESTED_DEG, EqualEfficiencyScale


@dataclass(frozen=True, eq=False)
class ScaledLayout:
    """A layout of N scaled items, in the order given to :func:`scale_layout`.

    Attributes:
        size_deg: (height, width) of each scaled item in degrees, [N, 2].
        eccentricity_deg: Eccentricity of each item's centre in degrees, [N].
        fitted: Whether the item is scaled by the line S(E) within the eccentricities of its fit, [N] bool.
        extrapolated: Whether the item is scaled by the line beyond these eccentricities, [N] bool.
        tested: Whether the larger side is within 5 .. 26 deg, the sizes that the study tested, [N] bool.
    """

    size_deg: Tensor
    eccentricity_deg: Tensor
    fitted: Tensor
    extrapolated: Tensor
    tested: Tensor

    @property
    def kept(self) -> Tensor:
        """Whether an item keeps its original size, because it is neither fitted nor extrapolated, [N] bool."""
        return ~(self.fitted | self.extrapolated)


def scale_layout(
    centres_deg: Any, size_deg: Any, scale: EqualEfficiencyScale, *, extrapolate: bool = False
) -> ScaledLayout:
    """Scale each item at eccentricity E to the size S(E) of ``scale``, at constant aspect ratio.

    Items at eccentricities below ``scale.low_deg`` always keep their size, because the lines are not valid there: those
    of Table 2.2 reach a size of zero at 13 to 33 deg.

    Args:
        centres_deg: (elevation, azimuth) of each item's centre, [N, 2]; azimuths to the left are negative.
        size_deg: (height, width) of each item, [N, 2]. The larger side becomes S(E); the patterns of the study were as
            wide as high.
        scale: The line S(E), for example of a row of Table 2.2. The result is differentiable in its parameters.
        extrapolate: Also scale items beyond ``scale.high_deg``; otherwise these items keep their size.

    Raises:
        ValueError: A shape is not [N, 2], a size is not above zero or is above 360 deg, an elevation is beyond 90 deg,
            an azimuth is beyond 180 deg, or S(E) is not above zero.
    """
    centres, sizes = _items(centres_deg, size_deg)
    eccentricity = eccentricity_of(centres[:, 0], centres[:, 1])
    fitted = scale.inside(eccentricity)
    beyond = ~fitted & (eccentricity > scale.high_deg) & extrapolate
    scaled_items = fitted | beyond
    # For items that are not scaled, the line is evaluated at high_deg instead, to avoid errors and NaN gradients.
    target_size = scale(torch.where(scaled_items, eccentricity, scale.high_deg), extrapolate=extrapolate)
    factor = torch.where(scaled_items, target_size / sizes.amax(-1), 1)
    scaled = sizes * factor[:, None]
    tested = angles.within(scaled.detach().amax(-1), *TESTED_DEG)
    return ScaledLayout(scaled, eccentricity, fitted, beyond, tested)


def overlaps(centres_deg: Any, size_deg: Any) -> tuple[Tensor, Tensor]:
    """Find pairs of items that overlap; each item is a box in elevation and azimuth.

    An item of width w at elevation e spans w / cos e of azimuth. Boxes that only touch do not overlap.

    The arguments [N, 2] are those of :func:`scale_layout`.

    Returns:
        Indices of the K overlapping pairs, [K, 2], the lower index first, and the overlap of each pair, [K], which is
        the smallest visual angle in degrees by which one box must move, in elevation or azimuth, to separate them.
    """
    centres, sizes = _items(centres_deg, size_deg)
    first, second = torch.triu_indices(len(centres), len(centres), 1, device=centres.device)
    cosine = centres[:, 0].deg2rad().cos().clamp(min=1e-6)
    height, width = sizes[:, 0], (sizes[:, 1] / cosine).clamp(max=360)
    apart = (centres[first, 1] - centres[second, 1] + 180).remainder(360) - 180  # within -180 .. 180 deg
    overlap_y = (height[first] + height[second]) / 2 - (centres[first, 0] - centres[second, 0]).abs()
    overlap_x = ((width[first] + width[second]) / 2 - apart.abs()) * torch.minimum(cosine[first], cosine[second])
    overlap = torch.minimum(overlap_y, overlap_x)
    overlapping = overlap > 1e-9
    return torch.stack([first, second], -1)[overlapping], overlap[overlapping]


def _items(centres_deg: Any, size_deg: Any) -> tuple[Tensor, Tensor]:
    centres, sizes = angles.as_tensor("centres_deg", centres_deg), angles.size(size_deg)
    if centres.ndim != 2 or centres.shape[-1] != 2 or sizes.shape != centres.shape:
        shapes = f"{tuple(centres.shape)} and {tuple(sizes.shape)}"
        raise ValueError(f"centres_deg and size_deg must both be [N, 2], (y, x), got {shapes}")
    valid = centres.abs() <= centres.new_tensor([90.0, 180.0])
    angles.require(valid, "centres_deg must be within 90 degrees of elevation and 180 of azimuth", centres)
    return centres, sizes
