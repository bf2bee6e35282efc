"""Pose from places on a line against the general solver, which knows of no line, and against what made the places."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from oracles.strips import on_plane

from holotorch.tracking import THESIS, Camera, solve_pose
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line
from holotorch.tracking.pose.resection import LinePose, pose_on_line

CAMERA = Camera(torch.tensor([[1400.0, 0, 959.5], [0, 1400, 539.5], [0, 0, 1]]), torch.zeros(5))
LENS = Lens(CAMERA)
BANDS = THESIS.positions.numpy()
SIX = np.array([0.05, 0.062, 0.08, 0.1, 0.12, 0.135])
Seen = tuple[Line, np.ndarray, np.ndarray, np.ndarray]


def seen(depth: float, tilt: float, positions: np.ndarray, place=(0.02, -0.03)) -> Seen:
    """Line through a tool's image, places of its points on it, tip and direction."""
    tip = np.array([*place, depth])
    angles = math.radians(tilt), math.radians(35)
    flat = math.cos(angles[0])
    direction = np.array([flat * math.cos(angles[1]), flat * math.sin(angles[1]), -math.sin(angles[0])])
    plane = on_plane(tip + positions[:, None] * direction)
    line = Line.between(LENS, *plane[[0, -1]].tolist())
    return line, line.place(plane)[0], tip, direction


def solved(
    line: Line,
    t: np.ndarray,
    positions: np.ndarray,
    deviation: float | np.ndarray = 0.1,
    offset_sd=0.1,
    slope_sd=1e-4,
    shared_sd=0.0,
) -> LinePose:
    found = pose_on_line(
        line, t.tolist(), positions.tolist(), (deviation * np.ones_like(t)).tolist(), offset_sd, slope_sd, shared_sd
    )
    assert found is not None
    return found


@pytest.mark.parametrize("positions", [BANDS, BANDS[[0, 2, 3]], SIX], ids=["4", "3", "6"])
@pytest.mark.parametrize("tilt", [0.0, 20.0, -45.0, 80.0])
def test_what_made_the_places_is_found(positions, tilt):
    """Rounding of 1e-13 pixels, times what a pixel moves the tip by: below a metre in all of these."""
    line, t, tip, direction = seen(0.52, tilt, positions)
    pose = solved(line, t, positions)
    np.testing.assert_allclose(pose.tip, tip, rtol=0, atol=1e-11)
    np.testing.assert_allclose(pose.direction, direction, rtol=0, atol=1e-11)
    assert 0 <= pose.chi_square < 1e-18
    assert pose.tip_sd == pytest.approx(math.sqrt(np.trace(pose.covariance[:3, :3])), rel=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 20.0, -45.0])
@pytest.mark.parametrize("positions", [BANDS, SIX], ids=["4", "6"])
def test_the_general_solver_finds_the_same(positions, tilt):
    """With deviations across that amount to the line's; it stops within 1e-9 deviations of the optimum.

    Its spread along the line is that of the places its pose gives, 0.1 px of some 300 from those that were seen.
    """
    line, t, *_ = seen(0.6, tilt, positions)
    generator = torch.Generator().manual_seed(3)
    t = t + 0.1 * torch.randn(len(t), generator=generator, dtype=torch.float64).numpy()
    deviation = 0.05 + 0.1 * torch.rand(len(t), generator=generator, dtype=torch.float64).numpy()
    across = 0.07
    spread = float(((t - t.mean()) ** 2).sum())
    pose = solved(line, t, positions, deviation, across / math.sqrt(len(t)), across / math.sqrt(spread))
    plane: NDArray[np.complex128] = line.plane(t)
    pixels = CAMERA.distort(torch.from_numpy(np.stack([plane.real, plane.imag], -1)))
    along = torch.from_numpy(deviation)[None]
    general = solve_pose(pixels[None], torch.from_numpy(positions), CAMERA, along_px=along, across_px=across)[0]
    wanted = general.covariance.numpy()
    sd = np.sqrt(wanted.diagonal())
    assert (np.abs(pose.tip - general.tip.numpy()) < 1e-6 * sd[:3]).all()
    assert (np.abs(pose.direction - general.direction.numpy()) < 1e-6 * sd[3:]).all()
    scale = np.outer(sd, sd)
    np.testing.assert_allclose(pose.covariance / scale, wanted / scale, rtol=0, atol=1e-4)
    assert pose.chi_square == pytest.approx(float(general.chi_square), rel=1e-6)


def test_the_stated_scatter_is_that_of_the_tip():
    """Of 300 poses the scatter is known to 4 %; four times that."""
    line, t, tip, _ = seen(0.5, 20, BANDS)
    middle = Line(complex(line.plane(t.mean())), line.along, line.scale)  # about which offset and slope are independent
    rng = np.random.default_rng(5)
    missed, stated = [], 0.0
    for _ in range(300):
        noise = rng.normal(size=6)
        moved = middle.moved(0.1 * noise[4], 2e-4 * noise[5])
        pose = solved(moved, t - t.mean() + 0.1 * noise[:4], BANDS, slope_sd=2e-4)
        missed.append(pose.tip - tip)
        stated = pose.tip_sd
    scatter = math.sqrt((np.array(missed) ** 2).sum(-1).mean())
    assert scatter == pytest.approx(stated, rel=4 * 0.041)


def test_what_moves_all_places_alike_is_in_the_covariance():
    """Slopes by differences over 0.02 px of some 300: what bends is 1e-4 of them."""
    line, t, *_ = seen(0.5, 20, BANDS)
    ahead, behind = solved(line, t + 0.01, BANDS), solved(line, t - 0.01, BANDS)
    slope = np.concatenate([ahead.tip - behind.tip, ahead.direction - behind.direction]) / 0.02
    alone, shared = solved(line, t, BANDS).covariance, solved(line, t, BANDS, shared_sd=0.3).covariance
    expected = np.outer(slope, slope) * 0.3**2
    np.testing.assert_allclose(shared - alone, expected, rtol=0, atol=1e-3 * np.abs(expected[:3, :3]).min())


def test_a_direction_keeps_its_length_and_says_so():
    line, t, *_ = seen(0.5, 20, BANDS)
    pose = solved(line, t + [0.1, -0.1, 0.05, 0.02], BANDS)
    assert np.linalg.norm(pose.direction) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(pose.covariance, pose.covariance.T, rtol=1e-12, atol=0)
    assert np.abs(pose.covariance[:, 3:] @ pose.direction).max() < 1e-12 * np.abs(pose.covariance).max()


WRONG = {
    "one place": np.zeros(4),
    "nowhere": np.full(4, math.nan),
    "in disorder": np.array([0.0, 300.0, -200.0, -100.0]),
    "endless": np.array([0.0, 1.0, 2.0, math.inf]),
}


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize("kind", WRONG)
def test_what_no_pose_explains_is_refused(kind):
    line, *_ = seen(0.5, 20, BANDS)
    assert pose_on_line(line, WRONG[kind].tolist(), BANDS.tolist(), [0.1] * 4, 0.1, 1e-4) is None


@pytest.mark.parametrize("tilt", [0.0, 20.0, -60.0])
def test_a_rough_pose_is_the_same_without_its_covariance(tilt):
    line, t, *_ = seen(0.52, tilt, SIX)
    places = (t + 0.1 * np.random.default_rng(5).normal(size=len(t))).tolist()
    given = line, places, SIX.tolist(), [0.05] * len(t), 0.1, 1e-4, 0.01
    whole, rough = pose_on_line(*given), pose_on_line(*given, rough=True)
    assert whole is not None and rough is not None and whole.covariance.any() and not rough.covariance.any()
    np.testing.assert_allclose(rough.tip, whole.tip, rtol=0, atol=1e-15)
    np.testing.assert_allclose(rough.direction, whole.direction, rtol=0, atol=1e-15)
    assert rough.chi_square == whole.chi_square
