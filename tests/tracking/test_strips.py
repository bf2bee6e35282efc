"""Lines on the plane z = 1, and light between pixels, against direct formulas."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from holotorch.tracking.camera import Camera
from holotorch.tracking.strips import Line, Sampler
from holotorch.tracking.world import synthetic_camera

CAMERA = Camera(
    torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.3, 0.1, 2e-3, -1e-3, -0.02])
)
F64: Any = {"dtype": torch.float64}


@pytest.fixture(scope="module")
def frame():
    return torch.from_numpy(np.random.default_rng(3).integers(0, 256, (3, 24, 31)).astype(np.uint8))


@pytest.fixture(scope="module")
def sampler(frame):
    return Sampler(frame, synthetic_camera().table())


def test_light_is_bilinear_in_linear_light(frame, sampler):
    """Float32 sums of four parts of light up to 1: a few 1e-7."""
    rng = np.random.default_rng(4)
    places = rng.uniform([0, 0], [30, 23], (200, 2))
    share = frame.numpy() / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    wanted = np.zeros((3, 200))
    for i, (x, y) in enumerate(places):
        for row in range(24):
            for column in range(max(0, int(x) - 1), min(31, int(x) + 3)):
                wanted[:, i] += light[:, row, column] * max(0, 1 - abs(x - column)) * max(0, 1 - abs(y - row))
    found = sampler(torch.from_numpy(places).reshape(20, 10, 2))
    assert found.dtype == torch.float32 and found.shape == (3, 20, 10)
    np.testing.assert_allclose(found.reshape(3, 200).numpy(), wanted, atol=2e-6, rtol=0)


def test_whole_pixels_and_corners_are_exact(frame, sampler):
    y, x = torch.meshgrid(torch.arange(24.0, **F64), torch.arange(31.0, **F64), indexing="ij")
    pixels = torch.stack([x, y], -1)
    assert torch.equal(sampler(pixels), synthetic_camera().table()[frame.long()])
    levels, inside = sampler.nearest(pixels)
    assert torch.equal(levels, frame) and inside.all()


def test_beyond_the_border_the_border_shows(frame, sampler):
    outside = torch.tensor([[-5.0, 3], [1e6, 3], [4, -0.01], [4, 99], [-9, -9]], **F64)
    border = torch.tensor([[0.0, 3], [30, 3], [4, 0], [4, 23], [0, 0]], **F64)
    torch.testing.assert_close(sampler(outside), sampler(border), rtol=0, atol=0)
    assert not sampler.inside(outside).any() and sampler.inside(border).all()
    levels, inside = sampler.nearest(outside)
    assert not inside.any()
    assert torch.equal(
        levels[:, :4], torch.stack([frame[:, 3, 0], frame[:, 3, 30], frame[:, 0, 4], frame[:, 23, 4]], 1)
    )


def test_nan_is_outside_and_does_not_spread(sampler):
    pixels = torch.tensor([[math.nan, 3.0], [4.0, math.nan], [5.0, 6.0]], **F64)
    assert sampler.inside(pixels).tolist() == [False, False, True]
    assert sampler.nearest(pixels)[1].tolist() == [False, False, True]
    assert sampler(pixels).isfinite().all()


def test_nearest_rounds(frame, sampler):
    pixels = torch.tensor([[3.4, 7.6], [3.6, 7.4]], **F64)
    levels, _ = sampler.nearest(pixels)
    assert torch.equal(levels[:, 0], frame[:, 8, 3]) and torch.equal(levels[:, 1], frame[:, 7, 4])


def test_a_line_goes_through_its_pixels_and_back():
    ends = torch.tensor([[120.0, 80], [860, 500]], **F64)
    line = Line.through(CAMERA, ends)
    t, u = line.place(CAMERA.undistort(ends))
    assert float(u.abs().max()) < 1e-9 and float(t.sum().abs()) < 1e-9 and t[1] > 0
    # undistort comes back to 1e-9 px.
    torch.testing.assert_close(CAMERA.distort(line.plane(t, u)), ends, rtol=0, atol=1e-8)
    assert float(line.along.norm()) == pytest.approx(1, abs=1e-15) and line.scale == 700
    assert float(line.along @ line.across) == pytest.approx(0, abs=1e-15)
    rng = torch.rand(7, 5, 2, **F64) * 200 - 100
    there = line.plane(rng[..., 0], rng[..., 1])
    assert there.shape == (7, 5, 2)
    t, u = line.place(there)
    torch.testing.assert_close(torch.stack([t, u], -1), rng, rtol=0, atol=1e-10)


def test_steps_along_are_pixels_in_the_middle():
    """Near the principal point a step of 1 along or across moves the pixel by 1, but for 1e-4 of distortion there."""
    plane = torch.tensor([[-0.01, -0.004], [0.01, 0.004]], **F64)
    line = Line.between(CAMERA, plane)
    base, one, side = (
        CAMERA.distort(line.plane(torch.tensor(t, **F64), torch.tensor(u, **F64))) for t, u in ((0, 0), (1, 0), (0, 1))
    )
    assert float((one - base).norm()) == pytest.approx(1, abs=1e-3)
    assert float((side - base).norm()) == pytest.approx(1, abs=1e-3)
    assert float((one - base) @ (side - base)) == pytest.approx(0, abs=1e-2)


def test_a_straight_line_of_space_stays_on_its_line_however_the_lens_bends_it():
    points = torch.tensor([[-0.2, -0.1, 0.5], [0.25, -0.12, 0.7]], **F64)
    between = points[0] + torch.linspace(0, 1, 9, **F64)[:, None] * (points[1] - points[0])
    line = Line.through(CAMERA, CAMERA.project(points))
    _, u = line.place(CAMERA.undistort(CAMERA.project(between)))
    assert float(u.abs().max()) < 1e-8
    bent = CAMERA.project(between)
    chord = bent[-1] - bent[0]
    away = ((bent - bent[0]) @ torch.stack([-chord[1], chord[0]])) / chord.norm()
    assert float(away.abs().max()) > 1  # on the frame it is not straight


@pytest.mark.parametrize("about", [0.0, 40.0])
def test_moved_lines_pass_where_they_are_said_to(about):
    line = Line.between(CAMERA, torch.tensor([[-0.1, 0.05], [0.2, 0.1]], **F64))
    offset, slope = torch.tensor([3.0, 0.05], **F64)
    moved = line.moved(offset, slope, about)
    t, u = line.place(moved.plane(torch.tensor([0.0, 50, -30], **F64), torch.zeros(3, **F64)))
    assert float(t[0]) == pytest.approx(about, abs=1e-10)
    torch.testing.assert_close(u, offset + slope * (t - about), rtol=0, atol=1e-10)
    assert float(moved.along.norm()) == pytest.approx(1, abs=1e-14) and moved.scale == line.scale


def test_outside_the_lens_there_is_no_line():
    narrow = Camera(CAMERA.matrix, torch.tensor([-0.6, 0.0, 0, 0, 0]))
    line = Line.through(narrow, torch.tensor([[480.0, 270], [2000, 270]], **F64))
    assert not line.origin.isfinite().all()


def test_strips_are_parabolas_across_to_a_thousandth_of_a_pixel():
    """The third derivative of this lens across, 2 |k1| / 700^2 and some, times 30^3 / 16: what a parabola misses."""
    line = Line.between(CAMERA, torch.tensor([[-0.35, 0.2], [0.3, 0.25]], **F64))
    t, u = torch.linspace(-200, 200, 41, **F64), torch.linspace(-30, 30, 61, **F64)
    found = line.pixels(CAMERA, t, u)
    assert found.shape == (41, 61, 2)
    exact = CAMERA.distort(line.plane(t[:, None], u))
    assert float((found - exact).abs().max()) < 6 * 0.3 / 700**2 * 30**3 / 16
    torch.testing.assert_close(found[:, [0, 30, 60]], exact[:, [0, 30, 60]], rtol=0, atol=1e-10)


def test_memory_of_any_layout_is_read_alike(frame, sampler):
    places = torch.from_numpy(np.random.default_rng(6).uniform(0, 20, (9, 2)))
    camera = frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    part = torch.zeros(3, 30, 70, dtype=torch.uint8)[:, 3:27, 4:66:2]
    part[:] = frame
    for other in (camera, part):
        again = Sampler(other, sampler.light)
        assert torch.equal(again(places), sampler(places)) and torch.equal(
            again.nearest(places)[0], sampler.nearest(places)[0]
        )
