"""Reader of VTK image data (.vti): XML with voxels as text, base64 or raw bytes, uncompressed or compressed by zlib."""

import base64
import re
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import numpy as np

from holotorch.io.formats import scan
from holotorch.io.formats.limits import inflated
from holotorch.io.formats.scan import Scan

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4", "Int64": "i8",
    "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip
# Bounded repetitions keep the time of the search linear even for files with many partial matches.
_APPENDED = re.compile(
    rb"<AppendedData\s[^<>]{0,200}encoding\s{0,9}=\s{0,9}[\"'](\w{1,20})[\"'][^<>]{0,200}>\s{0,999}_"
)


def read_vti(path: Path, member: str | None = None) -> Scan:
    """Read the scalar array ``member`` of a .vti file whose image is one Piece.

    The default is the array that the file marks as its active scalars, or else the only array. The format has no unit
    of length, so the unit is "relative". Large uncompressed raw data are memory-mapped.
    """
    root, start, base64_coded = _document(path)
    image = root.find("ImageData")
    pieces = root.findall("ImageData/Piece")
    if image is None or len(pieces) != 1:
        raise ValueError(f"{path} must hold one ImageData in one Piece, got {root.get('type')} in {len(pieces)} pieces")
    array, cells = _array(pieces[0], member, path)
    bounds = [int(word) for word in pieces[0].get("Extent", image.get("WholeExtent", "")).split()]
    if len(bounds) != 6:
        raise ValueError(f"{path} must state its Extent as six whole numbers, got {bounds}")
    points = [last - first + 1 for first, last in zip(bounds[::2], bounds[1::2], strict=True)]
    shape = [max(1, size - cells) for size in points[::-1]]
    kind = array.get("type", "")
    if kind not in _TYPES:
        raise ValueError(f"{path} has an array of type {kind!r}; known are {', '.join(_TYPES)}")
    components = int(array.get("NumberOfComponents", 1))
    if components != 1:
        raise ValueError(
            f"{path}: array {array.get('Name')!r} has {components} components per voxel, expected a scalar"
        )
    dtype = np.dtype((">" if root.get("byte_order") == "BigEndian" else "<") + _TYPES[kind])
    values = scan.three_axes(_values(path, root, array, shape, dtype, start, base64_coded), path)
    if "Spacing" not in image.attrib:
        return Scan(values)
    spacing = np.array([float(word) for word in image.attrib["Spacing"].split()])
    direction = np.reshape([float(word) for word in image.get("Direction", "1 0 0 0 1 0 0 0 1").split()], (3, 3))
    axes = direction.T * spacing[:, None]  # the columns of Direction are unit vectors along the axes
    corner = np.array([float(word) for word in image.get("Origin", "0 0 0").split()])
    first = np.array(bounds[::2]) + (0.5 if cells else 0)
    return scan.placed(values, axes, corner + first @ axes, "relative", frame="xyz" * ("Direction" in image.attrib))


def _document(path: Path) -> tuple[ElementTree.Element, int, bool]:
    """Root of the XML, byte offset of the appended data or -1 if there are none, and whether they are in base64."""
    data = np.memmap(path, np.uint8, "r")
    match = _APPENDED.search(data)  # type: ignore[arg-type]
    text = bytes(data[: match.start()]) + b"</VTKFile>" if match else bytes(data)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a readable VTK XML file, or is truncated: {error}") from None
    return root, match.end() if match else -1, bool(match) and match[1] == b"base64"


def _array(piece: ElementTree.Element, member: str | None, path: Path) -> tuple[ElementTree.Element, int]:
    """The array to read, and how many fewer values than points an axis has: 1 for cell data, 0 for point data."""
    for name, cells in (("PointData", 0), ("CellData", 1)):
        holder = piece.find(name)
        arrays = {item.get("Name", ""): item for item in (holder if holder is not None else ())}
        if holder is not None and arrays and (member is None or member in arrays or cells):
            active = holder.get("Scalars")
            chosen = member or (active if active in arrays else None)
            return arrays[scan.chosen(list(arrays), chosen, path)], cells
    raise ValueError(f"{path} holds no array{f' {member!r}' if member else ''}")


def _values(
    path: Path,
    root: ElementTree.Element,
    array: ElementTree.Element,
    shape: list[int],
    dtype: np.dtype,
    start: int,
    base64_coded: bool,
) -> np.ndarray:
    """Voxels of ``array``; :func:`_document` returns ``start``, an offset in bytes, and ``base64_coded``."""
    form, compressor = array.get("format", "ascii"), root.get("compressor")
    if form == "ascii":
        return scan.from_text(path, array.text or "", shape, dtype)
    header_type = root.get("header_type", "UInt32")
    if header_type not in ("UInt32", "UInt64"):
        raise ValueError(f"{path} has header_type {header_type!r}, expected UInt32 or UInt64")
    if compressor not in (None, "vtkZLibDataCompressor"):
        raise ValueError(f"{path} is compressed by {compressor}; write it with vtkZLibDataCompressor or without")
    count = np.dtype((">" if root.get("byte_order") == "BigEndian" else "<") + _TYPES[header_type])
    if form == "appended" and start < 0:
        raise ValueError(f"{path} is truncated: its appended data are missing")
    offset = start + int(array.get("offset", 0))
    if form == "appended" and not base64_coded:
        if compressor is None:
            with open(path, "rb") as stream:
                stream.seek(offset)
                size = _length(stream.read(count.itemsize), count)
            offset += count.itemsize
            scan.expect_bytes(path, max(0, min(size, path.stat().st_size - offset)), shape, dtype)
            return scan.uncompressed_from(path, shape, dtype, offset)
        data = path.read_bytes()[offset:]
    else:
        data = _decoded(array.text or "" if form == "binary" else path.read_bytes()[offset:].decode("latin-1"))
    if compressor:
        return scan.unpacked(path, _inflated(path, data, count, scan.stated_bytes(path, shape, dtype)), shape, dtype)
    return scan.unpacked(path, data[count.itemsize : count.itemsize + _length(data, count)], shape, dtype)


def _length(data: bytes, count: np.dtype) -> int:
    """Number of bytes of uncompressed data, which precedes the data as an integer of type ``count``."""
    return int.from_bytes(data[: count.itemsize], "big" if count.byteorder == ">" else "little")


def _decoded(text: str) -> bytes:
    """Decode ``text`` up to "<". It consists of two base64 texts, the length of the data and the data."""
    parts = re.findall(r"[A-Za-z0-9+/]+=*", "".join(text.partition("<")[0].split()))
    # Base64 consists of groups of four characters, of which a truncated file may lack some of the last.
    letters = [part[: len(part) // 4 * 4].rstrip("=") for part in parts]
    letters = [part[:-1] if len(part) % 4 == 1 else part for part in letters]  # a single letter is less than a byte
    return b"".join(base64.b64decode(part + "=" * (-len(part) % 4)) for part in letters)


def _inflated(path: Path, data: bytes, count: np.dtype, size: int) -> bytearray:
    """Decompress ``data`` to at most ``size`` bytes.

    Before the compressed blocks there is a header of integers of type ``count``: the number of blocks, the uncompressed
    sizes of a block and of the last block, and the compressed size of each block.
    """
    try:
        blocks = int(np.frombuffer(data, count, 1)[0])
        sizes = np.frombuffer(data, count, blocks, 3 * count.itemsize)
        content, place = bytearray(), (3 + blocks) * count.itemsize
        for length in map(int, sizes):
            content += inflated(data[place : place + length], size - len(content))
            place += length
        return content
    except (ValueError, zlib.error) as error:
        raise ValueError(f"{path} is truncated or damaged: {error}") from None
