"""Edges that colours do not show, from two that they do."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tracked import WORLD, scenes, truth

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.completion import complete_edges, lies_across
from holotorch.tracking.detection.stations import Axis
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


def crossed(frame: torch.Tensor, line: Line, at: float, spans: list[tuple[float, float]]) -> bool:
    fit = SimpleNamespace(unknown=[0.0] * 4 + [0.8])
    axis = Axis(line, 6.0, 0.0, 0.1, 0.1, 1e-3, 0.0, fit)  # type: ignore[arg-type]
    return lies_across(Sampler(frame, LENS.light), LENS, axis, at, spans)


def test_what_lies_across_shows_on_both_sides_and_ends():
    """A tube of 6 px along a row, from 100 on, with edges every 100 px; a bar of another colour over its third edge."""
    line = Line(complex(LENS.undistort(np.array([300.0 + 240.0j]))[0]), 1.0 + 0.0j, LENS.scale)
    bare = torch.full((3, 480, 640), 90, dtype=torch.uint8)
    bare[:, 237:244, 100:] = torch.tensor([40, 60, 200], dtype=torch.uint8)[:, None, None]
    spans, edge = [(-200.0, -100.0), (-100.0, 0.0)], 100.0
    bar = bare.clone()
    bar[:, :, 385:420] = torch.tensor([200, 150, 120], dtype=torch.uint8)[:, None, None]
    assert crossed(bar, line, edge, spans)
    assert not crossed(bar, line, edge - 50, spans) and not crossed(bare, line, edge, spans)
    behind, onward, beside = bar.clone(), bar.clone(), bare.clone()
    behind[:, 237:244] = bare[:, 237:244]  # the tube is in front of the bar
    onward[:, :, 420:] = bar[:, :, 400:401]  # a background that changes for good
    beside[:, :238, 385:420] = bar[:, :238, 385:420]  # on one side only
    assert not any(crossed(frame, line, edge, spans) for frame in (behind, onward, beside))
    assert not crossed(bar, line, 1e5, spans)  # off the frame
