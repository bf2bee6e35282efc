"""What a pose makes of the tube on a line, against the outline of a cylinder by cones of tangent planes in numpy."""

import math

import numpy as np
import pytest
import torch
from oracles.strips import on_plane

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line
from holotorch.tracking.detection.footprint import Front, bulge_px, width_px
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.pose.resection import LinePose

LENS = Lens(Camera(torch.tensor([[1400.0, 0, 960], [0, 1400, 540], [0, 0, 1]]), torch.zeros(5)))


def found_at(tip: np.ndarray, direction: np.ndarray) -> LinePose:
    return LinePose(tip, direction, np.eye(6), 0.0)


def outline(tip, direction, radius):
    """Normals [2, 3] of the two planes through the camera that touch an infinite cylinder."""
    foot = tip - (tip @ direction) * direction
    far = np.linalg.norm(foot)
    toward = foot / far
    side = np.cross(direction, toward)
    sine = radius / far
    return [sign * math.sqrt(1 - sine**2) * side + sine * -toward for sign in (1, -1)]


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.0, 0.2), (0.0, 0.33), (0.4, -0.25)])
@pytest.mark.parametrize("direction", [(1.0, 0.1, -0.3), (0.4, 0.9, 0.2)])
def test_width_is_that_of_the_outline(place, direction):
    """Of an outline of a thin tube; what is left is of second order in radius over distance: 2e-6 here."""
    depth, direction = 0.5, np.array(direction) / np.linalg.norm(direction)
    tip = np.array([place[0] * depth, place[1] * depth, depth])
    positions = THESIS.positions.numpy()
    points = tip + positions[[0, -1], None] * direction
    line = Line.between(LENS, *on_plane(points).tolist())
    near, taper = width_px(found_at(tip, direction), positions.tolist(), THESIS.radius, line)
    for t in (-100.0, 0.0, 100.0):
        # Where the line across at t meets the images of the two planes, n . (x, y, 1) = 0.
        start, across = complex(line.plane(t)), 1j * line.along
        u = [
            -(n[0] * start.real + n[1] * start.imag + n[2]) / (n[0] * across.real + n[1] * across.imag)
            for n in outline(tip, direction, THESIS.radius)
        ]
        assert near + taper * t == pytest.approx(1400 * abs(u[0] - u[1]), rel=1e-5)


@pytest.mark.parametrize("direction", [(1.0, 0.1, -0.3), (0.4, 0.9, 0.2), (0.6, -0.5, 0.0)])
def test_rings_bulge_to_where_their_points_nearest_to_the_camera_are_seen(direction):
    """Of 20,000 points of each ring. Half a step of them is 1.6e-7 m or 4e-4 px, and all but 1 % of it is across."""
    direction = np.array(direction) / np.linalg.norm(direction)
    tip, positions = np.array([0.02, -0.03, 0.5]), THESIS.positions.numpy()
    centres = tip + positions[:, None] * direction
    line = Line.between(LENS, *on_plane(centres[[0, -1]]).tolist())
    one = np.cross(direction, [0.0, 0.0, 1.0])
    one /= np.linalg.norm(one)
    turn = np.linspace(0, 2 * math.pi, 20000)[:, None]
    ring = THESIS.radius * (np.cos(turn) * one + np.sin(turn) * np.cross(direction, one))
    found = bulge_px(found_at(tip, direction), positions.tolist(), THESIS.radius, line)
    assert found.shape == (4,) and np.abs(found).max() > 0.3 * (direction[2] != 0)
    for centre, bulge in zip(centres, found, strict=True):
        front = centre + ring[np.linalg.norm(centre + ring, axis=-1).argmin()]
        (there, middle), _ = line.place(on_plane(np.stack([front, centre])))
        assert bulge == pytest.approx(there - middle, abs=4e-6)


def test_a_pose_along_the_line_of_sight_has_no_width():
    tip = np.array([0.02, 0.01, 0.7])
    line = Line.between(LENS, 0j, 0.1 + 0j)
    near, taper = width_px(found_at(tip, -tip / np.linalg.norm(tip)), THESIS.positions.tolist(), THESIS.radius, line)
    assert not (1 < near < 1000 and abs(taper) < 1)


def rows_of(bulge: float, width: float, blur: float, change) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [U], where each shows an edge that bulges across a tube, and its step: of a blurred picture's fine samples.

    The edge lies at ``bulge`` sqrt(1 - q^2), q from -1 to 1 across; light changes by ``change`` of q there.
    """
    fine = 16
    u = (np.arange(-12 * fine, 12 * fine) + 0.5) / fine
    t = u[:, None]
    q = 2 * u / width
    inside = np.abs(q) < 1
    place = bulge * np.sqrt(np.where(inside, 1 - q * q, 0))
    picture = np.where(inside, change(np.where(inside, q, 0.0)), 0.0) * (t > place)
    bell = np.exp(-0.5 * (np.arange(-8 * fine, 8 * fine + 1) / fine / blur) ** 2)
    bell = bell / bell.sum()
    for axis in (0, 1):
        picture = np.apply_along_axis(np.convolve, axis, picture, bell, "same")
    rows = np.arange(-3.0, 4.0)
    seen = np.stack([0.5 * (picture[:, int((12 + r) * fine) - 1] + picture[:, int((12 + r) * fine)]) for r in rows])
    near = np.abs(u) < 7  # beyond, the picture's own border is blurred
    step = seen[:, u > 6].T[0]
    return rows, 7 - seen[:, near].sum(1) / fine / step, step


@pytest.mark.parametrize(("width", "blur"), [(5.4, 0.7), (4.0, 1.2), (9.0, 0.5)])
def test_rows_see_a_ring_where_its_front_has_it_through_the_blur(width, blur):
    """To half of one of the picture's samples, which is what is missed where the front is flat."""
    rows, place, _ = rows_of(0.9, width, blur, np.ones_like)
    front = Front.of(rows, np.array([width, width]), math.sqrt(blur**2 + 1 / 6))
    on = np.abs(rows) < width / 2 + 0.5
    np.testing.assert_allclose(0.9 * front.mean[0][on], place[on], rtol=0, atol=1 / 32)


@pytest.mark.parametrize("lit", ["alike", "from one side", "round", "more at its sides"])
def test_how_a_tube_is_lit_moves_its_rings_by_what_is_said(lit):
    """As above; without it an edge would be off by several hundredths of the bulge."""
    change = {
        "alike": np.ones_like,
        "from one side": lambda q: 1 + 0.8 * q,
        "round": lambda q: np.sqrt(1 - q * q),
        "more at its sides": lambda q: 1.2 - np.sqrt(1 - q * q),
    }[lit]
    rows, place, step = rows_of(-1.0, 5.4, 0.7, change)
    front = Front.of(rows, np.array([5.4]), math.sqrt(0.7**2 + 1 / 6))
    row = (5.4 / 2 + 0.9 - np.abs(rows)).clip(0, 1)
    told = np.ones((1, len(rows), 3))
    told[..., 1] = 0.0  # a channel that tells nothing
    steps = step[:, None] * np.array([1.0, 0.3, -0.5])
    # What rows of the tube say on average, above what they would if all of it were as bright as its middle.
    wanted = float((step**2 * (-place - front.mean[0])).sum() / (step**2).sum())
    found = float(front.shift(steps[None], told, row[None])[0])
    assert found == pytest.approx(wanted, abs=0.015)
    assert lit in ("alike", "from one side") or abs(wanted) > 0.02
