"""Edges that colours do not show, from two that they do."""

import math

import numpy as np
import pytest
import torch
from tracked import WORLD, scenes, truth

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.completion import complete_edges
from holotorch.tracking.pose.catheter import THESIS

LENS = Lens(WORLD.camera)
POSITIONS = THESIS.positions.tolist()


def on_line(name: str) -> tuple[torch.Tensor, Line, np.ndarray]:
    """A frame, the line of its catheter, and the positions of the edges along this line in pixels."""
    case, frame = scenes()[name]
    tip, direction = truth(case)
    x, y, z = (tip[:, None] + direction[:, None] * THESIS.positions).numpy()
    places = (x + 1j * y) / z
    line = Line.between(LENS, complex(places[0]), complex(places[-1]))
    return frame, line, line.place(places)[0]


@pytest.mark.parametrize("known", [(0, 1), (1, 2), (2, 3), (0, 3)], ids=str)
@pytest.mark.parametrize("name", ["near", "far", "slanted"])
def test_two_edges_and_the_steps_of_light_give_all(name, known):
    """Without any colour: the frame is grey. The front of a ring bulges from the axis by up to two pixels,
    which edges on one side of the known ones triple; a window reaches 20."""
    frame, line, t = on_line(name)
    grey = frame.float().mean(0, keepdim=True).round().to(torch.uint8).expand(3, -1, -1).contiguous()
    given = [value if i in known else math.nan for i, value in enumerate(t.tolist())]
    found = complete_edges(Sampler(grey, LENS.light), LENS, line, given, POSITIONS)
    assert found is not None
    assert np.abs(found - t)[list(known)].max() < 1e-6
    assert np.abs(found - t).max() < 6


def test_edges_in_the_wrong_order_are_no_catheter():
    frame, line, t = on_line("near")
    assert complete_edges(Sampler(frame, LENS.light), LENS, line, [math.nan, t[2], t[1], math.nan], POSITIONS) is None


def test_a_frame_without_steps_gives_some_catheter_all_the_same():
    """Whether its edges are there is for the measurement to say."""
    _, line, t = on_line("near")
    plain = torch.full((3, 540, 960), 128, dtype=torch.uint8)
    found = complete_edges(Sampler(plain, LENS.light), LENS, line, [math.nan, t[1], t[2], math.nan], POSITIONS)
    assert found is not None and np.isfinite(found).all() and (np.diff(found) > 0).all()
