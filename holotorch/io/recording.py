"""Recording of video frames without loss, and replay with the same pixels and times.

A recording is a folder::

    recording.json   format version, frame size, frame rate, source, channel order, names of the copied files
    camera.yaml ...  copies of files that a replay needs, such as the calibration of the camera
    frames.rgb       the frames without any bytes between them, each with H rows of W pixels of 8-bit red, green, blue
    times.csv        frame,seconds,crc32,problem: a line per frame, written after the pixels of the frame. A frame that
                     the source could not deliver has no pixels; its line states the problem instead of a checksum

The pixels are not compressed, since encoding a 1080p frame as PNG takes longer than the frame period of a camera.
``frames.rgb`` and ``times.csv`` are only appended to, so that after a crash the frames recorded before it can be
replayed. If the disk is full, an incomplete frame is removed.
``ffplay -f rawvideo -pixel_format rgb24 -video_size WxH frames.rgb`` plays the frames.
"""

import csv
import io
import math
import shutil
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from holotorch.core import checks
from holotorch.io.files import append, read_json, write_bytes, write_json
from holotorch.io.video import Frame, Frames, check_pixels

_FORMAT = 1  # version of the file format
_CHANNELS = "RGB"  # channel order of every recording; recordings of older versions of holotorch do not state it
_COLUMNS = ("frame", "seconds", "crc32", "problem")


def recording_bytes(shape: tuple[int, int], frames: int) -> int:
    """Size of ``frames`` frames of ``shape`` (H, W) in a recording, in bytes."""
    return 3 * shape[0] * shape[1] * frames


def is_recording(path: Path) -> bool:
    """Whether ``path`` is the folder of a recording."""
    return (path / "recording.json").is_file() and (path / "times.csv").is_file()


class Recorder:
    """Writer of a new recording, to which frames are appended; also a context manager that closes the recording."""

    def __init__(
        self, folder: Path, shape: tuple[int, int], rate: float, source: str, copies: Mapping[str, Path] | None = None
    ):
        """Start a recording.

        Args:
            folder: Folder of the recording, new or empty.
            shape: Size (H, W) of every frame in pixels.
            rate: Frames per second that the source states.
            source: Name of the source.
            copies: Files to copy into the folder; the keys are the names of the copies, such as ``camera.yaml``.

        Raises:
            ValueError: The folder is not empty, or the shape or rate is impossible.
            OSError: The folder cannot be written, or a file to copy cannot be read.
        """
        for side in shape:
            checks.whole("side of a frame", side, 1)
        checks.positive("rate", rate, "frames per second")
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise ValueError(f"{folder} holds files already; a recording needs a new folder")
        self.folder, self.shape, self.frames = folder, tuple(shape), 0
        for name, path in (copies or {}).items():
            write_bytes(folder / name, path.read_bytes())
        header = {
            "format": _FORMAT,
            "height": shape[0],
            "width": shape[1],
            "channels": _CHANNELS,
            "rate_hz": rate,
            "source": source,
            "copies": sorted(copies or {}),
        }
        write_json(folder / "recording.json", header)
        self._pixels = open(folder / "frames.rgb", "ab", buffering=0)  # noqa: SIM115
        self._times = open(folder / "times.csv", "ab", buffering=0)  # noqa: SIM115
        self._row(_COLUMNS)

    def write(self, frame: Frame) -> None:
        """Append a frame.

        ValueError for another shape or dtype; OSError if the disk is full, and the recording then stays as it was.
        """
        import cv2

        seconds = repr(checks.finite("time of a frame", frame.seconds, "seconds"))  # repr keeps all digits of a float
        if frame.pixels is None:
            problem = " ".join(frame.problem.split())  # removes line breaks
            self._row((str(self.frames), seconds, "", problem or "not readable"))
        else:
            check_pixels(frame.pixels, self.shape, "recording")
            data = cv2.merge(list(frame.pixels.cpu().numpy())).data.cast("B")
            start = self._pixels.tell()
            append(self._pixels, data)
            try:
                self._row((str(self.frames), seconds, f"{zlib.crc32(data):08x}", ""))
            except OSError:
                self._pixels.seek(start)
                self._pixels.truncate()
                raise
        self.frames += 1

    def close(self) -> None:
        """Close the files."""
        self._pixels.close()
        self._times.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _row(self, cells: tuple[str, ...]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(cells)
        append(self._times, text.getvalue().encode("utf-8", "replace"))


def open_recording(folder: Path) -> Frames:
    """Open a recording to replay its frames with their times.

    A truncated recording yields all complete frames and a remark in ``notes``. A frame whose checksum does not match
    has a problem instead of pixels. ValueError if the folder holds no recording, or if the recording is damaged, has
    the format of a later version, or contains no complete frame.
    """
    if not is_recording(folder):
        raise ValueError(f"{folder} holds no recording: it must contain recording.json and times.csv")
    header = _header(folder)
    shape = (header["height"], header["width"])
    size = recording_bytes(shape, 1)
    rows = _rows(folder)
    available = (folder / "frames.rgb").stat().st_size if (folder / "frames.rgb").is_file() else 0
    # A frame's line is written after its pixels, so an interruption can leave pixels without a line.
    complete, used = [], 0
    for row in rows:
        used += size if row[1] is not None else 0
        if used > available:
            break
        complete.append(row)
    if not any(crc is not None for _, crc, _ in complete):
        raise ValueError(f"{folder} holds no complete frame; the recording was cut off before its end")
    notes = []
    if len(complete) < len(rows):
        notes.append(f"frames.rgb is cut off: it holds {len(complete)} of {len(rows)} frames")
    elif available > used:
        notes.append(f"the recording was cut off while a frame was written; it holds the {len(complete)} before it")

    def frames() -> Iterator[Frame]:
        with open(folder / "frames.rgb", "rb") as stream:
            for seconds, crc, problem in complete:
                if crc is None:
                    yield Frame(seconds, None, problem)
                elif zlib.crc32(data := bytearray(stream.read(size))) != crc:
                    yield Frame(seconds, None, "its pixels have changed since it was recorded")
                else:
                    pixels = np.frombuffer(data, np.uint8).reshape(*shape, 3)
                    yield Frame(seconds, torch.from_numpy(pixels).permute(2, 0, 1).contiguous())

    made_from = str(header.get("source", ""))
    return Frames(folder.name, shape, len(complete), header["rate_hz"], frames(), notes, recorded_from=made_from)


def free_bytes(folder: Path) -> int:
    """Free bytes on the disk on which ``folder`` lies or would be created."""
    folder = folder.resolve()
    return shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists())).free


def _header(folder: Path) -> dict[str, Any]:
    path = folder / "recording.json"
    try:
        header = read_json(path)
        version = checks.whole("format", header["format"], 1)
        for name in ("height", "width"):
            checks.whole(name, header[name], 1)
        checks.positive("rate_hz", header["rate_hz"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {type(error).__name__} {error}") from None
    if (channels := header.get("channels", _CHANNELS)) != _CHANNELS:
        raise ValueError(f"{path} states channels {channels!r}; recordings are {_CHANNELS}: convert its frames")
    if version > _FORMAT:
        raise ValueError(f"{path} has format {version}; this holotorch reads up to format {_FORMAT}: use a newer one")
    return header


def _rows(folder: Path) -> list[tuple[float, int | None, str]]:
    """Time, checksum and problem of each frame. A last line without a line break is incomplete and is ignored."""
    path = folder / "times.csv"
    text = path.read_bytes().decode("utf-8", "replace")
    reader = csv.reader(text[: text.rfind("\n") + 1].split("\n")[:-1])
    try:
        lines = list(reader)
    except csv.Error as error:  # a carriage return within a line, or a cell too long for csv
        raise ValueError(f"{path}:{reader.line_num} is damaged: {error}") from None
    if not lines or tuple(lines[0]) != _COLUMNS:
        got = ",".join(lines[0]) if lines else "nothing"
        raise ValueError(f"{path} must begin with {','.join(_COLUMNS)}, got {got}")
    rows: list[tuple[float, int | None, str]] = []
    for number, cells in enumerate(lines[1:]):
        try:
            index, seconds, crc, problem = cells
            row = float(seconds), int(crc, 16) if crc else None, problem
            if int(index) != number or not math.isfinite(row[0]):
                raise ValueError
        except ValueError:
            raise ValueError(f"{path}:{number + 2} is damaged: {','.join(cells)!r}") from None
        rows.append(row)
    return rows
