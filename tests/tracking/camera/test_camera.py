import cv2
import numpy as np
import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from kornia.geometry.calibration import distort_points, undistort_points
from oracles import tracking as oracle

from holotorch.tracking import Camera, CatheterTracker, ThesisTracker
from holotorch.tracking.simulation.world import THESIS

MATRIX = torch.tensor([[1400.0, 0, 959.5], [0, 1350, 539.5], [0, 0, 1]], dtype=torch.float64)
MILD = (-0.12, 0.05, 1e-3, -5e-4, -0.01)


def camera(distortion=MILD, **given) -> Camera:
    return Camera(MATRIX, torch.tensor(distortion, dtype=torch.float64), **given)


def ring(radius: float, count: int = 90) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def pixels_of(plane: np.ndarray, distortion) -> np.ndarray:
    return oracle.pixels(np.concatenate([plane, np.ones_like(plane[:, :1])], -1), MATRIX.numpy(), distortion)


@pytest.mark.parametrize("distortion", [MILD, (0.0,) * 5, (0.3, 0, 0, 0, 0), (-0.3, 0.1, 2e-3, -1e-3, 0)])
def test_projects_as_the_formula_says(distortion):
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.4], [0.3, 0.2, 2], (200, 3))
    found = camera(distortion).project(torch.tensor(points))
    # Coordinates up to some thousands in float64: a few 1e-13.
    np.testing.assert_allclose(found, oracle.pixels(points, MATRIX.numpy(), distortion), rtol=0, atol=1e-11)
    assert camera(distortion).project(torch.tensor(points[:8], dtype=torch.float32).reshape(2, 4, 3)).shape == (2, 4, 2)


@pytest.mark.parametrize("distortion", [MILD, (-0.3, 0.1, 2e-3, -1e-3, 0)])
def test_kornia_and_ours_distort_alike(distortion):
    plane = torch.tensor(np.random.default_rng(1).uniform(-0.6, 0.6, (4, 50, 2)))
    given = torch.tensor(distortion, dtype=torch.float64)
    theirs = distort_points(plane, MATRIX[None], given[None], torch.eye(3, dtype=torch.float64)[None])
    torch.testing.assert_close(camera(distortion).distort(plane), theirs, rtol=0, atol=1e-11)  # rounding of 1e3 px


def test_kornia_opencv_and_ours_undistort_alike():
    """Over the whole frame of 1920 x 1080, in pixels of the undistorted image."""
    y, x = np.mgrid[0:1080:27, 0:1920:32]
    pixels = np.stack([x, y], -1).reshape(-1, 2).astype(float)
    matrix, given = MATRIX.numpy(), np.array(MILD)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-14)
    theirs = cv2.undistortPoints(pixels[:, None], matrix, given, criteria=criteria)[:, 0]
    other = undistort_points(torch.tensor(pixels)[None], MATRIX[None], torch.tensor(given)[None])[0].numpy()
    ours = camera().undistort(torch.tensor(pixels)).numpy()
    focal = np.array([1400.0, 1350.0])
    assert np.abs((ours - theirs) * focal).max() < 1e-9
    assert np.abs(ours * focal + matrix[:2, 2] - other).max() < 1e-3
    assert np.abs(pixels_of(ours, MILD) - pixels).max() < 1e-9


@pytest.mark.parametrize("k1", [-0.3, -0.5])
def test_strong_lens_to_its_border_and_beyond(k1):
    """r (1 + k1 r^2) rises to r = 1 / sqrt(-3 k1), where it is 2/3 of that: no pixel farther out has an answer."""
    strong = camera((k1, 0, 0, 0, 0))
    limit = (-3 * k1) ** -0.5
    assert strong.valid_radius == pytest.approx(limit, rel=1e-12)
    for share in (0.5, 0.9, 0.99, 0.999):
        plane = ring(share * limit)
        found = strong.undistort(torch.tensor(pixels_of(plane, (k1, 0, 0, 0, 0)))).numpy()
        # The slope falls to 0 at the border: there 1e-12 pixels are (1 / 1400) 1e-12 / (1 - share^2) on the plane.
        np.testing.assert_allclose(found, plane, rtol=0, atol=1e-15 / (1 - share**2) + 1e-15)
    # The polynomial falls beyond, and reaches every pixel once more: Newton's steps alone find such answers here.
    far = 2 / 3 * limit * np.concatenate([np.geomspace(1.001, 30, 400), [1e6]])
    beyond = far[:, None] * [1400 * 0.6, 1350 * 0.8] + [959.5, 539.5]
    assert strong.undistort(torch.tensor(beyond)).isnan().all()
    points = torch.tensor(np.concatenate([ring(limit * 1.001), np.ones((90, 1))], -1))
    assert strong.project(points).isnan().all()
    assert strong.project(points * torch.tensor([0.99, 0.99, 1])).isfinite().all()


@pytest.mark.parametrize("distortion", [(0.3, 0, 0, 0, 0), (-0.3, 0.1, 1e-3, -1e-3, 0), (-0.5, 0.3, 1e-3, 1e-3, -0.1)])
def test_round_trip_of_lenses_at_which_fixed_point_steps_diverge(distortion):
    lens = camera(distortion)
    limit = min(lens.valid_radius, 3.0)  # 72 degrees from the axis
    for share in (0.3, 0.6, 0.9, 0.95):  # the tangential part moves the border by a percent
        pixels = pixels_of(ring(share * limit), distortion)
        found = lens.undistort(torch.tensor(pixels)).numpy()
        assert np.abs(pixels_of(found, distortion) - pixels).max() < 1e-9
        assert np.abs(found - ring(share * limit)).max() < 1e-12


def test_behind_beside_and_nowhere():
    lens = camera()
    points = torch.tensor([[0.1, 0.1, 1], [0.1, 0.1, -1], [0.1, 0.1, 0], [3, 0, 1], [torch.nan, 0, 1]]).double()
    assert lens.project(points).isfinite().all(-1).tolist() == [True, False, False, False, False]
    given = torch.tensor([[900.0, 500], [torch.nan, 500], [torch.inf, 0]])
    assert lens.undistort(given).isfinite().all(-1).tolist() == [True, False, False]
    assert lens.undistort(torch.zeros(0, 4, 2)).shape == (0, 4, 2)
    assert camera((0.0,) * 5).valid_radius == 20
    # A lone good point is not spoilt by the others, nor are the camera's gradients.
    matrix, distortion = MATRIX.clone().requires_grad_(), torch.tensor(MILD).double().requires_grad_()
    lens = Camera(matrix, distortion)
    for values, function in ((points, lens.project), (given.double(), lens.undistort)):
        values = values.clone().requires_grad_()
        gradients = torch.autograd.grad(function(values)[0].sum(), (values, matrix, distortion))
        assert all(gradient.isfinite().all() for gradient in gradients)
        assert gradients[0][0].any() and not gradients[0][1:].any()


@pytest.mark.parametrize("k1", [-0.12, -0.3])
def test_gradients(k1):
    free = torch.tensor([1400.0, 1350, 959.5, 539.5], dtype=torch.float64, requires_grad=True)
    distortion = torch.tensor([k1, 0.05, 1e-3, -5e-4, -0.01], dtype=torch.float64, requires_grad=True)
    empty = torch.zeros((), dtype=torch.float64)

    def lens(v, k):
        rows = [torch.stack([v[0], empty, v[2]]), torch.stack([empty, v[1], v[3]]), torch.eye(3).double()[2]]
        return Camera(torch.stack(rows), k)

    points = torch.tensor([[0.1, 0.2, 0.9], [-0.3, 0.1, 0.7]], dtype=torch.float64, requires_grad=True)
    pixels = lens(free, distortion).project(points).detach().requires_grad_()
    # Undistorted points times 1000 are in the size of pixels: gradcheck's absolute tolerance then means something.
    assert torch.autograd.gradcheck(lambda p, v, k: lens(v, k).project(p), (points, free, distortion))
    assert torch.autograd.gradcheck(lambda p, v, k: 1e3 * lens(v, k).undistort(p), (pixels, free, distortion))
    plane = lens(free, distortion).undistort(pixels).detach()
    slopes = torch.stack([torch.autograd.functional.jacobian(camera(distortion.tolist()).distort, p) for p in plane])
    torch.testing.assert_close(camera(distortion.tolist()).slopes(plane), slopes, rtol=1e-12, atol=1e-9)


def test_srgb_both_ways():
    lens, levels = camera(), torch.arange(256, dtype=torch.uint8)
    light = lens.linear(levels)
    # kornia's constants are those of the standard in another rounding; float32.
    wanted = rgb_to_linear_rgb((levels / 255).expand(1, 3, 1, 256).double())[0, 0, 0]
    torch.testing.assert_close(light.double(), wanted, rtol=1e-4, atol=1e-6)
    back = linear_rgb_to_rgb(light.double().expand(1, 3, 1, 256))[0, 0, 0] * 255
    torch.testing.assert_close(lens.levels(light.double()), back, rtol=0, atol=0.01)
    fine = torch.linspace(0, 255, 1001, dtype=torch.float64)
    # The standard's two pieces meet to 1e-7 of light, at a slope of 1 / 12.92.
    torch.testing.assert_close(lens.levels(lens.linear(fine)), fine, rtol=0, atol=1e-3)
    assert torch.equal(lens.levels(light).round().to(torch.uint8), levels)
    assert light[0] == 0 and light[255] == 1 and bool((light.diff() > 0).all())
    assert lens.levels(torch.tensor([-1.0, 2.0])).tolist() == pytest.approx([0, 255], rel=1e-6)  # clipped
    for start in (0.0, 3.0, 10.3, 200.0):
        value = torch.tensor([start], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lens.linear, value)
    # Zero light: no infinite slope.
    value = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.grad(lens.levels(value), value)[0].item() == pytest.approx(255 * 12.92)


def test_tables_of_tone():
    levels, fine = torch.arange(256, dtype=torch.uint8), torch.linspace(0, 255, 777, dtype=torch.float64)
    gamma = (torch.arange(256, dtype=torch.float64) / 255) ** 2.2 * 0.9 + 0.05
    lens = camera(tone=gamma)
    torch.testing.assert_close(lens.linear(levels), gamma.float())
    torch.testing.assert_close(lens.linear(fine)[::97], torch.tensor(np.interp(fine[::97], np.arange(256), gamma)))
    torch.testing.assert_close(lens.levels(lens.linear(fine)), fine, rtol=0, atol=1e-9)
    assert lens.levels(torch.tensor([0.0, 1.0])).tolist() == [0, 255]  # what no level reaches
    line = camera(tone="linear")
    assert torch.equal(line.linear(fine), fine / 255)
    torch.testing.assert_close(line.levels(line.linear(fine)), fine)
    frame = torch.randint(0, 256, (2, 3, 4, 5), dtype=torch.uint8)
    assert line.linear(frame).shape == frame.shape and line.linear(frame).dtype == torch.float32


@pytest.mark.parametrize(
    ("matrix", "distortion", "tone", "message"),
    [
        (torch.eye(2), torch.zeros(5), "srgb", r"matrix must be of shape \[3, 3\], got \[2, 2\]"),
        (MATRIX, torch.zeros(4), "srgb", r"distortion must be of shape \[5\], got \[4\]"),
        (MATRIX * torch.nan, torch.zeros(5), "srgb", "matrix must be finite"),
        (MATRIX, torch.full((5,), torch.inf), "srgb", "distortion must be finite"),
        (-MATRIX, torch.zeros(5), "srgb", "fx, fy > 0"),
        (MATRIX + torch.eye(3).flip(0), torch.zeros(5), "srgb", r"\[\[fx, 0, cx\], \[0, fy, cy\], \[0, 0, 1\]\]"),
        (MATRIX * 2, torch.zeros(5), "srgb", r"\[0, 0, 1\]\]"),
        (MATRIX, torch.zeros(5), "gamma", "tone must be 'srgb', 'linear' or a table of 256 values, got 'gamma'"),
        (MATRIX, torch.zeros(5), torch.linspace(0, 1, 255), "256 values that rise"),
        (MATRIX, torch.zeros(5), torch.linspace(0, 1.1, 256), "256 values that rise"),
        (MATRIX, torch.zeros(5), torch.linspace(1, 0, 256), "256 values that rise"),
        (MATRIX, torch.zeros(5), torch.full((256,), torch.nan), "256 values that rise"),
    ],
)
def test_impossible_cameras(matrix, distortion, tone, message):
    with pytest.raises(ValueError, match=message):
        Camera(matrix, distortion, tone)


@pytest.mark.parametrize("tracker", [CatheterTracker, ThesisTracker])
def test_frames_of_another_size_are_an_error(tracker):
    """Half the pixels or a part of the frame: a pose would be found, and decimetres off."""
    lens = Camera(MATRIX, torch.zeros(5), size=(48, 64))
    track = tracker(lens, THESIS)
    assert not track(torch.zeros(1, 3, 48, 64, dtype=torch.uint8))[0].answered
    for shape in ((36, 48), (64, 48)):
        with pytest.raises(ValueError, match=f"for frames of 64 x 48 px, got {shape[1]} x {shape[0]}: scale or move"):
            track(torch.zeros(2, 3, *shape, dtype=torch.uint8))
    for size in ((0, 5), (-1, 5), (1.5, 5)):
        with pytest.raises((ValueError, TypeError), match="size"):
            Camera(MATRIX, torch.zeros(5), size=size)  # type: ignore[arg-type]


def test_impossible_points():
    with pytest.raises(ValueError, match=r"points must be floating, of shape \[..., 3\], got torch.float32, \[2\]"):
        camera().project(torch.zeros(2))
    with pytest.raises(ValueError, match="points must be floating"):
        camera().project(torch.zeros(4, 3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"pixels must be of shape \[..., 2\], got \[4, 3\]"):
        camera().undistort(torch.zeros(4, 3))
