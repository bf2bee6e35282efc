"""Position of a volume in front of the hologram, its intersection with rays, and the slabs around the planes."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH, DISTANCE
from holotorch.scene.volume import IDENTITY, Triple, Volume, reversed_along

_ON_FACE = 1e-9  # relative margin outside a face of the box within which a ray counts as inside, because of rounding


@dataclass(frozen=True)
class Rays:
    """Straight rays, one through each sample of ``grid`` at the reference depth ``reference``.

    The rays are parallel to the axis if ``eye`` is None; otherwise they meet at the point of the axis at depth ``eye``.
    Depths are in metres from the hologram.
    """

    grid: Grid
    reference: float
    eye: float | None

    def scale(self, depth: float) -> float:
        """Distance of a ray from the axis at ``depth``, divided by its distance at the reference depth."""
        return 1.0 if self.eye is None else (depth - self.eye) / (self.reference - self.eye)

    @property
    def spread(self) -> float:
        """Change of :meth:`scale` per metre of depth."""
        return 0.0 if self.eye is None else 1 / (self.reference - self.eye)


@dataclass(frozen=True)
class Placement:
    """Position, size and rotation of a volume in the scene.

    Offsets (z, y, x) are in metres from the centre of the volume, which lies on the axis. The box of the volume ends
    half a spacing beyond the outermost samples. Index coordinates (z, y, x) count samples from sample [0, 0, 0].
    """

    shape: tuple[int, int, int]  # number of samples (z, y, x)
    spacing: Triple  # distance between samples along (z, y, x) in metres
    distance: float  # depth of the centre in metres
    # Rows of a matrix over (z, y, x) with (offset in the scene) = rotation @ (offset along the volume's axes).
    rotation: tuple[Triple, Triple, Triple]

    @property
    def turned(self) -> bool:
        """Whether the volume is rotated relative to the scene."""
        return self.rotation != IDENTITY

    @property
    def half(self) -> Triple:
        """Half the size (z, y, x) of the box in metres."""
        (d, h, w), (z, y, x) = self.shape, self.spacing
        return d * z / 2, h * y / 2, w * x / 2

    def depth_range(
        self, low: Sequence[float] | None = None, high: Sequence[float] | None = None
    ) -> tuple[float, float]:
        """Smallest and largest depth in metres, of the box or its part from index coordinates ``low`` to ``high``."""
        if low is None or high is None:
            low, high = (-0.5, -0.5, -0.5), tuple(n - 0.5 for n in self.shape)
        depths = [corner[0] for corner in self._corners(low, high)]
        return min(depths), max(depths)

    def offsets(self, rays: Rays, depth: float, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets (z, y, x) of rays at ``depth`` along the axes of the volume, as two terms [h, 3] and [w, 3].

        The offset of a ray is the term of its row plus that of its column. ``rows`` [h] and ``columns`` [w] are the
        positions of the rays in metres at the reference depth.
        """
        axial, vertical, horizontal = (rows.new_tensor(row) for row in self.rotation)
        scale = rays.scale(depth)
        return (
            rows[:, None] * scale * vertical + (depth - self.distance) * axial,
            columns[:, None] * scale * horizontal,
        )

    def crossing(self, rays: Rays, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Depths at which the rays at ``rows`` [h] and ``columns`` [w] enter and leave the box, float64 [h, w] each.

        Depths are in metres from the centre. For a ray that misses the box, the first is not below the second.
        """
        axial, vertical, horizontal = self.rotation
        near, far = rows.new_full((), -math.inf), rows.new_full((), math.inf)
        for axis, half in enumerate(self.half):
            lateral = rows[:, None] * vertical[axis] + columns[None, :] * horizontal[axis]
            middle, slope = rays.scale(self.distance) * lateral, axial[axis] + rays.spread * lateral
            parallel = slope == 0
            one, other = ((end - middle) / torch.where(parallel, 1.0, slope) for end in (-half, half))
            # A ray that is parallel to two faces lies between them at all depths or at none.
            always = torch.where(middle.abs() <= half * (1 + _ON_FACE), math.inf, -math.inf)
            near = torch.maximum(near, torch.where(parallel, -always, torch.minimum(one, other)))
            far = torch.minimum(far, torch.where(parallel, always, torch.maximum(one, other)))
        return near, far

    def footprint(self, rays: Rays, low: Sequence[float], high: Sequence[float]) -> tuple[range, range]:
        """Rows and columns of the rays that may meet the part of the box from index coordinates ``low`` to ``high``."""
        projected: list[list[float]] = [[], []]
        for depth, *lateral in self._corners(low, high):
            scale = rays.scale(depth)
            if scale <= 0:  # the box extends behind the eye, so any ray may meet it
                return range(rays.grid.shape[0]), range(rays.grid.shape[1])
            for position, positions in zip(lateral, projected, strict=True):
                positions.append(position / scale)
        rows, columns = (
            range(
                max(0, math.ceil(min(positions) / step - _ON_FACE * n) + n // 2),
                max(0, min(n, math.floor(max(positions) / step + _ON_FACE * n) + n // 2 + 1)),
            )
            for positions, n, step in zip(projected, rays.grid.shape, rays.grid.pitch, strict=True)
        )
        return rows, columns

    def _corners(self, low: Sequence[float], high: Sequence[float]) -> list[Triple]:
        """Corners (depth, y, x) in metres of the part of the box from index coordinates ``low`` to ``high``."""
        ends = [
            [(index - (n - 1) / 2) * step for index in pair]
            for *pair, n, step in zip(low, high, self.shape, self.spacing, strict=True)
        ]
        turned = (
            (sum(r * c for r, c in zip(row, corner, strict=True)) for row in self.rotation)
            for corner in itertools.product(*ends)
        )
        return [(z + self.distance, y, x) for z, y, x in turned]


def upright(volume: Volume, rotation: tuple[Triple, Triple, Triple]) -> tuple[Volume, tuple[Triple, Triple, Triple]]:
    """Replace a rotation by right angles by a permutation of the voxels; return the new volume and the identity.

    This saves time, since slices parallel to the hologram are read several times faster than single points. For any
    other ``rotation``, volume and rotation are returned unchanged.
    """
    axes = [[j for j, cosine in enumerate(row) if abs(cosine) == 1] for row in rotation]
    if any(len(candidates) != 1 for candidates in axes):
        return volume, rotation
    order = [candidates[0] for candidates in axes]
    reverse = [i for i, j in enumerate(order) if rotation[i][j] < 0]
    if order == [0, 1, 2] and not reverse:
        return volume, rotation
    values = volume.values.permute(order)
    values = (reversed_along(values, reverse) if reverse else values).contiguous()
    z, y, x = (volume.spacing[j] for j in order)
    # Origin and orientation in the file have no effect on a scene.
    return Volume(values, (z, y, x), volume.unit), IDENTITY


def slabs(
    depths: Sequence[float], boundaries: Sequence[float] | None, whole: tuple[float, float]
) -> list[tuple[float, float]]:
    """Smallest and largest depth in metres of the slab around each plane.

    Neighbouring slabs meet half-way between their planes, unless ``boundaries`` [D + 1] in metres are given. The first
    and the last slab are symmetric about their planes. A single plane has the slab ``whole``, the range of the volume.
    """
    if boundaries is None and len(depths) == 1:
        return [whole]
    if boundaries is None:
        between = [(a + b) / 2 for a, b in itertools.pairwise(depths)]
        boundaries = [2 * depths[0] - between[0], *between, 2 * depths[-1] - between[-1]]
    return [(min(pair), max(pair)) for pair in itertools.pairwise(boundaries)]


def check_planes(
    depths: Sequence[float], boundaries: Sequence[float] | None
) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """``depths`` and ``boundaries`` as tuples; ValueError unless they are monotonic and each plane lies in its slab."""
    planes = tuple(checks.quantity(DEPTH, depth, "depth of a plane") for depth in depths)
    if not planes:
        raise ValueError("depths must hold at least one distance from the hologram in metres, got none")
    sign = -1 if len(planes) > 1 and planes[1] < planes[0] else 1
    for a, b in itertools.pairwise(planes):
        if sign * (b - a) <= 0:
            raise ValueError(f"depths must rise or fall throughout, front to back, got {a:g} before {b:g} m")
    if boundaries is None:
        return planes, None
    edges = tuple(checks.quantity(DISTANCE, edge, "boundary of a slab") for edge in boundaries)
    if len(edges) != len(planes) + 1:
        raise ValueError(f"boundaries must be one more than the {len(planes)} depths, got {len(edges)}")
    if len(planes) == 1 and edges[1] < edges[0]:
        sign = -1
    for k, (depth, (start, end)) in enumerate(zip(planes, itertools.pairwise(edges), strict=True)):
        if not sign * start <= sign * depth <= sign * end or start == end:
            raise ValueError(f"plane {k} at {depth:g} m must lie within its slab, got {start:g} to {end:g} m")
    return planes, edges


def check_rotation(rotation: Tensor | None) -> tuple[Triple, Triple, Triple]:
    """Rows of a rotation matrix, with entries near 0 and +-1 made exact; ValueError unless orthonormal to 1e-6."""
    if rotation is None:
        return IDENTITY
    if not isinstance(rotation, Tensor) or tuple(rotation.shape) != (3, 3):
        given = tuple(rotation.shape) if isinstance(rotation, Tensor) else type(rotation).__name__
        raise ValueError(f"rotation must be a (3, 3) tensor over (z, y, x), got {given}")
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
