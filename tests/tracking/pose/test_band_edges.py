"""Positions of band edges from many synthetic frames: what they determine, what not, and how sure it is."""

import math

import pytest
import torch

from holotorch.tracking import THESIS, Camera
from holotorch.tracking.pose.band_edges import fit_band_edges

CAMERA = Camera(
    torch.tensor([[1400.0, 0, 960], [0, 1400, 540], [0, 0, 1]]), torch.tensor([-0.1, 0.02, 0.001, -0.0005, 0])
)
NOMINAL = THESIS.positions
TRUE = NOMINAL + torch.tensor([0.3e-3, -0.2e-3, 0.25e-3, -0.4e-3])
OFFSET = 0.9e-3


def frames(
    count, positions=TRUE, *, resting=False, noise=0.1, spread=1.0, wobble=0.0, seed=0, camera=CAMERA, aside=0.0
):
    """Edges in pixels [F, N, 2] by the definition: on the ring's side that faces the camera."""
    generator = torch.Generator().manual_seed(seed)
    a, b, c, azimuth, tilt = torch.rand(5, count, dtype=torch.float64, generator=generator)
    tip = torch.stack([0.1 * a - 0.1 + aside, 0.1 * b - 0.05, 0.42 + 0.2 * c], -1)
    if resting:
        tip = torch.tensor([-0.06, 0.03, 0.5], dtype=torch.float64).expand(count, 3)
    tip = tip + wobble * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    azimuth, tilt = spread * (azimuth * (6 if resting else 1) - 0.5), spread * (1.2 * tilt - 0.6)
    along = torch.stack([tilt.cos() * azimuth.cos(), tilt.cos() * azimuth.sin(), -tilt.sin()], -1)
    toward = torch.nn.functional.normalize((tip * along).sum(-1, keepdim=True) * along - tip, dim=-1)
    points = tip[:, None] + positions[:, None] * along[:, None] + OFFSET * toward[:, None]
    pixels = camera.project(points)
    return pixels + noise * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)


def given(known):
    """Nominal positions in which the known distances are right."""
    nominal = NOMINAL.clone()
    for entry in known:
        if isinstance(entry, tuple):
            nominal[entry[1]] = nominal[entry[0]] + TRUE[entry[1]] - TRUE[entry[0]]
        else:
            nominal[entry] = TRUE[entry]
    return nominal


def test_edges_count_by_their_pixels_in_any_camera():
    """Chi-square of known errors in pixels, where a pixel is not the same angle in x, in y and from place to place.

    Toward the right border, at 0.5 focal lengths, the distortion draws the image together by 3 * 0.3 * 0.5^2 = 23 %.
    """
    camera = Camera(torch.tensor([[1500.0, 0, 960], [0, 1200, 540], [0, 0, 1]]), torch.tensor([-0.3, 0.05, 0, 0, 0]))
    chi, freedom = 0.0, 0
    for seed in range(6):
        pixels = frames(40, seed=seed, camera=camera, aside=0.18)
        found = fit_band_edges(pixels, given([0, 1, 3]), camera, [0, 1, 3], offset=OFFSET)
        chi, freedom = chi + found.chi_square, freedom + found.freedom
    # A chi-square of n degrees has a deviation sqrt(2 n): four of them.
    assert abs(chi - freedom) < 4 * math.sqrt(2 * freedom)


CASES = [(False, [0, 1, 3]), (False, [0, (0, 1), (0, 3)]), (True, [3]), (True, [(0, 3)])]


@pytest.mark.parametrize(("resting", "known"), CASES)
def test_exact_edges_give_the_exact_positions(resting, known):
    found = fit_band_edges(
        frames(25, resting=resting, noise=0.0), given(known), CAMERA, known, resting_tip=resting, offset=OFFSET
    )
    # Edges exact to 1e-9 px at 3 px/mm or so; the cross-ratio weakens that a few times.
    torch.testing.assert_close(found.positions, TRUE, rtol=0, atol=1e-10)
    assert found.chi_square < 1e-8
    if found.pivot is not None:
        torch.testing.assert_close(found.pivot, found.pivot.new_tensor([-0.06, 0.03, 0.5]), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("resting", "known", "limit"), [(False, [0, 1, 3], 15e-6), (True, [3], 15e-6)])
def test_covariance_is_that_of_repeated_runs(resting, known, limit):
    """24 runs of 40 frames: squared errors over variances, of 1 or 3 positions each, and chi-square."""
    scores, chi, freedom = [], 0.0, 0
    free = [i for i in range(4) if i not in known]
    for seed in range(24):
        pixels = frames(40, resting=resting, seed=seed)
        found = fit_band_edges(pixels, given(known), CAMERA, known, resting_tip=resting, offset=OFFSET)
        missed = (found.positions - TRUE)[free]
        scores.append(float(missed @ torch.linalg.solve(found.covariance[free][:, free], missed)))
        assert found.deviations[free].max() < limit
        chi, freedom = chi + found.chi_square, freedom + found.freedom
    n = len(scores) * len(free)
    # A chi-square of n degrees has a deviation sqrt(2 n): four of them.
    assert abs(sum(scores) - n) < 4 * math.sqrt(2 * n)
    assert abs(chi - freedom) < 4 * math.sqrt(2 * freedom)


def test_stretched_positions_explain_the_same_frames():
    """Why three distances must be known: s / (1 + e s) with other poses leaves residuals of zero."""
    stretched = TRUE / (1 + 0.5 * TRUE)
    nominal = stretched + torch.tensor([0, 0, 5e-4, 0])
    found = fit_band_edges(_on_axis(25), nominal, CAMERA, [0, 1, 3])
    assert found.chi_square < 1e-8
    torch.testing.assert_close(found.positions, stretched, rtol=0, atol=1e-10)


def _on_axis(count):
    generator = torch.Generator().manual_seed(1)
    tip = torch.rand(count, 3, dtype=torch.float64, generator=generator) * 0.1 + torch.tensor([-0.1, -0.05, 0.45])
    along = torch.randn(count, 3, dtype=torch.float64, generator=generator) * 0.3 + torch.tensor([1.0, 0, 0])
    along = torch.nn.functional.normalize(along, dim=-1)
    return CAMERA.project(tip[:, None] + TRUE[:, None] * along[:, None])


@pytest.mark.parametrize("known", [[], [0], [0, 3], [(0, 1), (1, 2), (2, 3)], [0, (0, 3), (1, 2)]])
def test_too_few_distances_are_refused(known):
    """The last: the middle band in the middle of the outer one, where it does not change to first order."""
    with pytest.raises(ValueError, match="three independent distances.*resting_tip"):
        fit_band_edges(frames(20), NOMINAL, CAMERA, known)


def test_resting_tip_needs_one_distance():
    with pytest.raises(ValueError, match="one known distance"):
        fit_band_edges(frames(20, resting=True), NOMINAL, CAMERA, [], resting_tip=True)


@pytest.mark.parametrize(("resting", "known"), [(False, [0, 1, 3]), (True, [3])])
def test_frames_in_one_pose_are_refused(resting, known):
    pixels = frames(40, resting=resting, spread=0.02)
    with pytest.raises(ValueError, match="parallel to itself.*tilt"):
        fit_band_edges(pixels, NOMINAL, CAMERA, known, resting_tip=resting)


def test_frames_too_coarse_are_refused():
    pixels = frames(6, noise=0.0)
    with pytest.raises(ValueError, match="edge 2 to .* mm.*nearer"):
        fit_band_edges(pixels, NOMINAL, CAMERA, [0, 1, 3], along_px=30.0, offset=OFFSET)


def test_tip_that_moved_shows_in_chi_square():
    pixels = frames(60, resting=True, wobble=0.5e-3)  # at 3 px/mm: fifteen deviations across
    found = fit_band_edges(pixels, given([3]), CAMERA, [3], resting_tip=True, offset=OFFSET)
    assert found.chi_square > 10 * found.freedom
    still = fit_band_edges(frames(60, resting=True), given([3]), CAMERA, [3], resting_tip=True, offset=OFFSET)
    assert bool((found.deviations[:3] > 3 * still.deviations[:3]).all())


@pytest.mark.parametrize(
    ("pixels", "positions", "known", "words"),
    [
        (frames(4), NOMINAL, [0, 1, 3], "at least 5 frames"),
        (frames(6) * math.nan, NOMINAL, [0, 1, 3], "finite"),
        (frames(6), NOMINAL.flip(0), [0, 1, 3], "must rise"),
        (frames(6), NOMINAL[:3], [0, 1, 3], r"shape \[4\]"),
        (frames(6), NOMINAL, [0, 1, 4], "edges 0 to 3"),
        (frames(6), NOMINAL, [0, 1, (2, 2)], "different"),
        (frames(6), NOMINAL, [()], r"pairs of different ones, got \(\)"),
        (frames(6), NOMINAL, [0, 1, 2, 3], "none is left"),
        (frames(6)[0], NOMINAL, [0, 1, 3], r"\[F, N, 2\]"),
    ],
)
def test_bad_input_is_named(pixels, positions, known, words):
    with pytest.raises(ValueError, match=words):
        fit_band_edges(pixels, positions, CAMERA, known)
