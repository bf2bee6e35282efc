"""DVRSampler: direct volume rendering that ends in light sources on planes (Section 5.3.1, Algorithm 3)."""

import warnings
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH, WIDTH
from holotorch.scene.compositing import safe_sqrt
from holotorch.scene.layers import SourceLayers
from holotorch.scene.lighting import Lighting
from holotorch.scene.march import March
from holotorch.scene.phases import PointPhases
from holotorch.scene.placement import Placement, Rays, check_planes, check_rotation, slabs, upright
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume

PhaseMaps = Tensor | PointPhases
_LOST = 1e-3  # of the visible depth


class DVRSampler(nn.Module):
    """Light sources of a volume: rays are composited front to back, and what every step adds becomes a source.

    A ray gains C_j = T_j alpha_j c_j on plane j (Eq. 5.6), with colour and opacity of the transfer function half-way
    through the plane's slab and the opacity corrected for the length of the path within slab and volume. So a
    homogeneous medium is exact for any planes, and the error elsewhere falls with the square of the slabs' thickness.
    The source stands on the plane; its amplitude is the root of C_j.

    Slabs meet half-way between planes; the outermost reach as far beyond their plane as before it, and a single plane
    stands for the whole volume. Beyond its faces a volume is transparent; what the slabs leave out is announced by a
    SamplingWarning.

    Rays are parallel to the axis, or with ``eye`` come from a point on it. Then they pass the grid's points on the
    first plane and spread from there: every ray keeps its own transmittance, and its sources, which lie between the
    grid's points on the other planes, are put where they belong by linear interpolation of the radiance onto the grid,
    along each axis. Light beyond the grid is cut off. ``phase`` belongs to the points of the grid, not to such rays.

    Places without opacity are skipped by bricks of the volume, and rays end below a transmittance of ``early``, which
    is the most that an image can lose. Both change nothing else.

    Args:
        transfer: Colour and opacity of the volume's values.
        rays: Their grid, centred on the axis, the same on all planes.
        depths: Of the planes, metres from the hologram, front (towards the observer) to back: rising or falling.
        width: Metres of the volume's longest side, whatever its own unit.
        distance: Of the volume's centre from the hologram; half-way between first and last plane by default.
        rotation: 3 x 3 over (z, y, x), about the volume's centre: offset in the scene = rotation @ offset in the
            volume. Index 0 of z is nearest to the hologram without it.
        eye: Depth of the observer, in front of all slabs (negative: on the other side of the hologram); None: far away.
        lighting: Shading by the gradient of the volume; None: all points glow evenly.
        phase: Grid -> phases in radians, [h, w] for every ray, or ``PointPhases``; see ``phases``. None: 0.
        early: Transmittance below which a ray ends, in [0, 1).
        boundaries: Of the slabs, [D + 1], if they are not half-way between the planes.

    Raises:
        TypeError: An argument of another kind.
        ValueError: Planes that do not follow one another, an eye among them, or another number out of range.
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
        lighting: Lighting | None = None,
        phase: Callable[[Grid], PhaseMaps] | None = None,
        early: float = 1e-3,
        boundaries: Sequence[float] | None = None,
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

    def forward(self, volume: Volume) -> SourceLayers:
        """Light sources of ``volume``, composited plane by plane when they are asked for.

        Raises:
            ValueError: A voxel is NaN or infinite, or the eye is not in front of the slabs.
        """
        march = self._march(volume)
        maps = self.phase(self.grid) if self.phase is not None else None
        common = maps.to(march.device, march.dtype) if isinstance(maps, Tensor) else None
        own = maps if isinstance(maps, PointPhases) else None
        turns = None if own is None else phasor(own.phase.to(march.device, march.dtype))

        def amplitudes() -> Iterator[Tensor]:
            for plane, amplitude in enumerate(march.planes(safe_sqrt)):
                yield amplitude if own is None or turns is None else _turned(amplitude, own.window(turns, plane))

        return SourceLayers(self.grid, self.depths, 3, amplitudes, common)

    def render(self, volume: Volume, rays: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Picture of ``volume`` as the rays see it: the sum of all contributions.

        Args:
            volume: Scalar field.
            rays: Which ones to follow, bool [h, w]; the others stay black. All by default.

        Returns:
            Red, green, blue [3, h, w] and opacity [h, w], 1 - T behind the last plane; differentiable.
        """
        march = self._march(volume)
        image, opacity = march.zeros(3), march.zeros(1)
        for step in march.steps(rays):
            image.index_add_(1, step.rays, step.weight * step.colour)
            opacity.index_add_(1, step.rays, step.weight[None])
        return march.whole(image), march.whole(opacity)[0]

    def depth_map(self, volume: Volume) -> Tensor:
        """Mean depth in metres of what a ray sees, [h, w], weighted by its share in opacity; 0 where it sees none."""
        march = self._march(volume)
        sums = march.zeros(2)
        for step in march.steps(None):
            sums.index_add_(1, step.rays, torch.stack([step.weight, step.weight * self.depths[step.plane]]))
        seen = sums[0] > 0
        return march.whole((sums[1] / torch.where(seen, sums[0], 1) * seen)[None])[0]

    def _march(self, volume: Volume) -> March:
        if not isinstance(volume, Volume):
            raise TypeError(f"volume must be a Volume, got {type(volume).__name__}; use Volume(values, spacing, unit)")
        volume, rotation = upright(volume, self.rotation)
        place = Placement.of(volume, self.width, self.distance, rotation)
        spans = slabs(self.depths, self.boundaries, place.reach())
        near, far = min(span[0] for span in spans), max(span[1] for span in spans)
        if self.eye is not None:
            falling = self.depths[-1] < self.depths[0] or (len(self.depths) == 1 and self.eye > self.depths[0])
            if not (self.eye > far if falling else self.eye < near):
                where = f"beyond {far:g} m" if falling else f"before {near:g} m"
                raise ValueError(f"eye must be in front of all slabs, {where} for these depths, got {self.eye:g} m")
        rays = Rays(self.grid, self.depths[0], self.eye)
        march = March(volume, place, self.transfer, self.lighting, rays, self.depths, spans, self.early)
        if self.boundaries is None and march.visible is not None:
            self._warn_if_cut(march.visible, near, far)
        return march

    def _warn_if_cut(self, visible: tuple[float, float], near: float, far: float) -> None:
        start, end = visible
        lost = (max(0.0, min(near, end) - start) + max(0.0, end - max(far, start))) / (end - start)
        if lost > _LOST:
            warnings.warn(
                f"the planes' slabs reach from {near:g} to {far:g} m, but there is something to see from {start:g} to "
                f"{end:g} m: {lost:.0%} of that depth is cut off; add planes, or pass boundaries to cut on purpose",
                checks.SamplingWarning,
                stacklevel=4,
            )


def _turned(amplitude: Tensor, turn: Tensor) -> Tensor:
    """Real [C, h, w] times complex [h, w], without making the real one complex first."""
    if not any(amplitude.stride()):
        return amplitude[0, 0, 0].to(turn.dtype).expand(amplitude.shape)  # a dark plane stays a single zero
    return torch.view_as_complex(amplitude[..., None] * torch.view_as_real(turn))
