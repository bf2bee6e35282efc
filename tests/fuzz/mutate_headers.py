"""Mutations of files with a header: its fields, what it says of the data, and data that unpack to far more."""

import bz2
import gzip
import re
import struct
import zlib
from functools import cache
from random import Random

from fuzz.mutate import NUMBERS, headed, mutated

_PNG = b"\x89PNG\r\n\x1a\n"
_FIELD = re.compile(rb"^([\w ]+?)(\s*:=?\s*|\s*=\s*)(.*)$")
_OTHERS = (
    b"raw",
    b"gzip",
    b"bzip2",
    b"ascii",
    b"hex",
    b"LIST",
    b"LOCAL",
    b"little",
    b"big",
    b"True",
    b"False",
    b"uint8",
)


def fields_mutated(rng: Random, data: bytes, other: bytes, end: bytes) -> bytes:
    """A header of lines ``name: value`` or ``name = value``, up to ``end``: values changed, lines left out or twice."""
    head, mark, rest = data.partition(end)
    if rng.random() < 0.15:
        return mutated(rng, data, other)
    lines = head.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 3))):
        place = rng.randrange(len(lines))
        match = _FIELD.match(lines[place])
        kind = rng.randrange(8)
        if match and kind < 5:
            lines[place] = match[1] + match[2] + _value(rng, match[3], lines)
        elif kind == 5:
            lines.insert(place, lines[rng.randrange(len(lines))])
        elif len(lines) > 1:
            del lines[place]
    if rng.random() < 0.2:
        rest = packed(rng, rest)
    return b"\n".join(lines) + mark + rest


def _value(rng: Random, value: bytes, lines: list[bytes]) -> bytes:
    words = value.split()
    if words and rng.random() < 0.6:
        words[rng.randrange(len(words))] = rng.choice((rng.choice(NUMBERS).encode()[:3000], rng.choice(_OTHERS), b""))
        return b" ".join(words)
    other = _FIELD.match(rng.choice(lines))
    return rng.choice((other[3] if other else b"", value + b" " + value, b"", rng.choice(_OTHERS), value + b"\r"))


def packed(rng: Random, data: bytes) -> bytes:
    """Packed data, cut, damaged, or a bomb: zeros of hundreds of megabytes in less than a megabyte."""
    match rng.randrange(5):
        case 0:
            return _bomb("bz2") * rng.choice((1, 100, 600))
        case 1:
            return _bomb("gzip") * rng.choice((1, 20, 60))
        case 2:
            return gzip.compress(data, 1)[: rng.randint(0, len(data))]
        case 3:
            return mutated(rng, gzip.compress(data, 1), data)
        case _:
            return zlib.compress(bytes(10**7)) + data


@cache
def _bomb(kind: str) -> bytes:
    """10 MB of zeros; whole streams may follow each other."""
    return bz2.compress(bytes(10**7)) if kind == "bz2" else gzip.compress(bytes(10**7))


def png_mutated(rng: Random, data: bytes, other: bytes) -> bytes:
    """A PNG: fields of its header, lengths of its chunks, their order, with checksums that fit; or its bytes."""
    if rng.random() < 0.3 or not data.startswith(_PNG):
        return headed(rng, mutated(rng, data, other), 64) if rng.random() < 0.5 else mutated(rng, data, other)
    chunks, place = [], len(_PNG)
    while place + 12 <= len(data):
        length = struct.unpack(">I", data[place : place + 4])[0]
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    index = rng.randrange(len(chunks))
    kind, body = chunks[index]
    match rng.randrange(6):
        case 0:
            chunks[0] = (chunks[0][0], headed(rng, chunks[0][1], 13))
        case 1:
            chunks[index] = (kind, mutated(rng, body, other))
        case 2:
            chunks.insert(rng.randrange(len(chunks)), chunks[index])
        case 3:
            del chunks[index]
        case 4:
            size = struct.pack(">II", rng.choice((1, 16, 30000, 100000, 2**31)), rng.choice((1, 16, 30000, 2**31 - 1)))
            chunks[0] = (chunks[0][0], size + chunks[0][1][8:])
            packed_rows = zlib.compress(bytes(10**7), 9) if rng.random() < 0.5 else body
            chunks = [(name, packed_rows if name == b"IDAT" else part) for name, part in chunks]
        case _:
            name = rng.choice(
                (b"iTXt", b"zTXt", b"iCCP", b"gAMA", b"tRNS", b"PLTE", b"eXIf", b"acTL", b"fdAT", b"IEND")
            )
            chunks.insert(
                rng.randrange(1, len(chunks) + 1), (name, rng.choice((b"", body, zlib.compress(bytes(10**6)))))
            )
    made = bytearray(_PNG)
    for name, part in chunks:
        length = len(part) if rng.random() < 0.97 else rng.choice((0, 2**31 - 1, 2**32 - 1, 4 * 10**9))
        made += struct.pack(">I", length) + name + part + struct.pack(">I", zlib.crc32(name + part))
    return bytes(made)


def sized(rng: Random, data: bytes, other: bytes) -> bytes:
    """A binary file whose first bytes hold sizes and offsets, as those of BMP, TIFF, EXR and AVI do."""
    return headed(rng, data, rng.choice((32, 64, 512))) if rng.random() < 0.5 else mutated(rng, data, other)
