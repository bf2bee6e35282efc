"""Icons and labels over a wide field, sized so that each is perceived in the time of the target pattern."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.perception import angles
from holotorch.perception.geometry import eccentricity_of
from holotorch.perception.scale import TESTED_DEG, EqualEfficiencyScale


@dataclass(frozen=True, eq=False)
class ScaledLayout:
    """A layout after scaling, N items in the order given.

    Attributes:
        size_deg: (height, width) of each item, [N, 2]; the larger is its size.
        eccentricity_deg: Of each item's centre, [N].
        fitted: The line holds there, and the size is the study's, [N] bool.
        extrapolated: The size follows the line beyond its eccentricities, [N] bool.
        tested: The larger side is among the sizes that the study showed, 5 .. 26 deg, [N] bool.
    """

    size_deg: Tensor
    eccentricity_deg: Tensor
    fitted: Tensor
    extrapolated: Tensor
    tested: Tensor

    @property
    def kept(self) -> Tensor:
        """Items that no line was used for, which keep the size that they had, [N] bool."""
        return ~(self.fitted | self.extrapolated)


def scale_layout(
    centres_deg: Any, size_deg: Any, scale: EqualEfficiencyScale, *, extrapolate: bool = False
) -> ScaledLayout:
    """Give each item the size S(E) that is perceived as soon as the scale's target; proportions are kept.

    Items nearer than ``scale.low_deg`` keep their size in any case: towards the centre the lines of Table 2.2 fall
    below zero (at 13 to 33 deg), so that nothing can be said by following them.

    Args:
        centres_deg: (elevation, azimuth) of each item, [N, 2]; azimuths to the left are negative.
        size_deg: (height, width) of each item, [N, 2]. The study's patterns are as high as wide; for others it is the
            larger side that becomes S(E).
        scale: Such as a row of Table 2.2; differentiable in its parameters.
        extrapolate: Follow the line beyond ``scale.high_deg`` too; otherwise such items keep their size.

    Raises:
        ValueError: Shapes other than [N, 2], sizes not above zero, elevations beyond 90 or azimuths beyond 180 deg.
    """
    centres, sizes = _items(centres_deg, size_deg)
    where = eccentricity_of(centres[:, 0], centres[:, 1])
    fitted = scale.inside(where)
    beyond = ~fitted & (where > scale.high_deg) & extrapolate
    used = fitted | beyond
    # Elsewhere the line is asked where it is known, so that no gradient and no refusal comes from what is not used.
    wanted = scale(torch.where(used, where, torch.full_like(where, scale.high_deg)), extrapolate=extrapolate)
    factor = torch.where(used, wanted / sizes.amax(-1), torch.ones_like(wanted))
    scaled = sizes * factor[:, None]
    largest = scaled.detach().amax(-1)
    tested = (largest >= TESTED_DEG[0]) & (largest <= TESTED_DEG[1])
    return ScaledLayout(scaled, where, fitted, beyond, tested)


def overlaps(centres_deg: Any, size_deg: Any) -> tuple[Tensor, Tensor]:
    """Pairs of items that cover each other, as boxes in elevation and azimuth.

    A width of w degrees at elevation e spans w / cos e of azimuth. Touching is no overlap.

    Args:
        centres_deg: (elevation, azimuth), [N, 2].
        size_deg: (height, width), [N, 2].

    Returns:
        Indices [K, 2], the lower first, and how far each pair must be moved apart to be free, in degrees along the axis
        that asks for less, [K].
    """
    centres, sizes = _items(centres_deg, size_deg)
    first, second = torch.triu_indices(len(centres), len(centres), 1, device=centres.device)
    level = centres[:, 0].deg2rad().cos().clamp(min=1e-6)
    height, width = sizes[:, 0], (sizes[:, 1] / level).clamp(max=360)
    apart = (centres[first, 1] - centres[second, 1] + 180).remainder(360) - 180  # across the back as well
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
