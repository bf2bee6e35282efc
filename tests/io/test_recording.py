import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from holotorch.io.recording import Recorder, free_bytes, is_recording, open_recording, recording_bytes
from holotorch.io.video import Frame

SHAPE = (12, 17)


def noise(count: int) -> list[torch.Tensor]:
    return list(torch.randint(0, 256, (count, 3, *SHAPE), dtype=torch.uint8))


def same(frame: Frame, pixels: torch.Tensor) -> bool:
    return frame.pixels is not None and torch.equal(frame.pixels, pixels)


def recorded(folder, pictures, times=None) -> None:
    with Recorder(folder, SHAPE, 30.0, "test") as recorder:
        for index, pixels in enumerate(pictures):
            recorder.write(Frame(index / 30 if times is None else times[index], pixels))


def test_replay_is_the_same_to_the_bit(tmp_path):
    (tmp_path / "lens.yaml").write_bytes(b"fx: 1400.0  # \xc2\xb5\r\n")
    pictures, times = noise(5), [1700000000.1, 1700000000.1333333, 1 / 3, 1e-300, 0.1 + 0.2]
    folder = tmp_path / "made"
    with Recorder(folder, SHAPE, 29.97, "camera 0", {"camera.yaml": tmp_path / "lens.yaml"}) as recorder:
        for seconds, pixels in zip(times, pictures, strict=True):
            recorder.write(Frame(seconds, pixels))
        recorder.write(Frame(2.0, None, 'its "cable",\nor its lens'))
    assert is_recording(folder) and not is_recording(tmp_path)
    assert (folder / "camera.yaml").read_bytes() == (tmp_path / "lens.yaml").read_bytes()
    assert (folder / "frames.rgb").stat().st_size == recording_bytes(SHAPE, 5) == 5 * 12 * 17 * 3
    # The layout as the module describes it, read without the module.
    raw = np.fromfile(folder / "frames.rgb", np.uint8).reshape(5, 12, 17, 3)
    np.testing.assert_array_equal(raw[3, 4, 5], pictures[3][:, 4, 5].numpy())
    for _ in range(2):
        frames = open_recording(folder)
        assert (frames.shape, frames.total, frames.rate, frames.notes) == (SHAPE, 6, 29.97, [])
        *found, lost = list(frames)
        assert [frame.seconds for frame in found] == times
        assert all(same(frame, pixels) for frame, pixels in zip(found, pictures, strict=True))
        assert lost == Frame(2.0, None, 'its "cable", or its lens')


_ENDLESS = """
import sys, torch
from pathlib import Path
from holotorch.io.recording import Recorder
from holotorch.io.video import Frame
recorder = Recorder(Path(sys.argv[1]), (12, 17), 30.0, "endless")
index = 0
while True:
    recorder.write(Frame(index / 30, torch.full((3, 12, 17), index % 256, dtype=torch.uint8)))
    index += 1
"""


def test_a_killed_recording_is_readable(tmp_path):
    folder = tmp_path / "killed"
    writer = subprocess.Popen([sys.executable, "-c", _ENDLESS, str(folder)])
    try:
        while not ((folder / "times.csv").is_file() and (folder / "times.csv").stat().st_size > 2000):
            assert writer.poll() is None
            time.sleep(0.01)
    finally:
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
    found = list(open_recording(folder))
    assert len(found) > 20
    for index, frame in enumerate(found):
        assert frame.pixels is not None and frame.seconds == index / 30
        assert bool((frame.pixels == index % 256).all())


@pytest.mark.parametrize(("size", "left"), [(recording_bytes(SHAPE, 5) + 99, 5), (recording_bytes(SHAPE, 1), 1)])
def test_a_full_disk_leaves_whole_frames_and_the_recording_can_go_on(tmp_path, full_disk, size, left):
    pictures = noise(9)
    with Recorder(tmp_path / "a", SHAPE, 30.0, "test") as recorder:
        with pytest.raises(OSError), full_disk(size):
            for index, pixels in enumerate(pictures):
                recorder.write(Frame(index / 30, pixels))
        assert recorder.frames == left
        assert (tmp_path / "a" / "frames.rgb").stat().st_size == recording_bytes(SHAPE, left)
        recorder.write(Frame(1.0, pictures[-1]))
    frames = open_recording(tmp_path / "a")
    assert not frames.notes
    *first, last = frames
    assert all(same(frame, pixels) for frame, pixels in zip(first, pictures[:left], strict=True))
    assert same(last, pictures[-1]) and last.seconds == 1.0


def test_a_line_that_does_not_fit_takes_its_frame_with_it(tmp_path, monkeypatch):
    first, second = noise(2)
    with Recorder(tmp_path / "a", SHAPE, 30.0, "test") as recorder:
        recorder.write(Frame(0.0, first))

        def full(_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(recorder, "_row", full)
        with pytest.raises(OSError, match="No space left"):
            recorder.write(Frame(1 / 30, second))
    frames = open_recording(tmp_path / "a")
    assert not frames.notes and [same(frame, first) for frame in frames] == [True]


@pytest.mark.parametrize(
    ("pixels_cut", "line_cut", "left", "note"),
    [(0, 0, 4, ""), (0, 7, 3, "cut off while a frame was written"), (100, 0, 3, "holds 3 of 4 frames")]
    + [(100, 7, 3, "cut off while a frame was written"), (recording_bytes(SHAPE, 1), 7, 3, "")],
)
def test_every_cut_leaves_the_frames_before_it(tmp_path, pixels_cut, line_cut, left, note):
    pictures = noise(4)
    recorded(tmp_path / "a", pictures)
    for name, cut in (("frames.rgb", pixels_cut), ("times.csv", line_cut)):
        os.truncate(tmp_path / "a" / name, (tmp_path / "a" / name).stat().st_size - cut)
    frames = open_recording(tmp_path / "a")
    found = list(frames)
    assert len(found) == left and note in "".join(frames.notes) and bool(note) == bool(frames.notes)
    assert all(same(frame, pixels) for frame, pixels in zip(found, pictures, strict=False))


def test_changed_bytes_are_noticed(tmp_path):
    recorded(tmp_path / "a", noise(3))
    data = bytearray((tmp_path / "a" / "frames.rgb").read_bytes())
    data[recording_bytes(SHAPE, 1) + 5] ^= 1
    (tmp_path / "a" / "frames.rgb").write_bytes(data)
    found = list(open_recording(tmp_path / "a"))
    assert [frame.pixels is None for frame in found] == [False, True, False]
    assert "changed since" in found[1].problem


def test_what_cannot_be_recorded_or_replayed_says_why(tmp_path):
    recorded(tmp_path / "a", noise(2))
    with pytest.raises(ValueError, match="holds files already"):
        Recorder(tmp_path / "a", SHAPE, 30.0, "again")
    with Recorder(tmp_path / "b", SHAPE, 30.0, "b") as recorder:
        with pytest.raises(ValueError, match=r"uint8 \[3, 12, 17\], got torch.uint8 \[3, 12, 16\]"):
            recorder.write(Frame(0.0, torch.zeros(3, 12, 16, dtype=torch.uint8)))
        with pytest.raises(ValueError, match="time of a frame must be finite"):
            recorder.write(Frame(float("nan"), noise(1)[0]))
    for folder, message in (("b", "no complete frame"), ("c", "holds no recording")):
        with pytest.raises(ValueError, match=message):
            open_recording(tmp_path / folder)
    lines = (tmp_path / "a" / "times.csv").read_text().splitlines()
    (tmp_path / "a" / "times.csv").write_text("\n".join([lines[0], "0,soon,00000000,", lines[2]]) + "\n")
    with pytest.raises(ValueError, match="times.csv:2 is damaged: '0,soon,"):
        open_recording(tmp_path / "a")
    facts = json.loads((tmp_path / "a" / "recording.json").read_text())
    assert facts["channels"] == "RGB"
    for change, message in (
        ({"format": 2}, "use a newer one"),
        ({"height": 0}, "height must be at least 1"),
        ({"channels": "BGR"}, "states channels 'BGR'; recordings are RGB"),
    ):
        (tmp_path / "a" / "recording.json").write_text(json.dumps(facts | change))
        with pytest.raises(ValueError, match=message):
            open_recording(tmp_path / "a")
    del facts["channels"]  # as recordings were before it was stated
    (tmp_path / "a" / "recording.json").write_text(json.dumps(facts))
    (tmp_path / "a" / "times.csv").write_text("\n".join(lines) + "\n")
    assert len(list(open_recording(tmp_path / "a"))) == 2
    assert free_bytes(tmp_path / "not" / "yet") > 0


def test_facts_nested_without_end_are_damage(tmp_path):
    recorded(tmp_path / "a", noise(1))
    (tmp_path / "a" / "recording.json").write_text('{"a":' * 100_000)
    with pytest.raises(ValueError, match="recording.json is damaged: ValueError nested too deeply"):
        open_recording(tmp_path / "a")


def test_a_carriage_return_in_the_times_is_damage_with_its_line(tmp_path):
    recorded(tmp_path / "made", noise(3))
    times = tmp_path / "made" / "times.csv"
    times.write_bytes(times.read_bytes().replace(b"1,", b"1\r,", 1))
    with pytest.raises(ValueError, match=r"times.csv:\d is damaged: "):
        open_recording(tmp_path / "made")
