"""The synthetic recording: what it holds, and how a table of poses is compared with its truth."""

import csv
import math

import pytest
import torch

from holotorch.experiments.config_tracking import build_camera, build_catheter, load_camera, load_catheter
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.synthetic import RATE, compared, write_synthetic
from holotorch.io.recording import is_recording, open_recording
from holotorch.tracking.catheter import THESIS
from holotorch.tracking.tracker import CatheterTracker
from holotorch.tracking.world import synthetic_camera

SIZE = (540, 960)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_synthetic(tmp_path_factory.mktemp("made") / "here", 3, SIZE)


def truths(folder):
    with open(folder / "truth.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_recording_with_its_camera_its_catheter_and_the_truth(folder):
    assert is_recording(folder) and not (folder / "images").exists()
    camera = build_camera(load_camera(folder / "camera.yaml"))
    torch.testing.assert_close(camera.matrix, synthetic_camera(SIZE).matrix, rtol=0, atol=1e-9)
    torch.testing.assert_close(camera.distortion, synthetic_camera(SIZE).distortion, rtol=0, atol=1e-12)
    assert tuple(load_camera(folder / "camera.yaml").size or ()) == SIZE
    assert build_catheter(load_catheter(folder / "catheter.yaml")) == THESIS
    rows = truths(folder)
    assert [row["frame"] for row in rows] == ["0", "1", "2"]
    for i, row in enumerate(rows):
        assert float(row["time_s"]) == pytest.approx(i / RATE, abs=1e-6)
        direction = [float(row[f"direction_{axis}"]) for axis in "xyz"]
        assert math.hypot(*direction) == pytest.approx(1, abs=1e-8)
    assert not list(folder.parent.glob(".*"))  # nothing left of the parts


def test_its_frames_show_the_truth(folder):
    """As in the tracker's own tests: within 4 stated deviations, and a millimetre at half the resolution."""
    tracker = CatheterTracker(build_camera(load_camera(folder / "camera.yaml")), THESIS)
    with open_recording(folder) as frames:
        assert frames.shape == SIZE and frames.rate == RATE
        found = list(frames)
    assert len(found) == 3
    for i, (frame, row) in enumerate(zip(found, truths(folder), strict=True)):
        assert frame.seconds == pytest.approx(i / RATE, abs=1e-6)
        assert frame.pixels is not None
        pose = tracker(frame.pixels[None])[0]
        assert pose.answered, pose.reason
        tip = torch.tensor([float(row[f"tip_{axis}_m"]) for axis in "xyz"], dtype=torch.float64)
        assert float((pose.tip - tip).norm()) < min(4 * float(pose.tip_sd), 1.5e-3)


def test_it_is_the_same_each_time_and_takes_no_folder_in_use(folder, tmp_path):
    again = write_synthetic(tmp_path / "again", 1, SIZE)
    assert truths(again) == truths(folder)[:1]
    with open_recording(again) as one, open_recording(folder) as other:
        torch.testing.assert_close(next(iter(one)).pixels, next(iter(other)).pixels, rtol=0, atol=0)
    with pytest.raises(ConfigError, match="again"):
        write_synthetic(again, 1, SIZE)


def test_without_a_folder_it_takes_the_next_free_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (write_synthetic(None, 1, (64, 96)) for _ in range(2))
    assert (str(first), str(second)) == ("runs/synthetic-001", "runs/synthetic-002")
    assert len(truths(second)) == 1


def write(path, rows):
    names = ("frame", "tip_x_m", "tip_y_m", "tip_z_m")
    path.write_text("\n".join([",".join(names), *(",".join(row) for row in rows)]) + "\n")
    return path


def test_poses_are_compared_with_the_truth_in_words(tmp_path):
    true = write(tmp_path / "truth.csv", [(str(i), "0.01", "0.02", "0.5") for i in range(5)])
    rows = [
        ("0", "0.010", "0.020", "0.5"),
        ("1", "0.010", "0.020", "0.501"),
        ("2", "0.013", "0.024", "0.5"),
        ("3", "", "", ""),
        ("4", "nan", "nan", "nan"),
    ]
    text = compared(write(tmp_path / "poses.csv", rows), true)
    assert "the tip is 1.00 mm off (median), 5.00 at most, in 3 frames; 2 refused (synthetic)" in text
    nothing = compared(write(tmp_path / "poses.csv", rows[3:]), true)
    assert "no frame answered of 2 (synthetic)" in nothing
