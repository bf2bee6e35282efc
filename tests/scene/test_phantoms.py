import math
from typing import Any, cast

import numpy as np
import paths
import pytest
import torch

from holotorch.scene import (
    c60,
    c60_atoms,
    exponential_medium,
    gaussian_ball,
    homogeneous_slab,
    marschner_lobb,
    shells,
)

SHARED = paths.SHARED / "volumes"
SHAPE = (6, 11, 16)
PHANTOMS = [marschner_lobb, gaussian_ball, homogeneous_slab, exponential_medium, c60, shells]


def centres(shape):
    """Middles of the voxels of [-1, 1]^3, each axis cut into equal parts."""
    edges = [np.linspace(-1, 1, n + 1) for n in shape]
    return np.meshgrid(*((e[1:] + e[:-1]) / 2 for e in edges), indexing="ij")


def expected_marschner_lobb(z, y, x):
    rings = np.cos(2 * np.pi * 6 * np.cos(np.pi * np.hypot(x, y) / 2))
    return ((1 - np.sin(np.pi * z / 2)) + 0.25 * (1 + rings)) / 2.5


def expected_ball(z, y, x):
    return np.exp(-(x * x + y * y + z * z) / (2 * 0.0625))


def expected_exponential(z, y, x):
    return np.exp(-1 - z) + 0 * y * x


def expected_shells(z, y, x):
    r, rho = np.sqrt(x * x + y * y + z * z), np.hypot(x, y)

    def wall(radius):
        return np.exp(-0.5 * ((r - radius) / 0.04) ** 2)

    open_part = np.where(z < 0, 1 - np.exp(-0.5 * (rho / 0.2) ** 2), 1)
    return open_part * (wall(0.9) / 3 + wall(0.6) * 2 / 3) + wall(0.3)


@pytest.mark.parametrize(
    ("phantom", "expected"),
    [
        (marschner_lobb, expected_marschner_lobb),
        (gaussian_ball, expected_ball),
        (exponential_medium, expected_exponential),
        (shells, expected_shells),
    ],
)
def test_values_are_those_of_the_formula(phantom, expected):
    # float64 throughout; the steepest term multiplies coordinates good to 2e-16 by 2 pi 6, or (r - R) by 25.
    np.testing.assert_allclose(
        phantom(SHAPE, dtype=torch.float64).values, expected(*centres(SHAPE)), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("phantom", PHANTOMS)
def test_sampling_type_and_size(phantom):
    exact, single, bytes_ = (phantom(SHAPE, dtype=dtype) for dtype in (torch.float64, torch.float32, torch.uint8))
    assert exact.shape == SHAPE and exact.unit == "relative" and exact.extent == pytest.approx((2, 2, 2))
    assert exact.origin == pytest.approx(tuple(axis.flat[0] for axis in centres(SHAPE)))
    assert single.values.dtype == torch.float32 and torch.equal(single.values, exact.values.float())
    assert bytes_.values.dtype == torch.uint8
    assert (bytes_.values.double() / 255 - exact.values).abs().max() <= 0.5 / 255 + 1e-12
    placed = phantom(5, width=8e-3)
    assert placed.unit == "m" and placed.shape == (5, 5, 5) and placed.spacing == pytest.approx((1.6e-3,) * 3)
    assert placed.origin == pytest.approx((-3.2e-3,) * 3)
    torch.testing.assert_close(placed.values, phantom(5).values)
    assert phantom(1).shape == (1, 1, 1)


def test_integrals_along_a_ray():
    """Midpoint sums: exact for the slab, to exp(-2 (pi sigma / h)^2) for the ball, by a known factor otherwise."""
    n = 64
    step = 2 / n
    ball = gaussian_ball(n, sigma=0.12, dtype=torch.float64).values
    y, x = (axis[0] for axis in centres((n, n, n))[1:])
    wanted = math.sqrt(2 * math.pi) * 0.12 * np.exp(-(x**2 + y**2) / (2 * 0.12**2))
    # Beyond +-1 lies erfc(1 / (0.12 sqrt 2)) = 8e-17 of it.
    np.testing.assert_allclose(ball.sum(0) * step, wanted, rtol=1e-12)
    for depth, thickness in ((7, 0.9), (8, 1.0), (1, 2.0), (9, 0.01)):
        slab = homogeneous_slab((depth, 2, 3), thickness=thickness, dtype=torch.float64).values
        np.testing.assert_allclose(slab.sum(0) * 2 / depth, thickness, rtol=1e-14)
        assert slab.min() >= 0 and slab.max() <= 1 + 1e-15
    medium = exponential_medium(n, length=0.3, dtype=torch.float64).values
    factor = math.sinh(step / 0.6) / (step / 0.6)
    np.testing.assert_allclose(medium.sum(0) * step * factor, 0.3 * (1 - math.exp(-2 / 0.3)), rtol=1e-12)


def test_a_full_slab_is_uniform():
    assert torch.equal(homogeneous_slab(9, thickness=2).values, torch.ones(9, 9, 9))


def test_shells_are_open_towards_the_first_slices_only():
    values = shells((200, 101, 101), dtype=torch.float64).values[:, 50, 50]
    z = (2 * np.arange(200) + 1) / 200 - 1
    walls = [int(np.abs(z - place).argmin()) for place in (-0.9, -0.6, -0.3, 0.3, 0.6, 0.9)]
    # The nearest sample is at most half a step, 0.005, from the peak: exp(-(0.005 / 0.04)^2 / 2) = 0.992.
    np.testing.assert_allclose(values[walls], [0, 0, 1, 1, 2 / 3, 1 / 3], atol=0.008)


def test_molecule_has_the_bonds_of_c60():
    gaps = torch.cdist(c60_atoms(), c60_atoms()).sort(1).values
    assert gaps.shape == (60, 60)
    torch.testing.assert_close(gaps[:, 1], torch.full((60,), 1.401, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(gaps[:, 2:4], torch.full((60, 2), 1.458, dtype=torch.float64), rtol=0, atol=1e-12)
    assert gaps[:, 4].min() > 2
    # Circumradius of an icosahedron's edge 4.317 cut 0.6583 (half a bond and half an edge away): 3.562 angstrom.
    radius = math.sqrt((4.317 * (1 + math.sqrt(5)) / 4) ** 2 + 0.7005**2)
    torch.testing.assert_close(c60_atoms().norm(dim=1), torch.full((60,), radius, dtype=torch.float64))


def test_molecule_is_a_sum_of_gaussians_with_value_one_at_an_atom():
    atoms = c60_atoms().numpy()
    points = np.stack(centres(SHAPE), -1) * 4.8

    def density(place):
        return np.exp(-((place[..., None, :] - atoms) ** 2).sum(-1) / (2 * 0.35**2)).sum(-1)

    wanted = density(points) / density(atoms[17])
    np.testing.assert_allclose(c60(SHAPE, dtype=torch.float64).values, wanted, rtol=0, atol=1e-13)


def test_molecule_agrees_with_the_shared_one():
    if not SHARED.is_dir():
        pytest.skip("the shared volumes are not beside this checkout; the formula above covers the same values")
    table = np.loadtxt(SHARED / "c60_synthetic_atoms.csv", delimiter=",", skiprows=1)[:, ::-1]
    gaps = np.linalg.norm(table[:, None] - c60_atoms().numpy(), axis=-1)
    # Printed to six digits: half of 1e-6 per component.
    assert gaps.min(1).max() < 1e-6 and sorted(gaps.argmin(1)) == list(range(60))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: gaussian_ball(cast(Any, (4, 4))), ValueError, r"one number or three \(D, H, W\), got \(4, 4\)"),
        (lambda: gaussian_ball(0), ValueError, "phantom shape must be at least 1"),
        (lambda: gaussian_ball(4, sigma=0), ValueError, "sigma must be above zero"),
        (lambda: homogeneous_slab(4, thickness=2.5), ValueError, "at most 2, the edge of the cube, got 2.5"),
        (lambda: shells(4, width=-1), ValueError, "width must be above zero in metres"),
        (lambda: shells(4, dtype=torch.int32), TypeError, "floating-point or torch.uint8, got torch.int32"),
    ],
)
def test_refuses(call, error, message):
    with pytest.raises(error, match=message):
        call()
