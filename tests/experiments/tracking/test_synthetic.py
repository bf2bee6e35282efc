"""The synthetic recording: what it holds, and how a table of poses is compared with its truth."""

import csv
import json
import math
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from stand_in import track

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking import run as tracking_run
from holotorch.experiments.tracking import synthetic
from holotorch.experiments.tracking.devices import (
    build_camera,
    build_catheter,
    load_camera,
    load_catheter,
    save_catheter,
)
from holotorch.experiments.tracking.forecast import HALF, working_range
from holotorch.experiments.tracking.synthetic import (
    RATE,
    compared,
    distance_text,
    errors,
    read_truth,
    synthetic_distance,
    synthetic_poses,
    synthetic_world,
    write_synthetic,
)
from holotorch.io.recording import is_recording, open_recording
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.pose.rolling_shutter import READOUT
from holotorch.tracking.simulation.world import World, synthetic_camera

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
    text = compared(errors(write(tmp_path / "poses.csv", rows), read_truth(true.parent)))
    assert "the tip is 1.00 mm off (median), 5.00 at most, in 3 frames; 2 refused (synthetic)" in text
    nothing = compared(errors(write(tmp_path / "poses.csv", rows[3:]), read_truth(true.parent)))
    assert "no frame answered of 2 (synthetic)" in nothing


def test_a_run_of_a_synthetic_recording_holds_its_errors(folder, tmp_path):
    out, _ = track(tmp_path / "run", folder, video=False)
    found = json.loads((out / "summary.json").read_text())["truth"]
    with open(out / "poses.csv", newline="") as stream:
        poses = list(csv.DictReader(stream))
    away, inside = [], 0
    for pose, true in zip(poses, truths(folder), strict=True):
        off = np.array([float(pose[f"tip_{axis}_m"]) - float(true[f"tip_{axis}_m"]) for axis in "xyz"])
        square = np.array([[float(pose[f"cov_{min(a, b)}{max(a, b)}_m2"]) for b in "xyz"] for a in "xyz"])
        away.append(1e3 * np.linalg.norm(off))
        inside += off @ np.linalg.solve(square, off) < 7.8147  # 95 % of chi-square with 3 degrees of freedom
    names = [found[f"{name}_mm"] for name in ("median", "p95", "worst")]
    assert names == pytest.approx([sorted(away)[1], max(away), max(away)]) and found["coverage"] == inside / 3
    assert (found["frames"], found["refused"], found["wrong"]) == (3, 0, 0)
    page = (out / "report.html").read_text()
    assert "not known here" not in page and f"{found['p95_mm']:.3f}" in page and "95 % ellipsoid" in page
    assert "<td>stability</td>" not in page


@pytest.mark.parametrize(
    ("shutter", "words", "motion"),
    [("global", [], False), ("rolling", [], True), ("rolling", ["still=true"], False)],
)
def test_only_what_moves_before_a_rolling_shutter_is_less_sure(folder, tmp_path, capsys, shutter, words, motion):
    """A synthetic recording says that its shutter is global; a file without that word means a rolling one."""
    text = (folder / "camera.yaml").read_text()
    assert "\nshutter: global\n" in text
    camera = tmp_path / "camera.yaml"
    camera.write_text(text if shutter == "global" else text.replace("shutter: global\n", ""))
    out = tmp_path / "run"
    assert main(["track", str(folder), "--camera", str(camera), "--out", str(out), "video=false", *words]) == 0
    assert ("Shutter    deviations" in capsys.readouterr().out) is motion
    with open(out / "poses.csv", newline="") as stream:
        variances = [sum(float(pose[f"cov_{axis}{axis}_m2"]) for axis in "xyz") for pose in csv.DictReader(stream)]
    known, catheter = load_camera(folder / "camera.yaml"), load_catheter(folder / "catheter.yaml")
    tracker = CatheterTracker(build_camera(known), build_catheter(catheter), readout=READOUT * motion)
    with open_recording(folder) as frames:
        first = next(iter(frames)).pixels
    assert first is not None
    assert variances[0] == pytest.approx(float(tracker(first[None])[0].tip_sd) ** 2, rel=1e-9)


@pytest.mark.parametrize(("offset", "wrong"), [(0.0, False), (-6e-3, True)])
def test_a_tube_that_goes_on_beyond_the_tip_is_noted(folder, tmp_path, offset, wrong):
    """Edges counted from a point behind the tip fit as well as the right ones."""
    catheter = tmp_path / "catheter.yaml"
    save_catheter(catheter, replace(THESIS, edges=tuple(edge + offset for edge in THESIS.edges)))
    out, _ = track(tmp_path / "run", folder, video=False, catheter=str(catheter))
    told = json.loads((out / "summary.json").read_text())
    assert told["answered"] == 3
    assert any("wrong tips: in 3 of 3 poses" in note for note in told["notes"]) is wrong
    with open(out / "poses.csv", newline="") as stream:
        assert {pose["status"] for pose in csv.DictReader(stream)} == {"UNVERIFIED" if wrong else "OK"}


def test_other_tables_of_that_name_and_frames_beyond_it_are_left_out(tmp_path):
    poses = write(tmp_path / "poses.csv", [("0", "0.01", "0.02", "0.507"), ("7", "0.01", "0.02", "0.5")])
    assert read_truth(tmp_path) == {} and errors(poses, {}) == {}
    (tmp_path / "truth.csv").write_text("name,value\na,1\n")
    assert read_truth(tmp_path) == {}  # beside pictures it may be anything
    write(tmp_path / "truth.csv", [("0", "0.01", "0.02", "0.5")])
    found = errors(poses, read_truth(tmp_path))
    assert found["frames"] == found["wrong"] == 1 and found["worst_mm"] == pytest.approx(7) and "coverage" not in found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "1: columns frame, tip_x_m, tip_y_m, tip_z_m are missing, got a, b"),
        ("", "1: columns frame, tip_x_m, tip_y_m, tip_z_m are missing, got "),
        ("frame,tip_x_m,tip_y_m,tip_z_m\n0,0,0,1\n1,0,nan,1\n", "3: expected .* a finite tip in metres, got 1,0,nan,1"),
        ("frame,tip_x_m,tip_y_m,tip_z_m\n0,0,0,left\n", "2: expected .*, got 0,0,0,left"),
        ("frame,tip_x_m,tip_y_m,tip_z_m\n0,0\n", "2: expected .*, got 0,0,None,None"),
        ("frame,tip_x_m,tip_y_m,tip_z_m\n0,0,0,1\n0,0,0,1\n", "3: expected the number of a frame, each once"),
        ("frame,tip_x_m,tip_y_m,tip_z_m\nfirst,0,0,1\n", "2: expected the number of a frame"),
        ("\0\udcff", " not a table in UTF-8 text"),
    ],
)
def test_a_truth_that_is_none_is_refused_before_tracking_begins(folder, tmp_path, text, message):
    source = shutil.copytree(folder, tmp_path / "source")
    (source / "truth.csv").write_text(text, errors="surrogateescape")
    with pytest.raises(ConfigError, match=f"truth.csv:{message}"):
        track(tmp_path / "run", source, video=False)
    assert not (tmp_path / "run").exists()


def test_a_number_that_is_none_costs_no_summary(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(
        tracking_run, "errors", lambda *_: {"frames": 3, "refused": 0, "median_mm": 1.0, "worst_mm": math.nan}
    )
    run, complete = track(tmp_path / "run", folder, video=False)
    assert complete and json.loads((run / "summary.json").read_text())["truth"]["worst_mm"] is None


def test_what_ends_the_rendering_early_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic.Recorder, "write", lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        write_synthetic(tmp_path / "here", 2, (64, 96))
    assert not list(tmp_path.iterdir())


def test_it_is_rendered_with_the_camera_and_the_catheter_that_were_given(tmp_path):
    """A wider lens, bands further from the tip: tracked with the same files, the tip is where the truth has it."""
    (tmp_path / "c.yaml").write_text("fx: 620\nfy: 640\ncx: 470\ncy: 280\nsize: [540, 960]\n")
    bands = "edges: [50 mm, 90 mm, 130 mm, 170 mm]\ncolours: [[40, 70, 190], [200, 40, 45], [40, 150, 70]]\n"
    (tmp_path / "t.yaml").write_text(bands + "radius: 1.5 mm\nlength: 300 mm\n")
    files = tmp_path / "c.yaml", tmp_path / "t.yaml"
    made = write_synthetic(tmp_path / "made", 2, camera=files[0], catheter=files[1])
    out, _ = track(tmp_path / "run", made, camera=str(files[0]), catheter=str(files[1]), video=False)
    found = json.loads((out / "summary.json").read_text())
    assert found["answered"] == 2 and found["truth"]["worst_mm"] < 1.5
    own, _ = track(tmp_path / "own", made, video=False)  # with the files that it holds
    assert json.loads((own / "summary.json").read_text())["truth"] == pytest.approx(found["truth"], rel=1e-6)
    with pytest.raises(ConfigError, match="c.yaml"):
        write_synthetic(tmp_path / "more", 1, camera=tmp_path / "none" / "c.yaml")
    assert not (tmp_path / "more").exists()


SMALL = "fx: 533\nfy: 533\ncx: 320\ncy: 240\nsize: [480, 640]\n"
COLOURS = "colours: [[200, 40, 45], [40, 150, 70], [40, 70, 190]]\n"


def small(folder, bands):
    """A small camera and a catheter with ``bands``, as files of ``folder``."""
    (folder / "c.yaml").write_text(SMALL)
    (folder / "t.yaml").write_text(bands + COLOURS)
    return folder / "c.yaml", folder / "t.yaml"


def test_the_usual_camera_and_catheter_stay_where_they_were():
    world = World()
    assert synthetic_distance(world) == 0.5 and "0.5 m from the camera: well within the range" in distance_text(world)
    poses = synthetic_poses(world, 90, 0.5)
    assert len(poses) == 90
    for i, pose in enumerate(poses):
        phase = 2 * math.pi * i / 45
        at = 0.05 * math.sin(phase), 0.03 * math.cos(phase)
        true = world.pose(0.5 + 0.03 * math.sin(phase), math.radians(15 + 8 * math.cos(phase)), 0.4, at)
        assert all(torch.equal(one, other) for one, other in zip(pose, true, strict=True))


def test_short_bands_before_a_small_camera_come_nearer_and_are_found(tmp_path, capsys):
    files = small(tmp_path, "edges: [10 mm, 18 mm, 26 mm, 34 mm]\nradius: 1 mm\nlength: 120 mm\n")
    world = synthetic_world(*files)
    largest, _ = working_range(world.camera, world.catheter, HALF)
    assert largest < 0.2
    given = {"camera": str(files[0]), "catheter": str(files[1])}
    out, _ = track(tmp_path / "run", "synthetic", frames=4, video=False, **given)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["answered"] == 4 and summary["truth"]["worst_mm"] < 1
    rows = truths(out / "synthetic")
    assert all(float(row["tip_z_m"]) < 1.1 * largest for row in rows)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Distance")]
    assert f"about {0.8 * largest:.2g} m from the camera: four fifths of the range in such colours" in line


def test_bands_too_long_to_be_seen_within_the_range_stay_in_the_frame_and_say_so(tmp_path):
    """Thin, so that the range is 0.22 m, from which bands of 240 mm do not fit into 62 degrees."""
    files = small(tmp_path, "edges: [10 mm, 90 mm, 170 mm, 250 mm]\nradius: 0.5 mm\nlength: 260 mm\n")
    world = synthetic_world(*files)
    distance = synthetic_distance(world)
    assert working_range(world.camera, world.catheter, HALF)[0] < distance < 0.5
    assert "its bands would leave the frame" in distance_text(world) and "beyond the range in such" in distance_text(
        world
    )

    def inside(distance):
        poses = synthetic_poses(world, 45, distance)
        edges = torch.stack([tip + world.catheter.positions[:, None] * along for tip, along in poses])
        return bool(((edges[..., :2] / edges[..., 2:]).abs() < torch.tensor([320, 240]) / 533).all())

    assert inside(1.01 * distance) and not inside(0.9 * distance)


def test_a_catheter_that_cannot_be_rendered_is_refused_before_a_folder_is_made(tmp_path):
    files = small(tmp_path, "edges: [10 mm, 120 mm, 230 mm, 340 mm]\nradius: 50 mm\nlength: 400 mm\n")
    with pytest.raises(ConfigError, match="cannot be rendered with this camera: the tube comes within"):
        track(tmp_path / "run", "synthetic", frames=1, camera=str(files[0]), catheter=str(files[1]))
    with pytest.raises(ConfigError, match="cannot be rendered"):
        write_synthetic(tmp_path / "made", 1, camera=files[0], catheter=files[1])
    assert {path.name for path in tmp_path.iterdir()} == {"c.yaml", "t.yaml"}
