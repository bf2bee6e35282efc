"""The catheter in photographs: what is measured of their pixels, and what is changed in them."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from holotorch.experiments.tracking_benchmark.real_pixels import real_pixels, shared_photographs
from holotorch.tracking import CatheterTracker, ChannelOrder
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.simulation.photographs import Photograph, drawn_photograph, measure, rendered

board = cache(drawn_photograph)  # drawing it takes longer than what is done with it; nobody changes it
SHARED = Path(__file__).parents[4] / "shared" / "data" / "calibration"


@pytest.mark.parametrize(("blur", "shot", "read"), [(0.6, 1e-4, 6e-3), (0.8, 6e-4, 3e-3), (1.3, 1e-3, 2e-3)])
def test_blur_noise_and_white_of_a_drawn_board(blur, shot, read):
    """Some 500 smooth patches of 58 degrees of freedom leave the variance at white to 1 %, and the noise of rounding a
    twelfth of a squared level; some 90 edges leave the blur to 1 %, and its profile of 4 samples a pixel to 2 %."""
    photograph = drawn_photograph(blur, shot, read)
    pixels = measure(photograph)
    assert not photograph.grey
    assert pixels.blur_px == pytest.approx(blur, rel=0.05)
    assert pixels.white == pytest.approx((0.7, 0.665, 0.595), rel=0.02)
    level = float(photograph.camera.linear(torch.tensor(205.0)) - photograph.camera.linear(torch.tensor(204.0)))
    expected = shot * 0.6 + read**2 + level**2 / 12
    assert pixels.shot_noise * 0.6 + pixels.read_noise**2 == pytest.approx(expected, rel=0.1)


def test_only_the_pixels_of_the_catheter_change():
    photograph = board()
    case = rendered(photograph, measure(photograph), seed=1)
    assert case.tip is not None and case.direction is not None
    frame = case.frame()
    assert torch.equal(frame, case.frame())
    along = torch.linspace(0, THESIS.length, 400, dtype=torch.float64)[:, None]
    axis = photograph.camera.project(case.tip + along * case.direction)
    y, x = torch.meshgrid(torch.arange(480.0), torch.arange(640.0), indexing="ij")
    away = torch.from_numpy(KDTree(axis).query(torch.stack([x, y], -1).double())[0])
    changed = (frame != photograph.frame).any(0)
    assert not changed[away > 15].any() and changed[away < 1].float().mean() > 0.9


def test_a_grey_photograph_without_a_board_is_measured_too():
    drawn = board()
    grey = Photograph("grey", drawn.frame[:1].expand(3, -1, -1), drawn.camera, None)
    pixels = measure(grey)
    assert grey.grey and math.isnan(pixels.blur_px) and len(set(pixels.white)) == 1
    assert 0.6 < pixels.white[0] < 0.8


def test_a_catheter_before_a_fine_board_is_tracked():
    """Squares of 25 px behind a tube of about five; the seeds are none of the chart's."""
    drawn = board()
    y, x = torch.meshgrid(torch.arange(480), torch.arange(640), indexing="ij")
    squares = torch.where((y // 25 + x // 25) % 2 == 0, 90, 170).to(torch.uint8).expand(3, -1, -1).contiguous()
    photograph, pixels = replace(drawn, frame=squares, board=None), measure(drawn)
    cases = [rendered(photograph, pixels, seed) for seed in range(20, 32)]
    tracker = CatheterTracker(photograph.camera, THESIS, channels=ChannelOrder.RGB)
    pairs = [(tracker(case.frame()[None])[0], case) for case in cases]
    errors = np.array([float((pose.tip - case.tip).norm()) for pose, case in pairs if pose.answered])
    stated = np.array([float(pose.tip_sd) for pose, _ in pairs if pose.answered])
    assert len(errors) >= 6 and np.median(errors) < 1e-3
    assert (errors < 3.4 * stated).all()  # errors in depth, which dominate, pass 3.4 deviations once in 1500


def test_rows_sheet_and_lines():
    rows, sheet, lines = real_pixels([board()], 2)
    assert {row["method"] for row in rows} == {"thesis, OpenCV", "ours, cold", "ours, cold, photometric fit"}
    for row in rows:
        assert row["right"] + row["wrong"] + row["refused"] == row["frames"] == 2 and row["wrong"] == 0
        assert row["bare"] == "refused" and (row["refusals"] != "") == (row["refused"] > 0)
    assert sheet.startswith(b"\x89PNG")
    assert len(lines) == 3 and all("in real photographs" in line for line in lines)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the calibration photographs of shared/data, which are not here")
def test_shared_photographs_come_with_their_cameras():
    photographs = shared_photographs(SHARED)
    assert len(photographs) == 22 and sum(photograph.grey for photograph in photographs) == 13
    assert all(photograph.board is not None for photograph in photographs)
    focal = {round(float(photograph.camera.matrix[0, 0])) for photograph in photographs}
    assert focal == {609, 536, 453}
    compressed = next(photograph for photograph in photographs if photograph.encoded)
    case = rendered(compressed, measure(compressed), 0)
    assert case.frame().shape == compressed.frame.shape
