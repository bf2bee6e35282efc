"""Memory limits for reading files: data are decompressed only up to the stated size, which is itself limited."""

import bz2
import os
import zlib
from collections.abc import Iterator
from pathlib import Path

from holotorch.core.memory import available_memory

MEMORY_LIMIT = 1 << 30  # bytes of memory allowed for any file
# Larger files may use this many times their size in memory. Photographs and scans expand less than 300-fold, a file of
# zeros up to 1000-fold.
RATIO = 500
VARIABLE = "HOLOTORCH_MEMORY_LIMIT"  # environment variable with a number of bytes that replaces MEMORY_LIMIT
_CHUNK = 1 << 20  # bytes decompressed at once


def affordable(source: Path | str, needed: int, stored: int) -> None:
    """Raise ValueError if a file needs more memory than is plausible for its size.

    The limit is :data:`MEMORY_LIMIT` bytes or :data:`RATIO` times the file's size, whichever is more. The environment
    variable :data:`VARIABLE` replaces the former.

    Args:
        source: Name of the file.
        needed: Memory for reading the file in bytes.
        stored: Size of the file in bytes.
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
    """Whether data of ``size`` bytes are read at once, not mapped: up to MEMORY_LIMIT or half of the free memory."""
    return size <= max(MEMORY_LIMIT, (available_memory() or 0) // 2)


def unzipped(path: Path, size: int, offset: int = 0, *, kind: str = "gzip") -> bytearray:
    """Decompress a file from ``offset`` on. Content shorter than ``size`` bytes is returned without an error.

    Args:
        path: Path of the file.
        size: Expected size of the content in bytes, usually stated by a header; decompression stops beyond it.
        offset: Position in the file, in bytes, at which the compressed data begin.
        kind: "gzip", which also accepts zlib streams, or "bzip2". Concatenated members are joined.

    Raises:
        ValueError: The data are damaged or cut short, have more than ``size`` bytes, or exceed the memory limit.
    """
    affordable(path, size, path.stat().st_size)
    content = bytearray()
    for piece in (_gzip if kind == "gzip" else _bzip2)(path, offset):
        content += piece
        if len(content) > size:
            raise ValueError(f"{path} holds more than the expected {size} bytes; check shape and dtype, or its header")
    return content


def inflated(data: bytes, size: int) -> bytes:
    """Decompress a zlib block of at most ``size`` bytes; ValueError if it has more, zlib.error if it is damaged."""
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
            engine = zlib.decompressobj(32 + zlib.MAX_WBITS)  # accepts the headers of gzip and zlib
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
