"""Memory limits for reading files: the size that a header states is limited, and no more is decompressed."""

import bz2
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from holotorch.core.memory import available_memory

MEMORY_LIMIT = 1 << 30  # bytes of memory that reading a file may take, whatever the size of the file
# Reading a larger file may take this many times its size. Photographs and scans expand by less than 300, zeros by 1000.
RATIO = 500
VARIABLE = "HOLOTORCH_MEMORY_LIMIT"  # environment variable with a number of bytes that replaces MEMORY_LIMIT
_CHUNK = 1 << 20  # bytes decompressed at once


def affordable(source: Path | str, needed: int, stored: int) -> None:
    """Raise ValueError if reading the file ``source`` needs more memory than the limit.

    ``needed`` is the memory and ``stored`` the size of the file, in bytes. The limit is :data:`MEMORY_LIMIT`, or the
    number in the environment variable :data:`VARIABLE`, or :data:`RATIO` times ``stored`` if this is more.
    """
    try:
        limit = float(os.environ.get(VARIABLE, MEMORY_LIMIT))
    except ValueError:
        raise ValueError(f"{VARIABLE} must be a number of bytes, got {os.environ[VARIABLE]!r}") from None
    if needed > max(limit, RATIO * stored):
        size = min(needed, 10**300) / 1e9  # a header may state a number too large for a float
        raise ValueError(
            f"{source} has {stored} bytes and asks for {size:.3g} GB of memory, more than the limit of "
            f"{limit / 1e9:.3g} GB; if it is what it should be, set the environment variable {VARIABLE}={needed}"
        )


def readable_at_once(size: int) -> bool:
    """Whether ``size`` bytes are read, not memory-mapped: up to the larger of MEMORY_LIMIT and half the free memory."""
    return size <= max(MEMORY_LIMIT, (available_memory() or 0) // 2)


def unzipped(path: Path, size: int, offset: int = 0, *, kind: str = "gzip") -> bytearray:
    """Decompress a file from byte ``offset`` on; ``size`` is the largest number of bytes that the result may have.

    ``kind`` is "gzip", which also accepts zlib streams, or "bzip2". The content of concatenated members is joined.
    ValueError if the data are damaged or truncated, have more than ``size`` bytes, or exceed the memory limit.
    """
    affordable(path, size, path.stat().st_size)
    content = bytearray()
    for piece in _decompressed(path, offset, kind):
        content += piece
        if len(content) > size:
            raise ValueError(f"{path} holds more than the expected {size} bytes; check shape and dtype, or its header")
    return content


def inflated(data: bytes, size: int) -> bytes:
    """Decompress a zlib block to at most ``size`` bytes; ValueError for more bytes, zlib.error for damaged data."""
    engine = zlib.decompressobj()
    content = engine.decompress(data, size + 1)
    if len(content) > size:
        raise ValueError(f"a compressed block holds more than the expected {size} bytes")
    if not engine.eof:
        raise ValueError("a compressed block is cut short")
    return content


def _decompressed(path: Path, offset: int, kind: str) -> Iterator[bytes]:
    """Yield the content of all members of a compressed file in pieces of at most ``_CHUNK`` bytes."""
    rest, members, done = b"", 0, 0
    with open(path, "rb") as stream:
        stream.seek(offset)
        while rest := rest or stream.read(_CHUNK):
            if members and not rest.strip(b"\0"):  # padding after the last member
                rest = b""
                continue
            # The window bits accept the headers of both gzip and zlib.
            engine: Any = zlib.decompressobj(32 + zlib.MAX_WBITS) if kind == "gzip" else bz2.BZ2Decompressor()
            try:
                while not engine.eof and (rest or not getattr(engine, "needs_input", True)):
                    piece = engine.decompress(rest, _CHUNK)
                    done += len(piece)
                    yield piece
                    # zlib returns the input that it has not consumed; bz2 keeps it and needs no further input.
                    rest = engine.unused_data if engine.eof else getattr(engine, "unconsumed_tail", b"")
                    if not rest and not engine.eof and getattr(engine, "needs_input", True):
                        rest = stream.read(_CHUNK)
            except (zlib.error, ValueError, OSError) as error:
                raise ValueError(f"{path} holds damaged {kind} data: {error}; fetch it again") from None
            if not engine.eof:
                raise ValueError(f"{path} is truncated: its {kind} data stop after {done} bytes; fetch it again")
            members += 1
