"""Analytic test volumes for renderers and holograms.

All volumes fill the cube [-1, 1]^3 with coordinates (z, y, x) and are sampled at voxel centres. The number of voxels
``shape`` (D, H, W) does not change the object: where D, H and W differ, the spacings differ. ``width`` is the edge
length of the cube in metres; without it the unit of the volume is "relative" and the edge is 2. Values lie in [0, 1].
``dtype`` is a floating-point type, or torch.uint8 for 255 times the values, rounded.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import WIDTH
from holotorch.scene.volume import Volume

Shape = int | tuple[int, int, int]
# Bond lengths of C60 in the gas phase in angstrom (Hedberg et al. 1991).
_DOUBLE_BOND = 1.401  # between two hexagons
_SINGLE_BOND = 1.458  # around a pentagon
_ATOM_SIGMA = 0.35  # standard deviation of the Gaussian at an atom in angstrom
_MOLECULE_BOX = 9.6  # edge length of the cube around the molecule in angstrom


def marschner_lobb(
    shape: Shape = 40,
    *,
    frequency: float = 6.0,
    modulation: float = 0.25,
    width: float | None = None,
    dtype: torch.dtype = torch.float32,
) -> Volume:
    """Test signal of Marschner and Lobb (1994); at 40^3 voxels it is sampled near its Nyquist rate.

    Its value is (1 - sin(pi z / 2) + a (1 + cos(2 pi f cos(pi r / 2)))) / (2 (1 + a)), with r^2 = x^2 + y^2,
    f = ``frequency`` and a = ``modulation``. The defaults are those of the paper.
    """
    frequency, modulation = checks.positive("frequency", frequency), checks.positive("modulation", modulation)

    def density(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
        rings = torch.cos(2 * math.pi * frequency * torch.cos(math.pi / 2 * torch.sqrt(x**2 + y**2)))
        return (1 - torch.sin(math.pi / 2 * z) + modulation * (1 + rings)) / (2 * (1 + modulation))

    return _sampled(density, shape, width, dtype)


def gaussian_ball(
    shape: Shape = 64, *, sigma: float = 0.25, width: float | None = None, dtype: torch.dtype = torch.float32
) -> Volume:
    """exp(-r^2 / (2 sigma^2)); the integral along a line is sqrt(2 pi) sigma times the largest value on the line."""
    sigma = checks.positive("sigma", sigma)
    return _sampled(lambda z, y, x: torch.exp((z**2 + y**2 + x**2) / (-2 * sigma**2)), shape, width, dtype)


def homogeneous_slab(
    shape: Shape = 64, *, thickness: float = 1.0, width: float | None = None, dtype: torch.dtype = torch.float32
) -> Volume:
    """1 where abs(z) < ``thickness`` / 2, else 0; a voxel on a face of the slab holds the fraction that lies inside.

    The integral over z is therefore ``thickness`` at any resolution. ``thickness`` is at most 2, the edge of the cube.
    """
    thickness = checks.positive("thickness", thickness)
    if thickness > 2:
        raise ValueError(f"thickness must be at most 2, the edge of the cube, got {thickness!r}")
    step = 2 / _sizes(shape)[0]

    def density(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
        inside = (z + step / 2).clamp(max=thickness / 2) - (z - step / 2).clamp(min=-thickness / 2)
        return inside.clamp(min=0) / step

    return _sampled(density, shape, width, dtype)


def exponential_medium(
    shape: Shape = 64, *, length: float = 1.0, width: float | None = None, dtype: torch.dtype = torch.float32
) -> Volume:
    """exp(-(z + 1) / ``length``): 1 at z = -1, with the integral ``length`` * (1 - exp(-2 / ``length``)) over z."""
    length = checks.positive("length", length)
    return _sampled(lambda z, y, x: torch.exp(-(z + 1) / length), shape, width, dtype)


def shells(shape: Shape = 128, *, width: float | None = None, dtype: torch.dtype = torch.float32) -> Volume:
    """Three nested shells with radii R = 0.9, 0.6 and 0.3, and peak values h = 1/3, 2/3 and 1.

    The value is the sum over the shells of h exp(-(r - R)^2 / (2 w^2)) with w = 0.04. For z < 0 the outer two shells
    are multiplied by 1 - exp(-(x^2 + y^2) / (2 g^2)) with g = 0.2, so that the inner shell is visible through a hole.
    """

    def density(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
        r = torch.sqrt(z**2 + y**2 + x**2)
        outer, middle, inner = (
            h * torch.exp((r - radius) ** 2 / (-2 * 0.04**2)) for h, radius in ((1 / 3, 0.9), (2 / 3, 0.6), (1.0, 0.3))
        )
        hole = 1 - torch.exp((x**2 + y**2) / (-2 * 0.2**2)) if z < 0 else 1
        return (outer + middle) * hole + inner

    return _sampled(density, shape, width, dtype)


def c60(shape: Shape = 128, *, width: float | None = None, dtype: torch.dtype = torch.float32) -> Volume:
    """Buckminsterfullerene: a Gaussian of sigma 0.35 angstrom at each of the 60 atoms, in a cube of 9.6 angstrom.

    The density is divided by its value at an atom. ``width`` is the edge of the enlarged cube in metres.
    """
    atoms = c60_atoms() * (2 / _MOLECULE_BOX)
    scale = -1 / (2 * (_ATOM_SIGMA * 2 / _MOLECULE_BOX) ** 2)
    peak = torch.exp((atoms - atoms[0]).square().sum(1) * scale).sum()

    def density(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
        # The Gaussian is separable, so a slice is one matrix product.
        along_z, along_y, along_x = (
            torch.exp((axis.reshape(-1, 1) - atoms[:, i]).square() * scale) for i, axis in enumerate((z, y, x))
        )
        return (along_y * along_z / peak) @ along_x.T

    return _sampled(density, shape, width, dtype)


def c60_atoms() -> Tensor:
    """Positions (z, y, x) of the nuclei of C60 relative to its centre in angstrom, float64 [60, 3].

    They form a truncated icosahedron: two nuclei lie on every edge of an icosahedron, each at the distance of a single
    bond from one end. The bond between the two is a double bond.
    """
    golden = (1 + math.sqrt(5)) / 2
    points = [(0.0, a, b * golden) for a, b in itertools.product((-1.0, 1.0), repeat=2)]
    vertices = torch.tensor([point[k:] + point[:k] for point in points for k in range(3)], dtype=torch.float64)
    # The edges of this icosahedron have length 2.
    starts, ends = torch.nonzero((torch.cdist(vertices, vertices) - 2).abs() < 1e-9, as_tuple=True)
    edge = 2 * _SINGLE_BOND + _DOUBLE_BOND
    atoms = vertices[starts] + (_SINGLE_BOND / edge) * (vertices[ends] - vertices[starts])
    return (atoms * (edge / 2)).flip(1)


def _sizes(shape: Shape) -> tuple[int, int, int]:
    sizes = shape if isinstance(shape, Sequence) else (shape, shape, shape)
    if len(sizes) != 3:
        raise ValueError(f"phantom shape must be one number or three (D, H, W), got {shape!r}")
    depth, height, width = (checks.whole("phantom shape", size, 1) for size in sizes)
    return depth, height, width


def _sampled(
    density: Callable[[Tensor, Tensor, Tensor], Tensor], shape: Shape, width: float | None, dtype: torch.dtype
) -> Volume:
    if not (dtype.is_floating_point or dtype == torch.uint8):
        raise TypeError(f"phantoms are floating-point or torch.uint8, got {dtype}")
    sizes = _sizes(shape)
    scale = 1.0 if width is None else checks.quantity(WIDTH, width) / 2
    z, y, x = ((2 * torch.arange(n, dtype=torch.float64) + 1) / n - 1 for n in sizes)
    values = torch.empty(sizes, dtype=dtype)
    # Slice by slice in float64, to keep temporary memory small.
    for index in range(sizes[0]):
        plane = density(z[index], y[:, None], x[None, :])
        values[index] = plane if dtype.is_floating_point else (255 * plane).round()
    depth, height, breadth = (2 * scale / n for n in sizes)
    front, top, left = ((1 / n - 1) * scale for n in sizes)
    return Volume(values, (depth, height, breadth), "relative" if width is None else "m", (front, top, left))
