"""Single scattering: shadows against closed forms and loops, the random directions, and the renderer in this light."""

import math

import numpy as np
import pytest
import torch
from oracles.rendering import trilinear

from holotorch import Grid
from holotorch.scene import DVRSampler, Scattering, TransferFunction, Volume
from holotorch.scene.lighting import optical_depth

SPACING = (2e-5, 3e-5, 2.5e-5)


def smooth(*shape: int) -> torch.Tensor:
    axes = [torch.linspace(0, 3, n, dtype=torch.float64) for n in shape]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return 4e3 * (1 + torch.sin(z + 2 * y) * torch.cos(x - z))


@pytest.mark.parametrize("towards", [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 0, 1)])
def test_a_homogeneous_medium_along_an_axis_is_exact(towards):
    depth = optical_depth(torch.full((6, 7, 8), 3e3, dtype=torch.float64), SPACING, torch.tensor(towards).double())
    axis, sign = next((k, s) for k, s in enumerate(towards) if s)
    count = depth.shape[axis]
    samples = torch.arange(count) if sign < 0 else torch.arange(count).flip(0)
    expected = 3e3 * SPACING[axis] * (samples + 0.5)
    torch.testing.assert_close(depth.movedim(axis, -1), expected.expand(depth.movedim(axis, -1).shape).double())


def test_an_oblique_path_through_a_slab_is_longer():
    towards = torch.tensor([-0.8, 0.36, 0.48], dtype=torch.float64)
    depth = optical_depth(torch.full((5, 40, 40), 2e3, dtype=torch.float64), SPACING, towards)
    expected = 2e3 * SPACING[0] * (torch.arange(5).double() + 0.5) / 0.8
    torch.testing.assert_close(depth[:, 20, 20], expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("towards", [(-0.9, 0.3, 0.2), (0.2, 0.85, -0.5), (-0.5, -0.6, 0.7)])
def test_shadows_are_those_of_rays(towards):
    """Loops along the ray of each sample, with short steps, through a smooth medium that ends before its box does."""
    density = smooth(10, 11, 9)
    for axis, count in enumerate(density.shape):
        edge = torch.sin(math.pi * torch.arange(count).double() / (count - 1)).square()
        density = density * edge.reshape([-1 if other == axis else 1 for other in range(3)])
    direction = np.array(towards) / np.linalg.norm(towards)
    found = optical_depth(density, SPACING, torch.tensor(direction)).numpy()
    step, spacing, shape = 4e-6, np.array(SPACING), np.array(density.shape)
    values, expected = density.numpy(), np.zeros(density.shape)
    for index in np.ndindex(*density.shape):
        place = np.array(index, dtype=float) + direction * step / 2 / spacing
        while np.all((place > -0.5) & (place < shape - 0.5)):
            expected[index] += trilinear(values, place) * step
            place = place + direction * step / spacing
    assert np.linalg.norm(found - expected) < 0.06 * np.linalg.norm(expected)


@pytest.mark.parametrize("half_angle", [0.0, 0.4, math.pi / 2, math.pi])
def test_directions_are_uniform_within_the_light(half_angle):
    light = Scattering((1.0, 2.0, -0.5), half_angle, samples=4000)
    middle = torch.tensor(light.towards, dtype=torch.float64)
    cosine = light.directions() @ (middle / middle.norm())
    torch.testing.assert_close(light.directions().norm(dim=1), torch.ones(4000).double())
    assert cosine.min() >= math.cos(half_angle) - 1e-12
    assert cosine.mean() == pytest.approx((1 + math.cos(half_angle)) / 2, abs=1e-3)
    sideways = light.directions().mean(0) - cosine.mean() * middle / middle.norm()
    assert sideways.norm() < 0.03


@pytest.mark.parametrize("anisotropy", [-0.6, 0.0, 0.5])
def test_a_clear_medium_scatters_all_light_whatever_the_phase_function(anisotropy):
    table = TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [1e-7, 1e-7], unit_distance=1.0)
    light = Scattering(half_angle=math.pi, anisotropy=anisotropy, samples=3000)
    _, march = _march(light, table, torch.zeros(2, 2, 2))
    lit = light.illumination(march.volume, march.place, table, -1.0)
    assert lit.mean() == pytest.approx(1, abs=0.03)


def test_the_error_of_few_directions_falls_at_least_with_their_square_root():
    table = TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [0.0, 0.4], unit_distance=0.1)
    values = smooth(8, 8, 8).float() / 8e3

    def spread(samples: int) -> float:
        each = []
        for seed in range(12):
            light = Scattering(half_angle=1.0, samples=samples, seed=seed)
            _, march = _march(light, table, values)
            each.append(light.illumination(march.volume, march.place, table, -1.0))
        return torch.stack(each).std(0).mean().item()

    few, many = spread(4), spread(64)
    assert few > 1e-3 and many < few / 4 * 1.3


def _march(light, table, values):
    volume = Volume(values, (1.0, 1.0, 1.0), "relative")
    sampler = DVRSampler(table, Grid((12, 12), 1e-4), (0.0096, 0.01, 0.0104), width=1e-3, lighting=light)
    return sampler, sampler._march(volume)


@pytest.mark.parametrize("turned", [False, True])
def test_what_lies_in_a_shadow_is_dark_and_the_rest_is_not(turned):
    """A plate in the light of a point along y, above a floor."""
    values = torch.zeros(6, 24, 24)
    values[:, 6, 8:16] = 1  # plate
    values[:, 18] = 1  # floor
    table = TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [0.0, 1.0], unit_distance=0.02)
    a = math.radians(0.5) if turned else 0.0
    rotation = torch.tensor([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]).double()
    volume = Volume(values, (1.0, 1.0, 1.0), "relative")
    setup = {"width": 1e-3, "rotation": rotation}
    grid, depths = Grid((48, 48), 2e-5), (0.0098, 0.01, 0.0102)
    lights = None, Scattering((0, -1, 0), 0.0, ambient=0.0, strength=1.0, samples=1)
    plain, lit = (DVRSampler(table, grid, depths, lighting=each, **setup).render(volume)[0][0] for each in lights)
    floor = slice(35, 39)
    middle, side = slice(21, 27), slice(2, 10)
    assert lit[floor, middle].max() < 0.02 * plain[floor, middle].max()
    assert lit[floor, side].max() > 0.5 * plain[floor, side].max()


def test_gradients_reach_opacities_through_the_shadows():
    table = TransferFunction(
        torch.tensor([0.0, 0.5, 1.0]).double(), torch.rand(3, 3).double(), torch.tensor([0.1, 0.3, 0.2]).double(),
        unit_distance=0.1,
    ).requires_grad_()  # fmt: skip
    volume = Volume(torch.rand(4, 5, 5, dtype=torch.float64), (1.0, 1.0, 1.0), "relative")
    sampler = DVRSampler(table, Grid((5, 5), 2e-4), (0.0096, 0.0104), width=1e-3, lighting=Scattering(samples=2))

    def loss() -> torch.Tensor:
        light = sampler(volume).stack().abs().square()
        return (light * torch.linspace(1, 2, light.numel()).double().reshape(light.shape)).sum()

    loss().backward()
    assert table.opacities.grad is not None
    for k in range(3):
        values = []
        for change in (1e-6, -1e-6):
            with torch.no_grad():
                table.opacities[k] += change
                values.append(loss().item())
                table.opacities[k] -= change
        assert table.opacities.grad[k].item() == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"half_angle": 3.2}, "from 0 to pi"),
        ({"anisotropy": 1.0}, "mean cosine"),
        ({"samples": 0}, "samples"),
        ({"strength": -1.0}, "strength"),
        ({"towards": (0.0, 0.0, 0.0)}, "point to the light"),
    ],
)
def test_numbers_out_of_range_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        Scattering(**options)
