"""Rays where the picture needs them: coarse first, dense where neighbours differ (Section 6.4.3).

The saving is in rays. The sampler passes over empty space and finished rays anyway, so that seconds are saved only
where a ray is dear: in dense matter, under lights, or when it is turned.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.scene.reading import mixed
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.volume import Volume


@dataclass(frozen=True)
class AdaptivePicture:
    """A picture of which not all rays were followed.

    Attributes:
        image: Red, green, blue, [3, h, w].
        opacity: [h, w].
        followed: Whether a ray was followed or filled in between its neighbours, bool [h, w].
    """

    image: Tensor
    opacity: Tensor
    followed: Tensor

    @property
    def share(self) -> float:
        """Part of the rays that were followed."""
        return self.followed.double().mean().item()


@dataclass(frozen=True)
class AdaptiveReport:
    """What leaving out rays saves and costs.

    Attributes:
        share: Part of the rays that were followed.
        error: Relative L2 error of the image against that of all rays; 0 for two black ones.
        largest: Largest difference of a pixel's colour.
    """

    share: float
    error: float
    largest: float


def render_adaptively(sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05) -> AdaptivePicture:
    """Picture from every ``step``-th ray of each axis, and all rays of the cells between them that show a contrast.

    A cell is refined if any colour, or the opacity, differs between its corners, or those of the cells around it, by
    more than ``contrast``; rays in the others are interpolated linearly. What is finer than a cell and touches no
    corner of it or its neighbours is missed. Differentiable; which rays are followed is not.

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
    down, across = (_cells(places, size) for places, size in zip((rows, columns), shape, strict=True))
    fine = refined[down[0]][:, across[0]] & ~coarse
    second = torch.cat([part.reshape(-1, *shape) for part in sampler.render(volume, fine)])
    filled = mixed(mixed(corners, *across, -1), *down, -2)
    picture = torch.where(coarse, first, torch.where(fine, second, filled))
    return AdaptivePicture(picture[:3], picture[3], coarse | fine)


@torch.no_grad()
def adaptive_report(sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05) -> AdaptiveReport:
    """How far :func:`render_adaptively` is from the picture of all rays, and how many it follows."""
    found = render_adaptively(sampler, volume, step=step, contrast=contrast)
    whole, _ = sampler.render(volume)
    difference, norm = found.image - whole, whole.norm().item()
    error = difference.norm().item() / norm if norm else 0.0
    return AdaptiveReport(found.share, error, difference.abs().max().item())


def _lattice(size: int, step: int, device: torch.device) -> Tensor:
    places = torch.arange(0, size, step, device=device)
    # The last ray as well, so that nothing lies outside.
    return places if places[-1] == size - 1 else torch.cat([places, places.new_tensor([size - 1])])


def _refined(corners: Tensor, contrast: float) -> Tensor:
    """Which cells [n - 1, m - 1] (at least one each) of corners [c, n, m] are to be refined."""
    sizes = corners.shape[1:]
    # Axes of one sample have one cell all the same.
    framed = torch.nn.functional.pad(corners[None], (0, int(sizes[1] == 1), 0, int(sizes[0] == 1)), mode="replicate")
    highest, lowest = (torch.nn.functional.max_pool2d(sign * framed, 2, 1) for sign in (1, -1))
    # The cells around: an edge may run just inside the next one.
    spread = [torch.nn.functional.max_pool2d(part, 3, 1, 1) for part in (highest, lowest)]
    return ((spread[0] + spread[1])[0] > contrast).any(0)


def _cells(places: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cell of every ray of an axis [size], and where in it, 0 to 1."""
    rays = torch.arange(size, device=places.device)
    cell = (torch.searchsorted(places, rays, right=True) - 1).clamp(max=max(0, len(places) - 2))
    if len(places) == 1:
        return cell, torch.zeros(size, device=places.device)
    start, end = places[cell], places[cell + 1]
    return cell, (rays - start).double() / (end - start)
