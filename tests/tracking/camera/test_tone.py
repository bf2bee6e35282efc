"""Tone curves of synthetic exposure series against the laws that made them."""

import cv2
import numpy as np
import pytest
import torch

from holotorch.tracking import Camera
from holotorch.tracking.camera.tone import tone_curve

LEVELS = np.arange(256) / 255
EXPOSURES = torch.tensor([0.25, 0.5, 1, 2, 4])


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


LAWS = {
    "srgb": (srgb, np.where(LEVELS <= 0.04045, LEVELS / 12.92, ((LEVELS + 0.055) / 1.055) ** 2.4)),
    "linear": (lambda light: light, LEVELS),
    "power": (lambda light: np.maximum(light, 0) ** (1 / 1.8), LEVELS**1.8),
}


def series(law, noise=0.0, seed=0, exposures=EXPOSURES):
    """Exposures of soft patches of many shades; the sensor clips at white."""
    generator = np.random.default_rng(seed)
    shades = np.exp(generator.uniform(np.log(0.004), np.log(1.5), (12, 16)))
    scene = cv2.GaussianBlur(np.kron(shades, np.ones((10, 10))), (0, 0), 1.0)
    frames = [255 * law(scene * time) + generator.normal(0, noise, scene.shape) for time in exposures.tolist()]
    return torch.from_numpy(np.clip(np.rint(frames), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("noise", "limit"), [(0.0, 2e-3), (1.0, 5e-3), (2.5, 12e-3)])
def test_curve_is_the_one_that_made_the_frames(law, noise, limit):
    """To a fifth of a level without noise; noise bends the dark end, by half the level's share or so."""
    make, truth = LAWS[law]
    found = tone_curve(series(make, noise), EXPOSURES).numpy()
    assert found[255] == 1 and found[0] == 0 and (np.diff(found) > 0).all()
    assert np.abs(found - truth).max() < limit


def test_opencv_finds_the_same_curve():
    frames = series(srgb)
    pictures = [np.repeat(frame[..., None], 3, 2) for frame in frames.numpy()]
    other = cv2.createCalibrateDebevec(300, 20.0, False).process(pictures, EXPOSURES.numpy())[:, 0, 0]
    assert np.abs(other / other[255] - tone_curve(frames, EXPOSURES).numpy()).max() < 0.01


def test_curve_makes_a_camera_that_inverts_it():
    table = tone_curve(series(srgb), EXPOSURES)
    camera = Camera(torch.eye(3), torch.zeros(5), table)
    levels = torch.arange(0, 255.5, 0.5, dtype=torch.float64)
    torch.testing.assert_close(camera.levels(camera.linear(levels)), levels, rtol=0, atol=1e-9)


def test_order_unit_and_colour_of_the_frames_do_not_matter():
    frames = series(srgb, 1.0)
    wanted = tone_curve(frames, EXPOSURES)
    order = torch.tensor([3, 0, 4, 1, 2])
    torch.testing.assert_close(tone_curve(frames[order], 0.01 * EXPOSURES[order]), wanted, rtol=0, atol=1e-6)
    coloured = frames[:, None].expand(-1, 3, -1, -1)
    torch.testing.assert_close(tone_curve(coloured, EXPOSURES), wanted, rtol=0, atol=1e-9)


def test_scene_that_moved_is_refused():
    frames = series(srgb)
    frames[2] = frames[2].roll(25, 1)
    with pytest.raises(ValueError, match="do not fit.*still"):
        tone_curve(frames, EXPOSURES)


def test_one_exposure_that_is_wrong_is_refused():
    with pytest.raises(ValueError, match="do not fit"):
        tone_curve(series(srgb), EXPOSURES * torch.tensor([1, 1, 1.7, 1, 1]))


def test_few_shades_are_refused():
    frames = torch.stack([torch.full((40, 50), level, dtype=torch.uint8) for level in (20, 60, 150)])
    with pytest.raises(ValueError, match="of 250 levels occur"):
        tone_curve(frames, EXPOSURES[:3])


@pytest.mark.parametrize(
    ("frames", "exposures", "words"),
    [
        (series(srgb), EXPOSURES[:4], r"shape \[5\]"),
        (series(srgb), EXPOSURES * float("nan"), "finite"),
        (series(srgb), EXPOSURES - 1, "above zero"),
        (series(srgb)[:2], EXPOSURES[:2], "3 or more"),
        (series(srgb)[0], EXPOSURES, r"\[E, H, W\]"),
        (torch.full((3, 8, 8), 255, dtype=torch.uint8), EXPOSURES[:3], "clipped in neither"),
    ],
)
def test_bad_input_is_named(frames, exposures, words):
    with pytest.raises(ValueError, match=words):
        tone_curve(frames, exposures)


def test_frames_of_another_type_are_refused():
    with pytest.raises(TypeError, match="uint8"):
        tone_curve(torch.zeros(3, 8, 8), EXPOSURES[:3])
