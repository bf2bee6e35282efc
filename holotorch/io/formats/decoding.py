"""Decoding of pictures by OpenCV, after a check that the size in the header fits the memory limit."""

import io
import math
import re
import struct
import warnings
from pathlib import Path

import numpy as np

from holotorch.io.formats.limits import affordable

PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
# Largest number of scans of a progressive JPEG. Decoding a scan takes as long as a whole picture, even if the scan has
# only a few bytes.
_MOST_SCANS = 100


def decode(path: Path, flags: int, *, data: bytes | None = None, memory: int = 8) -> np.ndarray:
    """Pixels [H, W] or [H, W, C] of a PNG, JPEG, BMP, TIFF or WebP file, as ``cv2.imdecode`` returns them.

    Args:
        path: Path of the file.
        flags: Flags of ``cv2.imdecode``.
        data: Content of the file, if it has been read already.
        memory: Bytes per pixel that decoding and further processing by the caller need; by default those of four
            channels of 16 bits.

    Raises:
        ValueError: The file is not a picture, is damaged, or needs more memory than the limit in
            :mod:`holotorch.io.formats.limits`.
    """
    import cv2

    data = path.read_bytes() if data is None else data
    height, width = picture_size(path, data)
    if data.startswith(PNG):
        data = data[: _png_end(data)]
    if data.startswith(_JPEG) and (scans := _scans(data)) > _MOST_SCANS:
        raise ValueError(
            f"{path} is a JPEG of {scans} scans, each of which takes as long to decode as a whole picture; usual files "
            f"have about ten, and {_MOST_SCANS} are accepted: save it again"
        )
    affordable(path, height * width * memory, len(data))
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # for some kinds of damage; for others imdecode returns None
        pixels = None
    if pixels is None:
        raise ValueError(_unreadable(path))
    return pixels


def picture_size(path: Path, data: bytes) -> tuple[int, int]:
    """Size (H, W) of an encoded picture from its header, without decoding; ValueError if it is not readable."""
    from PIL.BmpImagePlugin import BmpImageFile
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.TiffImagePlugin import TiffImageFile

    readers = {_JPEG: JpegImageFile, b"BM": BmpImageFile, b"II": TiffImageFile, b"MM": TiffImageFile}
    try:
        if data.startswith(PNG):
            _png_end(data)
            width, height = struct.unpack_from(">II", data, len(PNG) + 8)
            return height, width
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data)
        # Image.open also applies Pillow's own limit of the picture size, so the reader classes are called directly.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = readers[data[:2]](io.BytesIO(data))
        return picture.height, picture.width
    except Exception:  # truncated or damaged headers cause many kinds of errors
        raise ValueError(_unreadable(path)) from None


def check_exr(path: Path, *, memory: int) -> None:
    """Raise ValueError for an EXR file that is damaged or needs more memory than the limit.

    ``memory`` is the number of bytes per pixel that the caller needs in addition to 4 bytes per channel of the file.
    """
    import OpenEXR

    try:
        parts = OpenEXR.File(str(path), header_only=True).parts
        needed = 0
        for part in parts:
            low, high = part.header["dataWindow"]
            pixels = math.prod(int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
            needed += pixels * (memory + 4 * len(part.header["channels"]))
    except Exception as error:  # OpenEXR raises errors of many types, such as RuntimeError
        raise ValueError(f"{path} is not a readable EXR file: {error}") from None
    affordable(path, needed, path.stat().st_size)


def _scans(data: bytes) -> int:
    """Number of scans of a JPEG, without those of a thumbnail in its metadata."""
    marker = re.compile(rb"\xff+([^\x00\xff])")
    without_segment = {0x01, *range(0xD0, 0xD9)}  # markers without data, such as restart markers
    count, position = 0, 2
    while (match := marker.search(data, position)) and (kind := match[1][0]) != 0xD9:
        count += kind == 0xDA
        position = match.end()
        if kind not in without_segment:  # a segment begins with its length, which includes the two bytes that state it
            position += max(2, int.from_bytes(data[position : position + 2], "big"))
    return count


def _png_end(data: bytes) -> int:
    """Length in bytes of a PNG up to the end of its last chunk, IEND; struct.error or ValueError if it is truncated.

    Data after IEND must be removed: decoders read them as further chunks, and allocate the size that a chunk states.
    """
    position, kind = len(PNG), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, position)
        position += 12 + length
    if position > len(data):
        raise ValueError("a chunk is longer than the file")
    return position


def _webp_size(data: bytes) -> tuple[int, int]:
    """Size (H, W) from the header. Pillow's reader would allocate the picture when it opens the file."""
    kind = data[12:16]
    if kind == b"VP8X":  # extended format
        return 1 + int.from_bytes(data[27:30], "little"), 1 + int.from_bytes(data[24:27], "little")
    if kind == b"VP8L":  # lossless
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits >> 14 & 0x3FFF), 1 + (bits & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return height & 0x3FFF, width & 0x3FFF


def _unreadable(path: Path) -> str:
    return f"{path} is not a readable picture (PNG, JPEG, BMP, TIFF or WebP), or is truncated"
