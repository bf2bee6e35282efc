"""Tracking a source with a stand-in tracker, as a run and live."""

import math
from pathlib import Path
from typing import ClassVar

import pytest
import torch
import yaml
from stand_in import CAMERA, SIZE, StandIn, grey, pictures, read, summary, track, tracked

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking import run as tracking_run
from holotorch.experiments.tracking import source as track_source
from holotorch.experiments.tracking.devices import save_camera, save_catheter
from holotorch.experiments.tracking.report import COLUMNS, Log, Tracked, drawn_track, verdict
from holotorch.experiments.tracking.run import follow, live
from holotorch.io.files import write_bytes
from holotorch.io.images import encode_png
from holotorch.io.recording import is_recording, open_recording
from holotorch.io.video import Frame, Frames, open_frames
from holotorch.tracking import THESIS, Camera, Catheter, CatheterTracker, ChannelOrder, Status
from holotorch.tracking.simulation.world import World


def test_every_frame_gets_a_pose_or_a_reason(tmp_path, tracker):
    folder, complete = tracked(tmp_path, pictures(tmp_path / "in", [30, 33, 0, None, 36, 39]), still=True, rate_hz=20.0)
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
    tips = [[float(row[f"tip_{axis}_m"]) for axis in "xyz"] for row in rows if row["tip_x_m"]]
    away = [math.dist(tip, (0, 0, 0)) for tip in tips]
    assert told["tip_distance_m"] == pytest.approx([min(away), max(away)], abs=1e-15)
    assert f"; tips {min(away):.2f} to {max(away):.2f} m from the camera" in verdict(told)
    # Two pairs of neighbours, 1 mm each; the pair across the refusals is none.
    assert told["stability"]["s_rms_mm"] == pytest.approx(1.0) and told["stability"]["differences"] == 2
    page = (folder / "report.html").read_text()
    assert "4 of 6 frames" in page and "NO_CATHETER" in page and page.count("data:image/png") == 4
    with open_frames(folder / "overlay.mp4") as drawn:
        assert len(list(drawn)) == 6 and drawn.rate == 20


def test_a_catheter_that_moves_is_no_catheter_at_rest(tmp_path, tracker, capsys):
    """Of the stand-in 0.24 mm are stated (variances of 1, 2 and 3 e-8 m^2), and levels are 1/3 mm apart."""
    rest, _ = tracked(tmp_path, pictures(tmp_path / "rest", [30, 31, 30, 31]), "a", still=True, video=False)
    times, order = summary(rest)["notes"]
    assert times == "pictures have no times; 30 frames per second assumed" and "in the order BGR show" in order
    capsys.readouterr()
    moved, _ = tracked(tmp_path, pictures(tmp_path / "moved", [30, 33, 36, 39]), "b", still=True, video=False)
    (note,) = summary(moved)["notes"][2:]
    # 1 mm apart: +-0.5 and +-1.5 mm, over 3 degrees of freedom.
    assert "spread by 1.291 mm about their mean, more than 3 times their stated deviation of 0.245 mm" in note
    assert note in capsys.readouterr().out and note.split("?")[0] in (moved / "report.html").read_text()


def test_what_the_deviations_hold_is_said(tmp_path, tracker):
    folder, _ = tracked(tmp_path, pictures(tmp_path / "in", [30]), video=False)
    assert "without that of the calibration of the camera" in summary(folder)["tip_sd_holds"]
    assert "without that of the calibration of the camera" in (folder / "report.html").read_text()


def test_the_figure_of_no_pose_says_so_and_of_one_frame_has_no_scale(tmp_path):
    def axes(levels):
        log = Log(tmp_path)
        for i, level in enumerate(levels):
            log.take(Tracked(i, Frame(5 + 0.1 * i, grey(level)), StandIn()(grey(level)[None])[0], 0.0, {}), None)
        return drawn_track(log).axes

    for each in axes([0, 0, 0]):
        assert [text.get_text() for text in each.texts] == ["no pose"] and each.get_xlim() == pytest.approx((0, 0.2))
    for each in axes([9]):
        assert not each.texts and list(each.get_xticks()) == [0]
    for each in axes([0]):
        assert [text.get_text() for text in each.texts] == ["no pose"] and list(each.get_xticks()) == [0]
    for each in axes([9, 0, 12]):
        assert not each.texts and len(each.get_xticks()) > 2 and len(each.get_yticks()) > 2


def test_the_pose_before_is_passed_on_from_three_on_but_not_across_a_refusal():
    """Three searches of whole frames must agree before the next frame is searched near the last pose."""
    tracker = StandIn()
    levels = [10, 20, 30, 40, 0, 50, None, 60, 70, 80, 90]
    pixels = [None if level is None else grey(level) for level in levels]
    frames = [Frame(0.1 * i, each, "" if each is not None else "lost") for i, each in enumerate(pixels)]
    found = list(follow(frames, tracker))
    refused = {4: "NO_CATHETER", 6: "BAD_FRAME"}
    assert [item.status.name for item in found] == [refused.get(i, "OK") for i in range(len(levels))]
    given = [None if previous is None else float(previous[0].tip[0]) for previous in tracker.previous]
    assert given == [None, None, None, 30 / 3e3, 40 / 3e3, None, None, None, None, 80 / 3e3]
    assert found[6].pose.reason == "lost" and found[6].seconds == 0


@pytest.mark.parametrize("batch", [2, 5])
def test_a_batch_has_the_poses_of_its_frames_one_by_one(batch):
    world = World((540, 960))
    tracker = CatheterTracker(world.camera, world.catheter, channels=ChannelOrder.RGB)
    first, second, third = (case.frame() for case in world.still(0.3, 0.35, 3))
    black = torch.zeros(3, 540, 960, dtype=torch.uint8)
    frames = [Frame(0.0, first), Frame(0.1, None, "lost"), Frame(0.2, second), Frame(0.3, black), Frame(0.4, third)]
    alone = [tracker((black if frame.pixels is None else frame.pixels)[None])[0] for frame in frames]
    calls = []

    class Counted:
        times: ClassVar = {"edges": 1.0}

        def __call__(self, frames, previous):
            calls.append((len(frames), previous))
            return tracker(frames, previous)

    found = list(follow(iter(frames), Counted(), batch))
    assert calls == {2: [(1, None), (2, None), (1, None)], 5: [(4, None)]}[batch]
    assert [(item.number, item.status) for item in found] == [
        *((0, Status.OK), (1, Status.BAD_FRAME), (2, Status.OK), (3, alone[3].status), (4, Status.OK))
    ]
    assert not alone[3].answered and found[1].pose.reason == "lost" and not found[1].stages
    for item, pose in zip(found, alone, strict=True):
        if item.frame.pixels is not None:
            assert item.pose.reason == pose.reason
            for name in ("tip", "direction", "covariance", "chi_square"):
                assert torch.equal(getattr(item.pose, name), getattr(pose, name)) or not pose.answered
    assert found[4].stages == {"edges": {2: 1.0, 5: 0.25}[batch]}


def test_a_run_tracks_in_batches(tmp_path, tracker):
    """The stand-in takes one frame at a time, so that a larger batch fails and a batch with one good frame does not."""
    source = pictures(tmp_path / "in", [30, None, 33])
    folder, _ = tracked(tmp_path, source, batch=2, video=False)
    assert [row["status"] for row in read(folder)] == ["OK", "BAD_FRAME", "OK"]
    with pytest.raises(AssertionError):
        tracked(tmp_path, source, "whole", batch=3, video=False)


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
    again, complete = track(tmp_path / "b", recording, video=False)  # with the files beside it
    assert complete
    first, second = read(folder), read(again)
    for line in (*first, *second):
        line.pop("milliseconds")
    assert first == second


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"source": "missing.mp4"}, "no such video, folder or camera"),
        ({"camera": None}, "no camera is given: say which with --camera"),
        (
            {"catheter": "gone.yaml"},
            "gone.yaml: cannot read the configuration: No such file or directory; expected the settings of a catheter",
        ),
        ({"out": "in"}, "holds files already"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, tracker, options, message):
    pictures(tmp_path / "in", [9])
    before = sorted(tmp_path.rglob("*"))
    given = {"source": "in", "camera": "camera.yaml", "catheter": "catheter.yaml", "out": "out"} | options
    given = {name: value and str(tmp_path / value) for name, value in given.items()}
    with pytest.raises(ConfigError, match=message):
        track(Path(given.pop("out")), **given)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("method", "message"), [("ours", "colours"), ("thesis", "use CatheterTracker")])
def test_a_catheter_that_no_tracker_sees_is_refused_before_anything_is_written(tmp_path, method, message):
    greys = ((30, 30, 30), (128, 128, 128), (230, 230, 230))
    save_camera(tmp_path / "camera.yaml", CAMERA, SIZE)
    save_catheter(tmp_path / "catheter.yaml", Catheter(THESIS.edges, greys, THESIS.radius, THESIS.length))
    source = pictures(tmp_path / "in", [9])
    text = (tmp_path / "catheter.yaml").read_text()
    line = text[: text.index("colours:")].count("\n") + 1
    with pytest.raises(ConfigError, match=f"catheter.yaml:{line}:1: colours: .*{message}"):
        tracked(tmp_path, source, method=method)
    with pytest.raises(ConfigError, match=f"catheter.yaml:{line}:1: colours: .*{message}"):
        tracked(tmp_path, "synthetic", method=method, frames=1)
    assert not (tmp_path / "out").exists()
    if method == "ours":
        with pytest.raises(ConfigError, match=message):
            list(live([str(source)], tmp_path / "camera.yaml", tmp_path / "catheter.yaml"))


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
        live(["a.mp4", "b.mp4"], *files)
    with pytest.raises(ConfigError, match="no camera is given"):  # at once, not with the first frame
        live([str(source)], None, files[1])


def test_live_poses_of_a_recording_need_no_other_files(tmp_path, tracker):
    folder, _ = tracked(tmp_path, pictures(tmp_path / "in", [9, 12]), record=True, video=False)
    assert [float(pose.tip[0]) for _, pose in live([str(folder / "recording")], None, None)] == [9 / 3e3, 12 / 3e3]


def test_a_live_pose_has_the_time_of_its_frame_not_of_its_tracking(tmp_path, tracker, monkeypatch):
    camera = Frames("camera 0", SIZE, None, 30.0, iter([Frame(7.0, grey(9)), Frame(7.5, grey(12))]), [], live=True)
    monkeypatch.setattr(track_source, "open_frames", lambda *_: camera)
    monkeypatch.setattr(tracking_run, "now", lambda: 100.0)

    def slow(frames, tracker, batch):
        return (Tracked(i, frame, tracker(frame.pixels[None])[0], 0.25 + i, {}) for i, frame in enumerate(frames))

    monkeypatch.setattr(tracking_run, "follow", slow)
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


def test_a_rough_calibration_is_noted(tmp_path, tracker):
    source = pictures(tmp_path / "in", [9])
    path = tmp_path / "camera.yaml"
    settings = yaml.safe_load(path.read_text())
    evidence = {
        "rms_px": 0.2,
        "views": {"a.png": 0.2},
        "cells": 0.3,
        "radius": 0.4,
        "tilts": [0.5, 0.5],
        "between": 0.0,
    }
    for name, share, told in (("rough", 0.15, True), ("good", 0.001, False)):
        evidence["deviations"] = {"fx": share * settings["fx"], "fy": share * settings["fx"]}
        path.write_text(yaml.safe_dump(settings | {"calibration": evidence}))
        folder, _ = tracked(tmp_path, source, name, video=False)
        assert any("determines its focal length only to 15.0 %" in note for note in summary(folder)["notes"]) == told


def test_a_recording_that_does_not_fit_is_refused(tmp_path, tracker, monkeypatch):
    monkeypatch.setattr(tracking_run, "free_bytes", lambda _: 1000)
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
    again, _ = track(tmp_path / "b", folder / "recording", method=method, video=False)
    first, second = read(folder), read(again)
    for line, other in zip(first, second, strict=True):
        tip = torch.tensor([float(line[f"tip_{axis}_m"]) for axis in "xyz"], dtype=torch.float64)
        assert (tip - truth).norm() < 5e-3
        # Frames of a folder count at an assumed rate; the recording keeps those times.
        assert all(line[name] == other[name] for name in COLUMNS if name != "milliseconds")
