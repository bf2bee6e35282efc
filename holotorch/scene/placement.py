"""Where a volume stands in front of the hologram, which rays meet it, and how the planes cut it into slabs."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH, DISTANCE
from holotorch.scene.volume import Triple, Volume

# A ray that lies in a face of the box belongs to it, whatever rounding says.
_ON_FACE = 1e-9


@dataclass(frozen=True)
class Rays:
    """Straight rays, one per sample of ``grid``, which they pass at depth ``reference``.

    Parallel to the axis, or through a point of the axis at depth ``eye``; depths in metres from the hologram.
    """

    grid: Grid
    reference: float
    eye: float | None

    def scale(self, depth: float) -> float:
        """Distance from the axis at ``depth``, relative to that at the reference depth."""
        return 1.0 if self.eye is None else (depth - self.eye) / (self.reference - self.eye)

    @property
    def spread(self) -> float:
        """Change of :meth:`scale` per metre of depth."""
        return 0.0 if self.eye is None else 1 / (self.reference - self.eye)


@dataclass(frozen=True)
class Placement:
    """A volume of ``shape`` whose centre stands on the axis at depth ``distance``.

    Positions are offsets (z, y, x) from that centre in metres. A sample is the middle of a box of one ``spacing``; the
    volume ends where its outermost boxes do, half a spacing beyond the outermost samples.

    Attributes:
        shape: Samples (z, y, x).
        spacing: Between samples, metres, after scaling the longest side to ``width``.
        distance: Depth of the centre.
        rotation: Row-major 3 x 3 over (z, y, x): offset in the scene = rotation @ offset in the volume.
    """

    shape: tuple[int, int, int]
    spacing: Triple
    distance: float
    rotation: tuple[Triple, Triple, Triple]

    @classmethod
    def of(cls, volume: Volume, width: float, distance: float, rotation: tuple[Triple, Triple, Triple]) -> "Placement":
        """Place ``volume`` so that its longest side measures ``width``, whatever its own unit."""
        scale = width / max(volume.extent)
        z, y, x = volume.spacing
        return cls(volume.shape, (z * scale, y * scale, x * scale), distance, rotation)

    @property
    def turned(self) -> bool:
        """Whether the slices of the volume are not parallel to the hologram as they are."""
        return any(self.rotation[i][j] != (i == j) for i in range(3) for j in range(3))

    @property
    def half(self) -> Triple:
        """Half the size of the box."""
        (d, h, w), (z, y, x) = self.shape, self.spacing
        return d * z / 2, h * y / 2, w * x / 2

    def reach(self, low: Sequence[float] | None = None, high: Sequence[float] | None = None) -> tuple[float, float]:
        """Smallest and largest depth of the box, or of its part between index coordinates ``low`` and ``high``."""
        if low is None or high is None:
            low, high = (-0.5, -0.5, -0.5), tuple(n - 0.5 for n in self.shape)
        depths = [corner[0] for corner in self._corners(low, high)]
        return min(depths), max(depths)

    def offsets(self, rays: Rays, depth: float, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets in the volume at ``depth`` of the rays at ``rows`` [h] and ``columns`` [w] (metres at the reference).

        Returns:
            [h, 3] and [w, 3], to be added for every pair.
        """
        axial, vertical, horizontal = (rows.new_tensor(row) for row in self.rotation)
        scale = rays.scale(depth)
        return (
            rows[:, None] * scale * vertical + (depth - self.distance) * axial,
            columns[:, None] * scale * horizontal,
        )

    def crossing(self, rays: Rays, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Where the rays at ``rows`` [h] and ``columns`` [w] enter and leave the box, as depths from its centre.

        Returns:
            Smallest and largest, [h, w] each, float64; the first is not below the second where a ray misses the box.
        """
        axial, vertical, horizontal = self.rotation
        near, far = rows.new_full((), -math.inf), rows.new_full((), math.inf)
        for axis, half in enumerate(self.half):
            lateral = rows[:, None] * vertical[axis] + columns[None, :] * horizontal[axis]
            middle, slope = rays.scale(self.distance) * lateral, axial[axis] + rays.spread * lateral
            parallel = slope == 0
            one, other = ((end - middle) / torch.where(parallel, 1.0, slope) for end in (-half, half))
            # A ray along the face never leaves, or never enters.
            ever = torch.where(middle.abs() <= half * (1 + _ON_FACE), math.inf, -math.inf)
            near = torch.maximum(near, torch.where(parallel, -ever, torch.minimum(one, other)))
            far = torch.minimum(far, torch.where(parallel, ever, torch.maximum(one, other)))
        return near, far

    def footprint(self, rays: Rays, low: Sequence[float], high: Sequence[float]) -> tuple[range, range]:
        """Rows and columns of rays that may meet the part of the box between index coordinates ``low`` and ``high``."""
        seen: list[list[float]] = [[], []]
        for depth, *lateral in self._corners(low, high):
            scale = rays.scale(depth)
            if scale <= 0:  # the eye is inside: any ray may
                return range(rays.grid.shape[0]), range(rays.grid.shape[1])
            for place, found in zip(lateral, seen, strict=True):
                found.append(place / scale)
        rows, columns = (
            range(
                max(0, math.ceil(min(found) / step - _ON_FACE * n) + n // 2),
                max(0, min(n, math.floor(max(found) / step + _ON_FACE * n) + n // 2 + 1)),
            )
            for found, n, step in zip(seen, rays.grid.shape, rays.grid.pitch, strict=True)
        )
        return rows, columns

    def _corners(self, low: Sequence[float], high: Sequence[float]) -> list[Triple]:
        """Corners in the scene, (depth from the hologram, y, x), of the box between two index coordinates."""
        ends = [
            [(place - (n - 1) / 2) * step for place in pair]
            for *pair, n, step in zip(low, high, self.shape, self.spacing, strict=True)
        ]
        corners = []
        for own in itertools.product(*ends):
            z, y, x = (sum(r * c for r, c in zip(row, own, strict=True)) for row in self.rotation)
            corners.append((z + self.distance, y, x))
        return corners


def upright(volume: Volume, rotation: tuple[Triple, Triple, Triple]) -> tuple[Volume, tuple[Triple, Triple, Triple]]:
    """``volume`` with its axes exchanged and reversed where ``rotation`` does no more, and the rotation that is left.

    Slices parallel to the hologram are read several times faster than points between them.
    """
    axes = [[j for j, part in enumerate(row) if abs(part) == 1] for row in rotation]
    if any(len(found) != 1 for found in axes):
        return volume, rotation
    order = [found[0] for found in axes]
    reverse = [i for i, j in enumerate(order) if rotation[i][j] < 0]
    if order == [0, 1, 2] and not reverse:
        return volume, rotation
    values = volume.values.permute(order)
    values = (values.flip(reverse) if reverse else values).contiguous()
    z, y, x = (volume.spacing[j] for j in order)
    # Origin and orientation say where the file put the volume, which is of no matter to a scene.
    return Volume(values, (z, y, x), volume.unit), check_rotation(None)


def slabs(
    depths: Sequence[float], boundaries: Sequence[float] | None, reach: tuple[float, float]
) -> list[tuple[float, float]]:
    """Smallest and largest depth of the slab that each plane stands for.

    Half-way to the neighbours, and as far beyond the first and last plane as before them; a single plane stands for
    ``reach``, the whole volume. ``boundaries`` [D + 1] say otherwise.
    """
    if boundaries is None and len(depths) == 1:
        return [reach]
    if boundaries is None:
        between = [(a + b) / 2 for a, b in zip(depths, depths[1:], strict=False)]
        boundaries = [2 * depths[0] - between[0], *between, 2 * depths[-1] - between[-1]]
    return [(min(pair), max(pair)) for pair in zip(boundaries, boundaries[1:], strict=False)]


def check_planes(
    depths: Sequence[float], boundaries: Sequence[float] | None
) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """Depths and boundaries as tuples, or ValueError unless both rise or both fall and enclose one another."""
    found = tuple(checks.quantity(DEPTH, depth, "depth of a plane") for depth in depths)
    if not found:
        raise ValueError("depths must hold at least one distance from the hologram in metres, got none")
    sign = -1 if len(found) > 1 and found[1] < found[0] else 1
    for a, b in zip(found, found[1:], strict=False):
        if sign * (b - a) <= 0:
            raise ValueError(f"depths must rise or fall throughout, front to back, got {a:g} before {b:g} m")
    if boundaries is None:
        return found, None
    edges = tuple(checks.quantity(DISTANCE, edge, "boundary of a slab") for edge in boundaries)
    if len(edges) != len(found) + 1:
        raise ValueError(f"boundaries must be one more than the {len(found)} depths, got {len(edges)}")
    if len(found) == 1 and edges[1] < edges[0]:
        sign = -1
    for k, depth in enumerate(found):
        if not sign * edges[k] <= sign * depth <= sign * edges[k + 1] or edges[k] == edges[k + 1]:
            raise ValueError(
                f"plane {k} at {depth:g} m must lie within its slab, got {edges[k]:g} to {edges[k + 1]:g} m"
            )
    return found, edges


def check_rotation(rotation: Tensor | None) -> tuple[Triple, Triple, Triple]:
    """A rotation as rows of floats, or ValueError unless it is one to 1e-6. Cosines of right angles become exact."""
    if rotation is None:
        return (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    if not isinstance(rotation, Tensor) or tuple(rotation.shape) != (3, 3):
        found = tuple(rotation.shape) if isinstance(rotation, Tensor) else type(rotation).__name__
        raise ValueError(f"rotation must be a (3, 3) tensor over (z, y, x), got {found}")
    if rotation.requires_grad:
        raise TypeError("rotation is fixed in a sampler and cannot carry a gradient; detach it")
    matrix = rotation.to("cpu", torch.float64)
    checks.all_finite("rotation", matrix)
    off = (matrix @ matrix.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if off > 1e-6 or torch.linalg.det(matrix) < 0:
        raise ValueError(
            f"rotation must have orthonormal rows and determinant 1, but is off by {off:.2g}: {matrix.tolist()}"
        )
    whole = matrix.round()
    z, y, x = torch.where((matrix - whole).abs() < 1e-12, whole, matrix).tolist()
    return (z[0], z[1], z[2]), (y[0], y[1], y[2]), (x[0], x[1], x[2])
