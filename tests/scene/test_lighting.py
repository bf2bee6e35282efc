"""Phong shading against the printed formula, where there is no surface, and where there is hardly one."""

import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.scene.lighting import Lighting, flat_steps, slice_slopes, slopes
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume

EYE = torch.eye(3, dtype=torch.float64)


def phong(colour, normal, lighting, view):
    """For one point, as printed, for a normal that faces the observer."""
    light = np.array(lighting.towards) / np.linalg.norm(lighting.towards)
    normal = normal / np.linalg.norm(normal)
    normal = normal if normal @ view >= 0 else -normal
    facing = normal @ light
    mirrored = 2 * facing * normal - light
    shine = max(mirrored @ view, 0) ** lighting.shininess if facing > 0 else 0
    return colour * (lighting.ambient + lighting.diffuse * max(facing, 0)) + lighting.specular * shine


def test_steep_slopes_are_shaded_as_printed():
    lighting = Lighting((-1.0, 0.4, 0.7), 0.15, 0.6, 0.3, 5.0)
    steep = (torch.rand(3, 200, dtype=torch.float64) - 0.5) * 1e6
    colour = torch.rand(3, 200, dtype=torch.float64)
    for observer in (-1.0, 1.0):
        found = lighting.shade(colour, steep, EYE, observer)
        for k in range(200):
            wanted = phong(colour[:, k].numpy(), steep[:, k].numpy(), lighting, np.array([observer, 0, 0]))
            # Flat steps are 1: shading is complete to the inverse square of the slope, above 1e4 here.
            np.testing.assert_allclose(found[:, k], wanted, atol=1e-7)


def test_flat_matter_is_lit_from_everywhere():
    lighting = Lighting(ambient=0.2, diffuse=0.5, specular=0.9)
    colour = torch.rand(3, 4, dtype=torch.float64)
    torch.testing.assert_close(lighting.shade(colour, torch.zeros(3, 4, dtype=torch.float64), EYE, -1.0), colour * 0.7)


def test_gradcheck_and_gradients_without_a_slope():
    lighting = Lighting((-1.0, 0.4, 0.7), 0.15, 0.6, 0.3, 3.0)
    colour = torch.rand(3, 6, dtype=torch.float64, requires_grad=True)
    gentle = (torch.randn(3, 6, dtype=torch.float64) * 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda c, g: lighting.shade(c, g, EYE, -1.0), (colour, gentle))
    for size in (0.0, 1e-30, 1e-160):
        none = torch.full((3, 6), size, dtype=torch.float64, requires_grad=True)
        found = torch.autograd.grad(lighting.shade(colour, none, EYE, -1.0).sum(), [colour, none])
        assert all(torch.isfinite(gradient).all() for gradient in found)


def test_slopes_are_central_differences():
    values = torch.rand(4, 5, 6, dtype=torch.float64)
    found = slopes(values, (0.3, 0.7, 1.9))
    for axis, (part, step) in enumerate(zip(found, (0.3, 0.7, 1.9), strict=True)):
        np.testing.assert_allclose(part, np.gradient(values.numpy(), step, axis=axis), rtol=1e-13, atol=1e-15)
    for k in range(4):
        torch.testing.assert_close(slice_slopes(values.unbind(0), k, (0.3, 0.7, 1.9), torch.float64), found[:, k])
    assert slopes(values[:1, :1], (1.0, 1.0, 1.0))[:2].eq(0).all()


def test_a_flat_step_is_a_thousandth_of_the_range():
    volume = Volume(torch.tensor([[[0, 200]]], dtype=torch.uint8), (0.02, 0.01, 0.005), "m")
    assert flat_steps(volume) == pytest.approx((0.8, 0.4, 0.2))
    assert flat_steps(Volume(torch.ones(2, 2, 2), (0.01, 0.01, 0.01), "m")) == (1, 1, 1)


def sampler(lighting, **options) -> DVRSampler:
    table = TransferFunction(
        *(torch.tensor(part).double() for part in ([0, 0.5, 1], [[0.8, 0.6, 0.4]] * 3, [0, 0.1, 0.9])),
        unit_distance=0.02,
    )
    depths = [0.02 + 1e-3 * ((k + 0.5) / 40 - 0.5) for k in range(40)]
    chosen = {"rays": Grid((21, 23), 5e-5), "depths": depths, "width": 1e-3, "lighting": lighting, **options}
    return DVRSampler(table, chosen.pop("rays"), chosen.pop("depths"), **chosen)


def ball(size: int = 41) -> Volume:
    axis = torch.linspace(-1, 1, size, dtype=torch.float64)
    radius = (axis[:, None, None].square() + axis[:, None].square() + axis.square()).sqrt()
    return Volume(torch.sigmoid((0.8 - radius) * 15), (1.0, 1.0, 1.0), "relative")


def test_ball_is_bright_where_it_faces_the_light():
    above = Lighting((-1.0, -1.0, 0.0), 0.1, 0.9, 0.0)
    image, opacity = sampler(above).render(ball())
    unlit, same = sampler(None).render(ball())
    assert torch.equal(opacity, same)
    shade = (image / unlit.clamp(min=1e-9))[0]
    # The light is 45 degrees above the observer: n . l on the meridian is cos(45 degrees - elevation). What is seen
    # begins at an opacity of 0.5 near radius 0.75; shades of points a voxel apart differ by 1 / 16 radians.
    for row in (6, 10, 13):
        elevation = math.asin((10 - row) * 5e-5 / 0.5e-3 / 0.75)
        assert shade[row, 11].item() == pytest.approx(0.1 + 0.9 * math.cos(math.pi / 4 - elevation), abs=0.07)


def test_light_comes_from_the_scene_not_from_the_volume():
    """The turned ball looks the same, under a light that is not turned."""
    lighting = Lighting((-1.0, -0.6, 0.3), 0.1, 0.6, 0.3)
    rotation = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    turned, straight = (sampler(lighting, rotation=r).render(ball())[0] for r in (rotation, None))
    torch.testing.assert_close(turned, straight, rtol=0, atol=1e-12)


def test_falling_depths_have_their_observer_behind():
    lighting, mirrored = (Lighting((z, -0.6, 0.3), 0.1, 0.6, 0.3) for z in (-1.0, 1.0))
    front = sampler(lighting)
    back = sampler(mirrored, depths=front.depths[::-1])
    torch.testing.assert_close(back.render(ball())[0], front.render(ball())[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_lit_rendering_is_differentiable(turned):
    angle = math.radians(20)
    rotation = torch.tensor([[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
    made = sampler(
        Lighting(shininess=3.0), rays=Grid((3, 4), 2.3e-4), depths=[0.0198, 0.0202], early=0.0,
        rotation=rotation.double() if turned else None, boundaries=[0.019, 0.02, 0.021],
    )  # fmt: skip
    values = torch.rand(4, 3, 5, dtype=torch.float64, requires_grad=True)
    # Both ends of the range set the flat step, which does not carry a gradient: kept fixed by two voxels of their own.
    ends = torch.zeros(4, 3, 5, dtype=torch.bool)
    ends[0, 0, 0] = ends[3, 2, 4] = True
    fixed = torch.zeros(4, 3, 5, dtype=torch.float64)
    fixed[3, 2, 4] = 1

    def render(values):
        return made.render(Volume(torch.where(ends, fixed, values), (1.0, 1.0, 1.0), "relative"))[0]

    assert torch.autograd.gradcheck(render, (values,))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"towards": (0.0, 0.0, 0.0)}, "towards must point to the light"),
        ({"towards": (1.0, 0.0)}, r"direction \(z, y, x\)"),
        ({"ambient": -0.1}, "ambient must be at least zero"),
        ({"shininess": 0.5}, "shininess must be at least 1"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Lighting(**change)
