"""The camera of the tracker's small calls against the camera itself."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens

NONE, MILD = [0.0] * 5, [-0.05, 0.02, 1e-3, -5e-4, 0.0]
STRONG, BARREL, PINCUSHION = [-0.35, 0.15, 2e-3, -1e-3, -0.02], [-0.6, 0.0, 0.0, 0.0, 0.0], [0.25, 0.1, -2e-3, 2e-3, 0]
LENSES = {"none": NONE, "mild": MILD, "strong": STRONG, "barrel": BARREL, "pincushion": PINCUSHION}


def camera(distortion, fx=700.0, fy=640.0) -> Camera:
    return Camera(torch.tensor([[fx, 0, 480], [0, fy, 270], [0, 0, 1]], dtype=torch.float64), torch.tensor(distortion))


def pairs(values: NDArray[np.complex128]) -> torch.Tensor:
    return torch.from_numpy(np.stack([values.real, values.imag], -1))


def numbers(values: torch.Tensor) -> np.ndarray:
    return values.numpy()[..., 0] + 1j * values.numpy()[..., 1]


def disc(radius: float, count: int = 400) -> np.ndarray:
    """Points [count] of the plane z = 1 within ``radius``, evenly."""
    rng = np.random.default_rng(7)
    return radius * np.sqrt(rng.random(count)) * np.exp(2j * math.pi * rng.random(count))


@pytest.mark.parametrize("name", LENSES)
def test_points_are_distorted_as_the_camera_does(name):
    """The same sums in another order: rounding of pixels up to some 1e3, 1e-12."""
    one = camera(LENSES[name])
    plane = disc(1.0).reshape(20, 20)
    found = Lens(one).distort(plane)
    assert found.shape == (20, 20)
    np.testing.assert_allclose(found, numbers(one.distort(pairs(plane))), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", LENSES)
def test_pixels_come_back_to_a_billionth_and_as_the_camera_has_them(name):
    """Both stop within 1e-9 px of the pixel.

    On the plane that is 1e-9 over what a step there moves the pixel by: above a tenth of the focal length to 0.95 of
    the valid radius.
    """
    one = camera(LENSES[name])
    lens = Lens(one)
    plane = disc(min(0.8, 0.95 * one.valid_radius))
    pixels = lens.distort(plane)
    found = lens.undistort(pixels)
    assert np.abs(lens.distort(found) - pixels).max() < 1e-9
    np.testing.assert_allclose(found, plane, rtol=0, atol=1e-9 / (0.1 * 640))
    np.testing.assert_allclose(found, numbers(one.undistort(pairs(pixels))), rtol=0, atol=2e-9 / (0.1 * 640))


def test_a_few_steps_are_enough_for_mild_lenses():
    """The slow way is the camera's: with a camera that has none, all pixels of the frame come back all the same."""
    one = camera(MILD)
    lens = Lens(one)
    x, y = np.meshgrid(np.linspace(0, 959, 25), np.linspace(0, 539, 15))
    pixels = (x + 1j * y).ravel()
    known = numbers(one.undistort(pairs(pixels)))
    object.__setattr__(one, "undistort", None)
    np.testing.assert_allclose(lens.undistort(pixels), known, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["strong", "barrel"])
def test_beyond_the_lens_there_are_no_points(name):
    """Pixels farther than the distorted radius where the lens turns back, and those that only come from beyond it."""
    one = camera(LENSES[name])
    lens = Lens(one)
    edge = abs(np.subtract(*lens.distort(np.array([one.valid_radius, 0j]))))
    turns: NDArray[np.complex128] = np.exp(2j * math.pi * np.arange(12) / 12)
    far = 480 + 270j + np.concatenate([1.3 * edge * turns, 1e5 * turns])
    beyond = lens.distort(1.02 * one.valid_radius * turns)  # the same pixel has a point within
    found = lens.undistort(np.concatenate([far, beyond]))
    assert np.isnan(found[:24]).all()
    known = numbers(one.undistort(pairs(beyond)))
    assert (np.isnan(found[24:]) == np.isnan(known)).all()
    inside = found[24:][~np.isnan(known)]
    assert (np.abs(inside) <= one.valid_radius).all()
    np.testing.assert_allclose(inside, known[~np.isnan(known)], rtol=0, atol=1e-6)  # where the slope is nearly nought


def test_one_pixel_without_a_point_leaves_the_others_theirs():
    lens = Lens(camera(BARREL))
    plane = disc(0.5, 5)
    pixels = np.append(lens.distort(plane), [3000 + 270j, complex(math.nan, 3)])
    found = lens.undistort(pixels)
    np.testing.assert_allclose(found[:5], plane, rtol=0, atol=1e-9)
    assert np.isnan(found[5:]).all()


def test_it_has_the_cameras_scale_and_light():
    one = camera(MILD)
    lens = Lens(one)
    assert lens.scale == 670.0 and lens.camera is one
    assert lens.light.dtype == np.float32 and np.array_equal(lens.light, one.table().numpy())
    linear = Camera(one.matrix, one.distortion, "linear")
    np.testing.assert_allclose(Lens(linear).light, np.arange(256) / 255, rtol=0, atol=1e-7)
