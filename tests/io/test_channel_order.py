"""What is red in a file is red in channel 0, whatever reads it; files are made by Pillow, OpenCV's own order is BGR."""

import io

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from holotorch.io.images import encode_png, load_image
from holotorch.io.recording import Recorder, open_recording
from holotorch.io.video import Frame, open_frames, replacing_video

COLOUR = (220, 60, 10)  # mostly red, and no two channels alike
SHAPE = (32, 48)
LOSSLESS = ["png", "bmp", "tiff", "tif"]
LOSSY = ["jpg", "jpeg", "webp"]


def painted(mode: str = "RGB") -> Image.Image:
    return Image.new("RGB", (SHAPE[1], SHAPE[0]), COLOUR).convert(mode)


def red(pixels: torch.Tensor | None, scale: float = 1.0) -> None:
    """[3, H, W] of the colour, to the few levels that codecs lose."""
    assert pixels is not None and pixels.shape == (3, *SHAPE)
    levels = [float(channel.double().mean()) * scale for channel in pixels]
    assert levels == pytest.approx(COLOUR, abs=8)


@pytest.mark.parametrize("suffix", LOSSLESS + LOSSY)
def test_pictures(tmp_path, suffix):
    painted().save(tmp_path / f"a.{suffix}")
    red(load_image(tmp_path / f"a.{suffix}"), 255)
    with open_frames(tmp_path) as frames:  # a folder of pictures
        for frame in frames:
            red(frame.pixels)


@pytest.mark.parametrize(("suffix", "mode"), [("png", "RGBA"), ("png", "P"), ("bmp", "P"), ("tiff", "RGBA")])
def test_pictures_with_transparency_or_a_palette(tmp_path, suffix, mode):
    painted(mode).save(tmp_path / f"a.{suffix}")
    red(load_image(tmp_path / f"a.{suffix}"), 255)
    with open_frames(tmp_path) as frames:
        for frame in frames:
            red(frame.pixels)


def test_exr(tmp_path):
    planes = {name: np.full(SHAPE, level / 255, np.float32) for name, level in zip("RGB", COLOUR, strict=True)}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(tmp_path / "a.exr"))
    red(load_image(tmp_path / "a.exr"), 255)


def test_a_picture_that_is_written(tmp_path):
    colour = torch.tensor(COLOUR, dtype=torch.float64)[:, None, None].expand(3, *SHAPE) / 255
    written = Image.open(io.BytesIO(encode_png(colour)))
    assert written.convert("RGB").getpixel((3, 4)) == COLOUR


def test_a_video_of_jpegs(tmp_path):
    data = io.BytesIO()
    for _ in range(5):
        painted().save(data, "JPEG", quality=95)
    (tmp_path / "a.mjpeg").write_bytes(data.getvalue())
    with open_frames(tmp_path / "a.mjpeg") as frames:
        found = list(frames)
    assert len(found) == 5
    for frame in found:
        red(frame.pixels)


@pytest.mark.parametrize("name", ["a.avi", "a.mp4"])
def test_a_video_that_is_written(tmp_path, name):
    pixels = torch.tensor(COLOUR, dtype=torch.uint8)[:, None, None].expand(3, *SHAPE).contiguous()
    with replacing_video(tmp_path / name, SHAPE, 25.0) as video:
        for _ in range(4):
            video.write(pixels)
    with open_frames(tmp_path / name) as frames:
        for frame in frames:
            red(frame.pixels)


def test_a_recording(tmp_path):
    painted().save(tmp_path / "a.png")
    with open_frames(tmp_path) as frames:
        (frame,) = list(frames)
    with Recorder(tmp_path / "recording", SHAPE, 25.0, "red") as recorder:
        recorder.write(Frame(0.0, frame.pixels))
    assert (tmp_path / "recording" / "frames.rgb").read_bytes() == painted().tobytes()
    (found,) = list(open_recording(tmp_path / "recording"))
    red(found.pixels)
