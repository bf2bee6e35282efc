"""Intrinsics from one to three views: against a slow twin, on synthetic cameras, on photographs, and where they end."""

import math

import cv2
import numpy as np
import paths
import pytest
import scipy.stats
import torch
from oracles import boards as oracle

from holotorch.tracking.camera.boards import Charuco, Chessboard, View, find_board
from holotorch.tracking.camera.calibration import PARAMETERS, calibrate
from holotorch.tracking.camera.few_views import estimate

SHARED = paths.SHARED / "calibration"
SIZE = (480, 640)
GRID = oracle.grid()
USUAL = (500.0, 500, 319.5, 239.5, -0.1, 0, 0, 0, 0)


def taken(count, values=USUAL, tilt=0.7, noise=0.1, seed=0, bow=0.0, distance=1.0):
    """Views of a chessboard with its middle near the picture's, all corners in it."""
    fx, fy, cx, cy, *distortion = values
    camera = oracle.Camera([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], distortion, (2, 2))
    generator, views = np.random.default_rng(seed + 100), []
    for turned, at in oracle.handheld(200, (0.1, 0.0625), distance * fx / 500, tilt, seed):
        points = oracle.bent(GRID, *generator.normal(0, 1, 3) * bow)
        pixels = camera.project(points @ oracle.rotation(turned).T + at) + generator.normal(0, noise, (len(GRID), 2))
        if ((pixels > 0) & (pixels < np.array(SIZE[::-1]) - 1)).all():
            views.append(View(torch.from_numpy(GRID), torch.from_numpy(pixels), f"view {len(views)}"))
        if len(views) == count:
            return views
    raise AssertionError("no such views")


def deviations(found):
    return np.array([found.deviations[name] for name in PARAMETERS])


def values(found):
    matrix = found.camera.matrix.numpy()
    return np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], found.camera.distortion.numpy()])


@pytest.mark.parametrize("count", [1, 2, 3])
def test_slow_twin_finds_the_same_camera(count):
    views = taken(count, noise=0.2)
    found = estimate(views, SIZE)
    pairs = [(view.points.numpy(), view.pixels.numpy()) for view in views]
    most, sd = oracle.most_probable(pairs, SIZE, USUAL, 3 * 0.2)
    # The scatter is estimated, from 98 coordinates left of one view, to 1 / sqrt(2 * 98) = 7 %, and the deviations with
    # it; the optimum moves by twice that share of how far the prior pulls it, which is one deviation or less.
    assert (np.abs(found.values - most) < 0.15 * sd).all()
    np.testing.assert_allclose(found.deviations, sd, rtol=0.25)
    assert (found.formal < found.deviations).all()


def test_deviations_hold_for_cameras_and_bent_boards_of_all_kinds():
    """Ordinary cameras drawn at random, boards bent by 0.2 % of their size differently in each view (synthetic)."""
    generator, scores, relative = np.random.default_rng(0), [], []
    for seed in range(45):
        f, ratio = 640 * math.exp(generator.normal(math.log(0.9), 0.3)), math.exp(generator.normal(0, 0.005))
        middle = np.array([319.5, 239.5]) + generator.normal(0, 25, 2)
        distortion = generator.normal(0, 1, 5) * [0.15, 0.2, 0.002, 0.002, 0.2]
        truth = np.array([f * ratio, f, *middle, *distortion])
        found = estimate(taken(1 + seed % 3, truth, noise=0.15, seed=seed, bow=0.002), SIZE)
        scores.append((found.values - truth) / found.deviations)
        relative.append(found.deviations[0] / found.values[0])
    squares = np.square(scores).reshape(15, 3, 9).mean(0)
    # Of fifteen and nine that hang together; corners that err independently make the stated deviations cautious.
    assert (squares.mean(1) < 1.5).all() and (squares[:, 0] < 2.0).all() and squares.mean() > 0.1
    assert (np.abs(scores) < 4).all()
    one, two, three = np.median(np.reshape(relative, (15, 3)), 0)
    assert 0.2 > one > 2 * two > 2 * three


def test_as_the_board_tilts_the_focal_length_is_told():
    """From the front hardly more than the prior, a half; the more tilt the better; beyond 20 % it is refused."""
    relative = []
    for tilt in (0.0, 0.1, 0.3, 0.6):
        at = oracle.around((0.1, 0.0625), (tilt, 0.8 * tilt, 0), (0, 0, 0.3))
        camera = oracle.Camera([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], [0, 0, 0, 0, 0], (2, 2))
        pixels = camera.project(GRID @ oracle.rotation((tilt, 0.8 * tilt, 0)).T + at)
        views = [
            View(torch.from_numpy(GRID), torch.from_numpy(pixels + np.random.default_rng(1).normal(0, 0.1, (54, 2))))
        ]
        found = estimate(views, SIZE)
        relative.append(found.deviations[0] / found.values[0])
        assert abs(math.log(found.values[0] / 500)) < 2 * relative[-1]
        if relative[-1] > 0.2:
            with pytest.raises(ValueError, match="determine the focal length only to .* tilt the board"):
                calibrate(views, SIZE)
        else:
            assert calibrate(views, SIZE).camera.matrix[0, 0] == pytest.approx(found.values[0])
    assert 0.3 < relative[0] < 0.5 and relative == sorted(relative, reverse=True)
    assert relative[1] > 0.2 > relative[3]


def test_a_telephoto_lens_at_a_distance_is_refused():
    with pytest.raises(ValueError, match="determine the focal length only"):
        calibrate(taken(1, (2500.0, 2500, 319.5, 239.5, 0, 0, 0, 0, 0), distance=2.0), SIZE)


@pytest.mark.parametrize(
    ("strange", "count", "word"),
    [
        ((500.0, 500, 160, 239.5, 0, 0, 0, 0, 0), 2, "cx"),  # cropped
        ((525.0, 500, 319.5, 239.5, 0, 0, 0, 0, 0), 3, "fx / fy"),  # a stretched picture, or a board of no squares
    ],
)
def test_cameras_that_are_not_ordinary_are_named(strange, count, word):
    with pytest.raises(ValueError, match=f"contradict: {word} by .* deviations"):
        calibrate(taken(count, strange, noise=0.05), SIZE)


def test_corners_without_noise_or_on_one_line_or_by_chance():
    found = estimate(taken(2, noise=0.0), SIZE)
    assert (np.abs(found.values - USUAL) < found.deviations).all() and (found.errors < 0.01).all()
    steps = np.arange(12.0)
    line = View(
        torch.from_numpy(np.stack([0.02 * steps, 0 * steps, 0 * steps], -1)),
        torch.from_numpy(np.stack([100 + 30 * steps, 200 + 5 * steps], -1)),
    )
    point = View(torch.zeros(9, 3), torch.full((9, 2), 50.0))
    chance = View(torch.from_numpy(GRID), torch.from_numpy(np.random.default_rng(0).uniform(0, 400, (54, 2))))
    for view in (line, point, chance):
        with pytest.raises(ValueError, match="determine the focal length only|do not determine"):
            calibrate([view], SIZE)


def test_the_answer_says_that_it_is_a_start():
    one, four = calibrate(taken(1, tilt=1.0, seed=4), SIZE), calibrate(taken(4), SIZE)
    assert any("too inaccurate for measurements" in text for text in one.warnings) and one.coverage.between == 0
    assert not any("differ by" in text for text in one.warnings)
    assert not any("too inaccurate for measurements" in text for text in four.warnings)


def photographs(pattern, board):
    files = sorted(SHARED.glob(pattern))
    if not files:
        pytest.skip("the shared photographs are not beside this checkout; synthetic views cover the same path")
    return [
        find_board(torch.from_numpy(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)), board, path.name) for path in files
    ]


@pytest.mark.parametrize(
    ("pattern", "board"),
    [("opencv_left??.jpg", Chessboard(9, 6, 0.025)), ("bard_calib??.png", Chessboard(14, 10, 0.006))],
)
def test_each_photograph_agrees_with_all_of_them(pattern, board):
    """Focal lengths of one, two and three photographs, in deviations of theirs and of the whole set's."""
    views = photographs(pattern, board)
    whole = calibrate(views, SIZE)
    for count in (1, 2, 3):
        scores = []
        for first in range(len(views)):
            found = estimate([views[(first + 3 * i) % len(views)] for i in range(count)], SIZE)
            both = math.hypot(found.deviations[0], whole.deviations["fx"])
            scores.append((found.values[0] - float(whole.camera.matrix[0, 0])) / both)
        assert np.square(scores).sum() < scipy.stats.chi2.ppf(0.999, len(scores))
        assert np.square(scores).mean() > 0.05  # not by stating anything


def test_the_charuco_photograph_gives_its_reference_within_the_stated_deviations():
    """The reference is of four photographs, three of which are not here: one knows the focal length to 15 %."""
    found = calibrate(photographs("charuco_choriginal.jpg", Charuco(5, 7, 0.04, 0.02, "DICT_6X6_250")), SIZE)
    storage = cv2.FileStorage(str(SHARED / "charuco_camera.yml"), cv2.FILE_STORAGE_READ)
    matrix, distortion = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    reference = np.array([*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *distortion.reshape(-1)])
    assert (np.abs(values(found) - reference) < 2 * deviations(found)).all()
    assert deviations(found)[0] < 0.2 * reference[0] and found.rms_px < 0.25
