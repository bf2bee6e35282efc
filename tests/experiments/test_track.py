"""Tracking a source with a stand-in tracker, which knows the tip from the grey level of a frame."""

import csv
import json
import math
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from holotorch.experiments import track, track_source
from holotorch.experiments.config_tracking import save_camera, save_catheter
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.run import deferred
from holotorch.experiments.track import follow, live, run_tracking
from holotorch.experiments.track_report import COLUMNS, Tracked
from holotorch.io.files import write_bytes
from holotorch.io.images import encode_png
from holotorch.io.recording import is_recording, open_recording
from holotorch.io.video import Frame, Frames, open_frames
from holotorch.tracking import THESIS, Camera, Catheter, Pose, Status
from holotorch.tracking.world import World

SIZE = (48, 64)
CAMERA = Camera(torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), torch.zeros(5))
DIRECTION = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)


def grey(level: int) -> torch.Tensor:
    return torch.full((3, *SIZE), level, dtype=torch.uint8)


class StandIn:
    """Refuses black frames; the tip of others lies ``level`` / 3 mm to the right."""

    def __init__(self):
        self.previous: list = []
        self.times = {"colour": 2e-3, "edges": 6e-3}

    def __call__(self, frames, previous=None):
        assert frames.shape == (1, 3, *SIZE) and frames.dtype == torch.uint8
        self.previous.append(previous)
        level = int(frames[0, 0, 0, 0])
        if level == 0:
            return [Pose.refused(Status.NO_CATHETER, "nothing of the bands' colours, thin and long")]
        tip = torch.tensor([level / 3e3, 0.0, 0.5], dtype=torch.float64)
        covariance = torch.diag(torch.tensor([1.0, 2, 3, 4, 5, 6], dtype=torch.float64)) * 1e-8
        covariance[0, 2] = covariance[2, 0] = 1e-9 / 3
        one = torch.ones((), dtype=torch.float64)
        return [Pose(tip, DIRECTION, covariance, one / 7, one, Status.OK)]


@pytest.fixture
def tracker(monkeypatch, tmp_path):
    made = StandIn()
    save_camera(tmp_path / "camera.yaml", CAMERA, SIZE)
    save_catheter(tmp_path / "catheter.yaml", THESIS)
    monkeypatch.setattr(track_source, "make_tracker", lambda *_: made)
    return made


def pictures(folder: Path, levels: list[int | None]) -> Path:
    """A folder of pictures; None is one that cannot be read."""
    folder.mkdir()
    for number, level in enumerate(levels):
        path = folder / f"{number}.png"
        if level is None:
            path.write_bytes(b"\x89PNG cut off")
        else:
            cv2.imwrite(str(path), np.full((*SIZE, 3), level, np.uint8))
    return folder


def tracked(tmp_path: Path, source, name: str = "out", **options) -> tuple[Path, bool]:
    files = tmp_path / "camera.yaml", tmp_path / "catheter.yaml"
    return run_tracking(source, *files, tmp_path / name, **options)


def read(folder: Path) -> list[dict[str, str]]:
    with open(folder / "poses.csv", newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def summary(folder: Path, name: str = "summary.json"):
    return json.loads((folder / name).read_text())


def test_every_frame_gets_a_pose_or_a_reason(tmp_path, tracker):
    folder, complete = tracked(tmp_path, pictures(tmp_path / "in", [30, 33, 0, None, 36, 39]), still=True, rate=20.0)
    assert complete
    names = {path.name for path in folder.iterdir()}
    assert names == {
        *("camera.yaml", "catheter.yaml", "config.yaml", "env.json", "images", "overlay.mp4", "poses.csv"),
        *("report.html", "summary.json"),
    }
    rows = read(folder)
    assert tuple(rows[0]) == COLUMNS
    assert [row["status"] for row in rows] == ["OK", "OK", "NO_CATHETER", "BAD_FRAME", "OK", "OK"]
    assert [row["stage"] for row in rows] == ["", "", "colour", "frame", "", ""]
    assert [float(row["time_s"]) for row in rows] == [i / 20 for i in range(6)]
    assert "colours, thin and long" in rows[2]["reason"] and "3.png is not a readable picture" in rows[3]["reason"]
    first = rows[0]
    # To the bit: a third has no short decimal.
    assert float(first["tip_x_m"]) == 30 / 3e3 and float(rows[1]["tip_x_m"]) == 33 / 3e3
    assert [float(first[f"direction_{axis}"]) for axis in "xyz"] == [0.6, 0.0, 0.8]
    found = {name: float(first[f"cov_{name}_m2"]) for name in ("xx", "xy", "xz", "yy", "yz", "zz")}
    assert found == {"xx": 1e-8, "xy": 0.0, "xz": 1e-9 / 3, "yy": 2 * 1e-8, "yz": 0.0, "zz": 3 * 1e-8}
    assert float(first["chi_square"]) == 1 / 7 and float(first["milliseconds"]) >= 0
    assert all(rows[2][name] == "" for name in COLUMNS[5:-1]) and rows[3]["milliseconds"] == ""
    told = summary(folder)
    assert (told["frames"], told["answered"]) == (6, 4)
    assert told["statuses"] == {"OK": 4, "BAD_FRAME": 1, "NO_CATHETER": 1}
    assert told["stages"] == [
        {"stage": "colour", "milliseconds": pytest.approx(2), "percent": pytest.approx(25)},
        {"stage": "edges", "milliseconds": pytest.approx(6), "percent": pytest.approx(75)},
    ]
    # Two pairs of neighbours, 1 mm each; the pair across the refusals is none.
    assert told["stability"]["s_rms_mm"] == pytest.approx(1.0) and told["stability"]["differences"] == 2
    page = (folder / "report.html").read_text()
    assert "4 of 6 frames" in page and "NO_CATHETER" in page and page.count("data:image/png") == 4
    with open_frames(folder / "overlay.mp4") as drawn:
        assert len(list(drawn)) == 6 and drawn.rate == 20


def test_the_pose_before_is_passed_on_but_not_across_a_refusal():
    tracker = StandIn()
    frames = [Frame(0.0, grey(10)), Frame(0.1, grey(20)), Frame(0.2, grey(0)), Frame(0.3, grey(30))]
    frames += [Frame(0.4, None, "lost"), Frame(0.5, grey(40))]
    found = list(follow(frames, tracker))
    assert [item.status.name for item in found] == ["OK", "OK", "NO_CATHETER", "OK", "BAD_FRAME", "OK"]
    given = [None if previous is None else float(previous[0].tip[0]) for previous in tracker.previous]
    assert given == [None, 10 / 3e3, 20 / 3e3, None, None]
    assert found[4].pose.reason == "lost" and found[4].seconds == 0


def test_a_recording_replays_to_the_same_poses(tmp_path, tracker, capsys):
    source = pictures(tmp_path / "in", [9, 0, None, 200, 255])
    folder, _ = tracked(tmp_path, source, "a", record=True, video=False)
    assert "Recording  0.000 GB" in capsys.readouterr().out and not (folder / "overlay.mp4").exists()
    recording = folder / "recording"
    assert (
        is_recording(recording) and (recording / "camera.yaml").read_bytes() == (tmp_path / "camera.yaml").read_bytes()
    )
    for one, other in zip(open_frames(source), open_recording(recording), strict=True):
        assert one.seconds == other.seconds and one.problem == other.problem
        assert (one.pixels is None) == (other.pixels is None)
        assert one.pixels is None or (other.pixels is not None and torch.equal(one.pixels, other.pixels))
    again, complete = run_tracking(recording, out=tmp_path / "b", video=False)  # with the files beside it
    assert complete
    first, second = read(folder), read(again)
    for line in (*first, *second):
        line.pop("milliseconds")
    assert first == second


@pytest.fixture
def hangup():
    """SIGHUP, handled as in a program that a terminal has started, whatever this test was started by."""
    number = getattr(signal, "SIGHUP", None)
    if number is None:
        pytest.skip("this system has no terminals that hang up")

    def died(*_):
        raise AssertionError("SIGHUP would have ended the process")

    before = signal.signal(number, died)
    yield number
    signal.signal(number, before)


def test_a_run_under_nohup_outlives_its_terminal(tmp_path, tracker, monkeypatch, hangup):
    def pressed(frames, previous=None):
        signal.raise_signal(hangup)
        return tracker(frames, previous)

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: pressed)
    signal.signal(hangup, signal.SIG_IGN)
    folder, complete = tracked(tmp_path, pictures(tmp_path / "in", [9, 12]), video=False)
    assert complete and len(read(folder)) == 2 and signal.getsignal(hangup) is signal.SIG_IGN


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_interrupted_tracking_keeps_what_was_found(tmp_path, tracker, monkeypatch, hangup, name):
    calls = []

    def pressed(frames, previous=None):
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(getattr(signal, name))
        return tracker(frames, previous)

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: pressed)
    folder, complete = tracked(tmp_path, pictures(tmp_path / "in", [9, 12, 15, 18]), record=True)
    assert not complete and len(read(folder)) == 2 and not (folder / "summary.json").exists()
    assert summary(folder, "interrupted.json")["frames"] == 2
    assert len(list(open_recording(folder / "recording"))) == 3  # kept before it is looked at
    with open_frames(folder / "overlay.mp4") as drawn:
        assert len(list(drawn)) == 2
    assert not list(folder.glob(".*"))


def test_a_second_signal_loses_nothing(tmp_path, tracker, monkeypatch):
    """It comes after the first has ended the loop and before signals are held back for saving."""

    def pressed(frames, previous=None):
        if int(frames[0, 0, 0, 0]) == 15:
            signal.raise_signal(signal.SIGINT)
        return tracker(frames, previous)

    def late(noted):
        if len(noted) == 1:
            signal.raise_signal(signal.SIGTERM)
        return deferred(noted)

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: pressed)
    monkeypatch.setattr(track, "deferred", late)
    folder, complete = tracked(tmp_path, pictures(tmp_path / "in", [9, 12, 15, 18]))
    assert not complete and len(read(folder)) == 2 and summary(folder, "interrupted.json")["frames"] == 2


def test_a_tracker_that_fails_loses_nothing(tmp_path, tracker, monkeypatch):
    def failing(frames, previous=None):
        if int(frames[0, 0, 0, 0]) == 99:
            raise RuntimeError("no convergence")
        return tracker(frames, previous)

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: failing)
    with pytest.raises(RuntimeError, match="no convergence"):
        tracked(tmp_path, pictures(tmp_path / "in", [9, 99, 12]))
    assert len(read(tmp_path / "out")) == 1
    assert summary(tmp_path / "out", "interrupted.json")["failure"] == "RuntimeError: no convergence"
    with pytest.raises(RuntimeError, match="no convergence"):
        tracked(tmp_path, pictures(tmp_path / "in2", [99, 12]), "none")
    assert not (tmp_path / "none").exists()


def test_a_full_disk_leaves_the_poses_before_it(tmp_path, tracker, full_disk):
    source = pictures(tmp_path / "in", [9] * 60)
    with pytest.raises(OSError), full_disk(8000):
        tracked(tmp_path, source, video=False)
    rows = read(tmp_path / "out")
    assert 10 < len(rows) < 60 and [int(row["frame"]) for row in rows] == list(range(len(rows)))
    assert all(row["milliseconds"] for row in rows)
    assert not list((tmp_path / "out").glob(".*"))


def test_a_part_that_cannot_be_closed_takes_no_other_along(tmp_path, tracker, monkeypatch):
    def broken(self):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(track.Recorder, "close", broken)
    with pytest.raises(OSError, match="No space left"):
        tracked(tmp_path, pictures(tmp_path / "in", [9, 12]), record=True)
    assert len(read(tmp_path / "out")) == 2 and summary(tmp_path / "out", "interrupted.json")["frames"] == 2
    with open_frames(tmp_path / "out" / "overlay.mp4") as drawn:
        assert len(list(drawn)) == 2


def test_ctrl_c_is_the_ordinary_end_of_a_camera(tmp_path, tracker, monkeypatch):
    class Device:
        """A camera that never ends, and a user who ends it."""

        count = 0

        def isOpened(self):  # noqa: N802
            return True

        def get(self, what):
            return 1e3 + 33.0 * self.count if what == cv2.CAP_PROP_POS_MSEC else 0.0

        def set(self, *_):
            return True

        def grab(self):
            self.count += 1
            if self.count == 5:
                signal.raise_signal(signal.SIGINT)
            return True

        def retrieve(self):
            return True, np.full((*SIZE, 3), self.count, np.uint8)

        def read(self):
            return self.retrieve() if self.grab() else (False, None)

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", lambda _: Device())
    folder, complete = tracked(tmp_path, "0", video=False)
    assert complete and summary(folder)["status"] == "complete"
    assert [float(row["time_s"]) for row in read(folder)] == pytest.approx([1.033, 1.066, 1.099, 1.132])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"source": "missing.mp4"}, "no such video, folder or camera"),
        ({"method": "best"}, "expected one of ours, thesis as the method, got 'best'"),
        ({"camera": None}, "no camera.yaml: say which with --camera"),
        ({"catheter": "gone.yaml"}, "gone.yaml: cannot read the configuration"),
        ({"rate": math.nan}, "rate must be finite"),
        ({"out": "in"}, "holds files already"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, tracker, options, message):
    pictures(tmp_path / "in", [9])
    before = sorted(tmp_path.rglob("*"))
    given = {"source": "in", "camera": "camera.yaml", "catheter": "catheter.yaml", "out": "out"} | options
    for name in ("source", "camera", "catheter", "out"):
        given[name] = given[name] and tmp_path / given[name]
    with pytest.raises(ConfigError, match=message):
        run_tracking(**given)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("method", "message"), [("ours", "colours"), ("thesis", "use CatheterTracker")])
def test_a_catheter_that_no_tracker_sees_is_refused_before_anything_is_written(tmp_path, method, message):
    greys = ((30, 30, 30), (128, 128, 128), (230, 230, 230))
    save_camera(tmp_path / "camera.yaml", CAMERA, SIZE)
    save_catheter(tmp_path / "catheter.yaml", Catheter(THESIS.edges, greys, THESIS.radius, THESIS.length))
    source = pictures(tmp_path / "in", [9])
    with pytest.raises(ConfigError, match=message):
        tracked(tmp_path, source, method=method)
    assert not (tmp_path / "out").exists()
    if method == "ours":
        with pytest.raises(ConfigError, match=message):
            list(live([str(source)], tmp_path / "camera.yaml", tmp_path / "catheter.yaml"))


def test_ctrl_c_before_the_first_frame_leaves_nothing(tmp_path, tracker, monkeypatch):
    monkeypatch.setattr(track, "environment", lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        tracked(tmp_path, pictures(tmp_path / "in", [9]), record=True)
    assert not (tmp_path / "out").exists()


def test_live_poses_of_a_folder_come_with_its_notes_and_at_the_rate_asked_for(tmp_path, tracker, capsys):
    source = pictures(tmp_path / "in", [9, 0, 12])
    double = Camera(torch.tensor([[120.0, 0, 64], [0, 120, 48], [0, 0, 1]]), torch.zeros(5))
    save_camera(tmp_path / "double.yaml", double)  # says no size
    files = tmp_path / "double.yaml", tmp_path / "catheter.yaml"
    found = list(live([str(source)], *files, 4.0))
    # Multiples of 2.4e-7 s, the spacing of numbers near 1.7e9.
    assert [time - found[0][0] for time, _ in found] == pytest.approx([0, 0.25, 0.5], abs=1e-6)
    assert [pose.status.name for _, pose in found if isinstance(pose.status, Status)] == ["OK", "NO_CATHETER", "OK"]
    assert "calibrated at another resolution" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="expected one source to track and stream, got 2"):
        list(live(["a.mp4", "b.mp4"], *files))


def test_live_poses_of_a_recording_need_no_other_files(tmp_path, tracker):
    folder, _ = tracked(tmp_path, pictures(tmp_path / "in", [9, 12]), record=True, video=False)
    assert [float(pose.tip[0]) for _, pose in live([str(folder / "recording")], None, None)] == [9 / 3e3, 12 / 3e3]


def test_a_live_pose_has_the_time_of_its_frame_not_of_its_tracking(tmp_path, tracker, monkeypatch):
    camera = Frames("camera 0", SIZE, None, 30.0, iter([Frame(7.0, grey(9)), Frame(7.5, grey(12))]), [], live=True)
    monkeypatch.setattr(track_source, "open_frames", lambda *_: camera)
    monkeypatch.setattr(track, "now", lambda: 100.0)

    def slow(frames, tracker):
        return (Tracked(i, frame, tracker(frame.pixels[None])[0], 0.25 + i, {}) for i, frame in enumerate(frames))

    monkeypatch.setattr(track, "follow", slow)
    found = list(live(["0"], tmp_path / "camera.yaml", tmp_path / "catheter.yaml"))
    assert [captured for captured, _ in found] == [99.75, 98.75]


def test_intrinsics_of_another_resolution_are_noticed(tmp_path, tracker):
    source = pictures(tmp_path / "in", [9])
    double = Camera(torch.tensor([[120.0, 0, 64], [0, 120, 48], [0, 0, 1]]), torch.zeros(5))
    save_camera(tmp_path / "camera.yaml", double, (96, 128))
    with pytest.raises(ConfigError, match="holds for frames of 128 x 96 px, and these have 64 x 48 px"):
        tracked(tmp_path, source)
    save_camera(tmp_path / "camera.yaml", double)  # says no size
    folder, _ = tracked(tmp_path, source, video=False)
    assert any("calibrated at another resolution" in note for note in summary(folder)["notes"])


def test_a_recording_that_does_not_fit_is_refused(tmp_path, tracker, monkeypatch):
    monkeypatch.setattr(track, "free_bytes", lambda _: 1000)
    with pytest.raises(ConfigError, match="the recording takes 0.00 GB and 0.00 GB are free; choose --out"):
        tracked(tmp_path, pictures(tmp_path / "in", [9]), record=True)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", ["ours", "thesis"])
def test_synthetic_frames_through_the_real_trackers(tmp_path, method):
    """From files to poses, and the recording to the same poses; how good they are is tested with the trackers."""
    world = World(size=(720, 1280))
    cases = world.still(0.35, math.radians(5), 2)
    truth = cases[0].tip
    assert truth is not None
    (tmp_path / "in").mkdir()
    for number, case in enumerate(cases):
        write_bytes(tmp_path / "in" / f"{number}.png", encode_png(case.frame().double() / 255))
    save_camera(tmp_path / "camera.yaml", world.camera, world.size)
    save_catheter(tmp_path / "catheter.yaml", THESIS)
    folder, complete = tracked(tmp_path, tmp_path / "in", "a", method=method, record=True, video=False)
    assert complete and summary(folder)["statuses"] == {"OK": 2} and len(summary(folder)["stages"]) >= 4
    again, _ = run_tracking(folder / "recording", out=tmp_path / "b", method=method, video=False)
    first, second = read(folder), read(again)
    for line, other in zip(first, second, strict=True):
        tip = torch.tensor([float(line[f"tip_{axis}_m"]) for axis in "xyz"], dtype=torch.float64)
        assert (tip - truth).norm() < 5e-3
        # Frames of a folder count at an assumed rate; the recording keeps those times.
        assert all(line[name] == other[name] for name in COLUMNS if name != "milliseconds")
