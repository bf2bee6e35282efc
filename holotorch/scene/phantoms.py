"""Analytic test volumes for renderers and holograms.

All fill the cube [-1, 1]^3, coordinates (z, y, x), and are sampled at voxel centres: every shape (D, H, W) shows the
same object, with unequal spacings where D, H and W differ. ``width`` is the edge length of the cube in metres; without
it the volume is "relative", with edges of 2. Values lie in [0, 1]; torch.uint8 stores them times 255, rounded.
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
_GOLDEN = (1 + math.sqrt(5)) / 2
_DOUBLE_BOND = 1.401  # angstrom; bond between two hexagons of C60 in the gas phase (Hedberg et al. 1991)
_SINGLE_BOND = 1.458  # angstrom; bond around a pentagon (the same source)
_ATOM_SIGMA = 0.35  # angstrom; width of the Gaussian at an atom
_MOLECULE_BOX = 9.6  # angstrom; edge of the cube around the molecule
_SHELLS = ((1 / 3, 0.9), (2 / 3, 0.6), (1.0, 0.3))  # peak and radius of the three shells, from outside in


def marschner_lobb(
    shape: Shape = 40,
    *,
    frequency: float = 6.0,
    modulation: float = 0.25,
    width: float | None = None,
    dtype: torch.dtype = torch.float32,
) -> Volume:
    """Test signal of Marschner and Lobb (1994), hard for every interpolation near its Nyquist rate.

    (1 - sin(pi z / 2) + a (1 + cos(2 pi f cos(pi r / 2)))) / (2 (1 + a)), with r^2 = x^2 + y^2, f = ``frequency`` and
    a = ``modulation``. The defaults are those of the paper.
    """
    frequency, modulation = checks.positive("frequency", frequency), checks.positive("modulation", modulation)

    def density(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
        rings = torch.cos(2 * math.pi * frequency * torch.cos(math.pi / 2 * torch.sqrt(x**2 + y**2)))
        return (1 - torch.sin(math.pi / 2 * z) + modulation * (1 + rings)) / (2 * (1 + modulation))

    return _sampled(density, shape, width, dtype)


def gaussian_ball(
    shape: Shape = 64, *, sigma: float = 0.25, width: float | None = None, dtype: torch.dtype = torch.float32
) -> Volume:
    """exp(-r^2 / (2 sigma^2)); along a line at distance b from the centre it integrates to sqrt(2 pi) sigma f(b)."""
    sigma = checks.positive("sigma", sigma)
    return _sampled(lambda z, y, x: torch.exp((z**2 + y**2 + x**2) / (-2 * sigma**2)), shape, width, dtype)


def homogeneous_slab(
    shape: Shape = 64, *, thickness: float = 1.0, width: float | None = None, dtype: torch.dtype = torch.float32
) -> Volume:
    """1 where abs(z) < ``thickness`` / 2, else 0; a voxel on an end face holds the fraction that lies inside.

    The sum over z times the spacing is therefore ``thickness`` at any resolution. With ``thickness`` = 2 all is 1.
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
    """exp(-(z + 1) / ``length``), from 1 on the face z = -1; its integral over z is length (1 - exp(-2 / length))."""
    length = checks.positive("length", length)
    return _sampled(lambda z, y, x: torch.exp(-(z + 1) / length), shape, width, dtype)


def shells(shape: Shape = 128, *, width: float | None = None, dtype: torch.dtype = torch.float32) -> Volume:
    """Three nested shells with peaks 1/3, 2/3 and 1 from outside in, at radii 0.9, 0.6 and 0.3.

    Sum of h exp(-(r - R)^2 / (2 w^2)) with w = 0.04. Those of the outer two are multiplied by 1 - exp(-(x^2 + y^2) /
    (2 g^2)), g = 0.2, where z < 0: a hole towards the first slices, through which the inner shell is visible.
    """

    def density(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
        radius = torch.sqrt(z**2 + y**2 + x**2)
        walls = [h * torch.exp((radius - middle) ** 2 / (-2 * 0.04**2)) for h, middle in _SHELLS]
        outer = walls[0] + walls[1]
        if z < 0:
            outer = outer * (1 - torch.exp((x**2 + y**2) / (-2 * 0.2**2)))
        return outer + walls[2]

    return _sampled(density, shape, width, dtype)


def c60(shape: Shape = 128, *, width: float | None = None, dtype: torch.dtype = torch.float32) -> Volume:
    """Buckminsterfullerene: a Gaussian of sigma 0.35 angstrom at each of the 60 atoms, in a box of 9.6 angstrom.

    The density is divided by its value at an atom. ``width`` enlarges the box, which is 9.6e-10 m in nature.
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
    """Nuclei of C60 about its centre, float64 [60, 3], (z, y, x) in angstrom.

    The shape is a truncated icosahedron: every edge of an icosahedron is cut at the length of a pentagon bond from
    both ends; the remainder is the bond between two hexagons.
    """
    signs = itertools.product((-1.0, 1.0), repeat=2)
    corners = [_rotated((0.0, a, b * _GOLDEN), turn) for a, b in signs for turn in range(3)]
    vertices = torch.tensor(corners, dtype=torch.float64)
    gaps = torch.cdist(vertices, vertices)
    # With these corners edges have length 2.
    starts, ends = torch.nonzero((gaps - 2).abs() < 1e-9, as_tuple=True)
    edge = 2 * _SINGLE_BOND + _DOUBLE_BOND
    atoms = vertices[starts] + (_SINGLE_BOND / edge) * (vertices[ends] - vertices[starts])
    return (atoms * (edge / 2)).flip(1)


def _rotated(point: Sequence[float], turn: int) -> list[float]:
    return [*point[turn:], *point[:turn]]


def _sizes(shape: Shape) -> tuple[int, int, int]:
    sizes = tuple(shape) if isinstance(shape, Sequence) else (shape, shape, shape)
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
    # Computed slice by slice in float64, which keeps temporaries small.
    for index in range(sizes[0]):
        plane = density(z[index], y[:, None], x[None, :])
        values[index] = plane if dtype.is_floating_point else (255 * plane).round()
    depth, height, breadth = (2 * scale / n for n in sizes)
    front, top, left = ((1 / n - 1) * scale for n in sizes)
    return Volume(values, (depth, height, breadth), "relative" if width is None else "m", (front, top, left))
