"""Ray marching: front-to-back compositing of a volume along all rays, one slab of the volume per plane of sources."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.core import checks
from holotorch.scene.compositing import absorb, corrected_opacity, safe_sqrt
from holotorch.scene.lighting import Lighting, Scattering, flat_steps, slice_slopes, slopes
from holotorch.scene.placement import Placement, Rays
from holotorch.scene.reading import BRICK, PointReader, SliceReader, Window, interpolate, occupied_box
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume


@dataclass(frozen=True)
class Step:
    """Contribution of a sample within a slab to n rays; the radiance is weight times colour."""

    plane: int  # index of the plane, from front to back
    rays: Tensor  # flat indices of the rays into the rows and columns of the window, [n]
    weight: Tensor  # transmittance up to the part of the slab times opacity of this part, [n]
    colour: Tensor  # of each channel, such as red, green, blue, [C, n]


@dataclass(eq=False)
class March:
    """Front-to-back compositing of a volume along rays, slab by slab.

    A voxel is visible if its opacity is above 0. The attribute ``window`` holds the rays that may meet visible voxels;
    only these are computed. ``visible`` is the range of depths in metres of the bricks that contain visible voxels, or
    None if there are none. ValueError if a voxel is NaN or infinite.

    Volumes without values, as under ``torch.compile``, are not checked, and none of their rays and voxels is left out;
    the result is the same.
    """

    volume: Volume  # scalar field
    place: Placement  # position, size and rotation of the volume
    transfer: TransferFunction  # colour and opacity of a value
    lighting: Lighting | Scattering | None  # shading; None for emission without shading
    rays: Rays  # geometry of the rays
    depths: Sequence[float]  # depths of the planes in metres, front to back
    spans: Sequence[tuple[float, float]]  # smallest and largest depth in metres of the slab of each plane
    observer: float  # -1 if the observer is on the side of smaller depths, else 1
    early: float  # transmittance below which a ray ends
    samples: int = 1  # equal parts of each slab, within the volume, of which each is one sample of a ray

    def __post_init__(self) -> None:
        volume, place, transfer, rays = self.volume, self.place, self.transfer, self.rays
        self.dtype, self.device = transfer.colours.dtype, volume.values.device
        self.channels = transfer.colours.shape[1]
        self.ends = place.depth_range()
        if volume.values.is_floating_point():
            self.dtype = torch.promote_types(self.dtype, volume.values.dtype)
        # If voxels are optimised none is skipped, since transparent voxels have a gradient as well. Without values,
        # which of them are transparent is unknown.
        self.learned, self.known = volume.values.requires_grad, checks.have_values(volume.values, transfer.opacities)
        bricks = volume.bricks(BRICK) if self.known else None
        self.occupied = None if self.learned or bricks is None else transfer.visible(*bricks)
        box = occupied_box(self.occupied, volume.shape)
        self.visible = place.depth_range(*box) if box is not None and self.known else None
        rows, columns = place.footprint(rays, *box) if box is not None else (range(0), range(0))
        self.window = Window.of(place, rays, rows, columns, torch.empty((), dtype=self.dtype, device=self.device))

    @property
    def thickest(self) -> float:
        """Thickness of the thickest part of a slab that is one sample, in the smallest distance between voxels."""
        thickness = [high - low for span in self.spans for low, high in self.parts(*span)]
        return max([0.0, *thickness]) / min(self.place.spacing)

    def parts(self, low: float, high: float) -> list[tuple[float, float]]:
        """Smallest and largest depths of the parts of a slab, front to back; none for a slab beside the volume."""
        low, high = max(low, self.ends[0]), min(high, self.ends[1])
        if low >= high:
            return []
        ends = [low + (high - low) * i / self.samples for i in range(self.samples)] + [high]
        return list(itertools.pairwise(ends))[:: -1 if self.observer > 0 else 1]

    def steps(self, selected: Tensor | None = None) -> Iterator[Step]:
        """Yield the contributions to the planes, front to back; planes without a contribution are left out.

        ``selected``, bool [h, w], selects the rays to compute; None means all.
        """
        if not self.window.size:
            return
        reader, place = self._reader(), self.place
        unit = self.transfer.unit_distance * max(place.half) * 2  # in metres
        rotation = torch.tensor(place.rotation, dtype=torch.float64, device=self.device)
        transmittance = self.zeros(1)[0] + 1
        if selected is not None:
            rows, columns = self.window.rows, self.window.columns
            transmittance = transmittance * selected[rows.start : rows.stop, columns.start : columns.stop].flatten()
        for plane, (low, high) in ((i, part) for i, span in enumerate(self.spans) for part in self.parts(*span)):
            alive = transmittance.detach() > self.early
            if self.known and not alive.any():
                return
            sampled = reader.read(low - place.distance, high - place.distance, alive)
            if sampled is None:
                continue
            colour, opacity = self.transfer(sampled.samples[0])
            if self.lighting is not None:
                colour = self.lighting.shade(colour, sampled.samples[1:], rotation, self.observer)
            before = transmittance.index_select(0, sampled.rays)
            weight, after = absorb(before, corrected_opacity(opacity, sampled.length * (1 / unit)))
            transmittance.index_copy_(0, sampled.rays, after)
            yield Step(plane, sampled.rays, weight, colour)

    def picture(self, selected: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Colours [C, h, w] and opacity [h, w], summed along each ray; ``selected`` as in :meth:`steps`."""
        image, opacity = self.zeros(self.channels), self.zeros(1)
        for step in self.steps(selected):
            image.index_add_(1, step.rays, step.weight * step.colour)
            opacity.index_add_(1, step.rays, step.weight[None])
        return self.whole(image), self.whole(opacity)[0]

    def amplitudes(
        self, selected: Tensor | None = None, fill: Callable[[Tensor], Tensor] | None = None
    ) -> Iterator[Tensor]:
        """Yield the square root of the radiance, [C, h, w], for every plane.

        ``selected`` as in :meth:`steps`; ``fill`` completes the radiance of a plane, for rays parallel to the axis.
        """
        # One zero, expanded to the shape of a plane without allocating it.
        dark = torch.zeros((), dtype=self.dtype, device=self.device).expand(self.channels, *self.rays.grid.shape)
        done = 0
        for plane, rays, radiance in self._sources(selected):
            yield from [dark] * (plane - done)
            done = plane + 1
            scale, window = self.rays.scale(self.depths[plane]), self.zeros(self.channels)
            if fill is not None:
                yield safe_sqrt(fill(self.whole(window.index_copy_(1, rays, radiance))))
            elif scale == 1:
                yield self.whole(window.index_copy_(1, rays, safe_sqrt(radiance)))
            else:
                yield safe_sqrt(self._resampled(window.index_copy_(1, rays, radiance), scale))
        yield from [dark] * (len(self.depths) - done)

    def _sources(self, selected: Tensor | None) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Yield each plane that has a contribution, its rays [n], and their radiance [C, n] from all samples."""
        if self.samples == 1:
            for step in self.steps(selected):
                yield step.plane, step.rays, step.weight * step.colour
            return
        plane, every, window = -1, torch.arange(self.window.size, device=self.device), self.zeros(self.channels)
        for step in self.steps(selected):
            if step.plane != plane:
                if plane >= 0:
                    yield plane, every, window
                plane, window = step.plane, self.zeros(self.channels)
            window.index_add_(1, step.rays, step.weight * step.colour)
        if plane >= 0:
            yield plane, every, window

    def zeros(self, channels: int) -> Tensor:
        """Zeros of shape [channels, rays of the window]."""
        return torch.zeros(channels, self.window.size, dtype=self.dtype, device=self.device)

    def whole(self, values: Tensor) -> Tensor:
        """Values of the rays of the window, [c, n], on the whole grid, [c, h, w], with zeros outside the window."""
        (height, width), rows, columns = self.rays.grid.shape, self.window.rows, self.window.columns
        if not self.window.size:
            return values.new_zeros(len(values), height, width)
        framed = values.unflatten(1, (len(rows), len(columns)))
        return functional.pad(framed, (columns.start, width - columns.stop, rows.start, height - rows.stop))

    def _reader(self) -> SliceReader | PointReader:
        """Reader whose first channel is the value; lighting adds three slopes, scattering its illumination."""
        support = (-math.inf, math.inf) if self.occupied is None else self.transfer.support()
        common = (self.place, self.rays, self.window, self.occupied, support)
        values, light = self.volume.values, None
        steps = flat_steps(self.volume) if isinstance(self.lighting, Lighting) else None
        if isinstance(self.lighting, Scattering):
            light = self.lighting.illumination(self.volume, self.place, self.transfer, self.observer).to(self.dtype)
        if self.place.turned:
            extra = [] if steps is None else [slopes(values.to(self.dtype), steps)]
            extra += [] if light is None else [light[None]]
            return PointReader(*common, torch.cat([values.to(self.dtype)[None], *extra]))
        # Backward, unbind allocates one gradient for all slices; indexing would allocate a whole volume per slice.
        slices, lit = values.unbind(0), None if light is None else light.unbind(0)

        def channels(k: int) -> Tensor:
            here = [slices[k].to(self.dtype)[None]]
            if steps is not None:
                here.append(slice_slopes(slices, k, steps, self.dtype))
            return torch.cat(here if lit is None else [*here, lit[k][None]])

        return SliceReader(*common, channels)

    def _resampled(self, window: Tensor, scale: float) -> Tensor:
        """Radiance of the rays of the window, [C, n], interpolated linearly at the points of the grid, [C, h, w].

        At the depth of the plane, the rays are ``scale`` times as far from the axis as the points of the grid.
        """
        rows, columns = self.window.rows, self.window.columns
        framed = functional.pad(window.unflatten(1, (len(rows), len(columns))), (1, 1, 1, 1))
        for axis, part, count in zip((-2, -1), (rows, columns), self.rays.grid.shape, strict=True):
            index = (torch.arange(count, dtype=torch.float64, device=window.device) - count // 2) / scale + count // 2
            # Index into the window, which is padded with a dark border of one sample.
            index = (index - (part.start - 1)).clamp(0, len(part) + 1)
            first = index.floor().clamp_(max=len(part))
            framed = interpolate(framed, first.to(torch.int64), index - first, axis)
        return framed
