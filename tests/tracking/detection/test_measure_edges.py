"""Edges measured on frames whose line is known: right, smeared, hidden, outside, and left alone by what lies beyond."""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from oracles.strips import on_plane
from scipy.special import ndtr
from tracked import NEAR, SIZE, WORLD, at

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.fits import EdgeFit, fit_edges
from holotorch.tracking.detection.footprint import bulge_px
from holotorch.tracking.detection.measure import Edges, _across, _without_background, measure_edges
from holotorch.tracking.detection.stations import Axis, look_across, measure_axis
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.pose.resection import LinePose
from holotorch.tracking.pose.status import Refusal, Status
from holotorch.tracking.simulation.render import Occluder

LENS = Lens(WORLD.camera)
POSITIONS = THESIS.positions.numpy()
TIP, DIRECTION = (value.numpy() for value in at())
FOUND = LinePose(TIP, DIRECTION, np.zeros((6, 6)), 0.0)
OUTER = (True, False, False, True)


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame, the axis on it, and where on that the edges are and their rings bulge."""

    frame: torch.Tensor
    axis: Axis
    t: np.ndarray
    curve: np.ndarray

    def edges(self, blur=0.9, doubtful=OUTER, moved: float | np.ndarray = 0.0, frame=None) -> Edges:
        sampler = Sampler(self.frame if frame is None else frame, LENS.light)
        return measure_edges(sampler, LENS, self.axis, self.t + moved, doubtful, blur, self.curve)


@cache
def seen(name: str = "plain", **changes) -> Seen:
    """Of the pose ``at()``; the axis is measured on a plain frame."""
    plain = WORLD.case("edges", at()).frame()
    ends = on_plane(TIP + POSITIONS[[0, -1], None] * DIRECTION).tolist()
    line = Line.between(LENS, *ends)
    places = line.place(on_plane(TIP + POSITIONS[:, None] * DIRECTION))[0]
    whole = tuple(np.diff(places).tolist())
    stretches = Stretches(places, places, whole, whole, (False,) * 4, False)
    width = 2 * THESIS.radius * LENS.scale / NEAR
    stations = look_across(Sampler(plain, LENS.light), LENS, line, stretches, width, 0.9)
    axis = measure_axis(stations, (width, 0.0), 0.01, 0.9)
    t = axis.line.place(on_plane(TIP + POSITIONS[:, None] * DIRECTION))[0]
    frame = plain if name == "plain" else WORLD.case(name, at(), **changes).frame()
    return Seen(frame, axis, t, bulge_px(FOUND, POSITIONS.tolist(), THESIS.radius, axis.line))


def along(scene: Seen) -> np.ndarray:
    """Place along the line [H, W] of each pixel."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return scene.axis.line.place(LENS.undistort((x + 1j * y).ravel()))[0].reshape(SIZE)


def right(edges: Edges, scene: Seen, floor: float = 0.03) -> None:
    """Within 4 stated deviations, and what pixels and a table that shines through leave however little noise."""
    known = np.isfinite(edges.t)
    assert (np.abs(edges.t - scene.t)[known] < 4 * np.hypot(edges.deviation[known], floor)).all()


@pytest.mark.parametrize("moved", [0.0, 1.5, -4.0, 9.0])
def test_edges_are_right_wherever_they_were_thought(moved):
    scene = seen()
    edges = scene.edges(moved=moved)
    assert np.isfinite(edges.t).all() and edges.hidden == edges.outside == () and not edges.coarse
    right(edges, scene)
    assert edges.deviation.max() < 0.1 and edges.expected == 0.9 and edges.blur == pytest.approx(0.8, abs=0.15)
    assert edges.bulge == np.abs(scene.curve).max()


def test_of_edges_that_are_not_looked_for_nothing_is_said():
    scene = seen()
    some = scene.edges(moved=np.array([0, math.nan, 0, 0]))
    assert np.isnan(some.t).tolist() == [False, True, False, False] and np.isinf(some.deviation[1])
    none = scene.edges(0.7, moved=math.nan)
    assert np.isnan(none.t).all() and none.blur == none.expected == 0.7 and none.hidden == none.outside == ()


@pytest.mark.parametrize("path", [20, 26])
def test_edges_smeared_by_more_than_a_lens_does_are_looked_at_with_their_blur(path):
    """A path's deviation is its length over sqrt(12), and the lens's 0.8; a box is fitted by an error function."""
    ends = WORLD.camera.project(torch.from_numpy(TIP + POSITIONS[[0, -1], None] * DIRECTION))
    x, y = ((ends[1] - ends[0]) / (ends[1] - ends[0]).norm() * path).tolist()
    smeared = seen(f"smeared {path}", motion_px=(x, y))
    edges = smeared.edges()
    blur = math.hypot(path / math.sqrt(12), 0.8)
    assert edges.expected > 4 and edges.blur == pytest.approx(blur, rel=0.2)
    assert edges.expected == pytest.approx(edges.blur, rel=0.2)
    assert np.isfinite(edges.t).all()
    right(edges, smeared, 0.03 * blur)


def flat(start: float, end: float) -> Occluder:
    """A thing with straight sides across the tube, 60 px to both sides, from ``start`` to ``end`` in metres."""
    ends = WORLD.camera.project(torch.from_numpy(TIP + np.array([[start], [end]]) * DIRECTION))
    side = ends[1] - ends[0]
    across = 60 * torch.stack([-side[1], side[0]]) / side.norm()
    corners = [ends[0] + across, ends[1] + across, ends[1] - across, ends[0] - across]
    return Occluder(tuple((float(x), float(y)) for x, y in corners), (224, 172, 140))


def test_an_outer_edge_that_something_across_the_tube_makes_is_hidden():
    """Its border passes for the first edge; between two bands colours say what an edge is."""
    scene = seen("covered", occluders=(flat(0.055, 0.0703),))
    edges = scene.edges()
    assert edges.hidden == (0,) and np.isnan(edges.t).tolist() == [True, False, False, False]
    right(edges, scene)
    assert scene.edges(doubtful=(False,) * 4).hidden == ()


def test_edges_too_near_to_the_border_are_outside():
    scene = seen()
    x = float(WORLD.camera.project(torch.from_numpy(TIP + POSITIONS[-1] * DIRECTION)[None])[0, 0])
    for room, outside in ((6, (3,)), (40, ())):  # 8 px and two blurs are needed along the line
        edges = scene.edges(frame=scene.frame[:, :, : int(x) + room])
        assert edges.outside == outside and np.isnan(edges.t).tolist() == [False] * 3 + [bool(outside)]


@pytest.mark.parametrize("last", [False, True])
def test_what_lies_far_beyond_the_bands_leaves_the_outer_edges_alone(last):
    """From 10 px and two blurs on nothing is read, but for the two pixels that reading between pixels reaches."""
    scene = seen()
    away = along(scene) - scene.t[-1] if last else scene.t[0] - along(scene)
    spoiled, noise = scene.frame.clone(), torch.Generator().manual_seed(1)
    beyond = torch.from_numpy(away > 10 + 2 * 0.9 + float(np.abs(scene.curve).max()) + 3)
    spoiled[:, beyond] = torch.randint(0, 256, (3, int(beyond.sum())), dtype=torch.uint8, generator=noise)
    plain, edges = (scene.edges(doubtful=(False,) * 4, frame=frame) for frame in (scene.frame, spoiled))
    assert np.array_equal(edges.t, plain.t) and np.array_equal(edges.deviation, plain.deviation)


def test_bands_that_go_on_beside_the_tube_are_somebody_elses():
    thick = seen("thick", shown=replace(THESIS, radius=4e-3))
    with pytest.raises(Refusal, match="continue beside the tube") as refusal:
        thick.edges()
    assert refusal.value.status is Status.INCONSISTENT


def test_what_is_blurred_more_than_was_thought_reaches_farther_and_is_nothing_across_the_tube():
    scene = seen("soft", blur_px=3.0)
    edges = scene.edges()
    assert edges.hidden == () and np.isfinite(edges.t).all() and edges.blur == pytest.approx(3.0, rel=0.1)
    right(edges, scene, 0.08 * 3)


def fit_of(steps: float, edges: int = 3) -> EdgeFit:
    """Edges in the middle, of a step in all channels."""
    flat = np.zeros(edges)
    shape = (edges, 5, 3)
    light = np.full(shape, steps), np.zeros(shape), np.ones(shape)
    return EdgeFit(flat, flat + 0.9, flat + 0.05, flat + 1, *light, flat + 1)


def beside(steps: list[list[float]], noise: float = 0.01) -> np.ndarray:
    """Light [E, 33, 6, 3] that changes to the left and right of each edge by ``steps`` [E][2]."""
    along = np.arange(-16.0, 17)
    up = np.array([0.5 * math.erfc(-t / 0.9 / math.sqrt(2)) for t in along])
    each = np.repeat(np.array(steps), 3, axis=1)  # three rows a side
    light = 0.3 + up[None, :, None, None] * each[:, None, :, None] * np.ones(3)
    return light + noise * np.random.default_rng(3).normal(size=light.shape)


@pytest.mark.parametrize(
    ("steps", "across", "beyond"),
    [
        ([[0, 0], [0, 0], [0, 0]], [False] * 3, False),
        ([[0.1, 0.1], [0, 0], [0.1, 0]], [True, False, False], False),
        ([[0.1, -0.1], [-0.1, 0.1], [0.02, 0.02]], [True, True, False], False),
        ([[0.15, 0], [0.15, 0], [0.15, 0]], [False] * 3, True),
        ([[0.15, 0], [0.15, 0], [0, 0.15]], [False] * 3, False),
        ([[0.02, 0], [0.15, 0], [0.15, 0]], [False] * 3, False),
    ],
    ids=["nothing", "one", "any sign, not a little", "bands go on", "not on one side", "but one"],
)
def test_something_lies_across_where_both_sides_change_by_a_quarter_of_the_edge(steps, across, beyond):
    """Of an edge of 0.2: above 0.05 on both sides; above 0.03 on one side of all, the bands go on there."""
    along = np.broadcast_to(np.arange(-16.0, 17), (3, 33))
    found, on, _ = _across(beside(steps), along, fit_of(0.2))
    assert found.tolist() == across and on == beyond


def test_changes_that_noise_may_make_are_none():
    """33 x 3 rows of noise 0.3: a step is known to 0.3 / sqrt(3 * 33 / 4), a tenth, and one of 0.1 not clear."""
    along = np.broadcast_to(np.arange(-16.0, 17), (3, 33))
    steps = [[0.1, 0.1]] * 3
    assert not _across(beside(steps, 0.3), along, fit_of(0.2))[0].any()
    assert _across(beside(steps, 0.01), along, fit_of(0.2))[0].all()


@pytest.mark.parametrize("stripe", [3.0, 8.0, 21.0])
def test_a_striped_background_that_leaks_into_the_rows_leaves_the_edge_where_it_is(stripe):
    """Stripes beside a tube of five rows, 2 to 30 % of whose light the blur mixes into them."""
    rng, t, u = np.random.default_rng(4), np.arange(-20, 21.0), np.arange(-2, 3.0)
    behind = (np.sin(2 * math.pi * (t[:, None] + np.array([0.0, 0.4 * stripe])) / stripe) > 0)[None, ..., None] * 0.5
    behind = behind + 0.1 + np.zeros((1, 1, 1, 3))  # [E, T, 2, C]
    share = np.stack([0.3 * np.exp(-(u + 2)), 0.3 * np.exp(u - 2)], -1)  # of each row and side
    step, noise = np.array([0.2, -0.1, 0.05]), 0.004
    light = 0.3 + step * ndtr((t - 0.3) / 0.9)[None, :, None, None] + np.zeros((1, 1, 5, 1))
    light = light + np.einsum("us,etsc->etuc", share, behind) + noise * rng.standard_normal(light.shape)
    weight = np.full(light.shape, noise**-2)
    before = fit_edges(light, weight, t=t)
    after = fit_edges(_without_background(light, weight, before, t, behind), weight, t=t)
    assert abs(after.place[0] - 0.3) < 4 * after.deviation[0] < 0.2
    assert (
        before.noise[0] > 3 * after.noise[0] and after.noise[0] < 1.3 and after.deviation[0] < before.deviation[0] / 3
    )


def test_a_background_that_is_even_or_changes_only_at_the_edge_is_not_subtracted():
    t, noise = np.arange(-20, 21.0), 0.004
    rise = ndtr(t / 0.9)[None, :, None, None]
    light = 0.3 + 0.2 * rise + noise * np.random.default_rng(1).standard_normal((1, len(t), 5, 3))
    weight = np.full(light.shape, noise**-2)
    fit = fit_edges(light, weight, t=t)
    for behind in (np.full((1, len(t), 2, 3), 0.4), 0.4 + 0.3 * rise + np.zeros((1, 1, 2, 3))):
        again = fit_edges(_without_background(light, weight, fit, t, behind), weight, t=t)
        assert again.place[0] == pytest.approx(fit.place[0], abs=0.3 * fit.deviation[0])
