"""Limits of the memory that reading a file may take, and decompression up to the size that a header states."""

import bz2
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from holotorch.core.memory import available_memory

MEMORY_LIMIT = 1 << 30  # bytes of memory that reading a file may take, whatever the size of the file
# Reading a file may take this many times its size, if that is more than MEMORY_LIMIT. Photographs and scans take less
# than 300 times their size; a compressed file of zeros would take 1000 times.
RATIO = 500
VARIABLE = "HOLOTORCH_MEMORY_LIMIT"  # environment variable with a number of bytes that replaces MEMORY_LIMIT
_CHUNK = 1 << 20  # bytes decompressed at once


def affordable(source: Path | str, needed: int, stored: int) -> None:
    """Raise ValueError if reading the file ``source`` needs more memory than the limit.

    ``needed`` is the memory and ``stored`` the size of the file, in bytes. The limit is the larger of two numbers:
    :data:`RATIO` times ``stored``, and :data:`MEMORY_LIMIT` or its replacement in the environment variable
    :data:`VARIABLE`.
    """
    try:
        limit = float(os.environ.get(VARIABLE, MEMORY_LIMIT))
    except ValueError:
        raise ValueError(f"{VARIABLE} must be a number of bytes, got {os.environ[VARIABLE]!r}") from None
    limit = max(limit, RATIO * stored)
    if needed > limit:
        size = min(needed, 10**300) / 1e9  # a header may state a number too large for a float
        raise ValueError(
            f"{source} has {stored} bytes and asks for {size:.3g} GB of memory, more than the limit of "
            f"{limit / 1e9:.3g} GB; if you trust the file, set the environment variable {VARIABLE}={needed}"
        )


def readable_at_once(size: int) -> bool:
    """Whether ``size`` bytes are read at once, instead of memory-mapped.

    They are if they take at most :data:`MEMORY_LIMIT` or half of the free memory, whichever is larger.
    """
    return size <= max(MEMORY_LIMIT, (available_memory() or 0) // 2)


def unzipped(path: Path, size: int, offset: int = 0, *, kind: str = "gzip") -> bytearray:
    """Decompress a file from byte ``offset`` on; ``size`` is the largest number of bytes that the result may have.

    ``kind`` is "gzip", for gzip and zlib streams, or "bzip2". If the file has several compressed members, one after
    another, their content is joined. ValueError if the data are damaged or truncated, decompress to more than ``size``
    bytes, or if ``size`` exceeds the memory limit.
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
    """Yield the decompressed content of all members of a file, in pieces of at most ``_CHUNK`` bytes."""
    rest, members, done = b"", 0, 0
    with open(path, "rb") as stream:
        stream.seek(offset)
        while rest := rest or stream.read(_CHUNK):
            if members and not rest.strip(b"\0"):  # zeros that pad the file after its last member
                rest = b""
                continue
            # 32 + MAX_WBITS makes zlib accept the headers of both gzip and zlib.
            engine: Any = zlib.decompressobj(32 + zlib.MAX_WBITS) if kind == "gzip" else bz2.BZ2Decompressor()
            try:
                while not engine.eof and (rest or not getattr(engine, "needs_input", True)):
                    piece = engine.decompress(rest, _CHUNK)
                    done += len(piece)
                    yield piece
                    # zlib hands back the input that it has not consumed; bz2 keeps it and clears needs_input.
                    rest = engine.unused_data if engine.eof else getattr(engine, "unconsumed_tail", b"")
                    if not rest and not engine.eof and getattr(engine, "needs_input", True):
                        rest = stream.read(_CHUNK)
            except (zlib.error, ValueError, OSError) as error:
                raise ValueError(f"{path} holds damaged {kind} data: {error}; fetch it again") from None
            if not engine.eof:
                raise ValueError(f"{path} is truncated: its {kind} data stop after {done} bytes; fetch it again")
            members += 1
