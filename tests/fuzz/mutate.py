"""Mutations of bytes: what a bad cable, a cut file, another program or a bad will makes of them."""

import re
from collections.abc import Callable
from random import Random

NUMBERS = (
    *("0", "-1", "1", "-0.0", "2", "255", "256", "360", "65535", "65536", "2147483647", "2147483648", "4294967295"),
    *("4294967296", "9223372036854775807", "9223372036854775808", "18446744073709551615", "1000000001", "99999999999"),
    *("1e-300", "1e300", "1e999", "-1e999", "nan", "-nan", "inf", "-inf", "1e99999999", "1e-99999999", "1_000", "0x10"),
    *("1" * 30, "9" * 5000, "0." + "3" * 400, "1.5", "1e9", "-1e9", "+5", "٣", "½", "1,5", ""),
)
_WIDTHS = (1, 2, 4, 8)


def mutated(rng: Random, data: bytes, other: bytes, tokens: tuple[bytes, ...] = ()) -> bytes:
    """``data`` after one to six mutations; ``other`` is a second valid file, ``tokens`` are words of the format."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        change = rng.choice(_TEXT if rng.random() < 0.3 else _CHANGES)
        data = change(rng, data)
        if tokens and rng.random() < 0.2:
            place = rng.randint(0, len(data))
            data = data[:place] + rng.choice(tokens) + data[place + rng.choice((0, 0, 4)) :]
        if rng.random() < 0.05:
            data = _spliced(rng, data, other)
    return data


def headed(rng: Random, data: bytes, size: int) -> bytes:
    """``data`` with a whole number within its first ``size`` bytes replaced, where formats keep sizes and offsets."""
    width = rng.choice(_WIDTHS)
    place = rng.randrange(max(1, min(size, len(data)) // width)) * width
    return data[:place] + _word(rng, width) + data[place + width :]


def _word(rng: Random, width: int) -> bytes:
    top = 2 ** (8 * width)
    value = rng.choice((0, 1, 2, 255, 256, top - 1, top // 2, top // 2 - 1, top // 256, 65535, 10**6, 10**9, 17))
    value = rng.randrange(top) if rng.random() < 0.2 else value
    return (value % top).to_bytes(width, rng.choice(("little", "big")))


def _flipped(rng: Random, data: bytes) -> bytes:
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64)) if data else 0):
        found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


def _overwritten(rng: Random, data: bytes) -> bytes:
    if not data:
        return data
    width = rng.choice(_WIDTHS)
    place = rng.randrange(len(data)) if rng.random() < 0.5 else rng.randrange(min(len(data), 256))
    return data[:place] + _word(rng, width) + data[place + width :]


def _cut(rng: Random, data: bytes) -> bytes:
    return data[: rng.randint(0, len(data))]


def _without(rng: Random, data: bytes) -> bytes:
    start = rng.randint(0, len(data))
    return data[:start] + data[start + rng.choice((1, 1, 4, 64, 4096)) :]


def _twice(rng: Random, data: bytes) -> bytes:
    start, size = rng.randint(0, len(data)), rng.choice((1, 4, 16, 256, 4096))
    times = rng.choice((2, 2, 3, 100, 2000))
    return (data[:start] + data[start : start + size] * times + data[start + size :])[: 1 << 20]


def _inserted(rng: Random, data: bytes) -> bytes:
    place = rng.randint(0, len(data))
    what = rng.choice(
        (rng.randbytes(rng.choice((1, 4, 100))), b"\0" * 8, b"\xff" * 8, b"\r", b"\n\n", b"\x00", b"\xc3")
    )
    return data[:place] + what + data[place:]


def _spliced(rng: Random, data: bytes, other: bytes) -> bytes:
    return data[: rng.randint(0, len(data))] + other[rng.randint(0, len(other)) :]


def _numbered(rng: Random, data: bytes) -> bytes:
    """Another number in the place of one that is written in digits."""
    places = [match.span() for match in re.finditer(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?", data[:20000])]
    if not places:
        return _flipped(rng, data)
    start, stop = rng.choice(places)
    return data[:start] + rng.choice(NUMBERS).encode() + data[stop:]


def _lines(rng: Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    place = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[place]
        case 1:
            lines.insert(rng.randrange(len(lines)), lines[place])
        case 2:
            other = rng.randrange(len(lines))
            lines[place], lines[other] = lines[other], lines[place]
        case _:
            lines[place] = lines[place].rstrip() + rng.choice((b"\r", b" ", b",", b"\t", b'"', b":", b"#", b"\\"))
    return b"\n".join(lines)


def _words(rng: Random, data: bytes) -> bytes:
    """One word of a text left out, twice, or in the place of another."""
    parts = re.split(rb"(\W+)", data[:20000])
    place = rng.randrange(len(parts))
    parts[place] = rng.choice((b"", parts[place] * 2, rng.choice(parts), b"(" * 5000, b"[" * 100000, b"x" * 70000))
    return b"".join(parts) + data[20000:]


_CHANGES: tuple[Callable[[Random, bytes], bytes], ...] = (
    *(_flipped, _flipped, _overwritten, _overwritten, _overwritten, _cut, _without, _twice, _inserted),
)
_TEXT: tuple[Callable[[Random, bytes], bytes], ...] = (_numbered, _numbered, _lines, _words)
