"""DVRSampler against loops over rays, closed forms, and itself in other ways."""

import math

import numpy as np
import pytest
import torch
from oracles import rendering

from holotorch import Grid
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume

GRID = Grid((12, 17), (0.9e-4, 0.7e-4))
POSITIONS = [0.0, 0.4, 0.7, 1.0]
COLOURS = [[0.1, 0.2, 0.9], [0.5, 0.9, 0.1], [1.0, 0.3, 0.2], [0.6, 0.6, 0.7]]
OPACITIES = [0.05, 0.2, 0.1, 0.4]
TABLE = (POSITIONS, COLOURS, OPACITIES)
WIDTH, CENTRE = 1e-3, 0.02
UNEQUAL = [0.01952, 0.01971, 0.0199, 0.02003, 0.02027, 0.02046]


def transfer(opacities=OPACITIES, unit=0.1, positions=POSITIONS) -> TransferFunction:
    parts = [torch.tensor(part, dtype=torch.float64) for part in (positions, COLOURS, opacities)]
    return TransferFunction(*parts, unit_distance=unit)


def noise(*shape: int, spacing=(1.0, 1.0, 1.0)) -> Volume:
    return Volume(torch.rand(*shape, dtype=torch.float64), spacing, "relative")


def planes(count: int, depth: float = WIDTH, centre: float = CENTRE) -> list[float]:
    """``count`` planes whose slabs fill ``depth``."""
    return [centre + depth * ((k + 0.5) / count - 0.5) for k in range(count)]


def edges(depths) -> list[float]:
    between = [(a + b) / 2 for a, b in zip(depths, depths[1:], strict=False)]
    return [2 * depths[0] - between[0], *between, 2 * depths[-1] - between[-1]]


def turn(z: float, y: float = 0.0, x: float = 0.0) -> torch.Tensor:
    """Rotation about the axes z, y and x, in that order."""
    total = torch.eye(3, dtype=torch.float64)
    for (i, j), angle in (((1, 2), z), ((2, 0), y), ((0, 1), x)):
        step = torch.eye(3, dtype=torch.float64)
        step[i, i] = step[j, j] = math.cos(angle)
        step[i, j], step[j, i] = -math.sin(angle), math.sin(angle)
        total = step @ total
    return total


def sampler(depths, *, table=None, grid=GRID, early=0.0, **options) -> DVRSampler:
    return DVRSampler(
        table or transfer(), grid, depths, **{"width": WIDTH, "distance": CENTRE, "early": early, **options}
    )


def oracle(volume, depths, cuts, table=TABLE, unit=0.1, **options):
    """Contributions [D, rays, 3] and transmittance [rays] by loops over the rays of GRID."""
    y, x = (axis.flatten().tolist() for axis in GRID.coordinates())
    points = [(down, across) for down in y for across in x]
    spacing = np.array(volume.spacing) * WIDTH / max(volume.extent)
    rotation = options.get("rotation", torch.eye(3)).double().numpy()
    at = {"distance": CENTRE, "rotation": rotation, "eye": options.get("eye")}
    return rendering.march(volume.values.numpy(), spacing, table, unit * WIDTH, points, depths, cuts, **at)


GEOMETRIES = {
    "parallel": {},
    "from an eye": {"eye": -0.03},
    "from a close eye": {"eye": 0.0175},
    "turned": {"rotation": turn(0.3, 0.5, -0.2)},
    "turned, from an eye": {"rotation": turn(0.3, 0.5, -0.2), "eye": 0.0175},
}


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("backwards", [False, True])
def test_image_is_that_of_algorithm_3(name, backwards):
    options = dict(GEOMETRIES[name])
    volume = noise(7, 9, 6, spacing=(1.1, 0.8, 1.7))
    depths = UNEQUAL[::-1] if backwards else UNEQUAL
    if backwards and "eye" in options:
        options["eye"] = 2 * CENTRE - options["eye"]
    found, left = oracle(volume, depths, edges(depths), **options)
    image, opacity = sampler(depths, **options, boundaries=edges(depths)).render(volume)
    assert 0.1 < left.min() < 0.9 and (left == 1).any()  # some rays pass by
    # Rounding of depths of 0.02 m to 3e-18 m in paths of 2e-4 m, where rays graze a face.
    np.testing.assert_allclose(image.flatten(1), found.sum(0).T, atol=1e-12)
    np.testing.assert_allclose(1 - opacity.flatten(), left, atol=1e-12)


@pytest.mark.parametrize("name", ["parallel", "turned"])
def test_sources_are_the_roots_of_the_contributions(name):
    volume = noise(5, 6, 7)
    found, _ = oracle(volume, UNEQUAL, edges(UNEQUAL), **GEOMETRIES[name])
    layers = sampler(UNEQUAL, **GEOMETRIES[name], boundaries=edges(UNEQUAL))(volume)
    stack = layers.stack()
    assert layers.depths == tuple(UNEQUAL) and layers.channels == 3 and layers.grid == GRID and layers.phase is None
    # The root of a contribution right to 1e-13 is right to 3e-7 where that is all there is.
    np.testing.assert_allclose(stack.real.square().flatten(2), found.transpose(0, 2, 1), atol=1e-12)
    assert stack.imag.eq(0).all()
    for plane, again in zip(layers.amplitudes(), stack, strict=True):
        assert torch.equal(plane, again.real)


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("count", [1, 2, 3, 8, 31])
def test_homogeneous_medium_is_exact_for_any_planes(name, count):
    depths = sorted((torch.rand(count, dtype=torch.float64) - 0.5).mul(WIDTH).add(CENTRE).tolist())
    cuts = [CENTRE - WIDTH, *edges(depths)[1:-1], CENTRE + WIDTH] if count > 1 else [CENTRE - WIDTH, CENTRE + WIDTH]
    table = transfer([0.3] * 4, unit=0.05)
    volume = Volume(torch.full((4, 5, 3), 0.6, dtype=torch.float64), (1.0, 0.8, 1.0), "relative")
    options = GEOMETRIES[name]
    _, opacity = sampler(depths, table=table, boundaries=cuts, **options).render(volume)
    whole = oracle(volume, depths[:1], [cuts[0], cuts[-1]], (POSITIONS, COLOURS, [0.3] * 4), 0.05, **options)[1]
    np.testing.assert_allclose(1 - opacity.flatten(), whole, rtol=0, atol=1e-12)


def test_homogeneous_slab_is_that_of_beer_and_lambert():
    volume = Volume(torch.full((10, 20, 20), 0.5, dtype=torch.float64), (1.0, 1.0, 1.0), "relative")
    table = transfer([0.3] * 4, unit=0.05)
    for count in (1, 7, 290):
        depths = planes(count, WIDTH / 2)
        _, opacity = sampler(depths, table=table, grid=Grid(8, 1e-4)).render(volume)
        # Half the width is ten unit distances.
        torch.testing.assert_close(opacity, torch.full((8, 8), 1 - 0.7**10, dtype=torch.float64), rtol=0, atol=1e-12)


def test_error_falls_with_the_square_of_the_slabs():
    """Opacity 0.6 exp(-2 z) per fifth of the depth 1: -ln T = 5 (Li2(0.6) - Li2(0.6 exp(-2))) / 2."""
    z = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000
    volume = Volume(torch.exp(-2 * z)[:, None, None], (1.0, 1.0, 1.0), "relative")
    table = TransferFunction(
        *(torch.tensor(part).double() for part in ([0, 1], [[1, 1, 1]] * 2, [0, 0.6])), unit_distance=0.2
    )
    k = np.arange(1, 200)
    wanted = math.exp(-5 * ((0.6**k - (0.6 * math.exp(-2)) ** k) / k**2).sum() / 2)
    errors = []
    for count in (5, 10, 20, 40):
        _, opacity = sampler(planes(count), table=table, grid=Grid(1, 1e-7)).render(volume)
        errors.append(abs(1 - opacity.item() - wanted))
    # The next order of the midpoint rule is (h b)^2 / 10 of the first at h b = 0.4; samples 1 / 2000 apart leave 1e-7.
    assert errors[-1] > 1e-5
    for one, half in zip(errors, errors[1:], strict=False):
        assert one / half == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("name", ["parallel", "turned", "from a close eye"])
def test_weights_sum_to_one_minus_transmittance(name):
    volume = noise(6, 6, 6)
    white = TransferFunction(
        torch.tensor(POSITIONS).double(), torch.ones(4, 3), torch.tensor(OPACITIES).double(), unit_distance=0.1
    )
    image, opacity = sampler(UNEQUAL, table=white, boundaries=edges(UNEQUAL), **GEOMETRIES[name]).render(volume)
    torch.testing.assert_close(image, opacity.expand(3, -1, -1), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_gradcheck_of_values_and_table(name):
    values = torch.rand(3, 4, 3, dtype=torch.float64, requires_grad=True)
    table = transfer()
    made = sampler(
        [0.0198, 0.0201], grid=Grid((3, 4), 2.3e-4), table=table, **GEOMETRIES[name], boundaries=[0.019, 0.02, 0.021]
    )

    def render(values, colours, opacities):
        inner = {"transfer.colours": colours, "transfer.opacities": opacities}
        return torch.func.functional_call(_Picture(made), {f"made.{k}": v for k, v in inner.items()}, (values,))

    # Within (0, 1): finite differences at an end would see only one side of the bound.
    colours = (table.colours.detach() * 0.9 + 0.05).requires_grad_()
    opacities = table.opacities.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(render, (values, colours, opacities))


class _Picture(torch.nn.Module):
    def __init__(self, made: DVRSampler):
        super().__init__()
        self.made = made

    def forward(self, values):
        volume = Volume(values, (1.0, 0.7, 0.9), "relative")
        image, opacity = self.made.render(volume)
        return image, opacity, self.made.depth_map(volume), self.made(volume).stack().abs()[:, :, 1, 1]


@pytest.mark.parametrize("name", GEOMETRIES)
def test_gradients_are_finite_at_opacity_zero_and_one_and_in_empty_volumes(name):
    table = transfer([0.0, 1.0, 1.0, 0.0])
    table.requires_grad_()
    for fill in (0.0, 0.4, 0.55, 1.0):
        values = torch.full((4, 4, 4), fill, dtype=torch.float64, requires_grad=True)
        made = sampler(UNEQUAL, table=table, boundaries=edges(UNEQUAL), **GEOMETRIES[name])
        total = made(Volume(values, (1.0, 1.0, 1.0), "relative")).stack().abs().sum()
        found = torch.autograd.grad(total, [values, table.opacities, table.colours])
        assert all(torch.isfinite(gradient).all() for gradient in found)


def test_gradient_of_a_transparent_value_says_that_it_could_be_seen():
    table = transfer([0.0] * 4).requires_grad_()
    _, opacity = sampler([CENTRE], table=table).render(noise(3, 3, 3))
    (slope,) = torch.autograd.grad(opacity.sum(), table.opacities)
    assert (slope > 0).all()
