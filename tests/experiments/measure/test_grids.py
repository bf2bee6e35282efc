"""Rests, grids and sheets: a simulated hand whose tips, errors and mistakes are known."""

import csv
import math
import re

import numpy as np
import pytest
import torch
from simulated_hand import RATE, hand, pose, told, write

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure.grid import Grid, directions, need_all, visit
from holotorch.experiments.measure.rests import Rest, Rests
from holotorch.tracking import Pose, Status

pytestmark = pytest.mark.usefixtures("undrawn")
SPACING = 0.0102
TURN = np.array([[0.8, 0.36, 0.48], [0.6, -0.48, -0.64], [0.0, 0.8, -0.6]])  # right, up and normal of the sheet
PLACE = np.array([-0.02, -0.05, 0.5])


def found(tips, refused=(), **criteria) -> list[Rest]:
    rests = Rests(SPACING / 2, **criteria)
    for i, tip in enumerate(tips):
        rests(i / RATE, Pose.refused(Status.NO_CATHETER, "hidden") if i in refused else pose(tip))
    return rests.completed


def sheet(rows=3, columns=4):
    """Points [n, 3] of a grid in the camera's frame, row by row from the upper left."""
    flat = [(c * SPACING, -r * SPACING, 0.0) for r in range(rows) for c in range(columns)]
    return np.array(flat) @ TURN.T + PLACE


def grid(rows=3, columns=4, reference=5) -> Grid:
    return Grid(rows, columns, SPACING, reference)


def test_each_place_where_the_hand_is_still_is_one_rest():
    points = sheet()
    rests = found(hand(points, 1e-4))
    assert len(rests) == 12 and all(rest.touches == 1 for rest in rests)
    # The mean of 15 or 16 tips, with 0.1 mm along each axis: 0.026 mm; five times that at most.
    assert np.abs(np.array([rest.tip for rest in rests]) - points).max() < 5 * 1e-4 / math.sqrt(15)
    assert all(15 <= rest.frames <= 16 and 0.05e-3 < rest.sd < 0.3e-3 for rest in rests)
    times = [(33 * i / RATE, (33 * i + 23) / RATE) for i in range(12)]
    assert all(a <= rest.start and rest.end <= b + 2 / RATE for rest, (a, b) in zip(rests, times, strict=True))


@pytest.mark.parametrize(
    ("speed", "spread", "number"),
    [(0.02, 0.5e-3, 0), (0.002, 0.5e-3, 1), (0.002, 0.1e-3, 0)],  # m/s; 0.5 s of it have an rms of speed / 2 / sqrt(12)
)
def test_a_slow_hand_does_not_rest(speed, spread, number):
    tips = PLACE + np.arange(75)[:, None] * speed / RATE * np.array([1.0, 0, 0])
    assert len(found(tips[: 60 if number else 75], spread=spread)) == number


def test_refusals_and_single_wrong_poses_do_not_end_a_rest_and_too_few_frames_are_none():
    tips = hand(sheet(1, 2), 1e-4, rest=40)
    tips[20] += [0.0, 0.0, 0.02]
    (first, second) = found(tips, refused=set(range(22, 27)) | set(range(60, 64)))
    assert first.touches == second.touches == 1
    assert abs(first.tip[2] - PLACE[2]) < 1e-4
    assert not found(tips[::6], frames=10)  # 5 frames a second: 7 of them at each point


def test_a_tip_that_the_tracker_knows_less_well_may_spread_more():
    tips = hand(sheet(1, 2), 0.5e-3, rest=40)
    assert not found(tips)
    rests = Rests(SPACING / 2)
    for i, tip in enumerate(tips):
        rests(i / RATE, pose(tip, sd=0.87e-3))
    assert len(rests.completed) == 2


def test_a_point_touched_twice_counts_once_as_it_was_touched_last():
    points = sheet()
    aside, again = points[4] + [0, 0, -0.02], points[4] + [0.4e-3, 0, 0]
    rests = found(hand(np.concatenate([points[:5], [aside], [again], points[5:]])))
    visited = visit(rests, grid())
    # The pause above the point is a rest as well, and no point.
    assert len(rests) == 14 and not visited.missing
    assert any("fits no point" in note for note in visited.notes)
    quick = found(
        np.concatenate([hand(points[:5]), np.linspace(aside, again, 9), hand(np.array([again, *points[5:]]))])
    )
    visited = visit(quick, grid())
    assert visited.rests[4] is not None and visited.rests[4].touches == 2
    assert np.allclose(visited.tips[4], again, atol=1e-9) and "row 2, column 1 was touched 2 times" in visited.notes[0]


@pytest.mark.parametrize("forgotten", [[0], [3], [4], [7], [11], [2, 3], [5, 10]])
def test_forgotten_points_are_named(forgotten):
    points = sheet()
    kept = [i for i in range(12) if i not in forgotten]
    visited = visit(found(hand(points[kept], 1e-4)), grid())
    assert visited.missing == forgotten
    assert np.abs(visited.tips[kept].numpy() - points[kept]).max() < 2e-4
    names = "; ".join(f"row {i // 4 + 1}, column {i % 4 + 1}" for i in forgotten)
    with pytest.raises(ConfigError, match=f"found rests at {len(kept)} of 12 points, missing: {names}; record again"):
        need_all(visited, grid())


@pytest.mark.parametrize("order", [[*range(4), 7, 6, 5, 4, *range(8, 12)], [*range(11, -1, -2), *range(10, -1, -2)]])
def test_another_order_is_refused(order):
    with pytest.raises(ConfigError, match="do not lie on a grid of 3 rows x 4 columns.*row by row"):
        visit(found(hand(sheet()[order])), grid())


def test_no_rest_at_all_is_said():
    with pytest.raises(ConfigError, match="no rest found for the 12 points: hold the tip still"):
        visit([], grid())


def test_accuracy_of_a_grid_is_that_of_the_formulas(tmp_path, capsys):
    """Errors of the tips are drawn, and Acc and the rigid fit are computed anew with loops and numpy."""
    points = sheet()
    off = 0.4e-3 * np.random.default_rng(3).standard_normal((12, 3))
    path = write(tmp_path / "poses.csv", hand(points + off, rest=30, way=10), refused={70, 71, 200})
    words = ["--rows", "3", "--columns", "4", "--reference", "2,3", "--out", str(tmp_path / "out")]
    assert main(["measure", "grid2d", str(path), *words]) == 0
    tips, m, n = (points + off).reshape(3, 4, 3), 1, 2
    errors = [
        abs(math.hypot(m - i, n - j) * SPACING - math.dist(tips[i, j], tips[m, n]))
        for i in range(3)
        for j in range(4)
        if (i, j) != (m, n)
    ]
    summary = told(tmp_path / "out")
    (face,) = summary["faces"]
    assert face["acc_mm"] == pytest.approx(1e3 * sum(errors) / 11, abs=1e-9) and face["points"] == 12
    a, b = (points + off) - (points + off).mean(0), points - points.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    rest = 1e3 * np.linalg.norm(a @ turn.T - b, axis=1)
    assert face["median_mm"] == pytest.approx(np.median(rest), abs=1e-9)
    assert face["p95_mm"] == pytest.approx(np.percentile(rest, 95), abs=1e-9)
    assert face["largest_mm"] == pytest.approx(rest.max(), abs=1e-9)
    assert "in_plane_mm" not in face
    page = (tmp_path / "out" / "report.html").read_text()
    assert "0.58 mm) is not here" in page and "blind to an error that is the same" in page and "data:image/png" in page
    with open(tmp_path / "out" / "points.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["row"], row["column"]) for row in rows[3:6]] == [("1", "4"), ("2", "1"), ("2", "2")]
    assert float(rows[6]["distance_error_mm"]) == 0
    assert max(abs(float(row["rigid_error_mm"]) - x) for row, x in zip(rows, rest, strict=True)) < 1e-9


def test_missing_points_end_a_file_unless_they_may(tmp_path, capsys):
    points = sheet()
    kept = [i for i in range(12) if i != 6]
    path = write(tmp_path / "poses.csv", hand(points[kept], 1e-5))
    words = ["measure", "grid2d", str(path), "--rows", "3", "--columns", "4", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "found rests at 11 of 12 points, missing: row 2, column 3; record again" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--partial"]) == 2
    assert "reference row 2, column 3" in capsys.readouterr().err
    assert main([*words, "--partial", "--reference", "1,1"]) == 0
    (face,) = told(tmp_path / "out")["faces"]
    assert face["points"] == 11 and face["missing"] == ["row 2, column 3"] and face["acc_mm"] < 0.02


def test_several_faces_have_their_numbers_and_the_mean(tmp_path):
    flat = np.array([(c * 0.01, -r * 0.01, 0.0) for r in range(8) for c in range(8)]) @ TURN.T + PLACE
    names = []
    for i, scale in enumerate((1.0, 1.01)):
        grown = flat[36] + scale * (flat - flat[36])
        names.append(str(write(tmp_path / f"{i}.csv", hand(grown, rest=18, way=6))))
    assert main(["measure", "grid3d", *names, "--out", str(tmp_path / "out")]) == 0
    summary = told(tmp_path / "out")
    apart = [math.hypot(i - 4, j - 4) * 10 for i in range(8) for j in range(8)]  # mm
    first, second = summary["faces"]
    assert first["acc_mm"] == pytest.approx(0, abs=1e-9)
    assert second["acc_mm"] == pytest.approx(0.01 * sum(apart) / 63, abs=1e-9)
    assert summary["acc_mm"] == pytest.approx(second["acc_mm"] / 2) and summary["reference"] == "row 5, column 5"
    assert "0.49, 0.93, 1.12; mean 0.85" in (tmp_path / "out" / "report.html").read_text()


def test_directions_of_the_sheet_are_those_of_its_board_however_it_is_turned():
    points = torch.from_numpy(sheet())
    board = TURN @ np.diag([1.0, -1.0, -1.0])  # right, down, away
    for quarter in range(4):
        c, s = round(math.cos(quarter * math.pi / 2)), round(math.sin(quarter * math.pi / 2))
        turned = board @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        right, up = directions(points, grid(), torch.from_numpy(turned))
        assert np.allclose(right, TURN[:, 0]) and np.allclose(up, TURN[:, 1])


def test_the_sheet_is_the_grid_and_a_board_in_true_millimetres(tmp_path, capsys):
    path = tmp_path / "grid.svg"
    assert main(["measure", "grid2d", "--print", str(path)]) == 0
    text = path.read_text()
    assert 'width="297mm" height="210mm" viewBox="0 0 297 210"' in text
    lines = re.findall(r'<line x1="([\d.]+)" y1="([\d.]+)" x2="([\d.]+)" y2="([\d.]+)"', text)
    level = [tuple(map(float, line)) for line in lines if line[1] == line[3]]
    assert len(lines) == 18 and len(level) == 9
    assert all(x2 - x1 == pytest.approx(81.6) for x1, _, x2, _ in level)
    assert np.allclose(np.diff([y for _, y, _, _ in level]), 10.2)
    squares = re.findall(r'<rect x="([\d.]+)" y="([\d.]+)" width="10" height="10"', text)
    assert len(squares) == 24 and min(float(x) for x, _ in squares) > 15 + 81.6 + 10
    bar = re.search(r'id="bar" d="M15 [\d.]+v4m0 -2h([\d.]+)', text)
    assert bar and float(bar[1]) == 100
    assert main(["measure", "grid2d", "--print", str(path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["measure", "grid2d", "--print", str(tmp_path / "b.svg"), "--spacing", "25mm"]) == 2
    assert "A4 has 297 x 210 mm: choose fewer points" in capsys.readouterr().err
