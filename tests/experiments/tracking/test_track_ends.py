"""How a tracking run ends before its time: signals, a full disk, a tracker that fails; and what it keeps."""

import signal

import cv2
import numpy as np
import pytest
from stand_in import SIZE, pictures, read, summary, tracked

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import resume
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.tracking import run as track
from holotorch.experiments.tracking import source as track_source
from holotorch.io.recording import open_recording
from holotorch.io.video import open_frames


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


def test_ctrl_c_while_the_first_frame_is_tracked_leaves_the_folder_free(tmp_path, tracker, monkeypatch):
    def pressed(frames, previous=None):
        signal.raise_signal(signal.SIGINT)
        return tracker(frames, previous)

    source = pictures(tmp_path / "in", [9, 12])
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(track_source, "make_tracker", lambda *_: pressed)
        tracked(tmp_path, source)
    assert not (tmp_path / "out").exists()
    assert tracked(tmp_path, source)[1]


def test_ctrl_c_while_the_first_frame_is_tracked_keeps_what_was_recorded(tmp_path, tracker, monkeypatch, capsys):
    def pressed(frames, previous=None):
        signal.raise_signal(signal.SIGINT)
        return tracker(frames, previous)

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: pressed)
    try:
        folder, complete = tracked(tmp_path, pictures(tmp_path / "in", [9, 12]), record=True)
    except KeyboardInterrupt:
        pytest.fail("the recorded frame is not spoken of")
    assert not complete and len(list(open_recording(folder / "recording"))) == 1
    told = f"no frame was tracked to its end; what there is of the first is in {folder}"
    assert told in capsys.readouterr().err


def test_a_pose_whose_picture_cannot_be_written_is_kept(tmp_path, tracker, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("holotorch.experiments.runs.pictures.write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        tracked(tmp_path, pictures(tmp_path / "in", [9, 12]))
    assert [row["status"] for row in read(tmp_path / "out")] == ["OK"]


def test_a_frame_that_the_tracker_fails_on_is_kept(tmp_path, tracker, monkeypatch):
    def failing(frames, previous=None):
        raise RuntimeError("no convergence")

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: failing)
    with pytest.raises(RuntimeError, match="no convergence"):
        tracked(tmp_path, pictures(tmp_path / "in", [9]), record=True)
    assert len(list(open_recording(tmp_path / "out" / "recording"))) == 1


def test_resume_says_what_to_do_with_a_tracking_run(tmp_path, tracker, monkeypatch):
    def pressed(frames, previous=None):
        if int(frames[0, 0, 0, 0]) == 12:
            signal.raise_signal(signal.SIGINT)
        return tracker(frames, previous)

    monkeypatch.setattr(track_source, "make_tracker", lambda *_: pressed)
    source = pictures(tmp_path / "in", [9, 12])
    for name, kept in (("a", f", the recorded ones by: holotorch track {tmp_path}/a/recording"), ("b", "")):
        folder, complete = tracked(tmp_path, source, name, record=name == "a", video=False)
        assert not complete
        with pytest.raises(ConfigError, match=f"cannot be continued: the poses .* holotorch track {source}{kept}$"):
            resume(folder)


def test_ctrl_c_before_the_first_frame_leaves_nothing(tmp_path, tracker, monkeypatch):
    monkeypatch.setattr("holotorch.experiments.runs.folder.environment", lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        tracked(tmp_path, pictures(tmp_path / "in", [9]), record=True)
    assert not (tmp_path / "out").exists()


def test_a_figure_that_cannot_be_written_costs_no_summary(tmp_path, tracker, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(track, "save_figure", full)
    with pytest.raises(OSError, match="No space left"):
        tracked(tmp_path, pictures(tmp_path / "in", [9, 12]), video=False)
    assert len(read(tmp_path / "out")) == 2 and summary(tmp_path / "out", "interrupted.json")["frames"] == 2
