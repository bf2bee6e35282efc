"""Adaptive ray sampling: a coarse lattice of rays first, all rays where neighbours differ (Section 6.4.3).

The sampler skips empty space and finished rays in any case. Fewer rays therefore save time only where a ray is
expensive: in dense matter, with lighting, or in a rotated volume.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.scene.reading import interpolate
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.volume import Volume


@dataclass(frozen=True)
class AdaptivePicture:
    """A picture rendered with a subset of the rays.

    Attributes:
        image: Red, green, blue, [3, h, w].
        opacity: [h, w].
        followed: Whether a ray was followed, bool [h, w]; the others are interpolated between their neighbours.
    """

    image: Tensor
    opacity: Tensor
    followed: Tensor

    @property
    def share(self) -> float:
        """Fraction of the rays that were followed."""
        return self.followed.double().mean().item()


@dataclass(frozen=True)
class AdaptiveReport:
    """Savings and error of an adaptively rendered picture.

    Attributes:
        share: Fraction of the rays that were followed.
        error: Relative L2 error of the image against that of all rays; 0 where both are black.
        largest: Largest difference of a pixel's colour.
    """

    share: float
    error: float
    largest: float


def render_adaptively(sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05) -> AdaptivePicture:
    """Picture from every ``step``-th ray of each axis, and from all rays in cells of high contrast between them.

    A cell is refined if any colour or the opacity differs by more than ``contrast`` between its corners or those of
    the adjacent cells; rays in the other cells are interpolated linearly. Details smaller than a cell that touch no
    corner of it or of its neighbours are missed. The picture is differentiable; the choice of rays is not.

    Raises:
        ValueError: A step below 1 or a contrast below 0.
    """
    step = checks.whole("step", step, 1)
    if checks.finite("contrast", contrast) < 0:
        raise ValueError(f"contrast must be at least 0, got {contrast}")
    shape = sampler.grid.shape
    device = volume.values.device
    rows, columns = (_lattice(size, step, device) for size in shape)
    coarse = torch.zeros(shape, dtype=torch.bool, device=device)
    coarse[rows[:, None], columns] = True
    first = torch.cat([part.reshape(-1, *shape) for part in sampler.render(volume, coarse)])
    corners = first[:, rows[:, None], columns]
    refined = _refined(corners.detach(), contrast)
    down, across = (_cells(lattice, size) for lattice, size in zip((rows, columns), shape, strict=True))
    fine = refined[down[0]][:, across[0]] & ~coarse
    second = torch.cat([part.reshape(-1, *shape) for part in sampler.render(volume, fine)])
    filled = interpolate(interpolate(corners, *across, -1), *down, -2)
    picture = torch.where(coarse, first, torch.where(fine, second, filled))
    return AdaptivePicture(picture[:3], picture[3], coarse | fine)


@torch.no_grad()
def adaptive_report(sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05) -> AdaptiveReport:
    """Error of :func:`render_adaptively` against the picture of all rays, and the fraction of rays that it follows."""
    adaptive = render_adaptively(sampler, volume, step=step, contrast=contrast)
    whole, _ = sampler.render(volume)
    difference, norm = adaptive.image - whole, whole.norm().item()
    error = difference.norm().item() / norm if norm else 0.0
    return AdaptiveReport(adaptive.share, error, difference.abs().max().item())


def _lattice(size: int, step: int, device: torch.device) -> Tensor:
    rays = torch.arange(0, size, step, device=device)
    # The last ray is included, so that every ray lies within a cell.
    return rays if rays[-1] == size - 1 else torch.cat([rays, rays.new_tensor([size - 1])])


def _refined(corners: Tensor, contrast: float) -> Tensor:
    """Mask of the cells to refine, [n - 1, m - 1] but at least one per axis, from corners [c, n, m]."""
    sizes = corners.shape[1:]
    # An axis of one sample has one cell.
    framed = torch.nn.functional.pad(corners[None], (0, int(sizes[1] == 1), 0, int(sizes[0] == 1)), mode="replicate")
    highest, lowest = (torch.nn.functional.max_pool2d(sign * framed, 2, 1) for sign in (1, -1))
    # Adjacent cells are included, since an edge may run just inside them.
    spread = [torch.nn.functional.max_pool2d(part, 3, 1, 1) for part in (highest, lowest)]
    return ((spread[0] + spread[1])[0] > contrast).any(0)


def _cells(lattice: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cell of every ray of an axis [size], and the position of the ray within it, 0 to 1."""
    rays = torch.arange(size, device=lattice.device)
    cell = (torch.searchsorted(lattice, rays, right=True) - 1).clamp(max=max(0, len(lattice) - 2))
    if len(lattice) == 1:
        return cell, torch.zeros(size, device=lattice.device)
    start, end = lattice[cell], lattice[cell + 1]
    return cell, (rays - start).double() / (end - start)
