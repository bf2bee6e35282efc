"""Ray marching: front-to-back compositing of one volume along all rays, plane by plane."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.scene.compositing import absorb, corrected_opacity
from holotorch.scene.lighting import Lighting, flat_steps, slice_slopes, slopes
from holotorch.scene.placement import Placement, Rays
from holotorch.scene.reading import BRICK, PointReader, SliceReader, Window, interpolate, occupied_box
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume


@dataclass(frozen=True)
class Step:
    """Contribution of a plane: ``weight`` T alpha [n] and ``colour`` [3, n] of ``rays`` [n] (flat window indices)."""

    plane: int
    rays: Tensor
    weight: Tensor
    colour: Tensor


class March:
    """Front-to-back compositing of ``volume`` along ``rays``, slab by slab, for rays that may cross visible voxels.

    The attribute ``visible`` is the range of depths that contains visible voxels, rounded outwards to whole bricks;
    None if there are none.

    Args:
        volume: Scalar field.
        place: Position, size and rotation of the volume.
        transfer: Colours and opacities.
        lighting: Shading, or None.
        rays: Geometry of the rays.
        depths: Depths of the planes, front to back.
        spans: Smallest and largest depth of the slab of each plane.
        early: Transmittance below which a ray ends.

    Raises:
        ValueError: A voxel is NaN or infinite.
    """

    def __init__(
        self,
        volume: Volume,
        place: Placement,
        transfer: TransferFunction,
        lighting: Lighting | None,
        rays: Rays,
        depths: Sequence[float],
        spans: Sequence[tuple[float, float]],
        early: float,
    ):
        self.volume, self.place, self.transfer, self.lighting = volume, place, transfer, lighting
        self.rays, self.depths, self.early = rays, depths, early
        near, far = place.depth_range()
        self.spans = [(max(low, near) - place.distance, min(high, far) - place.distance) for low, high in spans]
        self.dtype = transfer.colours.dtype
        if volume.values.is_floating_point():
            self.dtype = torch.promote_types(self.dtype, volume.values.dtype)
        self.device = volume.values.device
        self.unit = transfer.unit_distance * max(place.half) * 2
        self.steps_of_slope = flat_steps(volume) if lighting is not None else None
        low, high = volume.bricks(BRICK)
        # If the voxels are optimised, transparent ones have a gradient, too, so none may be skipped.
        self.learned = volume.values.requires_grad
        self.occupied = torch.ones_like(low, dtype=torch.bool) if self.learned else transfer.visible(low, high)
        box = occupied_box(self.occupied, volume.shape)
        self.visible = place.depth_range(*box) if box is not None else None
        rows, columns = place.footprint(rays, *box) if box is not None else (range(0), range(0))
        like = torch.empty((), dtype=self.dtype, device=self.device)
        self.window = Window.of(place, rays, rows, columns, like)

    def steps(self, wanted: Tensor | None = None) -> Iterator[Step]:
        """Yield the contributions of the planes, front to back; planes without a contribution are left out.

        Only rays where ``wanted``, bool [h, w], is true are followed; None means all.
        """
        if not self.window.size:
            return
        reader = self._reader()
        transmittance = self.zeros(1)[0] + 1
        if wanted is not None:
            rows, columns = self.window.rows, self.window.columns
            transmittance = transmittance * wanted[rows.start : rows.stop, columns.start : columns.stop].flatten()
        for plane, (low, high) in enumerate(self.spans):
            alive = transmittance.detach() > self.early
            if low >= high:
                continue
            sampled = reader.read(low, high, alive)
            if sampled is None:
                if not alive.any():
                    return
                continue
            colour, opacity = self.transfer(sampled.samples[0])
            if self.lighting is not None:
                colour = self._shaded(colour, sampled.samples[1:])
            before = transmittance.index_select(0, sampled.rays)
            weight, after = absorb(before, corrected_opacity(opacity, sampled.length * (1 / self.unit)))
            transmittance.index_copy_(0, sampled.rays, after)
            yield Step(plane, sampled.rays, weight, colour)

    def planes(self, after: Callable[[Tensor], Tensor]) -> Iterator[Tensor]:
        """Yield ``after(radiance)``, [3, h, w], for every plane.

        ``after`` must map zero to zero, since it is applied only where a plane has light.
        """
        done = 0
        for step in self.steps():
            yield from (self.empty() for _ in range(done, step.plane))
            done = step.plane + 1
            scale = self.rays.scale(self.depths[step.plane])
            if scale == 1:
                yield self.whole_of(step.rays, after(step.weight * step.colour))
            else:
                window = self.zeros(3).index_copy(1, step.rays, step.weight * step.colour)
                yield after(self._resampled(window, scale))
        yield from (self.empty() for _ in range(done, len(self.depths)))

    def zeros(self, channels: int) -> Tensor:
        """Zeros [channels, rays of the window]."""
        return torch.zeros(channels, self.window.size, dtype=self.dtype, device=self.device)

    def empty(self) -> Tensor:
        """A dark plane [3, h, w]: a single expanded zero, which consumers recognise by its strides and skip."""
        return torch.zeros((), dtype=self.dtype, device=self.device).expand(3, *self.rays.grid.shape)

    def whole(self, values: Tensor) -> Tensor:
        """Place values [c, rays of the window] on the grid, [c, h, w], which is zero outside the window."""
        (height, width), rows, columns = self.rays.grid.shape, self.window.rows, self.window.columns
        if not self.window.size:
            return values.new_zeros(len(values), height, width)
        framed = values.unflatten(1, (len(rows), len(columns)))
        margins = (columns.start, width - columns.stop, rows.start, height - rows.stop)
        return torch.nn.functional.pad(framed, margins)

    def whole_of(self, rays: Tensor, values: Tensor) -> Tensor:
        """Place values [3, n] of ``rays`` [n] (flat window indices) on the grid, [3, h, w], which is zero elsewhere."""
        (height, width), rows, columns = self.rays.grid.shape, self.window.rows, self.window.columns
        if len(columns) < width:
            rays = rays + torch.div(rays, len(columns), rounding_mode="floor") * (width - len(columns))
        rays = rays + (rows.start * width + columns.start)
        plane = torch.zeros(3, height * width, dtype=values.dtype, device=values.device)
        return plane.index_copy_(1, rays, values).unflatten(1, (height, width))

    def _reader(self) -> SliceReader | PointReader:
        common = (self.place, self.rays, self.window)
        support = (-math.inf, math.inf) if self.learned else self.transfer.support()
        if self.place.turned:
            return PointReader(*common, self._fields(), self.occupied, support)
        return SliceReader(*common, self._slice_fields(), self.occupied, support)

    def _fields(self) -> Tensor:
        values = self.volume.values.to(self.dtype)
        if self.steps_of_slope is None:
            return values[None]
        return torch.cat([values[None], slopes(values, self.steps_of_slope)])

    def _slice_fields(self) -> Callable[[int], Tensor]:
        # The backward pass of unbind makes one gradient for all slices; indexing would make a whole volume per slice.
        slices = self.volume.values.unbind(0)
        steps = self.steps_of_slope
        if steps is None:
            return lambda k: slices[k].to(self.dtype)[None]
        return lambda k: torch.cat([slices[k].to(self.dtype)[None], slice_slopes(slices, k, steps, self.dtype)])

    def _shaded(self, colour: Tensor, slope: Tensor) -> Tensor:
        assert self.lighting is not None
        rotation = torch.tensor(self.place.rotation, dtype=torch.float64, device=self.device)
        rising = self.depths[-1] > self.depths[0] if len(self.depths) > 1 else self._eye_is_in_front()
        return self.lighting.shade(colour, slope, rotation, -1.0 if rising else 1.0)

    def _eye_is_in_front(self) -> bool:
        return self.rays.eye is None or self.rays.eye < self.depths[0]

    def _resampled(self, window: Tensor, scale: float) -> Tensor:
        """Resample radiance [3, rays of the window] to the grid.

        At the depth of the plane the rays are ``scale`` times as far from the axis as the points of the grid.
        """
        framed = window.unflatten(1, (len(self.window.rows), len(self.window.columns)))
        framed = torch.nn.functional.pad(framed, (1, 1, 1, 1))
        for axis, part, count in zip(
            (-2, -1), (self.window.rows, self.window.columns), self.rays.grid.shape, strict=True
        ):
            index = (torch.arange(count, dtype=torch.float64, device=window.device) - count // 2) / scale + count // 2
            # Index into the padded window, whose border is dark.
            index = (index - (part.start - 1)).clamp(0, len(part) + 1)
            first = index.floor().clamp_(max=len(part))
            framed = interpolate(framed, first.to(torch.int64), index - first, axis)
        return framed
