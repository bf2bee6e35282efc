"""The datagram that carries one pose, and the datagram that compares two clocks; version 1, little-endian, no padding.

A pose packet has 460 bytes, less than any network's limit, so that it is never cut into fragments:

====== ===== ======== =================================================================================================
offset bytes type     meaning
====== ===== ======== =================================================================================================
0      4     bytes    ``HTPS``
4      2     uint16   version, 1
6      1     uint8    kind: 1 pose, 2 clock request, 3 clock reply
7      1     uint8    flags: bit 0 is set if there is a pose; the other bits are 0, and receivers ignore them
8      8     uint64   stream: random number that the sender draws at its start, which reveals a restart
16     8     uint64   sequence: 0, 1, 2, ... within a stream; poses and refusals are numbered together
24     8     float64  capture time of the camera frame, seconds (see :func:`now`)
32     8     float64  time of sending, seconds of the same clock
40     4     bytes    axes of the frame: ``RDF`` and a zero: x right, y down, z forward; right-handed
44     2     bytes    unit of length: ``m`` and a zero
46     2     bytes    order of the matrix: ``RM``, row by row, for points as columns: p_camera = M p_tool
48     32    bytes    name of the matrix, ASCII, filled with zeros: ``camera_from_tool``; ``headset_from_tool`` and
                      ``world_from_tool`` for a camera whose place in that frame is known, in axes RDF too
80     2     uint16   status: the integer of ``holotorch.tracking.Status``; 0 OK, 1 UNVERIFIED, larger: a refusal
82     2     uint16   degrees of freedom of chi-square; 0 if the pose was not checked
84     4     float32  seconds by which smoothing lags behind a steady motion; 0 without smoothing
88     128   float64  matrix [4, 4]. The last column is the tip, the third the direction from the tip to the rear;
                      the roll about it is not observed. NaN for a refusal
216    168   float64  covariance of (tip, direction) in m^2, m and 1: upper triangle of 6 x 6, row by row, 21 numbers;
                      NaN for a refusal
384    8     float64  chi-square
392    64    bytes    reason, UTF-8, printable characters, cut at 64 bytes, filled with zeros; empty when OK
456    4     uint32   CRC-32 (IEEE 802.3, zlib's) of all bytes before it
====== ===== ======== =================================================================================================

A clock request or reply has 52 bytes: the first 24 as above, with ``stream`` and ``sequence`` chosen by the receiver of
poses, which sends the request; at 24, 32 and 40 float64 times in seconds: sending of the request, its arrival, and
sending of the reply (the last two are 0 in a request); CRC-32 at 48.

A capture time must not lie after the time of sending: a receiver does not use such a packet, since its age is unknown.

Packets are neither encrypted nor signed: anyone who reaches a receiver's port can forge poses. Use a private network.
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
_ECHO_LENGTH = _HEAD.size + _STAMPS.size + _CRC.size
_LENGTHS = {POSE: _HEAD.size + _BODY.size + _CRC.size, ASK: _ECHO_LENGTH, REPLY: _ECHO_LENGTH}
_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
_DIAGONAL = [n for n, (i, j) in enumerate(_UPPER) if i == j]
_ALL = [_UPPER.index((min(i, j), max(i, j))) for i in range(6) for j in range(6)]
_FARTHEST = 100.0  # metres: a tip at a larger distance was probably given in another unit
_LONGEST = torch.finfo(torch.float32).max  # largest lag in seconds
_START = time.time() - time.perf_counter()


class PacketError(ValueError):
    """The bytes are not a packet of this version; the message says why."""


def now() -> float:
    """Seconds since 1970: the computer's clock at the start of this program, plus a performance counter since then.

    It is not affected by later corrections of the clock, and resolves a microsecond or less on every system. Two
    programs that started before and after a correction differ by it; the clock request measures such differences.
    """
    return _START + time.perf_counter()


@dataclass(frozen=True, eq=False)
class PosePacket:
    """One pose or refusal as it is sent. Times are in seconds by the sender's :func:`now`."""

    pose: Pose  # a single pose, without leading axes
    captured: float  # time at which the camera took the frame
    sent: float  # time of sending
    sequence: int  # number of the packet within the stream
    stream: int = 0  # number of the stream; each start of a sender draws another one
    frame: str = FRAME  # name of the matrix; "camera_from_tool" maps the tool's coordinates to the camera's
    lag: float = 0.0  # delay in seconds that smoothing added

    @property
    def answered(self) -> bool:
        """Whether the packet carries a pose and not a refusal."""
        return self.pose.answered


@dataclass(frozen=True)
class Echo:
    """Clock request or reply, whose times in seconds compare two clocks as NTP does (RFC 5905, Sec. 8)."""

    stream: int
    number: int
    asked: float  # time at which the receiver of poses sent the request, by its clock
    heard: float = 0.0  # time of arrival by the clock of the sender of poses; 0 in a request
    answered: float = 0.0  # time of the reply by the same clock; 0 in a request
    reply: bool = False


def encode(packet: PosePacket | Echo) -> bytes:
    """Bytes of a packet; ValueError for what :func:`decode` would refuse, TypeError for a batch of poses."""
    if isinstance(packet, Echo):
        _need_bits(64, stream=packet.stream, number=packet.number)
        head = _HEAD.pack(_MAGIC, VERSION, REPLY if packet.reply else ASK, 0, packet.stream, packet.number)
        return _with_crc(head + _STAMPS.pack(packet.asked, packet.heard, packet.answered))
    pose = packet.pose
    if not isinstance(pose.status, Status) or pose.tip.shape != (3,):
        raise TypeError(f"a packet carries one pose with one status, got tips {list(pose.tip.shape)}; index the batch")
    status, answered = pose.status, pose.status.answered
    # Plain numbers instead of tensors, since calls of torch would take three quarters of a packet's time.
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
    _need_bits(64, stream=packet.stream, sequence=packet.sequence)
    _need_bits(16, freedom=freedom)
    if not abs(packet.lag) <= _LONGEST:
        raise ValueError(f"lag must be finite and not negative, in seconds, got {packet.lag}")
    times = packet.captured, packet.sent, packet.lag
    if mistake := _mistake(status, matrix, covariance, chi_square, freedom, times):
        raise ValueError(mistake)
    printable = "".join(each if each.isprintable() else " " for each in pose.reason)
    reason = printable.encode()[:64].decode("utf-8", "ignore").encode()  # not cut within a character
    body = _BODY.pack(
        *(packet.captured, packet.sent, _AXES, _UNIT, _ORDER, frame, int(status), freedom, packet.lag),
        *(*matrix, *covariance, chi_square, reason),
    )
    return _with_crc(_HEAD.pack(_MAGIC, VERSION, POSE, int(answered), packet.stream, packet.sequence) + body)


def decode(data: bytes) -> PosePacket | Echo:
    """Inverse of :func:`encode`, with tensors in float64 on the CPU.

    The reason of a pose is cut at 64 bytes, and spaces replace its unprintable characters.

    Raises:
        PacketError: Another magic, version, kind, length or CRC, other axes, unit or order, an unknown status, a pose
            that is NaN or impossible, a refusal that carries a pose, or unprintable characters in a text.
    """
    if len(data) < _HEAD.size or data[:4] != _MAGIC:
        raise PacketError(f"not a pose packet: {len(data)} bytes beginning with {bytes(data[:4])!r}, not {_MAGIC!r}")
    _, version, kind, flags, stream, sequence = _HEAD.unpack_from(data)
    if version != VERSION:
        text = f"packet of version {version}, this is version {VERSION}; use the same holotorch on both ends"
        raise PacketError(text)
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
    if mistake := _mistake(status, matrix, upper, chi_square, freedom, (captured, sent, lag)):
        raise PacketError(mistake)
    parts = matrix[3:12:4], matrix[2:11:4], [upper[n] for n in _ALL], chi_square, float(freedom)
    tip, direction, covariance, chi, free = (torch.tensor(part, dtype=torch.float64) for part in parts)
    pose = Pose(tip, direction, covariance.reshape(6, 6), chi, free, status, reason)
    return PosePacket(pose, captured, sent, sequence, stream, name, lag)


def _matrix(tip: list[float], along: list[float]) -> list[float]:
    """The matrix of :attr:`Pose.camera_from_tool` [16], row by row, in a thirtieth of the time of that property.

    ``tip`` [3] in metres and the direction ``along`` [3] are columns of the matrix without rounding.
    """
    x, y, z = along
    square = x * x + y * y
    if z < 0 and square < 1e-30:
        first = [1.0, 0.0, 0.0]
    else:
        share = (1 - z) / square if z < 0 else 1 / (1 + z)
        first = [1 - x * x * share, -x * y * share, -x]
    # Remove the component along the direction that rounding leaves.
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
    """Why a pose is impossible, or "". ``matrix`` [16] is row by row, ``upper`` [21] a triangle of the covariance."""
    if not all(map(math.isfinite, times)) or min(times) < 0:
        return f"capture time, time of sending and lag must be finite and not negative, got {times}"
    if not status.answered:
        carried = not all(map(math.isnan, (*matrix, *upper)))
        return f"a refusal ({status.name}) must not carry a pose; its matrix and covariance are NaN" if carried else ""
    if not all(map(math.isfinite, (*matrix, *upper))) or (freedom and not math.isfinite(chi)):
        return f"a pose that is {status.name} must have a finite matrix, covariance and chi-square"
    first, second, third, tip = (matrix[n:12:4] for n in range(4))
    # Tolerance 1e-6: an angle of 1e-6 rad moves the bands by 0.1 micrometres, and float32 poses are accepted.
    lengths = [_dot(axis, axis) - 1 for axis in (first, second, third)]
    deviations = [*lengths, _dot(first, second), _dot(second, third), _dot(third, first)]
    mirrored = _dot(_cross(first, second), third) < 0
    if not all(abs(value) <= 1e-6 for value in deviations) or tuple(matrix[12:]) != (0.0, 0.0, 0.0, 1.0) or mirrored:
        return "the matrix must be a right-handed rotation and a translation, with a unit direction in its third column"
    if max(map(abs, tip)) > _FARTHEST:
        return f"the tip must be within {_FARTHEST:g} m, in metres, got {list(tip)}"
    if min(upper[n] for n in _DIAGONAL) < 0:
        return "the covariance must not be negative on its diagonal"
    return ""


def _need_bits(bits: int, **fields: int) -> None:
    for name, value in fields.items():
        if not 0 <= value < 2**bits:
            raise ValueError(f"{name} must be a whole number from 0 to {2**bits - 1}, got {value}")


def _with_crc(data: bytes) -> bytes:
    return data + _CRC.pack(zlib.crc32(data))
