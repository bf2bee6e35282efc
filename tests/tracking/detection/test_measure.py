"""Edges of bands from the light along a line."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line
from holotorch.tracking.detection.measure import halfway

LENS = Lens(
    Camera(torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.3, 0.1, 2e-3, -1e-3, 0]))
)
LINE = Line.between(LENS, -0.1 + 0.02j, 0.12 + 0.05j)
LEVELS = np.array([[0.1, 0.5, 0.2], [0.6, 0.1, 0.15], [0.2, 0.3, 0.7]])  # light of three bands


def seen(places: list[float], blur: float) -> Any:
    """Light at pixels, in the place of a frame's: ``LEVELS`` on the line, with edges at ``places`` along it."""

    def light(pixels: np.ndarray) -> np.ndarray:
        t, _ = LINE.place(LENS.undistort(pixels.ravel()))
        found = np.broadcast_to(LEVELS[0][:, None], (3, len(t))).copy()
        for i, place in enumerate(places):
            rise = [0.5 * math.erfc((place - value) / blur / math.sqrt(2)) for value in t]
            found += (LEVELS[i + 1] - LEVELS[i])[:, None] * np.array(rise)
        return found.reshape(3, *pixels.shape).astype(np.float32)

    return light


def tail(z: float) -> float:
    """Of the normal distribution beyond z."""
    return 0.5 * math.erfc(z / math.sqrt(2))


@pytest.mark.parametrize("blur", [0.5, 0.7, 0.9, 1.2, 1.5])
def test_edges_lie_where_the_light_is_halfway(blur):
    """Steps of an error function, up to 1.2 px from where labels changed.

    Samples a pixel apart miss 2 exp(-2 pi^2 blur^2) / 2 pi. The three outermost, 2.8 px from the edge and more, are
    taken for the light on that side: what they lack of it is lacking in all 8 samples there. Float32: 1e-5.
    """
    places, labels = [-39.7, 40.8], np.array([-40.0, 42.0])
    found = halfway(seen(places, blur), LENS, LINE, labels)
    lacking = sum(tail((2.8 + k) / blur) for k in range(3)) / 3
    assert np.abs(found - places).max() < math.exp(-2 * (math.pi * blur) ** 2) / math.pi + 8 * lacking + 1e-5


def test_where_no_light_changes_edges_stay_where_labels_changed():
    labels = np.array([10.0, -12.5, math.nan])
    found = halfway(seen([], 0.9), LENS, LINE, labels[:2])
    assert found.tolist() == [10.0, -12.5]
    # Nor do those that are not seen become any.
    assert np.isnan(halfway(seen([10.3], 0.9), LENS, LINE, labels)[2])


def test_edges_far_from_where_labels_changed_are_left_to_them():
    """Beyond 3 px the light on one of both sides is no band's own."""
    found = halfway(seen([5.5], 0.7), LENS, LINE, np.array([0.0]))
    assert found.tolist() == [0.0]
