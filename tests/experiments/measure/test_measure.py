"""The command ``measure`` for a catheter at rest, for latency, for frames and a live camera, and its mistakes."""

import csv
import json
import math
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from simulated_hand import RATE, hand, pose, told, write
from stand_in import SIZE, grey, pictures

from holotorch.cli import main
from holotorch.experiments.measure import run as measure_run
from holotorch.experiments.measure.source import Source, open_source
from holotorch.io.video import Frame, Frames
from holotorch.tracking import Camera

pytestmark = pytest.mark.usefixtures("tiny")


def test_a_catheter_at_rest(tmp_path, capsys):
    """For white noise, S_RMS is sqrt(2) times sd; a drift of 2 mm raises sd alone, and is said."""
    rng = np.random.default_rng(1)
    noise = 0.05e-3 * rng.standard_normal((400, 3))
    path = write(tmp_path / "rest.csv", np.array([0, 0, 0.5]) + noise, refused={7, 8, 100})
    assert main(["measure", "still", str(path), "--out", str(tmp_path / "a")]) == 0
    kept = [i for i in range(399) if not {i, i + 1} & {7, 8, 100}]
    change = [float(((noise[i + 1] - noise[i]) ** 2).sum()) for i in kept]
    summary = told(tmp_path / "a")
    assert summary["s_rms_mm"] == pytest.approx(1e3 * math.sqrt(sum(change) / len(change)), abs=1e-9)
    assert summary["differences"] == len(kept) and summary["answered"] == 397 and summary["notes"] == []
    assert "(dissertation 0.33)" in (said := capsys.readouterr().out) and "that moves" not in said
    drift = np.linspace(0, 2e-3, 400)[:, None] * np.array([1.0, 0, 0])
    path = write(tmp_path / "drift.csv", np.array([0, 0, 0.5]) + noise + drift)
    assert main(["measure", "still", str(path), "--out", str(tmp_path / "b")]) == 0
    moved = told(tmp_path / "b")
    assert moved["s_rms_mm"] == pytest.approx(summary["s_rms_mm"], rel=0.05) and moved["sd_mm"] > 0.5
    assert "was the catheter at rest?" in moved["notes"][0]
    assert "; a catheter that moves has no stability: see the Note" in capsys.readouterr().out


def motion(seconds):
    """A tip at rest for a second, which then moves without a rhythm."""
    t = np.clip(seconds - 1, 0, None)
    x = 0.03 * np.sin(2.1 * t) + 0.02 * np.sin(5.3 * t + 0.4 * t**1.3)
    return np.stack([x, 0.02 * np.sin(3.7 * t), 0.5 + 0.01 * np.sin(1.3 * t)], -1)


def log(path: Path, times, tips) -> Path:
    with open(path, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time_s", "x_m", "y_m", "z_m"])
        writer.writerows((t, *tip) for t, tip in zip(times, tips, strict=True))
    return path


def test_the_latency_is_the_delay_that_was_simulated(tmp_path, capsys):
    lag, times = 0.0873, np.arange(360) / RATE
    noise = 0.1e-3 * np.random.default_rng(2).standard_normal((360, 3))
    path = write(tmp_path / "poses.csv", motion(times - lag) + noise, refused={50, 51})
    vive = np.arange(1100) / 90
    turned = motion(vive)[:, [1, 2, 0]] * [1, -1, -1] + [0.3, 1.2, -0.4]  # its own frame
    reference = log(tmp_path / "vive.csv", vive, turned)
    words = ["measure", "latency", str(path), "--reference", str(reference), "--out", str(tmp_path / "out")]
    assert main(words) == 0
    summary = told(tmp_path / "out")
    # Half a millisecond: interpolation of frames 33 ms apart, and the stated deviation.
    assert summary["lag_ms"] == pytest.approx(1e3 * lag, abs=0.5 + 3 * summary["sd_ms"])
    assert summary["sd_ms"] < 1 and summary["correlation"] > 0.999
    assert "95.01" in (tmp_path / "out" / "report.html").read_text()
    with open(tmp_path / "out" / "curves.csv", newline="") as stream:
        assert {row["curve"] for row in csv.DictReader(stream)} == {"tracker", "reference"}


def test_the_time_of_the_tracker_is_added_to_the_lag(tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    write(folder / "poses.csv", motion(np.arange(360) / RATE))
    stages = [{"stage": "colour", "milliseconds": 3.0, "percent": 100.0}]
    (folder / "summary.json").write_text(json.dumps({"milliseconds": {"median": 8.5}, "stages": stages}))
    reference = log(tmp_path / "vive.csv", np.arange(360) / RATE, motion(np.arange(360) / RATE))
    assert main(["measure", "latency", str(folder), "--reference", str(reference), "--out", str(tmp_path / "o")]) == 0
    summary = told(tmp_path / "o")
    assert summary["tracker_ms"] == 8.5 and summary["total_ms"] == pytest.approx(8.5, abs=0.01)
    assert "colour" in (tmp_path / "o" / "report.html").read_text()


def test_clocks_that_differ_are_said(tmp_path, capsys):
    path = write(tmp_path / "poses.csv", motion(np.arange(360) / RATE))
    reference = log(tmp_path / "vive.csv", 1.7e9 + np.arange(360) / RATE, motion(np.arange(360) / RATE))
    assert main(["measure", "latency", str(path), "--reference", str(reference), "--out", str(tmp_path / "o")]) == 2
    error = capsys.readouterr().err
    assert "lasts from 0.000 to 11.967 s" in error and "1700000000.000" in error and "have one clock" in error
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["walk", "poses.csv"], "argument PROTOCOL: protocol: expected 'still', 'grid2d', 'grid3d'"),
        (["still"], "argument SOURCE: source: expected at least 1 entry, got 0"),
        (["still", "a.csv", "b.csv"], "expected one source; several are the faces of grid3d, got 2"),
        (["still", "nowhere.mp4"], "no such video, folder or camera: nowhere.mp4"),
        (["still", "nowhere.csv"], "nowhere.csv: No such file"),
        (["latency", "poses.csv"], "reference_log: the protocol latency needs the reference tracker's log"),
        (["latency", "poses.csv", "--reference", "none.csv"], "none.csv: cannot read the reference tracker's log"),
        (["latency", "poses.csv", "--reference", "poses.csv"], "expected the columns time_s, x_m, y_m, z_m, got frame"),
        (["latency", "synthetic", "--reference", "ok.csv"], "simulated poses are for still, grid2d and grid3d"),
        (["grid2d", "poses.csv", "--reference", "ref.csv"], "expected a point ROW,COLUMN, such as 5,5"),
        (["grid2d", "poses.csv", "--reference", "10,1"], "expected a point of 9 rows and 9 columns, got row 10"),
        (["grid2d", "poses.csv", "--rows", "1"], "argument --rows: grid.rows: expected greater than or equal to 2"),
        (["grid2d", "poses.csv"], "no rest found for the 81 points"),
        (["still", "poses.csv", "--rows", "5"], "grid: it belongs to the protocol grid2d or grid3d, got still"),
        (["still", "poses.csv", "--partial"], "grid: it belongs to the protocol grid2d or grid3d, got still"),
        (["grid2d", "poses.csv", "--delay", "50"], "delay: it belongs to the protocol prediction, got grid2d"),
        (["still", "poses.csv", "--resting"], "resting: it belongs to the protocol edges, got still"),
        (["still", "--print", "a.svg"], "--print writes the sheet of grid2d"),
        (["still", "pictures"], "no camera is given: say which with --camera"),
    ],
)
def test_mistakes_are_said(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "poses.csv", motion(1.5 + np.arange(40) / RATE))
    log(tmp_path / "ok.csv", [0.0, 1.0], [[0, 0, 0], [0, 0, 1]])
    pictures(tmp_path / "pictures", [3])
    assert main(["measure", *words]) == 2
    out, error = capsys.readouterr()
    assert message in error and "Traceback" not in out + error
    assert not [path for path in Path("runs").glob("*/*") if path.name == "summary.json"]


def test_frames_are_tracked_and_their_poses_kept(tmp_path, tracker, capsys):
    files = [word for name in ("camera", "catheter") for word in (f"--{name}", str(tmp_path / f"{name}.yaml"))]
    source = str(pictures(tmp_path / "in", [30, 31, 0, 30, 31, 30]))
    assert main(["measure", "still", source, *files, "--rate", "20", "--out", str(tmp_path / "out")]) == 0
    summary = told(tmp_path / "out")
    assert summary["s_rms_mm"] == pytest.approx(1 / 3) and summary["differences"] == 3 and summary["frames"] == 6
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("camera.yaml", "catheter.yaml", "config.yaml", "env.json", "images", "poses.csv", "report.html"),
        *("summary.json", "tips.csv"),
    }
    assert main(["measure", "still", str(tmp_path / "out"), "--out", str(tmp_path / "again")]) == 0
    assert told(tmp_path / "again")["s_rms_mm"] == summary["s_rms_mm"]
    assert main(["measure", "grid2d", source, *files, "--out", str(tmp_path / "bad")]) == 2
    error = capsys.readouterr().err
    assert (
        "no rest found" in error and f"the poses are kept, to be measured again without tracking: {tmp_path}" in error
    )
    assert (tmp_path / "bad" / "poses.csv").is_file() and not (tmp_path / "bad" / "summary.json").exists()


def camera(monkeypatch, tmp_path, tips, press=None):
    """A live camera, whose frames the tracker answers with the given tips."""
    inputs = open_source(measure_run_settings(tmp_path), str(pictures(tmp_path / "in", [9]))).inputs
    assert inputs is not None
    each = iter(tips)

    def frames():
        for i in range(len(tips)):
            if i == press:
                signal.raise_signal(signal.SIGINT)
            yield Frame(i / RATE, grey(9))

    made = Frames("camera 0", SIZE, None, RATE, frames(), [], live=True)
    live = inputs._replace(frames=made, tracker=lambda *_: [pose(next(each))])
    monkeypatch.setattr(measure_run, "open_source", lambda *_: Source("camera 0", live))


def measure_run_settings(tmp_path):
    from holotorch.experiments.measure.config import MeasureSettings

    files = {name: str(tmp_path / f"{name}.yaml") for name in ("camera", "catheter")}
    return MeasureSettings.model_validate({"experiment": "measure", "protocol": "still", "source": "0", **files})


GRID = ["--rows", "3", "--columns", "2", "--spacing", "10mm"]


def visits(order):
    flat = np.array([(c * 0.01, r * 0.01, 0.5) for r in range(3) for c in range(2)])
    return hand(flat[order], 1e-5)


def test_a_live_camera_guides_the_hand_and_ends_with_the_last_point(tmp_path, tracker, monkeypatch, capsys):
    camera(monkeypatch, tmp_path, np.concatenate([visits(range(6)), visits([0, 1])]))
    assert main(["measure", "grid3d", "0", *GRID, "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert out.count("\a") == 6
    said = [line.strip("\a") for line in out.splitlines() if "hold still" in line]
    assert said[0] == "point 1 of 6: row 1, column 1; hold still"
    assert said[-1] == "point 6 of 6: row 3, column 2; hold still" and len(said) == 6
    summary = told(tmp_path / "out")
    assert summary["acc_mm"] < 0.02 and summary["frames"] < 6 * 33


def test_an_interrupted_live_grid_keeps_what_it_has(tmp_path, tracker, monkeypatch, capsys):
    camera(monkeypatch, tmp_path, visits(range(6)), press=4 * 33)
    assert main(["measure", "grid3d", "0", *GRID, "--reference", "1,1", "--out", str(tmp_path / "out")]) == 0
    (face,) = told(tmp_path / "out")["faces"]
    assert face["points"] == 4 and face["missing"] == ["row 3, column 1", "row 3, column 2"]
    assert len((tmp_path / "out" / "poses.csv").read_text().splitlines()) == 4 * 33 + 1


def test_an_interrupted_file_is_measured_anew(tmp_path, monkeypatch, capsys):
    path = write(tmp_path / "poses.csv", np.array([0, 0, 0.5]) + np.zeros((50, 3)))
    take = measure_run.Track.take

    def pressed(self, item):
        take(self, item)
        if item.number == 10:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(measure_run.Track, "take", pressed)
        assert main(["measure", "still", str(path), "--out", str(tmp_path / "out")]) == 130
    assert "holotorch resume" in capsys.readouterr().err
    assert main(["resume", str(tmp_path / "out")]) == 0
    assert told(tmp_path / "out")["frames"] == 50


def test_a_sheet_seen_in_the_first_frames_gives_the_errors_in_its_plane(tmp_path, tracker, monkeypatch):
    """A board is drawn through the camera at a known tilt; the tips lie in its plane with known errors."""
    turn = np.array([[1, 0, 0], [0, math.cos(0.7), -math.sin(0.7)], [0, math.sin(0.7), math.cos(0.7)]])  # right, down
    lens = Camera(torch.tensor([[900.0, 0, 480], [0, 900, 270], [0, 0, 1]]), torch.zeros(5))
    y, x = np.mgrid[0:540, 0:960].astype(float)
    rays = np.stack([(x - 480) / 900, (y - 270) / 900, np.ones_like(x)], -1) @ turn  # in the axes of the board
    place = np.array([0.02, -0.03, 0.4]) @ turn
    flat = rays[..., :2] * (place[2] / rays[..., 2:]) - place[:2]
    cells = np.floor(flat / 0.010)
    inside = (cells >= 0).all(-1) & (cells < [8, 6]).all(-1)
    board = np.where(inside & (cells.sum(-1) % 2 == 0), 20, 235).astype(np.uint8)
    shown = torch.from_numpy(cv2.GaussianBlur(board, (0, 0), 0.8)).expand(3, 540, 960).contiguous()
    rng = np.random.default_rng(5)
    steps = np.array([(c * 0.01, r * 0.01, 0.0) for r in range(3) for c in range(4)])
    off = 0.5e-3 * rng.standard_normal((12, 3))
    tips = hand((steps + off) @ turn.T + [-0.03, -0.03, 0.4])
    inputs = open_source(measure_run_settings(tmp_path), str(pictures(tmp_path / "in", [9]))).inputs
    assert inputs is not None
    each = iter(tips)
    frames = (Frame(i / RATE, shown if i < 2 else torch.zeros_like(shown)) for i in range(len(tips)))
    source = inputs._replace(
        frames=Frames("film", (540, 960), len(tips), RATE, frames, []),
        camera=lens,
        tracker=lambda *_: [pose(next(each))],
    )
    monkeypatch.setattr(measure_run, "open_source", lambda *_: Source("film", source))
    words = ["--rows", "3", "--columns", "4", "--spacing", "10mm", "--reference", "2,2", "--out", str(tmp_path / "out")]
    assert main(["measure", "grid2d", "film", *words]) == 0
    (face,) = told(tmp_path / "out")["faces"]
    apart = 1e3 * np.delete(off - off[5], 5, 0)
    # Corners to 0.05 px of 180 px turn the directions by 0.02 degrees at most: 0.01 mm over the 30 mm of the grid.
    assert face["in_plane_mm"] == pytest.approx(np.linalg.norm(apart[:, :2], axis=1).mean(), abs=0.02)
    assert face["in_space_mm"] == pytest.approx(np.linalg.norm(apart, axis=1).mean(), abs=0.05)
    assert "dissertation" in (tmp_path / "out" / "report.html").read_text()


def test_prediction_of_a_recorded_motion(tmp_path, capsys):
    times = np.arange(400) / RATE
    path = write(tmp_path / "poses.csv", motion(times), refused={100, 101})
    words = ["measure", "prediction", str(path), "--delay", "100", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    summary = told(tmp_path / "out")
    none, constant, filtered = summary["methods"]
    # 100 ms are three frames: the tip three lines further on, wherever both have a pose.
    tips = motion(times)
    pairs = [(i, i + 3) for i in range(397) if not {i, i + 3} & {100, 101}]
    late = [1e3 * math.dist(tips[i], tips[j]) for i, j in pairs]
    assert summary["compared"] == pytest.approx(len(late), abs=3) and summary["delay_ms"] == 100
    assert none["rms_mm"] == pytest.approx(math.sqrt(sum(x * x for x in late) / len(late)), rel=0.01)
    assert constant["rms_mm"] < none["rms_mm"] / 2 and filtered["rms_mm"] < none["rms_mm"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "constant velocity" in page and "Shown 100 ms after capture" in page
    assert "prediction rms of a delay of 100 ms: none" in capsys.readouterr().out
