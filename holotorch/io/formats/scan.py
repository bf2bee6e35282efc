"""Scan, the voxels and geometry that a file states, and functions that the readers of all formats share."""

import importlib
import math
import mmap
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from holotorch.io.formats.limits import affordable, readable_at_once
from holotorch.scene.volume import IDENTITY, Triple

_MAP_NORESERVE = 0x4000  # mmap.MAP_NORESERVE on Linux; Python defines the name only from version 3.13 on
_METRES = {
    "m": 1.0, "meter": 1.0, "metre": 1.0, "cm": 1e-2, "mm": 1e-3, "millimeter": 1e-3, "um": 1e-6, "µm": 1e-6,
    "micron": 1e-6, "nm": 1e-9, "angstrom": 1e-10,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scan:
    """Voxels and geometry as a file states them."""

    values: np.ndarray  # voxels [D, H, W], usually in the dtype of the file, possibly memory-mapped
    spacing: Triple | None = None  # distance between voxels along (z, y, x) in ``unit``; None if the file states none
    unit: str = "relative"  # "m" or "relative"
    origin: Triple = (0.0, 0.0, 0.0)  # position (z, y, x) of voxel [0, 0, 0] in ``unit``
    # Three unit vectors, along the axes z, y and x of ``values``, each with components (z, y, x).
    orientation: tuple[Triple, Triple, Triple] = IDENTITY
    frame: str = ""  # where x, y and z of the file point; see :class:`~holotorch.scene.volume.Volume`


def metres(unit: str, path: Path) -> float:
    """Length in metres of the ``unit`` that the file ``path`` names, for instance "mm"; ValueError if it is unknown."""
    name = unit.strip().lower()
    length = _METRES.get(name) or _METRES.get(name.removesuffix("s"))
    if length is None:
        raise ValueError(f"{path} has spacing in {unit!r}; known are {', '.join(_METRES)}; pass spacing= instead")
    return length


def placed(values: np.ndarray, axes: Any, origin: Any, unit: str, scale: float = 1.0, frame: str = "") -> Scan:
    """Scan of ``values`` [D, H, W] with a geometry whose axes and components are in the order (x, y, z).

    Row i of ``axes`` [3, 3] is the vector from one voxel to the next along axis i. ``origin`` is the position of the
    first voxel. ``scale`` is the factor that converts lengths to ``unit``. If a vector has the length 0 or is not
    finite, the scan has no geometry.
    """
    steps = np.asarray(axes, dtype=np.float64)[::-1, ::-1]
    lengths = np.linalg.norm(steps, axis=1)
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        return Scan(values)
    z, y, x = (triple(row) for row in steps / lengths[:, None])
    first = triple(np.asarray(origin, dtype=np.float64)[::-1] * scale)
    return Scan(values, triple(lengths * scale), unit, first, (z, y, x), frame)


def triple(values: Sequence[float] | np.ndarray) -> Triple:
    """The three ``values`` as a tuple of floats."""
    z, y, x = (float(value) for value in values)
    return z, y, x


def existing(path: Path, where: str = "", *, file: bool = False) -> Path:
    """Return ``path``; ValueError if it is missing or an empty file, or cannot be read.

    If ``file`` is True, a folder is an error as well. ``where`` describes the path in error messages.
    """
    where = where or str(path)
    try:
        path.stat()
    except FileNotFoundError:
        raise ValueError(f"{where} does not exist") from None
    except OSError as error:  # such as an invalid file name, or no permission to read the folder
        raise ValueError(f"{where} cannot be read: {error.strerror}") from None
    if file and not path.is_file():
        raise ValueError(f"{where} is not a file")
    if path.is_file() and not path.stat().st_size:
        raise ValueError(f"{where} is empty (0 bytes)")
    return path


def named(header: Path, name: str) -> Path:
    """Path of the data file with the ``name`` that the file ``header`` states; relative to the folder of the header.

    ValueError if the data file is missing, empty, not a file, or outside of this folder: a header from an untrusted
    source must not give access to other files.
    """
    if name.split()[:1] == ["LIST"] or "%" in name:
        raise ValueError(f"{header} lists one file per slice; load the folder of the slices instead")
    path = header.parent / name
    if not path.resolve().is_relative_to(header.parent.resolve()):
        raise ValueError(
            f"{header} names the data file {name!r}, which lies outside the header's folder; move the file itself "
            "(not a link) beside the header, or load it without its header, with shape=, dtype= and spacing="
        )
    return existing(path, f"the data file {path}, which {header} names,", file=True)


def number_type(dtype: DTypeLike) -> np.dtype:
    """``dtype`` as a numpy dtype; ValueError if it is not a type of real numbers."""
    try:
        kind = np.dtype(dtype)
        if kind.kind not in "buif":
            raise TypeError("not a type of real numbers")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"dtype must name a type of number, such as 'uint8' or '>i2', got {dtype!r}: {error}"
        ) from None
    return kind


def expect_bytes(path: Path, found: int, shape: Sequence[int], dtype: np.dtype) -> int:
    """Return the number of bytes of ``shape`` (D, H, W) voxels; ValueError if it is not ``found`` or is 0."""
    sizes = " x ".join(map(str, shape))
    if any(size < 1 for size in shape):
        raise ValueError(f"{path} states {sizes} voxels (D x H x W); every size must be above 0")
    expected = math.prod(shape) * dtype.itemsize
    if found != expected:
        raise ValueError(
            f"{path}: expected {expected} bytes = {sizes} (D x H x W) of {dtype.name}, found {found}; check shape and "
            "dtype, or the file is truncated"
        )
    return expected


def uncompressed(path: Path, shape: Sequence[int], dtype: np.dtype, offset: int | None = 0) -> np.ndarray:
    """Voxels from byte ``offset`` to the end of a file, or at the end of a file if ``offset`` is None.

    They are read or memory-mapped by :func:`uncompressed_from`. ValueError if the number of bytes does not match.
    """
    size = path.stat().st_size
    offset = max(0, size - math.prod(shape) * dtype.itemsize) if offset is None else offset
    expect_bytes(path, size - offset, shape, dtype)
    return uncompressed_from(path, shape, dtype, offset)


def uncompressed_from(path: Path, shape: Sequence[int], dtype: np.dtype, offset: int) -> np.ndarray:
    """Writable voxels from byte ``offset`` of a file on; changing them does not change the file.

    They are read at once, or memory-mapped if they take over 1 GiB and over half of the free memory. Smaller volumes
    are not mapped, because access to mapped voxels ends the program if the file has been truncated in the meantime.
    """
    size = math.prod(shape) * dtype.itemsize
    if readable_at_once(size):
        values = np.fromfile(path, dtype, math.prod(shape), offset=offset)
        expect_bytes(path, values.nbytes, shape, dtype)
        return values.reshape(tuple(shape))
    if sys.platform != "linux":
        return np.memmap(path, dtype, "c", offset, tuple(shape))
    # numpy.memmap would reserve memory for a writable copy of the file, which fails if the file exceeds the memory.
    with open(path, "rb") as stream:
        access = {"flags": mmap.MAP_PRIVATE | _MAP_NORESERVE, "prot": mmap.PROT_READ | mmap.PROT_WRITE}
        return np.ndarray(tuple(shape), dtype, mmap.mmap(stream.fileno(), 0, **access), offset)


def stated_bytes(path: Path, shape: Sequence[int], dtype: np.dtype) -> int:
    """Number of bytes of ``shape`` (D, H, W) voxels; ValueError if it is 0 or exceeds the memory limit."""
    size = expect_bytes(path, math.prod(shape) * dtype.itemsize, shape, dtype)
    affordable(path, size, path.stat().st_size)
    return size


def unpacked(path: Path, data: bytes | bytearray, shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    """Decompressed ``data`` as an array of ``shape``."""
    expect_bytes(path, len(data), shape, dtype)
    # A bytearray is writable, which torch.from_numpy requires.
    return np.frombuffer(data if isinstance(data, bytearray) else bytearray(data), dtype).reshape(tuple(shape))


def from_text(path: Path, text: str | bytes, shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    """Voxels [D, H, W] from numbers separated by white space, in native byte order."""
    # Words are converted one by one: an array of strings would take the length of the longest word for every word.
    number = float if dtype.kind == "f" else int
    with readable(path, "text of numbers"):
        values = np.array([number(word) for word in text.split()], dtype.newbyteorder("="))
    expect_bytes(path, values.nbytes, shape, dtype)
    return values.reshape(tuple(shape))


def three_axes(values: np.ndarray, path: Path) -> np.ndarray:
    """``values`` [..., D, H, W] without leading axes of length 1; ValueError for colours, vectors and time series."""
    if values.dtype.names or values.dtype.kind not in "buif":
        raise ValueError(f"{path} holds {values.dtype} elements, not one real number per voxel; convert it to scalars")
    while values.ndim > 3 and values.shape[0] == 1:
        values = values[0]
    if values.ndim != 3:
        what = "fewer than three axes" if values.ndim < 3 else "colours, vectors or a time series"
        raise ValueError(
            f"{path} must hold one scalar on three axes (z, y, x), got shape {values.shape}: {what}; select or convert "
            "it to a single [D, H, W] array first"
        )
    return values


@contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Context manager that converts every error but MemoryError to a ValueError with the name of the file."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:  # decoders raise errors of many types, such as RuntimeError and KeyError
        raise ValueError(f"{path} is not a readable {kind}, or is truncated: {error}") from None


def extra(module: str, what: str) -> Any:
    """Import the optional ``module`` that ``what`` needs, or raise ImportError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ImportError(
            f"{what} needs {module}, an extra of holotorch; install it with: pip install 'holotorch[volumes]'"
        ) from None


def split_member(path: str | Path) -> tuple[Path, str | None]:
    """Split ``file::name`` into the path of the file and the name of an array in it, which is None if not given."""
    file, _, member = str(path).partition("::")
    return Path(file), member.strip("/") or None


def chosen(names: Sequence[str], member: str | None, path: Path) -> str:
    """Name of the array to read: ``member``, or the only one of ``names`` if ``member`` is None; else ValueError."""
    if member is None and len(names) == 1:
        return names[0]
    if member is None or member not in names:
        listed = ", ".join(names) or "none"
        asked = f"has no array {member!r}" if member else "does not hold exactly one volume"
        raise ValueError(f"{path} {asked}; its arrays are: {listed}; choose one by writing {path}::name")
    return member
