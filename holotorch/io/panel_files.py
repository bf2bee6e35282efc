"""Files for a phase panel: grey levels as PNG or BMP and phases as EXR, each with metadata."""

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
from holotorch.io.formats.decoding import PNG, check_exr, decode

_KEY = "holotorch"  # key of the PNG text chunk and of the EXR attribute that contain the metadata as JSON


def write_levels(path: Path, levels: Tensor, metadata: Mapping[str, Any]) -> None:
    """Write a frame of grey levels, uint8 or uint16 [H, W], as ``.png`` or (uint8 only) ``.bmp``, atomically.

    Levels are stored without scaling: levels of a 10-bit panel are 0 to 1023 in a 16-bit file. The metadata, a mapping
    to JSON values, are stored in a text chunk of a PNG, or in ``NAME.bmp.json`` beside a BMP, which has no text chunks.

    Raises:
        TypeError: Levels of another dtype, or metadata that cannot be written as JSON.
        ValueError: Another shape, another file extension, 16 bits in a BMP, or NaN in the metadata.
    """
    import cv2

    if not isinstance(levels, Tensor) or levels.dtype not in (torch.uint8, torch.uint16):
        raise TypeError(f"levels must be a tensor of uint8 or uint16, got {getattr(levels, 'dtype', type(levels))}")
    _two_axes("levels", levels)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".bmp"):
        raise ValueError(f"{path}: levels are written as .png or .bmp, got {suffix or 'no ending'}")
    if suffix == ".bmp" and levels.dtype == torch.uint16:
        raise ValueError(f"{path}: a BMP holds 8 bits and these levels have more; use .png")
    text = _json(metadata)
    ok, data = cv2.imencode(suffix, np.ascontiguousarray(levels.detach().cpu().numpy()))
    if not ok:
        raise ValueError(f"{path}: could not encode levels of shape {tuple(levels.shape)}")
    if suffix == ".png":
        write_bytes(path, _with_text(data.tobytes(), text))
        return
    write_bytes(_beside(path), text.encode() + b"\n")
    write_bytes(path, data.tobytes())


def read_levels(path: Path) -> tuple[Tensor, dict[str, Any]]:
    """Read a frame of grey levels, uint8 or uint16 [H, W], and its metadata, which are empty if the file has none.

    Raises:
        ValueError: The file is missing, damaged, or no grey picture of 8 or 16 bits.
    """
    import cv2

    data = _existing(path).read_bytes()
    pixels = decode(path, cv2.IMREAD_UNCHANGED, data=data, memory=16)
    if pixels.ndim == 3 and (pixels == pixels[..., :1]).all():
        pixels = pixels[..., 0]  # a grey BMP is read as three equal channels
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path} must be grey with 8 or 16 bits, got {pixels.shape} of {pixels.dtype}")
    text = _text_of(data) if data.startswith(PNG) else None
    if text is None and _beside(path).is_file():
        text = _beside(path).read_bytes().decode("utf-8", "replace")
    return torch.from_numpy(pixels.copy()), _metadata(path, text)


def write_phases(path: Path, phase: Tensor, metadata: Mapping[str, Any]) -> None:
    """Write phases in rad, float32 [H, W], as the channel Y of an ``.exr``, bit-exactly and atomically.

    Raises:
        TypeError: Phases that are not float32, the type of the channel, or metadata that cannot be written as JSON.
        ValueError: Another shape or file extension, or NaN or infinity in the phases or the metadata.
    """
    import OpenEXR

    if not isinstance(phase, Tensor) or phase.dtype != torch.float32:
        raise TypeError(f"EXR keeps float32 phases, got {getattr(phase, 'dtype', type(phase))}; use phase.float()")
    _two_axes("phase", phase)
    checks.all_finite("phase", phase)
    if path.suffix.lower() != ".exr":
        raise ValueError(f"{path}: phases are written as .exr, got {path.suffix or 'no ending'}")
    # OpenEXR ignores the strides of its arrays, so it needs a contiguous copy.
    pixels = np.array(phase.detach().cpu().numpy(), dtype=np.float32, order="C", copy=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, _KEY: _json(metadata)}
    with tempfile.TemporaryDirectory() as folder:  # the library writes only to a path
        made = Path(folder) / "phase.exr"
        OpenEXR.File(header, {"Y": pixels}).write(str(made))
        data = made.read_bytes()
    write_bytes(path, data)


def read_phases(path: Path) -> tuple[Tensor, dict[str, Any]]:
    """Read phases in rad, float32 [H, W], and their metadata from an EXR file with a channel Y.

    Raises:
        ValueError: The file is missing, damaged, or has no float32 channel Y.
    """
    import OpenEXR

    check_exr(_existing(path), memory=8)
    try:
        file = OpenEXR.File(str(path), separate_channels=True)
        header, channels = file.header(), file.channels()
    except Exception as error:  # the library raises bare RuntimeError and others
        raise ValueError(f"{path} is not a readable EXR file: {error}") from None
    if "Y" not in channels or channels["Y"].pixels.dtype != np.float32:
        raise ValueError(f"{path} must have a float32 channel Y, got {', '.join(sorted(channels))}")
    return torch.from_numpy(np.array(channels["Y"].pixels)), _metadata(path, header.get(_KEY))


def _with_text(png: bytes, text: str) -> bytes:
    """The PNG with ``text`` in an international text chunk (UTF-8, not compressed) after its header."""
    end = len(PNG) + 12 + struct.unpack(">I", png[8:12])[0]
    body = b"iTXt" + _KEY.encode() + b"\0\0\0\0\0" + text.encode()
    return png[:end] + struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body)) + png[end:]


def _text_of(png: bytes) -> str | None:
    place = len(PNG)
    while place + 12 <= len(png):
        length = struct.unpack(">I", png[place : place + 4])[0]
        kind, body = png[place + 4 : place + 8], png[place + 8 : place + 8 + length]
        if kind == b"iTXt" and body.startswith(_KEY.encode() + b"\0\0\0\0\0"):
            return body[len(_KEY) + 5 :].decode("utf-8", "replace")
        place += 12 + length
    return None


def _json(metadata: Mapping[str, Any]) -> str:
    return json.dumps(dict(metadata), allow_nan=False, ensure_ascii=False, sort_keys=True)


def _metadata(path: Path, text: str | None) -> dict[str, Any]:
    if text is None:
        return {}
    try:
        found = json.loads(text)
    except (ValueError, TypeError, RecursionError):  # TypeError: no text; RecursionError: nested too deeply
        raise ValueError(f"{path}: its metadata are damaged: not JSON") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: its metadata are damaged: expected settings, got {found!r}")
    return found


def _beside(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    return path


def _two_axes(name: str, value: Tensor) -> None:
    if value.ndim != 2 or 0 in value.shape:
        raise ValueError(f"{name} must be one frame (H, W), got {tuple(value.shape)}")
