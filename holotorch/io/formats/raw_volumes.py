"""Readers of raw voxels, with a text header (MetaImage and NRRD) or without one."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from holotorch.io.formats import scan
from holotorch.io.formats.limits import unzipped
from holotorch.io.formats.scan import Scan

# With "byte skip: -1", NRRD voxels are the last bytes of the data. Largest number of decompressed bytes before them.
_HEADER = 1 << 20
_META_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
# Frames of NRRD's spaces; x of a left-handed one is reversed when it is read.
_NRRD_FRAMES = {
    **dict.fromkeys(("left-posterior-superior", "lps"), "LPS"),
    **dict.fromkeys(("right-anterior-superior", "ras", "left-anterior-superior", "las"), "RAS"),
}
_NRRD_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}


def read_raw(path: Path, shape: Sequence[int] | None, dtype: DTypeLike | None) -> Scan:
    """Read voxels [D, H, W] without a header; ``shape`` is (D, H, W).

    If ``shape`` or ``dtype`` is None, the file name must state the number of voxels along (x, y, z) and the type, as in
    the Open SciVis Datasets, for example bonsai_256x256x256_uint8.raw. A file whose name ends in .gz is decompressed.
    """
    stated = re.search(r"_(\d+)x(\d+)x(\d+)_(u?int\d+|float\d+)\.", path.name)
    if stated:
        shape = shape or (int(stated[3]), int(stated[2]), int(stated[1]))
        dtype = dtype or stated[4]
    if shape is None or dtype is None:
        headers = [path.with_suffix(suffix) for suffix in (".mhd", ".nhdr") if path.with_suffix(suffix).is_file()]
        hint = f"load its header {headers[0]}" if headers else "name it name_XxYxZ_dtype.raw"
        raise ValueError(
            f"{path} has no header: pass shape=(D, H, W) and dtype=, such as 'uint8', or '>i2' if big-endian; or {hint}"
        )
    kind = scan.number_type(dtype)
    if path.suffix == ".gz":
        return Scan(scan.unpacked(path, unzipped(path, scan.stated_bytes(path, shape, kind)), shape, kind))
    return Scan(scan.uncompressed(path, shape, kind))


def read_metaimage(path: Path) -> Scan:
    """Read MetaImage (.mhd with a data file, or .mha); lengths are in DistanceUnits, by default millimetres."""
    fields, end = _metaimage_header(path)
    if fields.get("NDims", "3") != "3" or fields.get("ElementNumberOfChannels", "1") != "1":
        raise ValueError(
            f"{path} has NDims = {fields.get('NDims')} and ElementNumberOfChannels = "
            f"{fields.get('ElementNumberOfChannels', '1')}; expected one scalar on three axes"
        )
    if fields.get("BinaryData", "True").lower() != "true":
        raise ValueError(f"{path} holds its voxels as text; write it with BinaryData = True")
    name, kind = fields["ElementDataFile"], fields.get("ElementType")
    data = path if name == "LOCAL" else scan.named(path, name)
    if kind not in _META_TYPES:
        raise ValueError(f"{path} has ElementType = {kind}; known are {', '.join(_META_TYPES)}")
    big = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "False")).lower() == "true"
    dtype = np.dtype((">" if big else "<") + _META_TYPES[kind])
    shape = _whole(fields, "DimSize", 3, path, minimum=1)[::-1]
    skip = _whole(fields, "HeaderSize", 1, path, minimum=-1, default="0")[0]
    offset = end if name == "LOCAL" else skip
    if fields.get("CompressedData", "False").lower() == "true":
        values = scan.unpacked(data, unzipped(data, scan.stated_bytes(data, shape, dtype), offset), shape, dtype)
    else:
        values = scan.uncompressed(data, shape, dtype, None if skip == -1 else offset)
    if not {"ElementSpacing", "ElementSize"} & fields.keys():
        return Scan(values)
    spacing = _numbers(fields, ("ElementSpacing", "ElementSize"), 3, path)
    names = "TransformMatrix", "Orientation", "Rotation"
    rows = _numbers(fields, names, 9, path, default="1 0 0 0 1 0 0 0 1")
    frame = "LPS" if fields.keys() & set(names) else ""  # as ITK, which defines the format, understands it
    origin = _numbers(fields, ("Offset", "Position", "Origin"), 3, path, default="0 0 0")
    axes = np.reshape(rows, (3, 3)) * np.reshape(spacing, (3, 1))
    return scan.placed(values, axes, origin, "m", scan.metres(fields.get("DistanceUnits", "mm"), path), frame)


def read_nrrd(path: Path) -> Scan:
    """Read NRRD (.nrrd, or .nhdr with a data file); if the file states no unit of length, the unit is "relative"."""
    import nrrd

    with open(path, "rb") as stream:
        with scan.readable(path, "NRRD header"):
            header = nrrd.read_header(stream)
        end = stream.tell()
    missing = [field for field in ("type", "sizes", "encoding") if field not in header]
    if missing:
        raise ValueError(f"the NRRD header of {path} lacks {', '.join(missing)}")
    sizes = [int(size) for size in header["sizes"]]
    if len(sizes) != 3:
        kinds = f" of kinds {' '.join(header['kinds'])}" if "kinds" in header else ""
        raise ValueError(
            f"{path} has {len(sizes)} axes{kinds}, sizes {sizes}; expected one scalar on three axes x, y, z"
        )
    return _nrrd_placed(_nrrd_values(path, header, sizes[::-1], end), header, path)


def _nrrd_values(path: Path, header: dict[str, Any], shape: list[int], end: int) -> np.ndarray:
    encoding, dtype = header["encoding"].lower(), _nrrd_type(path, header)
    name = header.get("data file", header.get("datafile"))
    data = scan.named(path, name) if name else path
    with open(data, "rb") as stream:
        stream.seek(0 if name else end)
        for _ in range(int(header.get("line skip", header.get("lineskip", 0)))):
            if not stream.readline():
                break
        offset = stream.tell()
    skip = int(header.get("byte skip", header.get("byteskip", 0)))
    if skip < -1:
        raise ValueError(f"{path} has byte skip {skip}; expected -1 or a number of bytes")
    if encoding == "raw":
        return scan.uncompressed(data, shape, dtype, None if skip == -1 else offset + skip)
    if encoding in ("gzip", "gz", "bzip2", "bz2"):
        size, kind = scan.stated_bytes(data, shape, dtype), "gzip" if encoding[0] == "g" else "bzip2"
        content = unzipped(data, size + (_HEADER if skip == -1 else skip), offset, kind=kind)
        del content[: -size if skip == -1 else skip]  # the bytes before the voxels
        return scan.unpacked(data, content, shape, dtype)
    if encoding in ("ascii", "text", "txt"):
        return scan.from_text(data, data.read_bytes()[offset:], shape, dtype)
    raise ValueError(f"{path} is encoded as {encoding!r}; known are raw, gzip, bzip2 and ascii")


def _nrrd_type(path: Path, header: dict[str, Any]) -> np.dtype:
    kind = next((kind for kind, names in _NRRD_TYPES.items() if header["type"].lower() in names), None)
    if kind is None:
        raise ValueError(f"{path} has type {header['type']!r}, which is not a type of real numbers")
    endian = header.get("endian", "little" if kind[1] == "1" or header["encoding"].lower() == "ascii" else None)
    if endian not in ("little", "big"):
        raise ValueError(f"{path} must state endian: little or endian: big for type {header['type']}, got {endian!r}")
    return np.dtype((">" if endian == "big" else "<") + kind)


def _nrrd_placed(values: np.ndarray, header: dict[str, Any], path: Path) -> Scan:
    in_space = header.get("space directions") is not None
    if not in_space and "spacings" not in header:
        return Scan(values)
    axes = np.asarray(header["space directions"] if in_space else np.diag(header["spacings"]), dtype=np.float64)
    if axes.shape != (3, 3):
        raise ValueError(f"{path} has space directions {axes.tolist()}; expected three vectors of three components")
    units = [unit for unit in header.get("space units" if in_space else "units", []) if unit.strip()]
    if len(units) not in (0, 3):
        raise ValueError(f"{path} gives units for {len(units)} of three axes; pass spacing= instead")
    # "space units" belong to the components of the vectors, the columns of ``axes``. "units" belong to the axes; then
    # ``axes`` is a diagonal matrix, to which the same scaling applies.
    scale = np.array([scan.metres(unit, path) for unit in units] if units else [1.0, 1, 1])
    origin = np.asarray(header.get("space origin", [0.0, 0, 0]), dtype=np.float64)
    origin = np.where(np.isfinite(origin), origin, 0) * scale
    space = header.get("space", "").lower()
    frame = _NRRD_FRAMES.get(space, "xyz") if in_space else ""
    if space in ("left-anterior-superior", "las", "3d-left-handed"):
        axes, origin = axes * (-1.0, 1, 1), origin * (-1.0, 1, 1)
    return scan.placed(values, axes * scale, origin, "m" if units else "relative", frame=frame)


def _metaimage_header(path: Path) -> tuple[dict[str, str], int]:
    """Fields of a MetaImage header by name, and its length in bytes."""
    fields: dict[str, str] = {}
    with open(path, "rb") as stream:
        # ElementDataFile is always the last field of the header; voxels may follow it.
        while "ElementDataFile" not in fields and (line := stream.readline(1 << 16)):
            name, equals, value = line.decode("latin-1").partition("=")
            if equals:
                fields[name.strip()] = value.strip()
        if "ElementDataFile" not in fields:
            raise ValueError(f"{path} is not a MetaImage header: it has no field ElementDataFile")
        return fields, stream.tell()


def _whole(
    fields: dict[str, str], name: str, count: int, path: Path, *, minimum: int, default: str | None = None
) -> list[int]:
    """The ``count`` whole numbers, each at least ``minimum``, in the field ``name`` or in the text ``default``."""
    numbers = _numbers(fields, (name,), count, path, default)
    if not all(number.is_integer() and number >= minimum for number in numbers):
        raise ValueError(f"{path} must give whole numbers of at least {minimum} as {name}, got {fields[name]!r}")
    return [int(number) for number in numbers]


def _numbers(
    fields: dict[str, str], names: Sequence[str], count: int, path: Path, default: str | None = None
) -> list[float]:
    """The ``count`` numbers in the first of the fields ``names`` that exists, or in the text ``default``."""
    text = next((fields[name] for name in names if name in fields), default)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise ValueError(f"{path} must give {count} numbers as {names[0]}, got {text!r}")
    return numbers
