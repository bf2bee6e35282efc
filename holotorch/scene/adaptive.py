"""Adaptive ray sampling: first a coarse lattice of rays, then all rays where these differ (thesis Section 6.4.3).

``DVRSampler`` always skips empty space and ends opaque rays. Fewer rays therefore save time only where a ray is
expensive to compute: in dense matter, with lighting, or in a rotated volume.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.core import checks
from holotorch.scene.layers import SourceLayers
from holotorch.scene.reading import interpolate
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.volume import Volume


@dataclass(frozen=True)
class AdaptivePicture:
    """A picture rendered with a subset of the rays; each pixel corresponds to one ray.

    Attributes:
        image: Radiance in the colours of the transfer function, [C, h, w].
        opacity: Opacity in [0, 1], [h, w].
        traced: Whether the ray of a pixel was computed, bool [h, w]; the other pixels are interpolated.
    """

    image: Tensor
    opacity: Tensor
    traced: Tensor

    @property
    def share(self) -> float:
        """Fraction of the rays that were computed."""
        return self.traced.double().mean().item()


@dataclass(frozen=True)
class AdaptiveReport:
    """Savings and error of an adaptively rendered picture, against the picture from all rays.

    Attributes:
        share: Fraction of the rays that were computed.
        error: Relative L2 error of the colours; 0 if the picture from all rays is black.
        largest: Largest absolute error of one colour of one pixel.
    """

    share: float
    error: float
    largest: float


def render_adaptively(sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05) -> AdaptivePicture:
    """Render ``volume`` with every ``step``-th ray along each axis, and with all rays in cells of high contrast.

    The first rays are the corners of rectangular cells. In a cell all rays are computed if a colour or the opacity
    differs by more than ``contrast`` among the corners of this cell and its neighbours. Pixels in the other cells are
    interpolated linearly, so details between the corners are missed. The picture is differentiable, the choice of rays
    is not. ValueError for a ``step`` below 1 or a ``contrast`` below 0.
    """
    lattice = _Lattice(sampler.grid.shape, step, contrast, volume.values.device)
    first = torch.cat([part.reshape(-1, *sampler.grid.shape) for part in sampler.render(volume, lattice.coarse)])
    fine = lattice.fine(first)
    second = torch.cat([part.reshape(-1, *sampler.grid.shape) for part in sampler.render(volume, fine)])
    picture = torch.where(fine, second, lattice.filled(first))
    return AdaptivePicture(picture[:-1], picture[-1], lattice.coarse | fine)


def sample_adaptively(
    sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05
) -> tuple[SourceLayers, Tensor]:
    """Light sources of ``volume`` for a hologram, from the rays of :func:`render_adaptively`, which are bool [h, w].

    On every plane, the radiance between the rays is interpolated linearly, so the light of all planes together is
    that of the adaptive picture. ValueError also for a sampler with an ``eye``.
    """
    lattice = _Lattice(sampler.grid.shape, step, contrast, volume.values.device)
    with torch.no_grad():
        first = torch.cat([part.reshape(-1, *sampler.grid.shape) for part in sampler.render(volume, lattice.coarse)])
        fine = lattice.fine(first)
    traced = lattice.coarse | fine
    return sampler(volume, traced, lambda radiance: torch.where(fine, radiance, lattice.filled(radiance))), traced


@torch.no_grad()
def adaptive_report(sampler: DVRSampler, volume: Volume, *, step: int = 4, contrast: float = 0.05) -> AdaptiveReport:
    """Render with a subset of the rays and with all of them, and compare; see :func:`render_adaptively`."""
    adaptive = render_adaptively(sampler, volume, step=step, contrast=contrast)
    whole, _ = sampler.render(volume)
    difference, norm = adaptive.image - whole, whole.norm().item()
    error = difference.norm().item() / norm if norm else 0.0
    return AdaptiveReport(adaptive.share, error, difference.abs().max().item())


class _Lattice:
    """The coarse rays, the cells between them, and interpolation from the coarse rays to all rays."""

    def __init__(self, shape: tuple[int, int], step: int, contrast: float, device: torch.device):
        step = checks.whole("step", step, 1)
        self.contrast = checks.nonnegative("contrast", contrast)
        self.rows, self.columns = (_lattice(size, step, device) for size in shape)
        self.coarse = torch.zeros(shape, dtype=torch.bool, device=device)
        self.coarse[self.rows[:, None], self.columns] = True
        self.down, self.across = (
            _cells(lattice, size) for lattice, size in zip((self.rows, self.columns), shape, strict=True)
        )

    def fine(self, picture: Tensor) -> Tensor:
        """Rays to follow as well, bool [h, w], from the values [c, h, w] at the coarse ones."""
        refined = _refined(self._corners(picture).detach(), self.contrast)
        return refined[self.down[0]][:, self.across[0]] & ~self.coarse

    def filled(self, values: Tensor) -> Tensor:
        """Values [c, h, w] at the coarse rays, interpolated linearly between them."""
        return interpolate(interpolate(self._corners(values), *self.across, -1), *self.down, -2)

    def _corners(self, values: Tensor) -> Tensor:
        return values[:, self.rows[:, None], self.columns]


def _lattice(size: int, step: int, device: torch.device) -> Tensor:
    """Indices of every ``step``-th ray along an axis of ``size`` rays, and of the last ray."""
    rays = torch.arange(0, size, step, device=device)
    return rays if rays[-1] == size - 1 else torch.cat([rays, rays.new_tensor([size - 1])])


def _refined(corners: Tensor, contrast: float) -> Tensor:
    """Mask [n - 1, m - 1] of the cells to refine, from corners [c, n, m]; an axis with one corner has one cell."""
    _, n, m = corners.shape
    padded = functional.pad(corners[None], (0, int(m == 1), 0, int(n == 1)), mode="replicate")
    # Extremes over the corners of each cell, then over the adjacent cells, since an edge may lie just inside one.
    highest, lowest = (functional.max_pool2d(functional.max_pool2d(sign * padded, 2, 1), 3, 1, 1) for sign in (1, -1))
    return ((highest + lowest)[0] > contrast).any(0)


def _cells(lattice: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Index of the cell of each ray along an axis, and position of the ray in it from 0 to 1, both [size]."""
    rays = torch.arange(size, device=lattice.device)
    cell = (torch.searchsorted(lattice, rays, right=True) - 1).clamp(max=max(0, len(lattice) - 2))
    if len(lattice) == 1:
        return cell, torch.zeros(size, device=lattice.device)
    start, end = lattice[cell], lattice[cell + 1]
    return cell, (rays - start).double() / (end - start)
