"""Bytes that no page sends to its server: HTTP requests and WebSocket frames with faults.

``@TOKEN@`` and ``@PORT@`` stand for the token and the port of the server that they are sent to.
"""

import struct
from random import Random

from fuzz.mutate import mutated
from fuzz.mutate_tree import json_mutated

TOKEN, PORT = b"@TOKEN@", b"@PORT@"
_METHODS = ("GET", "POST", "PUT", "HEAD", "OPTIONS", "DELETE", "CONNECT", "TRACE", "PATCH", "PRI", "get", "\x01", "")
_PATHS = (
    *("/", "/view.js", "/style.css", "/server.py", "/..%2fserver.py", "/../../etc/passwd", "//", "*", "", "/%00", "/%"),
    *("http://example.org/", "/\xff", "/./", "/" + "a" * 9000, "example.org:80", "/?token=", "/?token=%00%ff", "/#x"),
)
_HEADERS = (
    *("Transfer-Encoding: chunked", "Transfer-Encoding: gzip, chunked", "Content-Encoding: gzip", "Upgrade: h2c"),
    *("Expect: 100-continue", "Content-Length: 5", "Content-Length: -1", "Content-Length: 1e3", "Host: example.org"),
    *("Connection: close", "Connection: keep-alive", "Cookie: " + "c" * 9000, "X: " + "y" * 70_000, ": x", "a b: c"),
    *("Origin: null", "Sec-Fetch-Site: cross-site", "Content-Type: ;;;=", "X: \r\n folded", "\xe9: \xe9", "X: \x00"),
    *("Sec-WebSocket-Version: 8", "Sec-WebSocket-Key: x", "Sec-WebSocket-Extensions: permessage-deflate", "Host: ["),
    *("Sec-WebSocket-Protocol: a, b", "Sec-WebSocket-Key: " + "A" * 5000, "Range: bytes=-5", "Host: localhost"),
)
_LENGTHS = (0, 1, 125, 126, 127, 4096, 4097, 65_535, 65_536, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1)
_ENOUGH = 50_000  # bytes of frames; the servers take no message of more than 4096
_TEXT, _BINARY, _CLOSE, _PING = 1, 2, 8, 9
_CODES = (0, 1, 999, 1000, 1001, 1004, 1005, 1006, 1007, 1011, 1015, 2999, 3000, 5000, 65_535)


def request(method: str, path: str, *more: str, body: bytes = b"") -> bytes:
    """An HTTP request as the page of a server sends it."""
    lines = [f"{method} {path} HTTP/1.1", "Host: 127.0.0.1:@PORT@", *(more or ["Connection: close"])]
    lines += [f"Content-Length: {len(body)}"] if body else []
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + body


def handshake(path: str) -> bytes:
    """The request that opens a WebSocket."""
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
    return request("GET", path, "Upgrade: websocket", "Connection: Upgrade", key, "Sec-WebSocket-Version: 13")


def frame(payload: bytes, opcode: int = _TEXT, *, first: int = 0x80, masked: bool = True, length: int = -1) -> bytes:
    """A frame of a WebSocket; ``length`` is what it says of itself in place of the truth."""
    length = len(payload) if length < 0 else length
    short = length if length < 126 else 126 if length < 65_536 else 127
    data = bytes([first | opcode, (0x80 if masked else 0) | short])
    data += b"" if short < 126 else struct.pack("!H" if short == 126 else "!Q", length)
    return data + (b"\0\0\0\0" if masked else b"") + payload


def ending() -> bytes:
    """The frame with which a page closes."""
    return frame(struct.pack("!H", 1000), _CLOSE)


def faulty_request(rng: Random, data: bytes) -> bytes:
    """A request with another method, path, header or body, or other bytes."""
    head, blank, body = data.partition(b"\r\n\r\n")
    lines = head.decode("latin-1").split("\r\n")
    if lines[-1].startswith("Content-Length: ") and rng.random() < 0.5:
        body = json_mutated(rng, body, body)
        lines[-1] = f"Content-Length: {len(body)}"
        return "\r\n".join(lines).encode("latin-1") + blank + body
    method, _, rest = lines[0].partition(" ")
    path, _, version = rest.rpartition(" ")
    kind = rng.randrange(6)
    if kind == 0:
        lines[0] = f"{rng.choice(_METHODS)} {path} {version}"
    elif kind == 1:
        lines[0] = f"{method} {rng.choice(_PATHS)} {version}"
    elif kind == 2:
        lines[1:1] = rng.choices(_HEADERS, k=rng.choice((1, 2, 300)))
    elif kind == 3:
        lines[0] = lines[0].replace("@TOKEN@", rng.choice(("", "@TOKEN", "@TOKEN@x", "\xff", "%00", "x" * 8000)))
        del lines[rng.randrange(1, len(lines))]
    elif kind == 4:
        del lines[rng.randrange(len(lines))]
    else:
        return mutated(rng, data, head, (b"\r\n", b"\r\n\r\n", b"chunked", b"HTTP/0.9", b"\n"))
    return "\r\n".join(lines).encode("latin-1") + blank + body


def faulty_frames(rng: Random, messages: list[bytes]) -> bytes:
    """One to thirty frames after a good handshake; most carry a message that was changed."""
    parts: list[bytes] = []
    for _ in range(rng.choice((1, 1, 2, 5, 30))):
        if sum(map(len, parts)) > _ENOUGH:  # large messages take long to make
            break
        payload = rng.choice(messages)
        payload = json_mutated(rng, payload, rng.choice(messages)) if rng.random() < 0.8 else payload
        kind = rng.random()
        if kind < 0.6:
            parts.append(frame(payload))
        elif kind < 0.7:
            half = rng.randint(0, len(payload))
            parts.append(frame(payload[:half], first=0) + frame(payload[half:], rng.choice((0, 0, _TEXT))))
        elif kind < 0.8:
            opcode, first = rng.randrange(16), rng.choice((0, 0x80, 0xC0, 0xF0))
            parts.append(frame(payload, opcode, first=first, masked=rng.random() < 0.8))
        elif kind < 0.88:
            parts.append(frame(payload, rng.choice((_TEXT, _BINARY)), length=rng.choice(_LENGTHS)))
        elif kind < 0.94:
            parts.append(frame(rng.randbytes(rng.choice((0, 5, 125, 126, 5000))), rng.choice((_PING, _BINARY, _TEXT))))
        else:
            parts.append(frame(struct.pack("!H", rng.choice(_CODES)) + rng.randbytes(rng.choice((0, 3))), _CLOSE))
    data = b"".join(parts)
    return mutated(rng, data, data) if rng.random() < 0.15 else data
