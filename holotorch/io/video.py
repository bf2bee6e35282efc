"""Reading of frames and their times from a video file, a folder of pictures or a camera; atomic writing of videos."""

import math
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.io.formats.decoding import decode

_TEXTS = (".txt", ".nfo", ".diz", ".ans")  # FFmpeg, which OpenCV opens videos with, films these as a terminal would
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_CODECS = {".mp4": "mp4v", ".avi": "MJPG"}  # four-character code of the codec for each file extension
_ASSUMED_RATE = 30.0  # Hz; frame rate of sources that state none
_HALF_COLOURS = (b"I420", b"IYUV", b"YV12", b"NV12", b"NV21", b"P010")  # formats of pixels, as FFmpeg names them


class Frame(NamedTuple):
    """One frame: its time in seconds, and its RGB pixels, uint8 [3, H, W].

    If the frame could not be read, ``pixels`` is None and ``problem`` states why.
    """

    seconds: float
    pixels: Tensor | None
    problem: str = ""


@dataclass(eq=False)
class Frames:
    """The frames of a video source, to iterate over once; also a context manager that closes the source.

    Attributes:
        name: Name of the source.
        shape: Size (H, W) of the frames in pixels.
        total: Number of frames that the source states, or None if it states none, as a camera.
        rate: Frames per second: stated by the source, given by the caller, or else 30.
        frames: Iterator over the frames.
        notes: Remarks for the user, such as that a rate was assumed; some are added after the last frame.
        live: Whether the source is a camera, which does not end.
        coarse_colours: Whether a file is known to hold colours at half the resolution (4:2:0).
        recorded_from: Name of the source of which the frames are a recording; empty for others.
        close: Function that closes the source; None if ``frames`` does so itself.
    """

    name: str
    shape: tuple[int, int]
    total: int | None
    rate: float
    frames: Iterator[Frame]
    notes: list[str]
    _: KW_ONLY
    live: bool = False
    coarse_colours: bool = False
    recorded_from: str = ""
    close: Callable[[], None] | None = None

    def __iter__(self) -> Iterator[Frame]:
        return self.frames

    def __enter__(self) -> "Frames":
        return self

    def __exit__(self, *_: object) -> None:
        for close in (getattr(self.frames, "close", None), self.close):
            if close is not None:
                close()


def open_frames(source: str | Path, rate: float | None = None) -> Frames:
    """Open a video file, a folder of pictures (ordered by the numbers in their names), or a camera (by its number).

    Frames of a video have the times that the file states; where it states none, a frame follows the previous one by the
    inverse of the frame rate. Frames of a camera have the times of its driver, or of their arrival if the driver states
    none. Pictures are spaced by 1 / ``rate``. A frame that cannot be read has a problem instead of pixels.

    Args:
        source: Path of a file or folder, or the number of a camera.
        rate: Frames per second of pictures, and of a video file that states no rate; 30 by default. A camera is asked
            for this rate.

    Raises:
        ValueError: There is no such source, no frame can be decoded, or the rate is not positive.
    """
    if rate is not None:
        checks.positive("rate", rate, "frames per second")
    path = Path(source)
    if path.is_dir():
        return _folder(path, rate)
    if path.is_file():
        return _video(path, rate)
    if is_camera(source):
        return _camera(int(str(source)), rate)
    raise ValueError(no_such_source(source))


def encode_jpeg(picture: Tensor, quality: int = 80) -> bytes:
    """Encode an RGB picture, uint8 [3, H, W], as JPEG with a quality of 1 to 100."""
    import cv2

    if picture.dtype != torch.uint8 or picture.ndim != 3 or picture.shape[0] != 3 or 0 in picture.shape:
        raise ValueError(f"picture must be uint8 of shape [3, H, W], got {picture.dtype} {list(picture.shape)}")
    bgr = cv2.merge(list(picture.flip(0).cpu().numpy()))
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, checks.whole("quality", quality, 1)])
    return data.tobytes()


def no_such_source(source: str | Path) -> str:
    """Error message for a source that does not exist and is not the number of a camera."""
    return f"no such video, folder or camera: {source}; a camera is given by its number, such as 0"


def is_camera(source: str | Path) -> bool:
    """Whether a source is the number of a camera; a file or folder of that name takes precedence."""
    return str(source).isdecimal() and not Path(source).exists()


def _video(path: Path, rate: float | None) -> Frames:
    import cv2

    if path.suffix.lower() in _TEXTS:
        raise ValueError(f"{path} is a text, not a video")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        capture.release()
        raise ValueError(f"{path} is not a video that OpenCV can open: damaged, cut off, or of another format")
    stated = capture.get(cv2.CAP_PROP_FPS)
    announced = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    notes: list[str] = []
    if not (math.isfinite(stated) and stated > 0):
        stated = _ASSUMED_RATE if rate is None else rate
        notes.append(f"{path.name} states no rate; {stated:g} frames per second assumed")
    first = _decoded(capture.read)
    if first is None:
        code = int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
        codec = code.to_bytes(4, "little").decode("ascii", "replace").strip("\0 ") or "unknown"
        capture.release()
        reason = f"no frame could be decoded (codec {codec}); the file is empty or damaged, or OpenCV lacks the codec"
        raise ValueError(f"{path}: {reason}: convert it, for example with ffmpeg -i IN -c:v ffv1 OUT.avi")

    def frames() -> Iterator[Frame]:
        pixels, seconds, count, guessed = first, 0.0, 0, 0
        while True:
            now = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            if count and not now > seconds:  # the file states no time for this frame
                now, guessed = seconds + 1 / stated, guessed + 1
            seconds, count = now, count + 1
            yield _frame(seconds, pixels)
            if not capture.grab():
                break
            pixels = _decoded(capture.retrieve)
        if guessed:
            notes.append(f"{guessed} of {count} frames have no time in the file; spaced at {stated:g} per second")
        if count < announced:
            notes.append(f"{path.name} announces {announced} frames and {count} could be read")

    total, shape = announced if announced > 0 else None, first.shape[:2]
    stored = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) & 0xFFFFFFFF
    coarse = stored.to_bytes(4, "little") in _HALF_COLOURS
    return Frames(path.name, shape, total, stated, frames(), notes, coarse_colours=coarse, close=capture.release)


def _decoded(read: Callable[[], tuple[bool, Any]]) -> Any:
    """Pixels from ``read``, a method of an OpenCV capture; None if that fails, as for a damaged file."""
    import cv2

    try:
        success, pixels = read()
    except cv2.error:
        return None
    return pixels if success else None


def _frame(seconds: float, pixels: np.ndarray | None) -> Frame:
    return Frame(seconds, None, "not decodable") if pixels is None else Frame(seconds, _rgb(pixels))


def _folder(folder: Path, rate: float | None) -> Frames:
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in PICTURES), key=_natural)
    if not paths:
        raise ValueError(f"{folder} holds no pictures ({', '.join(PICTURES)})")
    first = next((pixels for pixels in map(_picture, paths) if pixels is not None), None)
    if first is None:
        raise ValueError(f"none of the {len(paths)} pictures in {folder} could be decoded")
    shape, stated = first.shape[:2], rate or _ASSUMED_RATE
    notes = [] if rate else [f"pictures have no times; {_ASSUMED_RATE:g} frames per second assumed"]

    def frames() -> Iterator[Frame]:
        for index, path in enumerate(paths):
            pixels = _picture(path)
            if pixels is None:
                yield Frame(index / stated, None, f"{path.name} is not a readable picture, or is cut off")
            elif pixels.shape[:2] != shape:
                size = f"{pixels.shape[1]} x {pixels.shape[0]}"
                yield Frame(index / stated, None, f"{path.name} is {size} px and the first {shape[1]} x {shape[0]} px")
            else:
                yield Frame(index / stated, _rgb(pixels))

    return Frames(folder.name, shape, len(paths), stated, frames(), notes)


def _camera(index: int, rate: float | None) -> Frames:
    import cv2

    capture = cv2.VideoCapture(index)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # so that the driver delivers the newest frame, not the oldest in a queue
    if rate is not None:
        capture.set(cv2.CAP_PROP_FPS, rate)
    first = _decoded(capture.read) if capture.isOpened() else None
    if first is None:
        capture.release()
        raise ValueError(f"no frame from camera {index}: it is not connected, in use, or not readable by this user")
    stated = capture.get(cv2.CAP_PROP_FPS)
    stated = stated if math.isfinite(stated) and stated > 0 else _ASSUMED_RATE
    # Video4Linux provides the driver's time of each frame; other systems provide none.
    driver = capture.get(cv2.CAP_PROP_POS_MSEC) > 0
    notes = [] if driver else ["the camera's driver states no times; each frame has the time at which it arrived"]

    def now() -> float:
        return capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3 if driver else time.monotonic()

    start = now()

    def frames() -> Iterator[Frame]:
        yield _frame(start, first)
        while capture.grab():
            yield _frame(now(), _decoded(capture.retrieve))
        notes.append("the camera stopped delivering frames")

    return Frames(f"camera {index}", first.shape[:2], None, stated, frames(), notes, live=True, close=capture.release)


def check_pixels(pixels: Tensor, shape: Sequence[int], target: str) -> None:
    """Raise ValueError unless ``pixels`` are uint8 [3, H, W], with the ``shape`` (H, W) of the frames of ``target``.

    ``target`` is a word for the error message, such as "video".
    """
    if pixels.dtype != torch.uint8 or tuple(pixels.shape) != (3, *shape):
        raise ValueError(f"frames of this {target} are uint8 {[3, *shape]}, got {pixels.dtype} {list(pixels.shape)}")


class VideoWriter:
    """Writer of an ``.mp4`` (MPEG-4) or ``.avi`` (Motion JPEG) video; :func:`replacing_video` makes one."""

    def __init__(self, path: Path, shape: tuple[int, int], rate: float):
        import cv2

        self.path, self.shape = path, shape
        codec = cv2.VideoWriter.fourcc(*_CODECS[path.suffix.lower()])
        self._writer = cv2.VideoWriter(str(path), codec, rate, (shape[1], shape[0]))
        if not self._writer.isOpened():
            raise OSError(0, f"OpenCV cannot write a video of {shape[1]} x {shape[0]} px at {rate:g} Hz", str(path))

    def write(self, pixels: Tensor) -> None:
        """Append one RGB frame, uint8 [3, H, W]; OSError if it cannot be written, as on a full disk."""
        import cv2

        check_pixels(pixels, self.shape, "video")
        red, green, blue = pixels.cpu().numpy()
        if self._writer.write(cv2.merge([blue, green, red])) is False:
            raise OSError(0, "OpenCV could not write a frame; is the disk full?", str(self.path))

    def close(self) -> None:
        """Finish the file and close it."""
        self._writer.release()


@contextmanager
def replacing_video(path: Path, shape: tuple[int, int], rate: float) -> Iterator[VideoWriter]:
    """Context manager that writes a video under a temporary name and renames it to ``path`` if the block succeeds.

    Args:
        path: File to write; its name ends in ``.mp4`` or ``.avi``.
        shape: Size (H, W) of the frames in pixels; the codecs drop the last row or column of an odd size.
        rate: Frames per second; the video has a constant rate, whatever the times at which frames were captured.

    Raises:
        ValueError: Another file extension, or an impossible rate or shape.
        OSError: The file cannot be written.
    """
    if path.suffix.lower() not in _CODECS:
        raise ValueError(f"{path}: videos are written as {' or '.join(_CODECS)}, got {path.suffix or 'no extension'}")
    checks.positive("rate", rate, "frames per second")
    for side in shape:
        checks.whole("side of a frame", side, 2)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")  # OpenCV needs the extension
    try:
        try:
            writer = VideoWriter(partial, shape, rate)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None
        with closing(writer):
            yield writer
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _picture(path: Path) -> np.ndarray | None:
    """BGR pixels [H, W, 3] with the orientation tag applied, or None if the picture cannot be decoded."""
    import cv2

    try:
        return decode(path, cv2.IMREAD_COLOR)
    except (OSError, ValueError):
        return None


def _rgb(pixels: np.ndarray) -> Tensor:
    import cv2

    planes = np.empty((3, *pixels.shape[:2]), np.uint8)
    cv2.split(pixels, [planes[2], planes[1], planes[0]])  # many times faster than numpy's transposition
    return torch.from_numpy(planes)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that orders names by the numbers in them: frame2 comes before frame10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
