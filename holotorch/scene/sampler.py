"""DVRSampler: direct volume rendering to light sources on planes (Section 5.3.1, Algorithm 3)."""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH, WIDTH
from holotorch.scene.layers import SlabLayers, SourceLayers
from holotorch.scene.lighting import Lighting, Scattering
from holotorch.scene.march import March
from holotorch.scene.phases import PointPhases
from holotorch.scene.placement import Placement, Rays, check_planes, check_rotation, slabs, upright
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume

PhaseMaps = Tensor | PointPhases
_FEW_RAYS = 24  # rays along each axis that slab_error follows
_FARTHEST = 1e-3  # largest distance between these rays in metres
_MOST_SLABS = 2048  # largest number of parts of slabs along each of them
_THICK = 4  # voxels: the error of thicker slabs is predicted in the first call, since it takes 0.1 to 1 s
_COARSE = 0.25  # relative error of a rendering above which a warning is given


class DVRSampler(nn.Module):
    """Light sources from a volume: each ray is composited front to back, and each step becomes a source on a plane.

    Each plane represents a slab of the volume. On plane j a ray gives a source of radiance C_j = T_j alpha_j c_j
    (Eq. 5.6), with the transmittance T_j up to the slab, and opacity alpha_j and colour c_j of the slab. Its amplitude
    is the square root of C_j. Colour and opacity are those of the value half-way through the slab, as in the thesis, or
    of several ``samples`` within it, which are composited; the opacity is corrected for the path length within slab and
    volume. For a homogeneous medium the total opacity is therefore exact for any choice of planes; otherwise the error
    of the rendering is proportional to the square of the slab thickness per sample, and :meth:`slab_error` predicts it.
    More samples cost rendering time alone, more planes also that of the hologram; planes are needed for the depth of
    the light, at most a depth of focus apart.

    Slabs meet half-way between planes. The outermost slabs are symmetric about their plane; a single plane represents
    the whole volume. Space outside the volume is transparent.

    Rays are parallel to the axis, or start at a point on it (``eye``). In the second case they pass through the points
    of the grid on the first plane and diverge. On the other planes they do not meet the points of the grid, so their
    radiance is interpolated linearly onto the grid, and light beyond the grid is cut off. ``phase`` applies to the
    points of the grid, not to the rays.

    Transparent parts of the volume are skipped. A ray ends when its transmittance falls below ``early``, which is also
    the largest error that this causes in a picture.

    Attributes:
        checks_slabs: Whether the next call predicts the error of slabs more than four voxels thick per sample, which
            takes 0.1 to 1 s, and warns of a large one. False after the first call.

    Args:
        transfer: Colour and opacity as functions of the value of the volume.
        rays: Grid of rays and sources, centred on the axis, the same on all planes.
        depths: Distances of the planes from the hologram in metres, rising or falling; the first is nearest to the
            observer.
        width: Length of the longest side of the volume in the scene, in metres; the size in the file is not used.
        distance: Distance of the centre of the volume from the hologram in metres; by default half-way between the
            first and the last plane.
        rotation: Rotation matrix about the centre of the volume, [3, 3] over (z, y, x): offset in the scene = rotation
            @ offset in the volume. By default slice 0 of the volume is nearest to the hologram. An observer on the far
            side (falling depths) sees the mirror image of a right-handed volume: give him ``volume.mirrored()``.
        eye: Depth of the observer in metres, in front of all slabs; negative if the hologram is between observer and
            volume. None for an observer at infinity.
        lighting: Shading by the gradient of the volume, or light that it scatters; None for emission without shading.
        phase: Function from the grid to phases in radians: [h, w] for use on all planes, or ``PointPhases``; see
            ``holotorch.scene.phases``. None for a phase of 0.
        early: Transmittance below which a ray ends, in [0, 1).
        boundaries: Boundaries of the slabs in metres, [D + 1], if they are not half-way between the planes.
        samples: Samples of the volume within each slab, in the middles of equal parts of it.

    Raises:
        TypeError: An argument of a wrong type.
        ValueError: Depths that are not monotonic, an eye that is not in front, or another number out of range.

    Warns:
        SamplingWarning: In a call without ``boundaries``, if the slabs leave out a visible part of the volume. In the
            first call, if slabs are more than four voxels thick per sample and the rendering is a quarter off because
            of it.
    """

    def __init__(
        self,
        transfer: TransferFunction,
        rays: Grid,
        depths: Sequence[float],
        *,
        width: float,
        distance: float | None = None,
        rotation: Tensor | None = None,
        eye: float | None = None,
        lighting: Lighting | Scattering | None = None,
        phase: Callable[[Grid], PhaseMaps] | None = None,
        early: float = 1e-3,
        boundaries: Sequence[float] | None = None,
        samples: int = 1,
    ):
        super().__init__()
        self.transfer, self.grid, self.lighting, self.phase = transfer, rays, lighting, phase
        self.depths, self.boundaries = check_planes(depths, boundaries)
        self.width = checks.quantity(WIDTH, width)
        middle = (self.depths[0] + self.depths[-1]) / 2
        self.distance = checks.quantity(DEPTH, middle if distance is None else distance, "distance")
        self.rotation = check_rotation(rotation)
        self.eye = None if eye is None else checks.finite("eye", eye, "metres")
        if not 0 <= checks.finite("early", early) < 1:
            raise ValueError(f"early must be a transmittance in [0, 1), 0 to follow all rays, got {early}")
        self.early = float(early)
        self.samples = checks.whole("samples", samples, 1)
        self.checks_slabs = True

    def forward(
        self, volume: Volume, rays: Tensor | None = None, fill: Callable[[Tensor], Tensor] | None = None
    ) -> SourceLayers:
        """Light sources of ``volume``; the planes are composited one by one as the result is iterated.

        ``rays``, bool [h, w], selects the rays to compute, by default all. The others have no sources unless ``fill``
        adds them: a function from the radiance of a plane [C, h, w], 0 where no ray was computed, to that of all rays.

        Raises:
            ValueError: A voxel is NaN or infinite, the eye is not in front of the slabs, or ``fill`` and ``eye`` are
                both given.
        """
        if fill is not None and self.eye is not None:
            raise ValueError("fill needs rays through the points of the grid on every plane, eye=None")
        march = self._march(volume)
        phase = self.phase(self.grid) if self.phase is not None else None
        if not isinstance(phase, PointPhases):
            common = phase if phase is None else phase.to(march.device, march.dtype)
            return SourceLayers(self.grid, self.depths, march.channels, partial(march.amplitudes, rays, fill), common)
        factors = phasor(phase.phase.to(march.device, march.dtype))

        def amplitudes() -> Iterator[Tensor]:
            for plane, amplitude in enumerate(march.amplitudes(rays, fill)):
                yield _with_phase(amplitude, phase.window(factors, plane))

        return SourceLayers(self.grid, self.depths, march.channels, amplitudes)

    def render(self, volume: Volume, rays: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Picture of ``volume``: colours [C, h, w] (red, green and blue), and opacity [h, w], summed along each ray.

        ``rays``, bool [h, w], selects the rays to compute, by default all; the other pixels stay black.
        """
        return self._march(volume).picture(rays)

    def slab_layers(self, volume: Volume) -> SlabLayers:
        """Colours and opacities of the slabs on their own, for light towards any direction; without phases.

        ValueError for an ``eye``, since the light of a slab is known along parallel rays only.
        """
        if self.eye is not None:
            raise ValueError(f"slab_layers needs rays parallel to the axis, eye=None, got an eye at {self.eye:g} m")
        march = self._march(volume)
        emission, opacity = [], []
        for depth, span in zip(march.depths, march.spans, strict=True):
            alone = replace(march, depths=[depth], spans=[span])
            sums = alone.zeros(alone.channels + 1)
            for step in alone.steps():
                sums.index_add_(1, step.rays, torch.cat([step.weight * step.colour, step.weight[None]]))
            whole = alone.whole(sums)
            emission.append(whole[:-1])
            opacity.append(whole[-1].clamp(max=1))  # a sum of several weights may be above 1 by its rounding
        return SlabLayers(self.grid, self.depths, torch.stack(emission), torch.stack(opacity))

    def slab_error(self, volume: Volume) -> float:
        """Predicted relative L2 error of :meth:`render`, without lighting, because samples are not infinitely close.

        It is the change of some hundred rays spread over the grid when the part of a slab that each sample represents
        is divided into parts of half a voxel; of more than a thousand, neighbours are joined first, and the error falls
        with the square of their number. 0 for a volume without visible parts.
        """
        shape = tuple(
            min(n, max(_FEW_RAYS, math.ceil(extent / _FARTHEST)))
            for n, extent in zip(self.grid.shape, self.grid.extent, strict=True)
        )
        pitch = tuple(step * n / few for step, n, few in zip(self.grid.pitch, self.grid.shape, shape, strict=True))
        coarse = replace(self._placed(volume, Grid((shape[0], shape[1]), (pitch[0], pitch[1]))), lighting=None)
        spans = [part for span in coarse.spans for part in coarse.parts(*span)]
        joined = max(1, math.ceil(2 * len(spans) / _MOST_SLABS))
        groups = [spans[k : k + joined] for k in range(0, len(spans), joined)]
        spans = [(min(low for low, _ in group), max(high for _, high in group)) for group in groups]
        coarse = replace(coarse, spans=spans, samples=1)
        parts = max(2, min(math.ceil(2 * coarse.thickest), _MOST_SLABS // max(1, len(spans))))
        with torch.no_grad():
            thick, thin = coarse.picture()[0], replace(coarse, samples=parts).picture()[0]
        norm = thin.norm().item()
        error = (thick - thin).norm().item() / norm if norm else 0.0
        return error * parts**2 / (parts**2 - 1) / joined**2

    def depth_map(self, volume: Volume) -> Tensor:
        """Mean plane depth along each ray in metres, [h, w], weighted by T_j alpha_j; 0 where all is transparent."""
        march = self._march(volume)
        sums = march.zeros(2)
        for step in march.steps(None):
            sums.index_add_(1, step.rays, torch.stack([step.weight, step.weight * self.depths[step.plane]]))
        visible = sums[0] > 0
        return march.whole((sums[1] / torch.where(visible, sums[0], 1) * visible)[None])[0]

    def _march(self, volume: Volume) -> March:
        march = self._placed(volume, self.grid)
        self._warn_of_lost_depth(march)
        if self.checks_slabs and march.thickest > _THICK and march.known and not march.learned:
            self.checks_slabs = False
            if (error := self.slab_error(volume)) > _COARSE:
                warnings.warn(
                    f"slabs are up to {march.thickest:.0f} voxels thick for a scene that varies within them: the "
                    f"rendering is about {error:.0%} off the one with thin slabs; use more samples, or planes (see "
                    "slab_error)",
                    checks.SamplingWarning,
                    stacklevel=3,
                )
        return march

    def _placed(self, volume: Volume, grid: Grid) -> March:
        if not isinstance(volume, Volume):
            raise TypeError(f"volume must be a Volume, got {type(volume).__name__}; use Volume(values, spacing, unit)")
        volume, rotation = upright(volume, self.rotation)
        scale, (z, y, x) = self.width / max(volume.extent), volume.spacing
        place = Placement(volume.shape, (z * scale, y * scale, x * scale), self.distance, rotation)
        spans = slabs(self.depths, self.boundaries, place.depth_range())
        near, far = min(span[0] for span in spans), max(span[1] for span in spans)
        first, eye = self.depths[0], self.eye
        falling = self.depths[-1] < first or (len(self.depths) == 1 and eye is not None and eye > first)
        if eye is not None and not (eye > far if falling else eye < near):
            where = f"beyond {far:g} m" if falling else f"before {near:g} m"
            raise ValueError(f"eye must be in front of all slabs, {where} for these depths, got {eye:g} m")
        rays, observer = Rays(grid, first, eye), 1.0 if falling else -1.0
        geometry = place, self.transfer, self.lighting, rays, self.depths, spans, observer
        return March(volume, *geometry, self.early, self.samples)

    def _warn_of_lost_depth(self, march: March) -> None:
        if self.boundaries is not None or march.visible is None:
            return
        near, far = min(span[0] for span in march.spans), max(span[1] for span in march.spans)
        start, end = march.visible
        lost = (max(0.0, min(near, end) - start) + max(0.0, end - max(far, start))) / (end - start)
        if lost > 1e-3:
            warnings.warn(
                f"the slabs of the planes extend from {near:g} to {far:g} m, but the visible part of the volume from "
                f"{start:g} to {end:g} m: {lost:.0%} of that depth is cut off; add planes, or pass boundaries to cut "
                "on purpose",
                checks.SamplingWarning,
                stacklevel=4,
            )


def _with_phase(amplitude: Tensor, factor: Tensor) -> Tensor:
    """Real amplitude [C, h, w] times complex factor [h, w], without a complex copy of the amplitude."""
    if not any(amplitude.stride()):  # a dark plane, which stays a single expanded zero
        return amplitude[0, 0, 0].to(factor.dtype).expand(amplitude.shape)
    return torch.view_as_complex(amplitude[..., None] * torch.view_as_real(factor))
