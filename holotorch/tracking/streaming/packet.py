"""The datagram that carries one pose, and the one that compares two clocks. Version 1, little-endian, no padding.

A pose is 460 bytes, below any path's limit, so it is never cut into fragments:

====== ===== ======== =================================================================================================
offset bytes type     meaning
====== ===== ======== =================================================================================================
0      4     bytes    ``HTPS``
4      2     uint16   version, 1
6      1     uint8    kind: 1 pose, 2 clock request, 3 clock reply
7      1     uint8    flags: bit 0 is set when there is a pose; the others are 0 and to be ignored
8      8     uint64   stream: a number the sender draws when it starts, so that a restart is seen
16     8     uint64   sequence: 0, 1, 2, ... within a stream; a refusal has one of its own
24     8     float64  capture time of the camera frame, seconds (see :func:`now`)
32     8     float64  time of sending, seconds, the same clock
40     4     bytes    axes of the camera frame: ``RDF`` and a zero: x right, y down, z forward; right-handed
44     2     bytes    unit of length: ``m`` and a zero
46     2     bytes    order of the matrix: ``RM``, row by row, for points as columns: p_camera = M p_tool
48     32    bytes    name of the matrix, ASCII, filled with zeros: ``camera_from_tool``
80     2     uint16   status: the integer of ``holotorch.tracking.Status``; 0 OK, 1 UNVERIFIED, above: refused
82     2     uint16   degrees of freedom of chi-square; 0 where nothing was left to check the pose with
84     4     float32  seconds by which smoothing lags behind a steady motion; 0 where there was none
88     128   float64  matrix [4, 4]. The last column is the tip, the third the direction from the tip to the rear;
                      the roll about it is not observed. NaN where refused
216    168   float64  covariance of (tip, direction) in m^2, m and 1: upper triangle of 6 x 6, row by row, 21 numbers;
                      NaN where refused
384    8     float64  chi-square
392    64    bytes    reason, UTF-8, printable characters, cut at 64 bytes, filled with zeros; empty when OK
456    4     uint32   CRC-32 (IEEE 802.3, zlib's) of all bytes before it
====== ===== ======== =================================================================================================

A clock request or reply is 52 bytes: the first 24 as above (``stream`` and ``sequence`` are the asker's own), three
float64 at 24, 32 and 40 (asker's time of asking; answerer's time of hearing; answerer's time of answering; the last two
0 in a request), CRC-32 at 48. A reply is no longer than its request.

A capture time must not lie after the time of sending: a receiver does not use such a packet, since its age is unknown.

Nothing here is secret or signed: who can send to a receiver's port can forge poses. Use a network of your own.
"""

import math
import struct
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from holotorch.tracking.pose.status import Pose, Status

VERSION, POSE, ASK, REPLY = 1, 1, 2, 3
FRAME = "camera_from_tool"
_MAGIC, _AXES, _UNIT, _ORDER = b"HTPS", b"RDF\0", b"m\0", b"RM"
_HEAD, _CRC = struct.Struct("<4sHBBQQ"), struct.Struct("<I")
_BODY, _STAMPS = struct.Struct("<dd4s2s2s32sHHf16d21dd64s"), struct.Struct("<ddd")
_LENGTHS = {
    kind: _HEAD.size + part.size + _CRC.size for kind, part in ((POSE, _BODY), (ASK, _STAMPS), (REPLY, _STAMPS))
}
_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
_DIAGONAL = [n for n, (i, j) in enumerate(_UPPER) if i == j]
_ALL = [_UPPER.index((min(i, j), max(i, j))) for i in range(6) for j in range(6)]
_FARTHEST = 100.0  # metres; a tip farther off was given in another unit
_LONGEST = torch.finfo(torch.float32).max  # seconds of lag
_START = time.time() - time.perf_counter()


class PacketError(ValueError):
    """These bytes are not a packet of this version; the message says at what they fail."""


def now() -> float:
    """Seconds since 1970 by the computer's clock when this program started, carried on by its steady counter.

    It never steps and resolves a microsecond or less on every system; between two programs it may differ by what
    the clock was corrected meanwhile, which the clock request measures.
    """
    return _START + time.perf_counter()


@dataclass(frozen=True, eq=False)
class PosePacket:
    """One pose on its way. Times in seconds by the sender's :func:`now`.

    Attributes:
        pose: A single one, axes of :class:`Pose` without leading ones.
        captured: When the camera took the frame.
        sent: When it left.
        sequence: Within the stream.
        stream: Which run of a sender.
        frame: Name of the matrix; its left part says whose axes it is in.
        lag: Seconds that smoothing added.
    """

    pose: Pose
    captured: float
    sent: float
    sequence: int
    stream: int = 0
    frame: str = FRAME
    lag: float = 0.0

    @property
    def answered(self) -> bool:
        """Whether it carries a pose, not a refusal."""
        return self.pose.answered


@dataclass(frozen=True)
class Echo:
    """Stamps that compare two clocks, as NTP does (RFC 5905, Sec. 8); ``heard`` and ``answered`` are 0 in a request."""

    stream: int
    number: int
    asked: float
    heard: float = 0.0
    answered: float = 0.0
    reply: bool = False


def encode(packet: PosePacket | Echo) -> bytes:
    """Bytes of a packet; ValueError for what :func:`decode` would refuse, TypeError for a batch of poses."""
    if isinstance(packet, Echo):
        _fits(64, stream=packet.stream, number=packet.number)
        head = _HEAD.pack(_MAGIC, VERSION, REPLY if packet.reply else ASK, 0, packet.stream, packet.number)
        return _sealed(head + _STAMPS.pack(packet.asked, packet.heard, packet.answered))
    pose = packet.pose
    if not isinstance(pose.status, Status) or pose.tip.shape != (3,):
        raise TypeError(f"a packet carries one pose with one status, got tips {list(pose.tip.shape)}; index the batch")
    status, answered = pose.status, pose.status.answered
    # In plain numbers, as in the other direction: the calls into torch took three quarters of a packet's way.
    matrix, covariance = [math.nan] * 16, [math.nan] * 21
    if answered:
        matrix = _matrix(pose.tip.tolist(), pose.direction.tolist())
        both = pose.covariance.tolist()
        covariance = [both[i][j] for i, j in _UPPER]
    chi_square, freedom = float(pose.chi_square), float(pose.freedom)
    freedom = int(freedom) if math.isfinite(freedom) else 0
    frame = packet.frame.encode("ascii", "replace")
    if not 1 <= len(frame) <= 32 or not packet.frame.isascii() or not packet.frame.isprintable():
        raise ValueError(f"frame must be 1 to 32 printable ASCII characters, got {packet.frame!r}")
    _fits(64, stream=packet.stream, sequence=packet.sequence)
    _fits(16, freedom=freedom)
    if not abs(packet.lag) <= _LONGEST:
        raise ValueError(f"lag must be finite and not negative, in seconds, got {packet.lag}")
    wrong = _mistake(status, matrix, covariance, chi_square, freedom, (packet.captured, packet.sent, packet.lag))
    if wrong:
        raise ValueError(wrong)
    body = _BODY.pack(
        *(packet.captured, packet.sent, _AXES, _UNIT, _ORDER, frame, int(status), freedom, packet.lag),
        *(*matrix, *covariance, chi_square, _cut(pose.reason, 64)),
    )
    return _sealed(_HEAD.pack(_MAGIC, VERSION, POSE, int(answered), packet.stream, packet.sequence) + body)


def decode(data: bytes) -> PosePacket | Echo:
    """What :func:`encode` was given, float64 on the CPU; a reason comes back cut at 64 bytes, with spaces for controls.

    Raises:
        PacketError: Another magic, version, kind, length or CRC, other axes, unit or order, an unknown status, a pose
            that is NaN or impossible, a refusal that carries a pose, or a reason that would command a terminal.
    """
    if len(data) < _HEAD.size or data[:4] != _MAGIC:
        raise PacketError(f"not a pose packet: {len(data)} bytes beginning with {bytes(data[:4])!r}, not {_MAGIC!r}")
    _, version, kind, flags, stream, sequence = _HEAD.unpack_from(data)
    if version != VERSION:
        raise PacketError(
            f"packet of version {version}, this is version {VERSION}; use the same holotorch on both ends"
        )
    if kind not in _LENGTHS:
        raise PacketError(f"unknown kind of packet {kind}")
    if len(data) != _LENGTHS[kind]:
        raise PacketError(f"a packet of kind {kind} has {_LENGTHS[kind]} bytes, got {len(data)}")
    if _CRC.unpack_from(data, len(data) - 4)[0] != zlib.crc32(data[:-4]):
        raise PacketError("the CRC does not fit; the packet was damaged on its way")
    if kind != POSE:
        stamps = _STAMPS.unpack_from(data, _HEAD.size)
        if not all(map(math.isfinite, stamps)):
            raise PacketError(f"clock stamps must be finite, got {stamps}")
        return Echo(stream, sequence, *stamps, reply=kind == REPLY)
    return _pose_packet(_BODY.unpack_from(data, _HEAD.size), flags, stream, sequence)


def _pose_packet(fields: tuple, flags: int, stream: int, sequence: int) -> PosePacket:
    captured, sent, axes, unit, order, frame, code, freedom, lag = fields[:9]
    if (axes, unit, order) != (_AXES, _UNIT, _ORDER):
        raise PacketError(f"expected axes, unit and order {(_AXES, _UNIT, _ORDER)}, got {(axes, unit, order)}")
    try:
        status = Status(code)
        name = frame.rstrip(b"\0").decode("ascii")
        reason = fields[47].rstrip(b"\0").decode("utf-8")
    except ValueError as error:
        raise PacketError(f"status, frame name or reason cannot be read: {error}") from None
    if not name or not name.isprintable() or not reason.isprintable():
        raise PacketError(f"frame name and reason must be printable, got {name!r} and {reason!r}")
    if bool(flags & 1) != status.answered:
        raise PacketError(f"flags {flags} do not fit the status {status.name}")
    matrix, upper, chi_square = fields[9:25], fields[25:46], fields[46]
    if wrong := _mistake(status, matrix, upper, chi_square, freedom, (captured, sent, lag)):
        raise PacketError(wrong)
    parts = matrix[3:12:4], matrix[2:11:4], [upper[n] for n in _ALL], chi_square, float(freedom)
    tip, direction, covariance, chi, free = (torch.tensor(part, dtype=torch.float64) for part in parts)
    pose = Pose(tip, direction, covariance.reshape(6, 6), chi, free, status, reason)
    return PosePacket(pose, captured, sent, sequence, stream, name, lag)


def _matrix(tip: list[float], along: list[float]) -> list[float]:
    """As :attr:`Pose.camera_from_tool`, row by row [16], of a tip [3] in metres and a direction [3].

    The given numbers themselves, and the other axes square to them. In plain numbers, a thirtieth of the time there.
    """
    x, y, z = along
    square = x * x + y * y
    if z < 0 and square < 1e-30:
        first = [1.0, 0.0, 0.0]
    else:
        share = (1 - z) / square if z < 0 else 1 / (1 + z)
        first = [1 - x * x * share, -x * y * share, -x]
    # Square to it whatever the rounding.
    tilt = _dot(first, along)
    first = [a - tilt * b for a, b in zip(first, along, strict=True)]
    length = math.sqrt(_dot(first, first)) or math.nan
    first = [a / length for a in first]
    second = _cross(along, first)
    return [*(value for row in zip(first, second, along, tip, strict=True) for value in row), 0.0, 0.0, 0.0, 1.0]


def _dot(one: Sequence[float], other: Sequence[float]) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Sequence[float], other: Sequence[float]) -> list[float]:
    (a, b, c), (x, y, z) = one, other
    return [b * z - c * y, c * x - a * z, a * y - b * x]


def _mistake(
    status: Status, matrix: Sequence[float], upper: Sequence[float], chi: float, freedom: int, times: tuple
) -> str:
    """What is impossible about a pose, or nothing; its matrix row by row, and the upper triangle of its covariance."""
    if not all(map(math.isfinite, times)) or min(times) < 0:
        return f"capture time, time of sending and lag must be finite and not negative, got {times}"
    if not status.answered:
        carried = not all(map(math.isnan, (*matrix, *upper)))
        return f"a refusal ({status.name}) must not carry a pose; its matrix and covariance are NaN" if carried else ""
    if not all(map(math.isfinite, (*matrix, *upper))) or (freedom and not math.isfinite(chi)):
        return f"a pose that is {status.name} must have a finite matrix, covariance and chi-square"
    first, second, third, tip = (matrix[n:12:4] for n in range(4))
    # 1e-6 rad is 0.1 micrometres at the bands, and float32 poses pass.
    lengths = [_dot(axis, axis) - 1 for axis in (first, second, third)]
    twisted = [*lengths, _dot(first, second), _dot(second, third), _dot(third, first)]
    turned = _dot(_cross(first, second), third) < 0
    if not all(abs(value) <= 1e-6 for value in twisted) or tuple(matrix[12:]) != (0.0, 0.0, 0.0, 1.0) or turned:
        return "the matrix must be a right-handed rotation and a translation, with a unit direction in its third column"
    if max(map(abs, tip)) > _FARTHEST:
        return f"the tip must be within {_FARTHEST:g} m, in metres, got {list(tip)}"
    if min(upper[n] for n in _DIAGONAL) < 0:
        return "the covariance must not be negative on its diagonal"
    return ""


def _fits(bits: int, **fields: int) -> None:
    for name, value in fields.items():
        if not 0 <= value < 2**bits:
            raise ValueError(f"{name} must be a whole number from 0 to {2**bits - 1}, got {value}")


def _sealed(data: bytes) -> bytes:
    return data + _CRC.pack(zlib.crc32(data))


def _cut(text: str, size: int) -> bytes:
    """UTF-8 that can be printed, cut between characters."""
    printable = "".join(each if each.isprintable() else " " for each in text)
    return printable.encode()[:size].decode("utf-8", "ignore").encode()
