"""The wire format: its documented bytes, round trips, and everything it must refuse."""

import math
import struct
import zlib
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import Echo, PacketError, PosePacket, decode, encode, now

REFUSALS = [status for status in Status if not status.answered]


def unit(*values: float) -> torch.Tensor:
    vector = torch.tensor(values, dtype=torch.float64)
    return vector / vector.norm()


def pose(tip=(0.01, -0.02, 0.5), direction=(0.3, 0.2, -0.9), status: Status = Status.OK, reason: str = "") -> Pose:
    half = (torch.arange(36, dtype=torch.float64).reshape(6, 6).sin() + 3 * torch.eye(6)) * 1e-8
    chi, freedom = torch.tensor(1.25, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    return Pose(torch.tensor(tip, dtype=torch.float64), unit(*direction), half + half.T, chi, freedom, status, reason)


def packet(given: Pose | None = None, **changes) -> PosePacket:
    return replace(PosePacket(given or pose(), 1.7e9 + 0.25, 1.7e9 + 0.5, 41, 2**63 + 5), **changes)


def sealed(data: bytes) -> bytes:
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def put(data: bytes, offset: int, form: str, *values) -> bytes:
    changed = bytearray(data)
    struct.pack_into(form, changed, offset, *values)
    return sealed(bytes(changed))


def test_bytes_lie_where_the_table_says():
    given = pose(status=Status.UNVERIFIED, reason="nothing to check with")
    data = encode(packet(given, lag=0.25))
    assert len(data) == 460
    assert data[:8] == b"HTPS\x01\x00\x01\x01" and data[40:48] == b"RDF\0m\0RM"
    assert struct.unpack_from("<QQdd", data, 8) == (2**63 + 5, 41, 1.7e9 + 0.25, 1.7e9 + 0.5)
    assert data[48:80] == b"camera_from_tool".ljust(32, b"\0")
    assert struct.unpack_from("<HHf", data, 80) == (int(Status.UNVERIFIED), 1, 0.25)
    matrix = torch.tensor(struct.unpack_from("<16d", data, 88), dtype=torch.float64).reshape(4, 4)
    assert torch.equal(matrix[:3, 3], given.tip) and torch.equal(matrix[:3, 2], given.direction)
    assert matrix[3].tolist() == [0, 0, 0, 1]
    upper = struct.unpack_from("<21d", data, 216)
    assert upper[0] == given.covariance[0, 0] and upper[5] == given.covariance[0, 5] == given.covariance[5, 0]
    assert upper[6] == given.covariance[1, 1] and upper[20] == given.covariance[5, 5]
    assert struct.unpack_from("<d", data, 384) == (1.25,)
    assert data[392:456] == b"nothing to check with".ljust(64, b"\0")
    assert struct.unpack_from("<I", data, 456) == (zlib.crc32(data[:456]),)


def test_codes_on_the_wire_stay_what_they_are():
    """A receiver written from the table would misread a renumbered status."""
    names = "OK UNVERIFIED BAD_FRAME NO_CATHETER BANDS_MISSING NO_AXIS TOO_NARROW EDGES_UNCLEAR OUT_OF_FRAME"
    names += " OUTSIDE_CAMERA INCONSISTENT UNCERTAIN"
    assert [(status.name, int(status)) for status in Status] == [(name, i) for i, name in enumerate(names.split())]


numbers = st.floats(-10, 10)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers).filter(lambda v: math.hypot(*v) > 1e-3),
    st.sampled_from([Status.OK, Status.UNVERIFIED]),
    st.text(max_size=16),
    st.integers(0, 2**64 - 1),
    st.floats(0, 1e10),
)
def test_what_goes_in_comes_out(tip, direction, status, reason, sequence, captured):
    given = pose(tip, direction, status, reason)
    back = decode(encode(packet(given, sequence=sequence, captured=captured, frame="headset_from_tool")))
    assert isinstance(back, PosePacket) and back.answered
    assert (back.sequence, back.stream, back.captured) == (sequence, 2**63 + 5, captured)
    assert back.frame == "headset_from_tool" and back.pose.status is status
    for name in ("tip", "direction", "covariance", "chi_square", "freedom"):
        assert torch.equal(getattr(back.pose, name), getattr(given, name)), name
    # Characters end whole; zeros would end a text, and other controls command the terminal that shows it.
    shown = "".join(each if each.isprintable() else " " for each in reason)
    assert back.pose.reason == shown.encode()[:64].decode("utf-8", "ignore")


@pytest.mark.parametrize("status", REFUSALS)
def test_a_refusal_carries_no_numbers(status):
    data = encode(packet(Pose.refused(status, "é" * 40)))
    assert all(math.isnan(value) for value in struct.unpack_from("<37d", data, 88))
    back = decode(data)
    assert isinstance(back, PosePacket) and not back.answered
    assert back.pose.status is status and back.pose.reason == "é" * 32 and bool(back.pose.tip.isnan().all())
    with pytest.raises(PacketError, match="must not carry a pose"):
        decode(put(data, 88, "<d", 0.0))


def on_the_wire(given: Pose) -> torch.Tensor:
    return torch.tensor(struct.unpack_from("<16d", encode(packet(given)), 88), dtype=torch.float64).reshape(4, 4)


@pytest.mark.parametrize("slope", [0.0, 1e-12, 1e-9, 4e-5, 1e-3])
def test_a_tool_that_points_at_the_camera_is_sent_too(slope):
    """There the smallest rotation from +z to the direction is half a turn about an axis that is hard to tell.

    Of (s, -s / 3, -1) it is about the axis square to it and to z, so a rounding of 1e-16 of s turns it by as much of s.
    """
    given = pose(direction=(slope, -slope / 3, -1.0))
    back = decode(encode(packet(given)))
    assert isinstance(back, PosePacket) and torch.equal(back.pose.direction, given.direction)
    missed = 1e-15 / slope if slope else 1e-15
    torch.testing.assert_close(on_the_wire(given), given.camera_from_tool, rtol=0, atol=max(missed, 1e-15))


@settings(max_examples=60, deadline=None)
@given(st.tuples(numbers, numbers, numbers).filter(lambda v: math.hypot(*v) > 1e-3))
def test_the_matrix_is_that_of_the_pose(direction):
    """In plain numbers what the pose does in torch: rounding, over the distance from straight back."""
    given = pose(direction=direction)
    back = math.hypot(*direction[:2]) / math.hypot(*direction)
    missed = 1e-15 / max(back, 1e-15) if direction[2] < 0 else 1e-15
    torch.testing.assert_close(on_the_wire(given), given.camera_from_tool, rtol=0, atol=2e-15 + missed)


def test_a_pose_that_carries_gradients_or_single_numbers_is_sent_too():
    given = pose()
    learnt = replace(given, tip=given.tip.float().requires_grad_(), covariance=given.covariance.float())
    back = decode(encode(packet(learnt)))
    assert isinstance(back, PosePacket) and torch.equal(back.pose.tip, learnt.tip.detach().double())


def test_every_damaged_byte_is_noticed():
    data = encode(packet())
    for i in range(len(data)):
        with pytest.raises(PacketError):
            decode(data[:i] + bytes([data[i] ^ 1 << i % 8]) + data[i + 1 :])
        with pytest.raises(PacketError):
            decode(data[:i])


def test_impossible_contents_are_named():
    data = encode(packet())
    cases = [
        (put(data, 0, "<4s", b"HTTP"), "not a pose packet"),
        (put(data, 4, "<H", 2), "packet of version 2, this is version 1"),
        (put(data, 6, "<B", 9), "unknown kind of packet 9"),
        (sealed(data + b"\0"), "has 460 bytes, got 461"),
        (put(data, 456, "<I", 0)[:-1] + b"\0", "CRC"),
        (put(data, 7, "<B", 0), "flags 0 do not fit the status OK"),
        (put(data, 24, "<d", math.nan), "capture time"),
        (put(data, 32, "<d", -1.0), "not negative"),
        (put(data, 40, "<4s", b"RUB\0"), "expected axes"),
        (put(data, 48, "<B", 200), "cannot be read"),
        (put(data, 48, "<32s", b""), "name and reason must be printable"),
        (put(data, 80, "<H", 999), "999 is not a valid Status"),
        (put(data, 84, "<f", math.inf), "lag must be finite"),
        (put(data, 88, "<d", math.nan), "finite matrix"),
        (put(data, 88, "<d", 5.0), "right-handed rotation"),
        (put(data, 88 + 8 * 12, "<d", 1.0), "right-handed rotation"),
        (put(data, 88 + 8 * 3, "<d", 500.0), "within 100 m, in metres"),
        (put(data, 216, "<d", -1.0), "negative on its diagonal"),
        (put(data, 216, "<d", math.inf), "finite matrix, covariance"),
        (put(data, 384, "<d", math.nan), "chi-square"),
        (put(data, 392, "<B", 255), "cannot be read"),
        (put(data, 392, "<4s", b"\x1b[2J"), r"frame name and reason must be printable, .*'\\x1b\[2J'"),
        (put(data, 392, "<4s", "\N{RIGHT-TO-LEFT OVERRIDE}a".encode()), "must be printable"),
    ]
    for bad, message in cases:
        with pytest.raises(PacketError, match=message):
            decode(bad)


def test_mirrored_axes_are_refused():
    data = bytearray(encode(packet()))
    first = [struct.unpack_from("<d", data, 88 + 32 * row)[0] for row in range(3)]
    for row, value in enumerate(first):
        struct.pack_into("<d", data, 88 + 32 * row, -value)
    with pytest.raises(PacketError, match="right-handed"):
        decode(sealed(bytes(data)))


def test_what_cannot_be_sent_is_refused_before():
    with pytest.raises(ValueError, match="1 to 32 printable ASCII"):
        encode(packet(frame="kamera_füralle"))
    with pytest.raises(ValueError, match="capture time"):
        encode(packet(captured=math.nan))
    with pytest.raises(ValueError, match="within 100 m, in metres"):
        encode(packet(pose(tip=(10.0, 20.0, 520.0))))
    with pytest.raises(ValueError, match="finite matrix"):
        encode(packet(pose(tip=(math.nan, 0.0, 0.5))))
    for wrong, name in (
        (packet(sequence=-1), "sequence"),
        (packet(stream=2**64), "stream"),
        (packet(lag=1e39), "lag"),
        (packet(lag=math.nan), "lag"),
        (packet(replace(pose(), freedom=torch.tensor(-1.0))), "freedom"),
        (packet(replace(pose(), freedom=torch.tensor(70000.0))), "freedom"),
        (Echo(1, -1, 0.0), "number"),
        (Echo(2**64, 1, 0.0), "stream"),
    ):
        with pytest.raises(ValueError, match=f"^{name} must be"):
            encode(wrong)
    both = replace(pose(), tip=torch.zeros(2, 3, dtype=torch.float64))
    with pytest.raises(TypeError, match="index the batch"):
        encode(packet(both))


def test_clock_stamps_keep_their_length():
    ask = Echo(7, 2**60, 1.5)
    reply = Echo(7, 2**60, 1.5, 2.5, 3.5, reply=True)
    assert decode(encode(ask)) == ask and decode(encode(reply)) == reply
    assert len(encode(ask)) == len(encode(reply)) == 52
    with pytest.raises(PacketError, match="stamps must be finite"):
        decode(put(encode(ask), 24, "<d", math.inf))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=500), st.sampled_from(["raw", "head", "sealed"]))
def test_no_bytes_crash_the_decoder(noise, kind):
    """Only the named error, also behind a head and a CRC that fit."""
    head = encode(packet())[:24]
    data = {"raw": noise, "head": head + noise, "sealed": sealed(head + noise[:436].ljust(436, b"\0"))}[kind]
    with pytest.raises(PacketError):
        decode(data)


def test_the_clock_is_that_of_the_computer_and_rises():
    import time

    stamps = [now() for _ in range(100)]
    assert stamps == sorted(stamps)
    assert abs(stamps[0] - time.time()) < 3600  # a correction of the clock since the start, but no other zero
