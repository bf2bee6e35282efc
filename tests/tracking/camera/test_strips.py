"""Lines on the plane z = 1, and light between pixels, against direct formulas."""

import cmath
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.simulation.world import synthetic_camera

CAMERA = Camera(
    torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.3, 0.1, 2e-3, -1e-3, -0.02])
)
LENS = Lens(CAMERA)
LIGHT = synthetic_camera().table().numpy()


@pytest.fixture(scope="module")
def frame():
    return torch.from_numpy(np.random.default_rng(3).integers(0, 256, (3, 24, 31)).astype(np.uint8))


@pytest.fixture(scope="module")
def sampler(frame):
    return Sampler(frame, LIGHT)


def through(lens: Lens, *pixels: complex) -> Line:
    """The line through two pixels."""
    return Line.between(lens, *lens.undistort(np.array(pixels)).tolist())


def project(points: np.ndarray) -> np.ndarray:
    """Pixels of points [N, 3], by the camera."""
    x, y = CAMERA.project(torch.from_numpy(points)).numpy().T
    return x + 1j * y


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
    found = sampler((places[:, 0] + 1j * places[:, 1]).reshape(20, 10))
    assert found.dtype == np.float32 and found.shape == (3, 20, 10)
    np.testing.assert_allclose(found.reshape(3, 200), wanted, atol=2e-6, rtol=0)


def test_whole_pixels_and_corners_are_exact(frame, sampler):
    """The last row and column are mixed as the whole of the later of two, a + (b - a): rounding, 6e-8 each way."""
    pixels = np.arange(31.0) + 1j * np.arange(24.0)[:, None]
    found, light = sampler(pixels), LIGHT[frame.numpy()]
    assert np.array_equal(found[:, :-1, :-1], light[:, :-1, :-1])
    np.testing.assert_allclose(found, light, rtol=0, atol=1.2e-7)
    levels = sampler.nearest(pixels)
    assert levels.dtype == np.uint8 and np.array_equal(levels, frame.numpy().transpose(1, 2, 0))


def test_beyond_the_border_the_border_shows(frame, sampler):
    outside = np.array([-5.0 + 3j, 1e6 + 3j, 4 - 0.01j, 4 + 99j, -9 - 9j])
    border = np.array([0.0 + 3j, 30 + 3j, 4, 4 + 23j, 0])
    assert np.array_equal(sampler(outside), sampler(border))
    assert not sampler.inside(outside).any() and sampler.inside(border).all()


@pytest.mark.parametrize("kind", ["planar", "camera"])
def test_nearest_is_black_half_a_pixel_beyond_the_border(frame, kind):
    frame = frame.clamp(min=1)
    sampler = Sampler(layouts(frame)[kind], LIGHT)
    outside = np.array(
        [[-5.0 + 3j, 1e6 + 3j, 4 - 0.6j, 4 + 99j, 30.6 + 3j, complex(math.nan, 3), complex(3, math.inf)]]
    )
    assert not sampler.nearest(outside).any()
    levels = sampler.nearest(np.array([[4 - 0.4j, 30.4 + 23.4j, 3.4 + 7.6j, 3.6 + 7.4j]]))
    assert np.array_equal(levels[0].T, frame.numpy()[:, [0, 23, 8, 7], [4, 30, 3, 4]])


def test_nan_is_outside_and_does_not_spread(sampler):
    pixels = np.array([complex(math.nan, 3.0), complex(4.0, math.nan), 5.0 + 6j])
    assert sampler.inside(pixels).tolist() == [False, False, True]
    assert np.isfinite(sampler(pixels)).all()


def test_a_line_goes_through_its_pixels_and_back():
    ends = np.array([120.0 + 80j, 860 + 500j])
    line = through(LENS, *ends)
    t, u = line.place(LENS.undistort(ends))
    assert np.abs(u).max() < 1e-9 and abs(t.sum()) < 1e-9 and t[1] > 0
    # undistort comes back to 1e-9 px.
    np.testing.assert_allclose(LENS.distort(line.plane(t, u)), ends, rtol=0, atol=1e-8)
    assert abs(line.along) == pytest.approx(1, abs=1e-15) and line.scale == 700
    rng = np.random.default_rng(5).random((2, 7, 5)) * 200 - 100
    there = line.plane(rng[0], rng[1])
    assert there.shape == (7, 5) and line.plane(rng[0, :, :1], rng[1, 0]).shape == (7, 5)
    np.testing.assert_allclose(line.place(there), rng, rtol=0, atol=1e-10)
    assert complex(line.plane(0.0)) == line.origin


def test_steps_along_are_pixels_in_the_middle():
    """Near the principal point a step of 1 along or across moves the pixel by 1, but for 1e-4 of distortion there."""
    line = Line.between(LENS, -0.01 - 0.004j, 0.01 + 0.004j)
    base, one, side = (complex(LENS.distort(line.plane(t, u))) for t, u in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    assert abs(one - base) == pytest.approx(1, abs=1e-3)
    # Across is a quarter turn from x to y.
    assert abs((side - base) - 1j * (one - base)) == pytest.approx(0, abs=1e-2)


def test_a_straight_line_of_space_stays_on_its_line_however_the_lens_bends_it():
    points = np.array([[-0.2, -0.1, 0.5], [0.25, -0.12, 0.7]])
    between = points[0] + np.linspace(0, 1, 9)[:, None] * (points[1] - points[0])
    line = through(LENS, *project(points))
    bent = project(between)
    _, u = line.place(LENS.undistort(bent))
    assert np.abs(u).max() < 1e-8
    chord = bent[-1] - bent[0]
    away = ((bent - bent[0]) * chord.conjugate() / abs(chord)).imag
    assert np.abs(away).max() > 1  # on the frame it is not straight


@pytest.mark.parametrize("slope", [0.0, 0.05, -0.3])
def test_moved_lines_pass_where_they_are_said_to(slope):
    line = Line.between(LENS, -0.1 + 0.05j, 0.2 + 0.1j)
    moved = line.moved(3.0, slope)
    t, u = line.place(moved.plane(np.array([0.0, 50, -30])))
    assert float(t[0]) == pytest.approx(0, abs=1e-10)
    np.testing.assert_allclose(u, 3.0 + slope * t, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.hypot(t, u - 3.0), [0, 50, 30], rtol=0, atol=1e-10)
    assert abs(moved.along) == pytest.approx(1, abs=1e-14) and moved.scale == line.scale


def test_outside_the_lens_there_is_no_line():
    narrow = Lens(Camera(CAMERA.matrix, torch.tensor([-0.6, 0.0, 0, 0, 0])))
    assert not cmath.isfinite(through(narrow, 480 + 270j, 2000 + 270j).origin)
    assert not cmath.isfinite(Line.between(LENS, 0.1 + 0.2j, 0.1 + 0.2j).along)  # nor through one point


def test_strips_are_parabolas_across_to_a_thousandth_of_a_pixel():
    """The third derivative of this lens across, 2 |k1| / 700^2 and some, times 30^3 / 16: what a parabola misses."""
    line = Line.between(LENS, -0.35 + 0.2j, 0.3 + 0.25j)
    t, u = np.linspace(-200, 200, 41), np.linspace(-30, 30, 61)
    found = line.pixels(LENS, t, u)
    assert found.shape == (41, 61)
    exact = LENS.distort(line.plane(t[:, None], u))
    missed: NDArray[np.complex128] = found - exact
    assert max(np.abs(missed.real).max(), np.abs(missed.imag).max()) < 6 * 0.3 / 700**2 * 30**3 / 16
    np.testing.assert_allclose(found[:, [0, 30, 60]], exact[:, [0, 30, 60]], rtol=0, atol=1e-10)


def layouts(frame: torch.Tensor) -> dict[str, torch.Tensor]:
    """The same picture, as memory may hold it."""
    _, height, width = frame.shape
    camera = frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    part = torch.zeros(3, height + 6, 2 * width + 8, dtype=torch.uint8)[:, 3 : 3 + height, 4 : 4 + 2 * width : 2]
    padded = torch.zeros(height, width + 5, 4, dtype=torch.uint8)[:, 2 : 2 + width, :3].permute(2, 0, 1)
    turned = torch.zeros(3, width, height, dtype=torch.uint8).mT
    rows = torch.zeros(height, 3, width, dtype=torch.uint8).transpose(0, 1)
    for other in (part, padded, turned, rows):
        other[:] = frame
    return {"planar": frame, "camera": camera, "part": part, "padded": padded, "turned": turned, "rows": rows}


@pytest.mark.parametrize("kind", ["camera", "part", "padded", "turned", "rows"])
def test_memory_of_any_layout_is_read_alike(frame, sampler, kind):
    """To the last bit, the last row and column included, where a step too far would leave the memory."""
    other = layouts(frame)[kind]
    assert other.stride() != frame.stride() and torch.equal(other, frame)
    places = np.random.default_rng(6).uniform(-2, 33, (2, 90))
    pixels = np.append(places[0] + 1j * places[1], [30 + 23j, 29.5 + 22.5j, 30 + 22.5j])
    again = Sampler(other, LIGHT)
    assert np.array_equal(again(pixels), sampler(pixels))
    assert np.array_equal(again.nearest(pixels[None]), sampler.nearest(pixels[None]))


@pytest.mark.parametrize("kind", ["planar", "camera", "part", "padded", "turned"])
def test_frames_that_are_not_the_hosts_are_read_alike(frame, kind):
    """To the last bit, by the way that other devices take; between pixels, on half pixels, and beyond the border."""
    places = np.random.default_rng(6).uniform(-2, 33, (2, 90))
    halves = (np.arange(-3, 64) / 2 + 1j * np.array([[-0.5], [0.5], [7.5], [8.0], [23.0], [23.5]])).ravel()
    pixels = np.concatenate([places[0] + 1j * places[1], halves, [30 + 23j, 1e6 - 1e6j]])
    there = Sampler(layouts(frame)[kind], LIGHT)
    here = (there(pixels), there.sharp(pixels), there.nearest(pixels[:90, None]))
    there._host, there._image = None, None
    for one, other in zip((there(pixels), there.sharp(pixels), there.nearest(pixels[:90, None])), here, strict=True):
        assert one.dtype == other.dtype and np.array_equal(one, other)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("kind", ["planar", "camera", "padded"])
def test_frames_of_a_gpu_are_read_alike(frame, kind):
    pixels = np.random.default_rng(6).uniform(-2, 33, (2, 90))
    pixels = pixels[0] + 1j * pixels[1]
    here, there = (Sampler(given, LIGHT) for given in (frame, layouts(frame)[kind].cuda()))
    assert np.array_equal(there(pixels), here(pixels)) and np.array_equal(there.sharp(pixels), here.sharp(pixels))
    assert np.array_equal(there.nearest(pixels[None]), here.nearest(pixels[None]))


def test_grey_frames_that_share_one_plane_are_read_as_three():
    grey = torch.from_numpy(np.random.default_rng(8).integers(0, 256, (1, 9, 11)).astype(np.uint8))
    pixels = np.array([0j, 3.3 + 4.1j, 10 + 8j])
    found = Sampler(grey.expand(3, -1, -1), LIGHT)(pixels)
    assert np.array_equal(found, Sampler(grey.repeat(3, 1, 1), LIGHT)(pixels)) and np.array_equal(found[0], found[2])


def test_the_cubic_keeps_parabolas_and_the_border():
    """Keys' kernel reproduces polynomials to the second degree; float32 sums of sixteen parts: 1e-6."""
    y, x = np.mgrid[:16, :16]
    levels = np.stack([x * x, y * y, x * y]).astype(np.uint8)
    sampler = Sampler(torch.from_numpy(levels), np.arange(256, dtype=np.float32))
    px, py = np.random.default_rng(2).uniform(1, 14, (2, 5, 7))
    found = sampler.sharp(px + 1j * py)
    assert found.shape == (3, 5, 7) and found.dtype == np.float32
    np.testing.assert_allclose(found, [px * px, py * py, px * py], rtol=0, atol=225e-6)
    whole = np.array([3 + 5j, 1 + 1j, 14 + 14j])
    np.testing.assert_allclose(sampler.sharp(whole), sampler(whole), rtol=0, atol=1e-4)
    beyond = sampler.sharp(np.array([complex(np.nan, 3), -40 + 2j, 1e6 + 1e6j]))
    assert np.isfinite(beyond).all()
