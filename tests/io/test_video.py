import math
import time

import cv2
import numpy as np
import pytest
import torch

from holotorch.io.video import Frame, open_frames, replacing_video


def picture(value: int, shape=(48, 64)) -> torch.Tensor:
    """A frame whose red, green and blue differ, and its rows and columns too."""
    y, x = torch.meshgrid(torch.arange(shape[0]), torch.arange(shape[1]), indexing="ij")
    return torch.stack([y + value, 2 * x, torch.full_like(x, value)]).clamp(0, 255).to(torch.uint8)


def same(frame: Frame, pixels: torch.Tensor) -> bool:
    return frame.pixels is not None and torch.equal(frame.pixels, pixels)


def save(path, pixels: torch.Tensor) -> None:
    cv2.imwrite(str(path), np.ascontiguousarray(pixels.permute(1, 2, 0).numpy()[..., ::-1]))


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_a_written_video_comes_back_with_its_times(tmp_path, name):
    path = tmp_path / name
    with replacing_video(path, (48, 64), 12.5) as video:
        for value in range(0, 250, 25):
            video.write(picture(value))
    with open_frames(path) as frames:
        assert (frames.shape, frames.total, frames.rate, frames.live) == ((48, 64), 10, 12.5, False)
        assert frames.coarse_colours
        found = list(frames)
    assert [frame.seconds for frame in found] == pytest.approx([i / 12.5 for i in range(10)], abs=1e-9)
    assert not frames.notes
    for value, frame in zip(range(0, 250, 25), found, strict=True):
        assert frame.pixels is not None and frame.pixels.shape == (3, 48, 64) and frame.pixels.is_contiguous()
        # The codecs lose some levels; swapped channels or axes would lose 50.
        assert (frame.pixels.double() - picture(value).double()).abs().mean() < 8
    assert [item.name for item in tmp_path.iterdir()] == [name]


def test_a_video_that_fails_half_way_leaves_nothing(tmp_path):
    def cut():
        with replacing_video(tmp_path / "a.mp4", (48, 64), 25.0) as video:
            video.write(picture(0))
            video.write(picture(0, (24, 64)))

    with pytest.raises(ValueError, match=r"uint8 \[3, 48, 64\], got torch.uint8 \[3, 24, 64\]"):
        cut()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "shape", "rate", "error"),
    [
        ("a.mov", (48, 64), 25.0, ValueError),
        ("a.mp4", (48, 64), math.nan, ValueError),
        ("a.mp4", (1, 64), 25.0, ValueError),
    ]
    + [("none/a.mp4", (48, 64), 25.0, OSError)],
)
def test_videos_that_cannot_be_written_say_so(tmp_path, name, shape, rate, error):
    with pytest.raises(error), replacing_video(tmp_path / name, shape, rate):
        pass


def test_a_damaged_video_gives_what_is_left_and_says_so(tmp_path):
    path = tmp_path / "a.avi"
    with replacing_video(path, (48, 64), 25.0) as video:
        for _ in range(10):  # noise, so that the file is frames more than headers
            video.write(torch.randint(0, 256, (3, 48, 64), dtype=torch.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with open_frames(path) as frames:
        found = list(frames)
    assert 1 <= len(found) < 10
    assert f"announces 10 frames and {len(found)} could be read" in frames.notes[0]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.mp4", b"no video at all" * 40, "not a video that OpenCV can open"),
        ("a.mp4", b"", "not a video that OpenCV can open"),
        ("b.mp4", None, "no such video, folder or camera"),
        ("", None, "holds no pictures"),
    ],
)
def test_sources_without_frames_are_refused(tmp_path, name, data, message):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=message):
        open_frames(tmp_path / name)


def test_pictures_come_in_natural_order_to_the_bit(tmp_path):
    for number in (1, 2, 10, 11):
        save(tmp_path / f"frame{number}.png", picture(number))
    (tmp_path / "notes.txt").write_text("no picture")
    frames = open_frames(tmp_path)
    assert frames.total == 4 and "30 frames per second assumed" in frames.notes[0]
    for index, (number, frame) in enumerate(zip((1, 2, 10, 11), frames, strict=True)):
        assert same(frame, picture(number)) and frame.seconds == index / 30
    timed = open_frames(tmp_path, rate=8)
    assert not timed.notes and [frame.seconds for frame in timed] == [0, 0.125, 0.25, 0.375]
    with pytest.raises(ValueError, match="rate must be above zero"):
        open_frames(tmp_path, rate=0)


def test_pictures_that_cannot_be_used_are_frames_with_a_problem(tmp_path):
    for number in range(5):
        save(tmp_path / f"{number}.png", picture(number, (48, 60) if number == 3 else (48, 64)))
    cut = (tmp_path / "1.png").read_bytes()
    (tmp_path / "1.png").write_bytes(cut[: len(cut) // 2])
    (tmp_path / "4.png").write_bytes(b"")
    found = list(open_frames(tmp_path))
    assert [frame.pixels is None for frame in found] == [False, True, False, True, True]
    assert "1.png is not a readable picture" in found[1].problem
    assert found[3].problem == "3.png is 60 x 48 px and the first 64 x 48 px"
    for number in range(5):
        (tmp_path / f"{number}.png").write_bytes(b"")
    with pytest.raises(ValueError, match="none of the 5 pictures"):
        open_frames(tmp_path)


class StandIn:
    """What OpenCV gives of a device: times of the driver in milliseconds, or zero; None is a frame that is lost."""

    def __init__(self, pictures, times, rate=0.0):
        self.pictures, self.times, self.rate, self.at, self.released = pictures, times, rate, -1, False

    def isOpened(self):  # noqa: N802
        return bool(self.pictures)

    def get(self, what):
        known = {cv2.CAP_PROP_FPS: self.rate, cv2.CAP_PROP_FRAME_COUNT: len(self.pictures)}
        return self.times[self.at] if what == cv2.CAP_PROP_POS_MSEC else known.get(what, 0.0)

    def set(self, *_):
        return True

    def grab(self):
        self.at += 1
        return self.at < len(self.pictures)

    def retrieve(self):
        found = self.pictures[self.at]
        return (found is not None), found

    def read(self):
        return self.retrieve() if self.grab() else (False, None)

    def release(self):
        self.released = True


def bgr(value: int) -> np.ndarray:
    return np.ascontiguousarray(picture(value).permute(1, 2, 0).numpy()[..., ::-1])


def test_a_camera_gives_the_drivers_times_or_says_that_it_has_none(monkeypatch):
    device = StandIn([bgr(1), None, bgr(3)], [5000.0, 5033.0, 5070.5])
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: device)
    with open_frames("0") as frames:
        assert frames.live and frames.total is None and frames.rate == 30 and not frames.notes
        found = list(frames)
    assert [frame.seconds for frame in found] == [5.0, 5.033, 5.0705] and device.released
    assert found[1].pixels is None and same(found[2], picture(3))
    device = StandIn([bgr(1), bgr(2)], [0.0, 0.0])
    frames = open_frames("0")
    assert "the time at which it arrived" in frames.notes[0]
    first, second = frames
    assert second.seconds >= first.seconds > 0
    device = StandIn([], [])
    with pytest.raises(ValueError, match="no frame from camera 0"):
        open_frames("0")


def test_a_source_that_was_not_read_is_closed_too(tmp_path, monkeypatch):
    (tmp_path / "a.mkv").write_bytes(b"stand-in")
    for source in ("0", tmp_path / "a.mkv"):
        device = StandIn([bgr(1), bgr(2)], [5000.0, 5033.0], rate=30.0)
        monkeypatch.setattr(cv2, "VideoCapture", lambda _, device=device: device)
        with open_frames(source):
            assert not device.released
        assert device.released


def test_the_first_frame_of_a_camera_has_the_time_at_which_it_was_read(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: StandIn([bgr(1), bgr(2)], [0.0, 0.0]))
    with open_frames("0") as frames:
        opened = time.monotonic()
        first, second = frames
    assert first.seconds <= opened <= second.seconds


def test_a_codec_that_keeps_all_colours_is_told_from_those_that_halve_them(tmp_path):
    path = tmp_path / "a.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (64, 48))
    video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    with open_frames(path) as frames:
        assert not frames.coarse_colours


def test_frames_without_times_of_their_own_are_counted_and_that_is_said(tmp_path, monkeypatch):
    (tmp_path / "a.mkv").write_bytes(b"stand-in")
    device = StandIn([bgr(1), None, bgr(3), bgr(4)], [0.0, 0.0, 50.0, 50.0])
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: device)
    frames = open_frames(tmp_path / "a.mkv", rate=50)
    found = list(frames)
    assert [frame.seconds for frame in found] == pytest.approx([0.0, 0.02, 0.05, 0.07])
    assert found[1].problem == "not decodable"
    assert frames.notes[0].endswith("50 frames per second assumed") and frames.notes[1].startswith("2 of 4 frames")


class Stumbling(StandIn):
    """OpenCV's own reader of AVI files throws where a damaged one states a frame of more than 64 MB."""

    def retrieve(self):
        if self.pictures[self.at] is None:
            raise cv2.error("chunk.m_size <= 67108864 in function 'readFrame'")
        return super().retrieve()


def test_a_frame_over_which_opencv_stumbles_is_a_problem_of_that_frame(tmp_path, monkeypatch):
    (tmp_path / "a.avi").write_bytes(b"anything")
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: Stumbling([bgr(1), None, bgr(3)], [0.0, 20.0, 40.0]))
    found = list(open_frames(tmp_path / "a.avi", rate=50))
    assert [frame.problem for frame in found] == ["", "not decodable", ""]
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: Stumbling([None], [0.0]))
    with pytest.raises(ValueError, match="no frame could be decoded"):
        open_frames(tmp_path / "a.avi")


@pytest.mark.parametrize("name", ["kernel.txt", "about.NFO"])
def test_a_text_is_not_filmed(tmp_path, name):
    """FFmpeg decodes one as what a terminal would show."""
    (tmp_path / name).write_text("0.1 0.2\n" * 40)
    with pytest.raises(ValueError, match=f"{name} is a text, not a video"):
        open_frames(tmp_path / name)
