"""track, calibrate and stream as a user types them: exit statuses and messages, and what is loaded when."""

import csv
import json
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import paths
import pytest
import torch

from holotorch.cli import main
from holotorch.experiments import execute
from holotorch.experiments.streaming import check as stream_check
from holotorch.experiments.streaming import stream
from holotorch.experiments.tracking import run, synthetic
from holotorch.experiments.tracking.report import Log, Tracked, doubts, refusals
from holotorch.experiments.tracking.synthetic import write_synthetic
from holotorch.io.video import Frame
from holotorch.tracking.pose.status import BEYOND_TIP, THREE_EDGES, Pose, Status
from holotorch.tracking.streaming.packet import PosePacket, decode

CONFIGS = paths.CONFIGS / "tracking"
FILES = ["--camera", str(CONFIGS / "camera.yaml"), "--catheter", str(CONFIGS / "catheter.yaml")]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch, undrawn):
    monkeypatch.chdir(tmp_path)


def said(capsys, *arguments: str, status: int = 2) -> str:
    """What a command says on stderr, ending with ``status`` and without a trace."""
    assert main(list(arguments)) == status
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return err


def wrong(capsys, *arguments: str) -> str:
    """What argparse says of arguments that it refuses."""
    with pytest.raises(SystemExit) as stop:
        main(list(arguments))
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_synthetic(tmp_path_factory.mktemp("made") / "recording", 2, (540, 960))


def test_track_a_recording_with_its_own_files(recording, capsys):
    assert main(["track", str(recording), "--out", "here", "--no-video"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "here/report.html" and Path("here/report.html").is_file()
    assert lines[-2] == "Pictures   here/images"
    assert lines[-3].startswith("Truth      the tip is") and "in 2 frames; 0 refused (synthetic)" in lines[-3]
    with open("here/poses.csv", newline="") as stream:
        assert [row["status"] for row in csv.DictReader(stream)] == ["OK", "OK"]
    assert not Path("here/overlay.mp4").exists()
    assert json.loads(Path("here/summary.json").read_text())["status"] == "complete"


def test_track_also_writes_poses_in_the_frame_of_a_headset(recording, capsys):
    Path("headset.yaml").write_text(
        "headset_from_camera: [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, -0.05], [0, 0, 0, 1]]\n"
        "covariance: [[0,0,0,0,0,0],[0,0,0,0,0,0],[0,0,0,0,0,0],[0,0,0,4.0e-6,0,0],[0,0,0,0,0,0],[0,0,0,0,0,0]]\n"
    )
    assert main(["track", str(recording), "--out", "here", "--no-video", "--headset", "headset.yaml"]) == 0
    tables = []
    for name in ("poses", "headset_poses"):
        with open(f"here/{name}.csv", newline="") as stream:
            tables.append(list(csv.DictReader(stream)))
    for own, moved in zip(*tables, strict=True):
        assert float(moved["tip_x_m"]) == pytest.approx(0.1 - float(own["tip_y_m"]), abs=1e-12)
        assert float(moved["tip_y_m"]) == pytest.approx(float(own["tip_x_m"]), abs=1e-12)
        assert float(moved["tip_z_m"]) == pytest.approx(float(own["tip_z_m"]) - 0.05, abs=1e-12)
        assert float(moved["direction_x"]) == pytest.approx(-float(own["direction_y"]), abs=1e-12)
        assert float(moved["cov_xx_m2"]) == pytest.approx(float(own["cov_yy_m2"]) + 4e-6, rel=1e-9)
        assert (moved["frame"], moved["status"]) == (own["frame"], own["status"])
    capsys.readouterr()
    assert "none.yaml" in said(capsys, "track", str(recording), "--headset", "none.yaml")


def test_track_the_synthetic_source_renders_it_first(monkeypatch, capsys):
    monkeypatch.setattr(run, "write_synthetic", lambda out, _, **given: write_synthetic(out, 1, (540, 960), **given))
    assert main(["track", "synthetic", "--no-video"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Source     synthetic: 45 frames") and lines[-1] == "runs/track-001/report.html"
    assert "in 1 frames; 0 refused" in lines[-3] and lines[-2] == "Pictures   runs/track-001/images"
    Path("c.yaml").write_text("fx: 620\nfy: 620\ncx: 480\ncy: 270\nsize: [540, 960]\n")
    assert main(["track", "synthetic", "--no-video", "--camera", "c.yaml", *FILES[2:]]) == 0
    assert "fx: 620" in Path("runs/track-002/synthetic/camera.yaml").read_text()
    with open("runs/track-002/poses.csv", newline="") as stream:
        (row,) = csv.DictReader(stream)
    with open("runs/track-002/synthetic/truth.csv", newline="") as stream:
        (true,) = csv.DictReader(stream)
    assert abs(float(row["tip_z_m"]) - float(true["tip_z_m"])) < 1.5e-3


def test_track_takes_settings_as_run_does_before_and_after_options(monkeypatch, capsys):
    taken = []
    monkeypatch.setattr(execute, "execute", lambda settings, *_: taken.append(settings) or (Path("o"), True))
    assert main(["track", "a.mp4", "still=true", "--no-video", "rate_hz=25", "method=thesis", "frames=3"]) == 0
    settings = taken[0]
    assert (settings.source, settings.still, settings.video) == ("a.mp4", True, False)
    assert (settings.rate_hz, settings.method, settings.frames) == (25, "thesis", 3)
    error = said(capsys, "track", "a.mp4", "frame=3")
    assert error == "argument 'frame=3': frame: unknown setting; did you mean 'frames'?\n"
    assert said(capsys, "track", "a.mp4", "b.mp4") == "argument 'b.mp4': expected key=value or key.sub=value\n"
    assert "unrecognized arguments: b.mp4" in wrong(capsys, "track", "a.mp4", "--still", "b.mp4")


def test_the_synthetic_recording_is_also_a_video_that_a_first_try_can_track(tmp_path, capsys):
    Path("c.yaml").write_text("fx: 930\nfy: 930\ncx: 640\ncy: 360\nsize: [720, 1280]\n")
    assert main(["track", "synthetic", "frames=2", "--camera", "c.yaml", "--out", "here"]) == 0
    made = Path("here/synthetic")
    files = ["--camera", str(made / "camera.yaml"), "--catheter", str(made / "catheter.yaml")]
    assert main(["track", str(made / "video.avi"), *files, "--no-video", "--out", "again"]) == 0
    tips = []
    for name in ("here", "again"):
        with open(f"{name}/poses.csv", newline="") as table:
            tips.append([[float(row[f"tip_{axis}_m"]) for axis in "xyz"] for row in csv.DictReader(table)])
    assert np.array(tips).shape == (2, 2, 3)
    assert np.abs(np.subtract(*tips)).max() < 3e-3  # chroma at half the resolution: some times the error of the frames


def test_track_says_an_interruption_by_its_status(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(execute, "execute", lambda *_: (tmp_path, False))
    assert main(["track", "video.mp4", *FILES]) == 130
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path)
    (tmp_path / "report.html").touch()
    assert main(["track", "video.mp4", *FILES]) == 130
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "report.html")


def test_track_hands_its_arguments_on(monkeypatch):
    taken = []

    def stand_in(settings, *others):
        taken.extend((settings.model_dump(), *others))
        return Path("here"), True

    monkeypatch.setattr(execute, "execute", stand_in)
    words = ["--out", "o", "--method", "thesis", "--record", "--still", "--rate", "25"]
    words += ["--headset", "h.yaml", "--batch", "4"]
    assert main(["track", "0", "--camera", "c.yaml", "--catheter", "t.yaml", *words]) == 0
    assert taken[1:] == [Path("o"), "track"]
    flags = {"method": "thesis", "record": True, "video": True, "still": True, "rate_hz": 25.0, "batch": 4}
    values = {
        "experiment": "track",
        "source": "0",
        "camera": "c.yaml",
        "catheter": "t.yaml",
        "frames": None,
        "headset": "h.yaml",
    }
    assert taken[0] == values | flags


def test_track_without_a_camera_or_a_catheter_asks_for_them(capsys):
    cv2.imwrite("0.png", np.zeros((48, 64, 3), np.uint8))
    error = said(capsys, "track", ".")
    assert "no camera is given: say which with --camera, or camera: in a configuration" in error
    assert "no catheter is given: say which with --catheter" in error
    error = said(capsys, "track", ".", *FILES[2:])
    assert "--camera" in error and "--catheter" not in error
    assert not Path("runs").exists()


def test_track_with_files_that_are_missing_or_wrong(capsys):
    cv2.imwrite("0.png", np.zeros((1080, 1920, 3), np.uint8))
    assert "nowhere.mp4" in said(capsys, "track", "nowhere.mp4", *FILES)
    assert "none.yaml" in said(capsys, "track", ".", "--camera", "none.yaml", *FILES[2:])
    assert "none.yaml" in said(capsys, "track", ".", *FILES[:2], "--catheter", "none.yaml")
    Path("bad.yaml").write_text("fx: -3\nfy: 1400\ncx: 960\ncy: 540\n")
    assert "bad.yaml:1:1: fx: expected greater than 0, got -3" in said(
        capsys, "track", ".", "--camera", "bad.yaml", *FILES[2:]
    )
    Path("text.mp4").write_text("no video")
    assert "text.mp4" in said(capsys, "track", "text.mp4", *FILES)
    Path("empty").mkdir()
    assert "empty" in said(capsys, "track", "empty", *FILES)
    assert not Path("runs").exists()


def test_track_with_wrong_arguments(capsys):
    words = said(capsys, "track", ".", *FILES, "--method", "best")
    assert words == "argument --method: method: expected 'ours' or 'thesis', got 'best'\n"
    assert "argument --rate: rate_hz: expected a finite number" in said(capsys, "track", ".", "--rate", "nan")
    assert "argument --batch: batch: expected greater than or equal to 1" in said(capsys, "track", ".", "--batch", "0")
    assert "argument --batch: batch: expected less than or equal to 64" in said(capsys, "track", ".", "--batch", "65")
    assert "SOURCE" in wrong(capsys, "track")
    assert "invalid float value: 'fast'" in wrong(capsys, "track", ".", "--rate", "fast")
    assert "unrecognized arguments: --colour" in wrong(capsys, "track", ".", "--colour", "red")


def test_track_looks_for_the_source_first(recording, capsys):
    assert said(capsys, "track", "nowhere").splitlines() == [
        "no such video, folder or camera: nowhere; a camera is given by its number, such as 0"
    ]
    for name, lost in (("a", "times.csv"), ("b", "recording.json")):
        shutil.copytree(recording, name)
        Path(name, lost).unlink()
        assert said(capsys, "track", name) == f"{name}: a recording without its {lost} cannot be replayed\n"


def test_track_with_two_wrong_files_names_both(capsys):
    cv2.imwrite("0.png", np.zeros((1080, 1920, 3), np.uint8))
    error = said(capsys, "track", ".", "--camera", "no1.yaml", "--catheter", "no2.yaml")
    assert [line.split(":")[0] for line in error.splitlines()] == ["no1.yaml", "no2.yaml"]
    Path("no1.yaml").write_text("")
    Path("no2.yaml").write_text("[1, 2]\n")
    error = said(capsys, "track", ".", "--camera", "no1.yaml", "--catheter", "no2.yaml")
    assert error.splitlines() == [
        "no1.yaml:1:1: the file is empty; expected the settings of a camera: fx, fy, cx, cy",
        "no2.yaml:1:1: expected the settings of a catheter: edges, colours, radius, length, got [1, 2]",
    ]


def test_track_for_frames_of_another_size(capsys):
    cv2.imwrite("0.png", np.zeros((48, 64, 3), np.uint8))
    Path("camera.yaml").write_text("fx: 60\nfy: 60\ncx: 320\ncy: 240\nsize: [480, 640]\n")
    error = said(capsys, "track", ".", "--camera", "camera.yaml", *FILES[2:])
    assert "holds for frames of 640 x 480 px, and these have 64 x 48 px" in error


def test_calibrate_with_files_that_are_missing_or_wrong(capsys):
    assert "FILE" in wrong(capsys, "calibrate")
    assert said(capsys, "calibrate", "none.png", "camera") == (
        "none.png: no such file or folder\ncamera: no such file or folder\n"
    )
    Path("empty").mkdir()
    assert "empty" in said(capsys, "calibrate", "empty")
    for i in range(4):
        cv2.imwrite(f"{i}.png", np.full((120, 160, 3), 90, np.uint8))
    error = said(capsys, "calibrate", *(f"{i}.png" for i in range(4)))
    assert "\n0.png, 1.png, 2.png, 3.png: " in error  # no board on any, all named
    cv2.imwrite("4.png", np.full((60, 80, 3), 90, np.uint8))
    assert "photographs of one size" in said(capsys, "calibrate", *(f"{i}.png" for i in range(5)))
    assert not Path("camera.yaml").exists()


def test_calibrate_with_a_board_that_is_none(capsys):
    cv2.imwrite("0.png", np.full((120, 160, 3), 90, np.uint8))
    error = said(capsys, "calibrate", "0.png", "--board", "chessboard", "9x6", "-25mm")
    assert error == "--board: square must be above zero in metres, got -0.025\n"
    for words in (["circles", "9x6", "25mm"], ["chessboard", "9x6"], ["chessboard", "nine", "25mm"], ["charuco"]):
        assert "--board: expected chessboard 9x6 25mm" in said(capsys, "calibrate", "0.png", "--board", *words)


def test_calibrate_does_not_write_over_a_file(capsys):
    Path("camera.yaml").write_text("mine")
    cv2.imwrite("0.png", np.full((120, 160, 3), 90, np.uint8))
    assert "camera.yaml exists already" in said(capsys, "calibrate", "0.png")
    assert "photo: no such file or folder" in said(capsys, "calibrate", "photo")
    assert Path("camera.yaml").read_text() == "mine"


def test_a_run_with_few_poses_says_what_to_look_at(tmp_path):
    log, frame = Log(tmp_path), Frame(0.0, None)
    wide = "{} times as wide as it should be at 0.48 m"
    reasons = [
        (Status.INCONSISTENT, "no line"),
        *((Status.INCONSISTENT, wide.format(0.45 + i / 100)) for i in range(4)),
    ]
    reasons += [(Status.UNCERTAIN, "tip uncertain to 3.0 mm")] * 2
    for i, (status, reason) in enumerate(reasons):
        log.take(Tracked(i, frame, Pose.refused(status, reason), 0.0, {}), None)
    refused = [{"status": s, "frames": n, "first": first} for (s, _), (n, first) in log.refused.items()]
    refused.sort(key=lambda each: -each["frames"])
    first, second = refusals({"refused": refused, "answered": 3, "frames": 10})
    assert first.startswith(f"Refused    4 like frame 1, INCONSISTENT: {wide.format(0.45)}; no pose explains")
    assert "`radius` (half the thickness)" in first
    assert second.startswith("Refused    2 like frame 5, UNCERTAIN: tip uncertain to 3.0 mm; are the lengths of the ")
    assert second.endswith("; 1 more for other reasons (poses.csv)") and "more for" not in first
    assert refusals({"refused": refused, "answered": 22, "frames": 29})
    (single, _) = refusals({"refused": refused, "answered": 48, "frames": 55})
    assert "the files fit the other frames: is something across or beside a band" in single
    few = {"refused": refused, "answered": 2, "frames": 9, "statuses": {"OK": 2, "INCONSISTENT": 7}}
    assert "the 2 poses beside so many contradictions may be wrong" in refusals(few)[-1]
    assert not refusals({"refused": refused, "answered": 593, "frames": 600})
    for status in Status:
        if not status.answered:
            (line,) = refusals(
                {"refused": [{"status": status.name, "frames": 2, "first": "frame 0"}], "answered": 0, "frames": 2}
            )
            assert line.startswith("Refused    2 like frame 0; ")


@pytest.mark.parametrize(
    ("reason", "words"), [(BEYOND_TIP, "is the camera's file that of this camera"), (THREE_EDGES, "is a band covered")]
)
def test_a_run_says_why_poses_are_unverified(tmp_path, reason, words):
    log = Log(tmp_path)
    one = torch.tensor(1.0)
    pose = Pose(torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]), torch.eye(6), one, one, Status.OK)
    for i in range(50):
        last = i == 49
        item = replace(pose, status=Status.UNVERIFIED, reason=reason) if last else pose
        log.take(Tracked(i, Frame(float(i), None), item, 0.0, {}), None)
    (kind,) = log.unverified.items()
    summary = {"unverified": [{"status": kind[0][0], "frames": kind[1][0], "first": kind[1][1]}], "frames": 50}
    (line,) = doubts(summary)
    assert line.startswith(f"Unverified 1 like frame 49, UNVERIFIED: {reason}; ") and words in line
    assert not doubts(summary | {"frames": 51}) and not doubts({"frames": 50})  # nor in summaries of before
    assert not log.refused


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_stream_check_on_a_free_port_and_on_one_in_use(capsys, monkeypatch):
    """Where others use the computer a packet may be slow; the status says so, and the counts are right all the same."""
    status = main(["stream", "--check", "--packets", "100", "--port", str(free_port())])
    lines = capsys.readouterr().out.splitlines()
    assert status == (1 if any(line.startswith("FAIL") for line in lines) else 0)
    assert lines[0].startswith("OK    port")
    assert sum(line.startswith("OK    receiver") and "100 of 100 packets" in line for line in lines) == 2
    assert sum(line.startswith("OK    lossy path") for line in lines) == 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", 0))
        monkeypatch.setattr(stream_check, "CHROMIUM", None)  # the port has no part in what a browser draws
        assert main(["stream", "--check", "--packets", "100", "--port", str(one.getsockname()[1])]) == 1
    assert capsys.readouterr().out.startswith("FAIL  port")


def test_stream_check_says_by_its_status_what_failed(monkeypatch, capsys):
    for sound, status in ((True, 0), (False, 1)):
        monkeypatch.setattr(stream_check, "check", lambda port, packets, sound=sound: sound and port == 4711)
        assert main(["stream", "--check", "--port", "4711"]) == status
    assert "--packets belongs to --check" in said(capsys, "stream", "poses.csv", "--packets", "500")
    assert "from 100 to 10 million, got '7'" in wrong(capsys, "stream", "--check", "--packets", "7")


def test_stream_with_nobody_and_nothing_to_send(capsys):
    assert "say to whom: --to HOST:PORT" in said(capsys, "stream", "poses.csv")
    to = ["--to", "127.0.0.1:1"]
    assert "expected one poses.csv or videos to track, got nothing" in said(capsys, "stream", *to)
    assert "poses.csv" in said(capsys, "stream", "poses.csv", *to)  # there is none
    Path("other.csv").write_text("a,b\n1,2\n")
    assert "other.csv: not a table of poses" in said(capsys, "stream", "other.csv", *to)
    assert "rate must be above 0 Hz, got -5" in said(capsys, "stream", "poses.csv", *to, "--rate", "-5")
    error = said(capsys, "stream", "poses.csv", "--to", "127.0.0.1:99999")
    assert "expected a port from 1 to 65535, got 99999 in '127.0.0.1:99999'" in error


def test_ports_that_are_none(capsys):
    for words in (["--view", "--port", "65536"], ["--check", "--port", "-1"], ["poses.csv", "--igtl", "99999"]):
        error = wrong(capsys, "stream", *words)
        assert f"expected a port from 0 (any that is free) to 65535, got '{words[-1]}'" in error


def test_stream_of_a_video_takes_a_camera_and_a_catheter(capsys):
    cv2.imwrite("0.png", np.zeros((1080, 1920, 3), np.uint8))
    to = ["--to", "127.0.0.1:1"]
    assert "no camera is given: say which with --camera" in said(capsys, "stream", ".", *to)
    assert "no catheter is given: say which with --catheter" in said(capsys, "stream", ".", *FILES[:2], *to)
    assert "expected one source to track and stream, got 2" in said(capsys, "stream", "a.mp4", "b.mp4", *FILES, *to)
    words = ["--replay . is the source itself: leave a.mp4 out"]
    assert said(capsys, "stream", "a.mp4", "--replay", ".").splitlines() == words
    swapped = ["--camera", FILES[3], "--catheter", FILES[3]]
    error = said(capsys, "stream", ".", *swapped, *to)
    assert f"{FILES[3]}: this is the file of a catheter, but that of a camera is expected (fx, fy, cx, cy)" in error
    error = said(capsys, "stream", ".", *FILES[:2], "--catheter", FILES[1], *to)
    assert f"{FILES[1]}: this is the file of a camera, but that of a catheter is expected (edges, colours" in error
    assert "nowhere.mp4" in said(capsys, "stream", "nowhere.mp4", *FILES, *to)
    assert "none.yaml" in said(capsys, "stream", ".", "--camera", "none.yaml", *FILES[2:], *to)


def test_stream_looks_at_its_files_before_it_says_that_it_sends(capsys):
    cv2.imwrite("0.png", np.zeros((1080, 1920, 3), np.uint8))
    assert main(["stream", ".", "--to", "127.0.0.1:1"]) == 2
    assert capsys.readouterr().out == ""


def test_what_sends_nothing_of_the_users_takes_no_source(capsys):
    error = said(capsys, "stream", "--to", "127.0.0.1:1", "--view")
    advice = "--view without a SOURCE only listens; name one, or send from another terminal"
    assert error.splitlines() == [f"{advice}: it takes no --to"]
    error = said(capsys, "stream", "poses.csv", "--check")
    assert error.splitlines() == ["--check sends to this computer itself: it takes no SOURCE"]
    error = said(capsys, "stream", "--check", "--view", "--smooth", "--igtl", "0")
    assert "takes no --igtl, --smooth, --view" in error


def test_stream_says_by_its_status_what_became_of_it(monkeypatch, capsys):
    for ended, source, status in (
        ((4, True, True), "rec", 0),
        ((4, False, True), "rec", 130),
        ((4, False, True), "0", 0),  # a camera never ends
        ((4, True, False), "rec", 1),
    ):
        monkeypatch.setattr(stream, "stream", lambda *_, ended=ended, **__: stream.Streamed(*ended))
        assert main(["stream", source, "--to", "127.0.0.1:1"]) == status
    assert "nothing could be delivered" in capsys.readouterr().err


def test_stream_tracks_a_recording(recording, capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        assert main(["stream", str(recording), "--to", f"127.0.0.1:{receiver.getsockname()[1]}"]) == 0
        packets = [decode(receiver.recv(4096)) for _ in range(2)]
    poses = [packet for packet in packets if isinstance(packet, PosePacket)]
    assert [packet.pose.status for packet in poses] == [Status.OK, Status.OK]
    assert 0 < poses[1].sequence - poses[0].sequence <= 2


def test_stream_renders_the_synthetic_source(monkeypatch, capsys):
    def small(out, frames, **given):
        assert frames == 45
        return write_synthetic(out, 2, (540, 960), **given)

    monkeypatch.setattr(synthetic, "write_synthetic", small)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        assert main(["stream", "synthetic", "--to", f"127.0.0.1:{receiver.getsockname()[1]}"]) == 0
        packets = [decode(receiver.recv(4096)) for _ in range(2)]
    assert [packet.pose.status for packet in packets if isinstance(packet, PosePacket)] == [Status.OK, Status.OK]


def test_stream_renders_nothing_for_nobody(monkeypatch, capsys):
    monkeypatch.setattr(synthetic, "write_synthetic", lambda *_, **__: pytest.fail("rendered"))
    assert "say to whom" in said(capsys, "stream", "synthetic")
    assert "expected a port from 1 to 65535" in said(capsys, "stream", "synthetic", "--to", "127.0.0.1:99999")
    assert "no way to nobody.invalid:18950: " in said(capsys, "stream", "synthetic", "--to", "nobody.invalid")
    assert "absent.yaml: cannot read" in said(capsys, "stream", "synthetic", "--to", "127.0.0.1=absent.yaml")


LOADED = """
import contextlib, io, sys
from holotorch.cli import main
for words in (["--help"], ["track", "--help"], ["calibrate", "--help"], ["stream", "--help"]):
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        main(words)
    slow = {"torch", "kornia", "cv2", "numpy", "yaml", "pydantic"}
    print(len(text.getvalue()) > 100, sorted(slow & set(sys.modules)))
"""


def test_help_loads_nothing():
    found = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == ["True []"] * 4


def test_a_configuration_tracks_as_the_short_form_does(recording, capsys):
    config = str(CONFIGS / "track.yaml")
    words = [config, f"source={recording}", "video=false"]
    assert main(["check", *words]) == 0
    said = capsys.readouterr().out
    assert said.startswith("Source     recording: 960 x 540 px, 30 per second, 2 frames\n")
    assert "for synthetic recordings" not in said
    assert main(["check", *words, "frames=10"]) == 0
    assert "frames=10 is for synthetic recordings" in capsys.readouterr().out
    assert main(["run", *words, "--out", "a"]) == main(["track", str(recording), "--no-video", "--out", "b"]) == 0
    texts = [Path(name, "poses.csv").read_text().splitlines() for name in ("a", "b")]
    one, other = ([row | {"milliseconds": ""} for row in csv.DictReader(text)] for text in texts)
    assert one == other and len(one) == 2
    assert main(["report", "a", "b", "--out", "both.html"]) == 0
    assert Path("both.html").read_text().count("2 of 2 frames have a pose") == 2
