"""Readers of volumes stored as pictures: pages of a TIFF file, numbered slices in a folder, and tiles of a picture."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from holotorch.io.formats.decoding import decode
from holotorch.io.formats.limits import affordable
from holotorch.io.formats.scan import Scan, readable

# TIFF tags: width and height in pixels, bits per sample, samples (channels) per pixel.
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES = 256, 257, 258, 277
_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg")


def read_tiff(path: Path) -> Scan:
    """Read the grey pages of a TIFF file as slices. TIFF states no spacing between pages."""
    import cv2

    pages = _tiff_pages(path)
    with readable(path, "TIFF file"):
        success, slices = cv2.imdecodemulti(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    decoded = len(slices) if success else 0
    if decoded != pages:
        raise ValueError(
            f"{path}: {decoded} of {pages} pages could be decoded; it is truncated, or in a TIFF variant that OpenCV "
            "does not read"
        )
    return _stacked(slices, [f"page {index} of {path}" for index in range(pages)])


def read_folder(folder: Path) -> Scan:
    """Read the pictures of a folder as slices, in order of the last number in each name; no number may be missing."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    if not paths:
        raise ValueError(f"{folder} holds no slices: neither DICOM, Zarr nor pictures ({', '.join(_SUFFIXES)})")
    numbered: dict[int, Path] = {}
    for path in paths:
        numbers = re.findall(r"\d+", path.stem)
        if not numbers:
            raise ValueError(f"{path} has no number in its name to state its position; remove or rename it")
        if (number := int(numbers[-1])) in numbered:
            raise ValueError(f"{folder} holds slice {number} twice: {numbered[number].name} and {path.name}")
        numbered[number] = path
    numbers = range(min(numbered), max(numbered) + 1)
    missing = len(numbers) - len(numbered)
    if missing:
        first = next(number for number in numbers if number not in numbered)
        raise ValueError(
            f"{folder}: of the slices {numbers[0]} to {numbers[-1]}, {missing} are missing, the first is {first}"
        )
    ordered = [numbered[number] for number in numbers]
    return _stacked((_picture(path) for path in ordered), [str(path) for path in ordered])


def read_tiles(path: Path, shape: Sequence[int] | None) -> Scan:
    """Read D slices of H x W pixels stored as tiles of one picture, row by row from the top left.

    ``shape`` is (D, H, W). Tiles after the last slice must be black.
    """
    if shape is None:
        raise ValueError(f"{path} is one picture: pass shape=(D, H, W) if its tiles are slices, or load the folder")
    picture = _picture(path)
    depth, height, width = shape
    rows, columns = picture.shape[0] // max(height, 1), picture.shape[1] // max(width, 1)
    if picture.shape != (rows * height, columns * width) or rows * columns < depth:
        raise ValueError(
            f"{path} is {picture.shape[0]} x {picture.shape[1]} px and cannot be cut into {depth} tiles of {height} x "
            f"{width} px; check shape=(D, H, W)"
        )
    tiles = picture.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(-1, height, width)
    if tiles[depth:].any():
        used = int(np.flatnonzero(tiles.any((1, 2)))[-1]) + 1
        raise ValueError(f"{path} holds {used} slices of {height} x {width} px, got shape={tuple(shape)}")
    return Scan(tiles[:depth])


def _picture(path: Path) -> np.ndarray:
    import cv2

    return _grey(decode(path, cv2.IMREAD_UNCHANGED), str(path))


def _grey(pixels: np.ndarray, source: str) -> np.ndarray:
    if pixels.ndim != 2:
        raise ValueError(f"{source} has {pixels.shape[2]} colour channels, expected grey: one scalar per voxel")
    return pixels


def _stacked(slices: Iterable[np.ndarray], sources: Sequence[str]) -> Scan:
    """Scan of grey ``slices``; ``sources`` are their names in error messages."""
    values = np.empty(0)
    for index, (pixels, source) in enumerate(zip(slices, sources, strict=True)):
        plane = _grey(pixels, source)
        if not index:
            values = np.empty((len(sources), *plane.shape), plane.dtype)
        if plane.shape != values.shape[1:] or plane.dtype != values.dtype:
            raise ValueError(
                f"slices must be equal in shape and type, but {source} is {plane.shape} of {plane.dtype} and "
                f"the first is {values.shape[1:]} of {values.dtype}"
            )
        values[index] = plane
    return Scan(values)


def _tiff_pages(path: Path) -> int:
    """Number of pages of a TIFF file. OpenCV omits pages that it cannot decode, so the page directories are counted.

    ValueError for a damaged file, or for pages that need more memory than the limit.
    """
    data = np.memmap(path, np.uint8, "r")
    mark, order = bytes(data[:2]), "big" if bytes(data[:2]) == b"MM" else "little"
    version = int.from_bytes(bytes(data[2:4]), order)
    if mark not in (b"II", b"MM") or version not in (42, 43):
        raise ValueError(f"{path} is not a TIFF file")
    wide = version == 43  # BigTIFF
    # Lengths in bytes of an offset, of the number of entries in a directory, and of an entry.
    length, counter, entry = (8, 8, 20) if wide else (4, 2, 12)

    def number(position: int, size: int) -> int:
        if position + size > data.size:
            raise ValueError(f"{path} is truncated: it ends at byte {data.size}, before its page directory")
        return int.from_bytes(bytes(data[position : position + size]), order)

    def first_value(directory: int, tag: int) -> int:
        """First value of the entry ``tag`` of the directory at byte ``directory``; 1 without this entry."""
        start = directory + counter
        for position in range(start, start + entry * number(directory, counter), entry):
            if number(position, 2) == tag:
                size = {3: 2, 4: 4, 16: 8}.get(number(position + 2, 2), 1)  # bytes per value, by TIFF type
                count, value = number(position + 4, length), position + 4 + length
                return number(value if count * size <= length else number(value, length), size)
        return 1

    position, directories, entries, needed = number(8 if wide else 4, length), set[int](), 0, 0
    while position:
        if position in directories:
            raise ValueError(f"{path} is damaged: its page directories form a loop")
        directories.add(position)
        count = number(position, counter)
        entries += count
        if entries * entry > data.size:
            raise ValueError(f"{path} is damaged: its page directories overlap")
        bits = max(8, first_value(position, _TIFF_BITS)) * first_value(position, _TIFF_SAMPLES)
        needed += first_value(position, _TIFF_WIDTH) * first_value(position, _TIFF_HEIGHT) * bits // 8
        position = number(position + counter + entry * count, length)
    # Twice: for the decoded pages, and for the volume to which they are copied.
    affordable(path, 2 * needed, data.size)
    return len(directories)
