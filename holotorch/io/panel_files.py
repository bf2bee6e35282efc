"""Files for a phase panel: grey levels as PNG or BMP and phases as EXR, each with metadata such as the wavelength."""

import json
import struct
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.io.files import write_bytes
from holotorch.io.formats.decoding import PNG, decode
from holotorch.io.images import read_exr

_KEY = "holotorch"  # key of the PNG text chunk and of the EXR attribute that contain the metadata as JSON
_CHUNK = b"iTXt"  # type of a PNG chunk with UTF-8 text
# Content of the chunk before the text: key, zero byte, two zero flags for "not compressed", and two empty strings
# (language, translated key), each ended by a zero byte.
_CHUNK_START = _KEY.encode() + bytes(5)


def write_levels(path: Path, levels: Tensor, metadata: Mapping[str, Any]) -> None:
    """Write a frame of grey levels, uint8 or uint16 [H, W], as ``.png`` or (uint8 only) ``.bmp``, atomically.

    Levels are stored without scaling: levels of a 10-bit panel are 0 to 1023 in a 16-bit file. The values of
    ``metadata`` must be of types that JSON has. They are stored in a text chunk of a PNG, or beside a BMP in
    ``NAME.bmp.json``.

    Raises:
        TypeError: Levels of another dtype, or metadata that cannot be written as JSON.
        ValueError: Another shape, another file extension, 16 bits in a BMP, or NaN in the metadata.
    """
    import cv2

    if not isinstance(levels, Tensor) or levels.dtype not in (torch.uint8, torch.uint16):
        raise TypeError(f"levels must be a tensor of uint8 or uint16, got {getattr(levels, 'dtype', type(levels))}")
    _check_frame("levels", levels)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".bmp"):
        raise ValueError(f"{path}: levels are written as .png or .bmp, got {suffix or 'no extension'}")
    if suffix == ".bmp" and levels.dtype == torch.uint16:
        raise ValueError(f"{path}: a BMP holds 8 bits and these levels have more; use .png")
    text = _json(metadata)
    ok, data = cv2.imencode(suffix, np.ascontiguousarray(levels.detach().cpu().numpy()))
    if not ok:
        raise ValueError(f"{path}: could not encode levels of shape {tuple(levels.shape)}")
    if suffix == ".png":
        write_bytes(path, _with_text(data.tobytes(), text))
        return
    write_bytes(_json_file(path), text.encode() + b"\n")
    write_bytes(path, data.tobytes())


def read_levels(path: Path) -> tuple[Tensor, dict[str, Any]]:
    """Read a frame of grey levels, uint8 or uint16 [H, W], and its metadata, an empty dict if the file has none.

    ValueError if the file is missing, damaged, or not a grey picture of 8 or 16 bits.
    """
    import cv2

    data = _existing(path).read_bytes()
    pixels = decode(path, cv2.IMREAD_UNCHANGED, data=data, memory=16)
    if pixels.ndim == 3 and (pixels == pixels[..., :1]).all():
        pixels = pixels[..., 0]  # a grey BMP is read as three equal channels
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path} must be grey with 8 or 16 bits, got {pixels.shape} of {pixels.dtype}")
    text = _png_text(data) if data.startswith(PNG) else None
    if text is None and _json_file(path).is_file():
        text = _json_file(path).read_bytes().decode("utf-8", "replace")
    return torch.from_numpy(pixels.copy()), _metadata(path, text)


def write_phases(path: Path, phase: Tensor, metadata: Mapping[str, Any]) -> None:
    """Write phases in rad, float32 [H, W], as the channel Y of an ``.exr``, without loss and atomically.

    Raises:
        TypeError: Phases that are not float32, or metadata that cannot be written as JSON.
        ValueError: Another shape or file extension, or NaN or infinity in the phases or the metadata.
    """
    import OpenEXR

    if not isinstance(phase, Tensor) or phase.dtype != torch.float32:
        raise TypeError(f"EXR keeps float32 phases, got {getattr(phase, 'dtype', type(phase))}; use phase.float()")
    _check_frame("phase", phase)
    checks.all_finite("phase", phase)
    if path.suffix.lower() != ".exr":
        raise ValueError(f"{path}: phases are written as .exr, got {path.suffix or 'no extension'}")
    pixels = np.array(phase.detach().cpu().numpy(), order="C")  # contiguous, since OpenEXR ignores strides
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, _KEY: _json(metadata)}
    with tempfile.TemporaryDirectory() as folder:  # the library writes only to a path
        temporary = Path(folder) / "phase.exr"
        OpenEXR.File(header, {"Y": pixels}).write(str(temporary))
        write_bytes(path, temporary.read_bytes())


def read_phases(path: Path) -> tuple[Tensor, dict[str, Any]]:
    """Read phases in rad, float32 [H, W], and their metadata from an EXR file.

    ValueError if the file is missing, damaged, or has no float32 channel Y.
    """
    header, channels = read_exr(_existing(path), memory=8)
    if "Y" not in channels or channels["Y"].dtype != np.float32:
        raise ValueError(f"{path} must have a float32 channel Y, got {', '.join(sorted(channels))}")
    return torch.from_numpy(np.array(channels["Y"])), _metadata(path, header.get(_KEY))


def _with_text(png: bytes, text: str) -> bytes:
    """The PNG with ``text`` in a text chunk after its header, the first chunk."""
    # A chunk consists of the length of its body, its type and a checksum, four bytes each, and the body.
    end = len(PNG) + 12 + struct.unpack_from(">I", png, len(PNG))[0]
    body = _CHUNK + _CHUNK_START + text.encode()
    return png[:end] + struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body)) + png[end:]


def _png_text(png: bytes) -> str | None:
    """The text that :func:`_with_text` has stored, or None."""
    offset = len(PNG)
    while offset + 12 <= len(png):
        length, kind = struct.unpack_from(">I4s", png, offset)
        body = png[offset + 8 : offset + 8 + length]
        if kind == _CHUNK and body.startswith(_CHUNK_START):
            return body.removeprefix(_CHUNK_START).decode("utf-8", "replace")
        offset += 12 + length
    return None


def _json(metadata: Mapping[str, Any]) -> str:
    return json.dumps(dict(metadata), allow_nan=False, ensure_ascii=False, sort_keys=True)


def _metadata(path: Path, text: str | None) -> dict[str, Any]:
    if text is None:
        return {}
    try:
        metadata = json.loads(text)
    except (ValueError, TypeError, RecursionError):  # TypeError: an EXR attribute that is no text
        raise ValueError(f"{path}: its metadata are damaged: not JSON") from None
    if not isinstance(metadata, dict):
        raise ValueError(f"{path}: its metadata are damaged: expected a JSON object, got {metadata!r}")
    return metadata


def _json_file(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    return path


def _check_frame(name: str, value: Tensor) -> None:
    if value.ndim != 2 or 0 in value.shape:
        raise ValueError(f"{name} must be one frame (H, W), got {tuple(value.shape)}")
