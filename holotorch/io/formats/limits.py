"""Memory limits of files: contents are unpacked only up to the stated size, which is itself limited."""

import bz2
import os
import zlib
from collections.abc import Iterator
from pathlib import Path

from holotorch.core.memory import available_memory

MEMORY_LIMIT = 1 << 30  # bytes of memory allowed for any file
# Memory allowed for a larger file, relative to its size: photographs and scans need less than 300, zeros up to 1000.
RATIO = 500
VARIABLE = "HOLOTORCH_MEMORY_LIMIT"  # environment variable with a number of bytes that replaces MEMORY_LIMIT
_CHUNK = 1 << 20  # bytes unpacked at once


def affordable(source: Path | str, needed: int, stored: int) -> None:
    """Raise ValueError where a file needs more memory than is plausible for its size.

    Allowed are :data:`MEMORY_LIMIT` bytes, or :data:`RATIO` times the file's size where that is more. The environment
    variable :data:`VARIABLE` raises the former.

    Args:
        source: Name of the file.
        needed: Bytes that reading it takes.
        stored: Bytes of the file.
    """
    try:
        limit = float(os.environ.get(VARIABLE, MEMORY_LIMIT))
    except ValueError:
        raise ValueError(f"{VARIABLE} must be a number of bytes, got {os.environ[VARIABLE]!r}") from None
    if needed > max(limit, RATIO * stored):
        size = min(needed, 10**300) / 1e9  # a header may state more than a float holds
        raise ValueError(
            f"{source} has {stored} bytes and asks for {size:.3g} GB of memory, more than the limit of "
            f"{limit / 1e9:.3g} GB; if it is what it should be, set the environment variable {VARIABLE}={needed}"
        )


def readable_at_once(size: int) -> bool:
    """Whether so many bytes are read rather than mapped: up to :data:`MEMORY_LIMIT`, or half of the free memory."""
    return size <= max(MEMORY_LIMIT, (available_memory() or 0) // 2)


def unzipped(path: Path, size: int, offset: int = 0, *, kind: str = "gzip") -> bytearray:
    """Content of a compressed file from ``offset`` on, which shall have ``size`` bytes; fewer are returned as they are.

    Args:
        path: Of the file.
        size: Bytes that the content has as the file or its header states; no more are unpacked.
        offset: Where the compressed data begin.
        kind: "gzip", which takes zlib's header too, or "bzip2"; several members one after another are one content.

    Raises:
        ValueError: Data that are damaged or cut short, more than ``size`` bytes, or a size beyond the memory limit.
    """
    affordable(path, size, path.stat().st_size)
    content = bytearray()
    for piece in (_gzip if kind == "gzip" else _bzip2)(path, offset):
        content += piece
        if len(content) > size:
            raise ValueError(f"{path} holds more than the expected {size} bytes; check shape and dtype, or its header")
    return content


def inflated(data: bytes, size: int) -> bytes:
    """Content of a block of zlib, at most ``size`` bytes; ValueError where it has more, zlib.error for damage."""
    engine = zlib.decompressobj()
    content = engine.decompress(data, size + 1)
    if len(content) > size:
        raise ValueError(f"a compressed block holds more than the expected {size} bytes")
    if not engine.eof:
        raise ValueError("a compressed block is cut short")
    return content


def _gzip(path: Path, offset: int) -> Iterator[bytes]:
    rest, members, done = b"", 0, 0
    with open(path, "rb") as stream:
        stream.seek(offset)
        # A gzip file may hold several members, one after another, and padding.
        while rest := rest or stream.read(_CHUNK):
            if members and not rest.strip(b"\0"):
                rest = b""
                continue
            engine = zlib.decompressobj(32 + zlib.MAX_WBITS)  # whichever header it has
            try:
                while rest and not engine.eof:
                    piece = engine.decompress(rest, _CHUNK)
                    done += len(piece)
                    yield piece
                    rest = engine.unused_data if engine.eof else engine.unconsumed_tail or stream.read(_CHUNK)
            except zlib.error as error:
                raise ValueError(f"{path} holds damaged gzip data: {error}; fetch it again") from None
            if not engine.eof:
                raise ValueError(f"{path} is truncated: its gzip data stop after {done} bytes; fetch it again")
            members += 1


def _bzip2(path: Path, offset: int) -> Iterator[bytes]:
    rest, done = b"", 0
    with open(path, "rb") as stream:
        stream.seek(offset)
        while rest := rest or stream.read(_CHUNK):
            engine = bz2.BZ2Decompressor()
            try:
                while not engine.eof and (rest or not engine.needs_input):
                    piece = engine.decompress(rest, _CHUNK)
                    done += len(piece)
                    yield piece
                    rest = engine.unused_data if engine.eof else stream.read(_CHUNK) if engine.needs_input else b""
            except (ValueError, OSError) as error:
                raise ValueError(f"{path} holds damaged bzip2 data: {error}; fetch it again") from None
            if not engine.eof:
                raise ValueError(f"{path} is truncated: its bzip2 data stop after {done} bytes; fetch it again")
