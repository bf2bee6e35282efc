"""Samples of a volume at the intersections of rays with a plane parallel to the hologram.

Only visible values are returned, which are those with an opacity above 0. Both readers interpolate trilinearly. Between
the outermost sample and the face, half a voxel farther out, the value is constant. ``SliceReader`` interpolates between
two slices that are parallel to the hologram; ``PointReader`` interpolates at each point of a rotated volume.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import overload

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.scene.placement import Placement, Rays

BRICK = 16  # edge length in voxels of the blocks of a volume that are skipped if they are transparent


@dataclass(frozen=True)
class RaySamples:
    """Samples of n rays on a plane."""

    rays: Tensor  # flat indices of the rays into the rows and columns of the window, [n]
    samples: Tensor  # value, and with lighting three slopes, of each ray, [c, n]
    length: Tensor | float  # length of the path of each ray through the slab in metres, [n], or one number for all rays


@dataclass(frozen=True)
class Window:
    """The h x w rays that may meet visible voxels, and their paths through the box of the volume."""

    rows: range  # rows of the grid of rays
    columns: range  # columns of the grid of rays
    down: Tensor  # positions of the rows in metres at the reference depth, float64 [h]
    across: Tensor  # positions of the columns in metres at the reference depth, float64 [w]
    # Depth at which each ray enters the box, in metres from the centre of the box, [h, w]; None if all rays are
    # parallel to the axis and the volume is not rotated.
    entry: Tensor | None
    exit: Tensor | None  # depth at which each ray leaves the box, like ``entry``
    oblique: Tensor | None  # length of the path of each ray per metre of depth, [h, w], or None for 1

    @classmethod
    def of(cls, place: Placement, rays: Rays, rows: range, columns: range, like: Tensor) -> "Window":
        """Window of ``rows`` and ``columns``; tensors on the device of ``like``, depths and lengths in its dtype."""
        y, x = (axis.flatten() for axis in rays.grid.coordinates(like.device))
        down, across = y[rows.start : rows.stop], x[columns.start : columns.stop]
        if not place.turned and rays.eye is None:
            return cls(rows, columns, down, across, None, None, None)
        entry, leave = (depth.to(like.dtype) for depth in place.crossing(rays, down, across))
        oblique = None
        if rays.eye is not None:
            slope = rays.spread**2 * (down[:, None].square() + across.square())
            oblique = (1 + slope).sqrt().to(like.dtype)
        return cls(rows, columns, down, across, entry, leave, oblique)

    @property
    def size(self) -> int:
        """Number of rays."""
        return len(self.rows) * len(self.columns)

    def length(self, low: float, high: float, rows: slice) -> Tensor | float:
        """Path length in metres in the box between two depths in metres from its centre: [rows, w] or one number."""
        if self.entry is None or self.exit is None:
            return max(0.0, high - low)
        path = (self.exit[rows].clamp(max=high) - self.entry[rows].clamp(min=low)).clamp_(min=0)
        return path if self.oblique is None else path * self.oblique[rows]


@dataclass(frozen=True, eq=False)
class SliceReader:
    """Reads a volume whose slices are parallel to the hologram, by interpolation between slices, columns and rows."""

    place: Placement  # position of the volume
    rays: Rays  # geometry of the rays
    window: Window  # rays that are read
    occupied: Tensor | None  # whether each brick contains a visible voxel, bool [Dz, Hy, Wx]; None if all may
    support: tuple[float, float]  # limits of the visible values, see ``TransferFunction.support``
    # Function from the number of a slice to its channels [c, H, W], of which the first is the value.
    channels: Callable[[int], Tensor]

    def read(self, low: float, high: float, alive: Tensor) -> RaySamples | None:
        """Samples half-way between the depths ``low`` and ``high``, in metres from the centre of the volume.

        ``alive``, bool [rays of the window], selects the rays to read. None if no ray meets a visible value.
        """
        place, width = self.place, len(self.window.columns)
        depth = (low + high) / 2
        index = min(max(depth / place.spacing[0] + (place.shape[0] - 1) / 2, 0.0), place.shape[0] - 1.0)
        k = min(int(index), max(0, place.shape[0] - 2))
        scale = self.rays.scale(place.distance + depth)
        first, row_weight = _taps(self.window.down * scale, place.shape[1], place.spacing[1])
        start, stop = self._rows(k, first)
        if start >= stop:
            return None
        length = self.window.length(low, high, slice(start, stop))
        mask = alive[start * width : stop * width]
        if isinstance(length, Tensor):
            length = length.flatten()
            mask = mask & (length > 0)
        left, column_weight = _taps(self.window.across * scale, place.shape[2], place.spacing[2])
        plane = self.channels(k)
        plane = plane if index == k else torch.lerp(plane, self.channels(k + 1), index - k)
        lines = interpolate(plane, left, column_weight, -1)
        first, row_weight = first[start:stop], row_weight[start:stop]
        values = interpolate(lines[:1], first, row_weight, -2).flatten(1)
        rays, length = _selected(mask & _visible(values[0], self.support), length, values.dtype)
        if not rays.numel():
            return None
        samples = values.index_select(1, rays)
        if len(lines) > 1:
            samples = torch.cat([samples, _between_rows(lines[1:], first, row_weight, rays)])
        return RaySamples(rays + start * width, samples, length)

    def _rows(self, k: int, first: Tensor) -> tuple[int, int]:
        """First row and the one after the last of the rays that meet occupied bricks between slices ``k`` and k + 1.

        ``first`` is the index of the voxel before each row. It rises, so these rows are one range.
        """
        if self.occupied is None:
            return 0, len(first)
        occupied = self.occupied[k // BRICK].any(1).nonzero()
        if not len(occupied):
            return 0, 0
        limits = first.new_tensor([int(occupied[0]) * BRICK, (int(occupied[-1]) + 1) * BRICK])
        start, stop = (int(row) for row in torch.searchsorted(first, limits))
        return start, stop


@dataclass(frozen=True, eq=False)
class PointReader:
    """Reads a rotated volume point by point; attributes as in :class:`SliceReader`, but channels are [c, D, H, W]."""

    place: Placement
    rays: Rays
    window: Window
    occupied: Tensor | None
    support: tuple[float, float]
    channels: Tensor

    def read(self, low: float, high: float, alive: Tensor) -> RaySamples | None:
        """Samples as in :meth:`SliceReader.read`."""
        place, window = self.place, self.window
        length = window.length(low, high, slice(None))
        assert isinstance(length, Tensor)  # one length for all rays occurs only without rotation
        length = length.flatten()
        rays, length = _selected(alive & (length > 0), length, self.channels.dtype)
        down, across = place.offsets(self.rays, place.distance + (low + high) / 2, window.down, window.across)
        # Offsets from the centre of the volume, in samples.
        spacing = down.new_tensor(place.spacing)
        down, across = ((offset / spacing).to(self.channels.dtype) for offset in (down, across))
        row = torch.div(rays, len(window.columns), rounding_mode="floor")
        points = down.index_select(0, row) + across.index_select(0, rays - row * len(window.columns))
        if self.occupied is not None and not self.occupied.all():
            visible = self._in_bricks(points, self.occupied)
            rays, points, length = rays[visible], points.index_select(0, visible), length[visible]
        if not rays.numel():
            return None
        ends = points.new_tensor([max(1, n - 1) / 2 for n in place.shape])
        # With align_corners the coordinates -1 and 1 are the first and the last sample; the order is (x, y, z).
        samples = torch.nn.functional.grid_sample(
            self.channels[None], (points / ends).flip(-1)[None, None, None], padding_mode="border", align_corners=True
        )[0, :, 0, 0]
        if self.occupied is not None:
            kept = _visible(samples[0], self.support).nonzero().flatten()
            if kept.numel() < rays.numel():
                rays, samples, length = rays[kept], samples.index_select(1, kept), length[kept]
        return RaySamples(rays, samples, length) if rays.numel() else None

    def _in_bricks(self, points: Tensor, occupied: Tensor) -> Tensor:
        """Indices of the points [n, 3] that lie in occupied bricks."""
        flat = torch.zeros_like(points[:, 0], dtype=torch.int64)
        for axis, (n, bricks) in enumerate(zip(self.place.shape, occupied.shape, strict=True)):
            brick = ((points[:, axis] + (n - 1) / 2).clamp_(0, n - 1) * (1 / BRICK)).to(torch.int64)
            flat = flat * bricks + brick
        return occupied.flatten()[flat].nonzero().flatten()


def occupied_box(occupied: Tensor | None, shape: tuple[int, int, int]) -> tuple[list[float], list[float]] | None:
    """Smallest and largest index coordinates (z, y, x) of the occupied bricks of a volume; None if there are none.

    ``occupied`` is bool [Dz, Hy, Wx], or None if all bricks are.
    """
    if occupied is None:
        return [-0.5] * 3, [n - 0.5 for n in shape]
    bricks = occupied.nonzero()
    if not len(bricks):
        return None
    first, last = bricks.amin(0).tolist(), bricks.amax(0).tolist()
    low = [brick * BRICK if brick else -0.5 for brick in first]
    high = [min((brick + 1) * BRICK, n - 0.5) for brick, n in zip(last, shape, strict=True)]
    return low, high


@overload
def _selected(mask: Tensor, length: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]: ...
@overload
def _selected(mask: Tensor, length: float, dtype: torch.dtype) -> tuple[Tensor, Tensor | float]: ...
def _selected(mask: Tensor, length: Tensor | float, dtype: torch.dtype) -> tuple[Tensor, Tensor | float]:
    """Indices of the rays in ``mask``, bool [n], and the lengths of their paths, of ``length`` [n] or one for all.

    Without values all rays are selected. Those that are not in ``mask`` have no path then, and absorb nothing.
    """
    if checks.have_values(mask):
        rays = mask.nonzero().flatten()
        return rays, length.index_select(0, rays) if isinstance(length, Tensor) else length
    return torch.arange(len(mask), device=mask.device), mask.to(dtype) * length


def _taps(offsets: Tensor, count: int, spacing: float) -> tuple[Tensor, Tensor]:
    """Index of the sample before each of n offsets, in metres from the centre, and weight of the following sample."""
    index = (offsets / spacing + (count - 1) / 2).clamp(0, count - 1)
    first = index.floor().clamp_(max=max(0, count - 2)).to(torch.int64)
    return first, index - first


def interpolate(values: Tensor, first: Tensor, weight: Tensor, axis: int) -> Tensor:
    """Linear interpolation along ``axis`` (-2 or -1) to n positions, between the samples ``first`` and ``first`` + 1.

    ``first`` is [n], and ``weight`` [n] is the weight of the sample ``first`` + 1.
    """
    one = values.index_select(axis, first)
    if values.shape[axis] == 1:
        return one
    other = values.index_select(axis, first + 1)
    weight = weight.to(values.dtype)
    return torch.lerp(one, other, weight[:, None] if axis == -2 else weight)


def _between_rows(lines: Tensor, first: Tensor, weight: Tensor, rays: Tensor) -> Tensor:
    """As :func:`interpolate` along axis -2 of ``lines`` [c, H, w], but only at m ``rays``, which are flat indices."""
    width = lines.shape[2]
    row = torch.div(rays, width, rounding_mode="floor")
    index = rays + (first.index_select(0, row) - row) * width
    following = index + width if lines.shape[1] > 1 else index
    lines, weight = lines.flatten(1), weight.to(lines.dtype).index_select(0, row)
    return torch.lerp(lines.index_select(1, index), lines.index_select(1, following), weight)


def _visible(values: Tensor, support: tuple[float, float]) -> Tensor:
    """Mask of the values inside the interval ``support``, outside which the opacity is zero."""
    low, high = support
    return (values.detach() > low) & (values.detach() < high)
