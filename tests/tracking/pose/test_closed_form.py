import numpy as np
import pytest
import torch
from oracles import tracking as oracle
from oracles.tracking import DIRECTION, EDGES, LENS, MATRIX, TIP, scenes

from holotorch.tracking import Camera, closed_form, solve_pose

CAMERA = Camera(torch.tensor(MATRIX), torch.tensor(LENS))
RADIUS = 0.9e-3


def image(
    tip=TIP, direction=DIRECTION, positions=EDGES, offset: float | np.ndarray = 0.0, matrix=MATRIX, lens=LENS
) -> torch.Tensor:
    return torch.tensor(oracle.image(tip, direction, positions, matrix, lens, offset))


def off(found: torch.Tensor, wanted: np.ndarray) -> float:
    """Largest distance; NaN fails every comparison."""
    return float(np.linalg.norm(found.numpy() - wanted, axis=-1).max())


def rays_of(edges: torch.Tensor) -> np.ndarray:
    rays = np.concatenate([CAMERA.undistort(edges).numpy(), np.ones((*tuple(edges.shape[:-1]), 1))], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@pytest.mark.parametrize("edges", [3, 4, 6])
def test_closed_form(edges):
    positions, tip, direction = scenes(2000, edges, np.random.default_rng(9))
    pixels = image(tip, direction, positions)
    found, along = closed_form(pixels, torch.tensor(positions), CAMERA)
    solved = solve_pose(pixels, torch.tensor(positions), CAMERA)
    # Triples of bands down to 4 mm in 1.5 m, near the view: a pixel's rounding of 1e-13 times up to 1e5 m.
    assert off(found, tip) < 1e-7 and off(along, direction) < 1e-6
    assert np.median(np.linalg.norm(found.numpy() - tip, axis=-1)) < 1e-11
    assert off(found, solved.tip.numpy()) < 1e-7
    one = oracle.sine_rule(rays_of(pixels[0, :3]), positions[:3])
    np.testing.assert_allclose(one, tip[0], atol=1e-8)
    flat = oracle.unit(np.stack([np.linspace(0, 6, 50), np.zeros(50)], -1))
    positions, tip, flat = scenes(50, edges, np.random.default_rng(10), flat)
    assert off(closed_form(image(tip, flat, positions), torch.tensor(positions), CAMERA)[0], tip) < 1e-8


def test_what_the_thesis_prints():
    """Eq. 3.7 with arctan, its formula for equal bands, and Eq. 3.12 with the inverted factor."""
    directions = np.random.default_rng(11).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    middle = np.array([0.05, -0.02, 0.6])
    tips = middle - 0.108 * directions
    rays = rays_of(image(tips, directions, EDGES[:3]))
    right = np.stack([oracle.sine_rule(ray, EDGES[:3]) for ray in rays])
    ours = closed_form(image(tips, directions, EDGES[:3]), torch.tensor(EDGES[:3]), CAMERA)[0]
    assert off(ours, tips) < 1e-8 and np.abs(right - tips).max() < 1e-8
    # arctan is wrong where the angle at the far end exceeds 90 degrees: of directions all about, in nearly half.
    wrong = np.stack([oracle.sine_rule(ray, EDGES[:3], arctan=True) for ray in rays])
    share = (np.linalg.norm(wrong - tips, axis=-1) > 1e-3).mean()
    assert 0.3 < share < 0.6
    # Of bands of 38 mm with the tip 70 mm off, the factors are 70 / 38 and 38 / 70: (1.842 - 0.543) 38 mm apart.
    inverted = np.stack([oracle.sine_rule(ray, EDGES[:3], inverted=True) for ray in rays])
    np.testing.assert_allclose(np.linalg.norm(inverted - tips, axis=-1), 0.0494, atol=5e-5)
    # Bands of 38 and 38.4 mm taken for equal ones.
    unequal = np.array([0.07, 0.108, 0.1464])
    pixels = image(positions=unequal)[None]
    assert off(closed_form(pixels, torch.tensor(EDGES[:3]), CAMERA)[0], TIP) > 5e-3
    assert off(closed_form(pixels, torch.tensor(unequal), CAMERA)[0], TIP) < 1e-9


def test_closed_form_without_an_answer():
    edges = image().expand(4, 4, 2).clone()
    edges[0, 0] = torch.nan
    edges[1] = 500.0
    edges[2, 1] = edges[2, 0]
    tip, direction = closed_form(edges, torch.tensor(EDGES), CAMERA)
    assert tip[:3].isnan().all() and direction[:3].isnan().all() and off(tip[3:], TIP) < 1e-9
