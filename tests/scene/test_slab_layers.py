"""Light of slabs towards a direction, against loops over pixels and against the renderer."""

import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.scene import DVRSampler, SlabLayers, TransferFunction, Volume

GRID = Grid((9, 11), (4e-6, 5e-6))


def slabs(depths=(1e-3, 1.1e-3, 1.25e-3), grid=GRID) -> SlabLayers:
    count = len(depths)
    emission = torch.rand(count, 2, *grid.shape, dtype=torch.float64)
    return SlabLayers(grid, depths, emission, torch.rand(count, *grid.shape, dtype=torch.float64))


def by_loops(layers: SlabLayers, direction) -> np.ndarray:
    """Follow the ray of every source through the slabs in front."""
    height, width = layers.grid.shape
    slope = [sine / math.sqrt(1 - sum(s * s for s in direction)) for sine in direction]
    light = layers.emission.numpy().copy()
    for j, r, c in np.ndindex(len(layers.depths), height, width):
        for i in range(j):
            y, x = (
                at + (layers.depths[j] - layers.depths[i]) * s / p
                for at, s, p in zip((r, c), slope, layers.grid.pitch, strict=True)
            )
            hidden = 0.0
            for row, column in (
                (a, b) for a in (math.floor(y), math.floor(y) + 1) for b in (math.floor(x), math.floor(x) + 1)
            ):
                if 0 <= row < height and 0 <= column < width:
                    share = (1 - abs(y - row)) * (1 - abs(x - column))
                    hidden += share * layers.opacity[i, row, column].item()
            light[j, :, r, c] *= 1 - hidden
    return light


@pytest.mark.parametrize("direction", [(0.0, 0.0), (0.013, -0.03), (-0.06, 0.0), (0.0, 0.1), (0.9, 0.0)])
@pytest.mark.parametrize("depths", [(1e-3, 1.1e-3, 1.25e-3), (1.25e-3, 1.1e-3), (2e-3,)])
def test_follows_every_ray(direction, depths):
    layers = slabs(depths)
    np.testing.assert_allclose(layers.towards(direction), by_loops(layers, direction), rtol=0, atol=1e-9)


@pytest.mark.parametrize("front", ["near", "far"])
@pytest.mark.parametrize("turned", [False, True])
def test_along_the_axis_is_the_light_of_the_renderer(front, turned):
    table = [
        torch.tensor(each, dtype=torch.float64) for each in ([0.0, 1.0], [[0.1, 0.5, 0.9], [0.8, 0.3, 0.2]], [0.0, 0.6])
    ]
    volume = Volume(torch.rand(7, 8, 9, dtype=torch.float64), (1.0, 1.0, 1.0), "relative")
    depths = sorted((0.88e-3, 1e-3, 1.12e-3), reverse=front == "far")
    a = math.radians(20)
    rotation = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    sampler = DVRSampler(
        TransferFunction(*table, unit_distance=0.2),
        GRID,
        depths,
        width=0.3e-3,
        rotation=rotation.double() if turned else None,
        early=0.0,
    )
    light = torch.stack(list(sampler(volume).amplitudes())).square()
    layers = sampler.slab_layers(volume)
    torch.testing.assert_close(layers.towards((0.0, 0.0)), light, rtol=1e-12, atol=1e-15)
    assert layers.depths == tuple(depths) and float(layers.opacity.max()) > 0.1


def test_a_view_from_the_side_uncovers_what_an_opaque_slab_hides():
    grid, spacing = Grid((1, 32), 5e-6), 2e-4
    emission, opacity = torch.zeros(2, 1, 1, 32), torch.zeros(2, 1, 32)
    emission[1, 0, 0, 16] = 1  # a point behind the middle of a bar of five samples
    opacity[0, 0, 14:19] = 1
    layers = SlabLayers(grid, (1e-3, 1e-3 + spacing), emission, opacity)
    for shift in range(-6, 7):
        angle = math.atan(shift * 5e-6 / spacing)
        seen = layers.towards((0.0, math.sin(angle)))[1, 0, 0, 16].item()
        assert seen == pytest.approx(float(abs(shift) > 2), abs=1e-6)


def test_gradients_reach_colour_and_opacity():
    layers = slabs()
    emission, opacity = layers.emission.requires_grad_(), layers.opacity.requires_grad_()

    def light(emission, opacity):
        return SlabLayers(GRID, layers.depths, emission, opacity).towards((0.01, 0.02))

    assert torch.autograd.gradcheck(light, (emission, opacity), fast_mode=True)


def test_what_is_refused():
    layers = slabs()
    with pytest.raises(ValueError, match="within the unit circle"):
        layers.towards((0.8, 0.8))
    with pytest.raises(ValueError, match="rise or fall"):
        SlabLayers(GRID, (1e-3, 1.2e-3, 1.1e-3), layers.emission, layers.opacity)
    with pytest.raises(ValueError, match="emission and opacity must be"):
        SlabLayers(GRID, layers.depths, layers.emission, layers.opacity[:2])
    table = [torch.tensor(each) for each in ([0.0, 1.0], [[0.1, 0.5, 0.9]] * 2, [0.0, 0.6])]
    with pytest.raises(ValueError, match="parallel to the axis"):
        sampler = DVRSampler(TransferFunction(*table, unit_distance=0.2), GRID, (1e-3, 1.1e-3), width=1e-4, eye=-0.1)
        sampler.slab_layers(Volume(torch.rand(4, 4, 4), (1.0, 1.0, 1.0), "relative"))
