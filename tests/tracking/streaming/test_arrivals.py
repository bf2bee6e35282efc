"""A wrong clock or a forged number neither keeps an old pose alive nor locks the genuine sender out."""

import asyncio
import math

import pytest
import torch

from holotorch.experiments.streaming.stream import _line, statistics_text
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import Echo, PosePacket, decode, encode, now
from holotorch.tracking.streaming.stream import PoseReceiver

PERIOD = 0.02  # seconds between poses of the genuine sender
STREAM = 7
SENDER = ("127.0.0.1", 9)


def pose() -> Pose:
    one = torch.ones((), dtype=torch.float64)
    tip, direction = torch.tensor([[0, 0, 0.5], [0.6, 0, -0.8]], dtype=torch.float64)
    return Pose(tip, direction, torch.eye(6, dtype=torch.float64) * 1e-8, one, one, Status.OK)


class Bench:
    """A receiver without a network, with clocks in the test's hand: ``receiver`` is ``apart`` behind the sender."""

    def __init__(self, monkeypatch, apart: float = 0.0):
        self.time, self.apart, self.number = 1000.0, apart, 0
        monkeypatch.setattr("time.monotonic", lambda: self.time + 5e6)
        self.receiver = PoseReceiver(0, clock=lambda: self.time)
        self.receiver.connection_made(self)
        self.asked: list[bytes] = []

    def sendto(self, data, addr):
        self.asked.append(data)

    @property
    def statistics(self):
        return self.receiver.statistics

    def hear(self, number=None, *, sent=0.0, captured=-0.01, stream=STREAM):
        """A packet that arrives now; its stamps in seconds from the sender's present time."""
        here = self.time + self.apart
        packet = PosePacket(pose(), here + captured, here + sent, self.number if number is None else number, stream)
        self.receiver.datagram_received(encode(packet), SENDER)

    def genuine(self, count=1):
        """So many poses at the pace of the stream; how many of them were given."""
        given = 0
        for _ in range(count):
            self.time += PERIOD
            self.hear()
            newest = self.receiver.latest()
            given += newest is not None and newest.sequence == self.number
            self.number += 1
        return given

    def newest(self) -> int | None:
        packet = self.receiver.latest()
        return None if packet is None else packet.sequence

    def compare_clocks(self):
        echo = decode(self.asked[-1])
        assert isinstance(echo, Echo)
        here = (echo.asked + self.time) / 2 + self.apart
        self.receiver.datagram_received(encode(Echo(echo.stream, echo.number, echo.asked, here, here, True)), SENDER)
        assert self.statistics.offset == pytest.approx(self.apart, abs=1e-6)


@pytest.mark.parametrize("ahead", [60.0, 1e6, 1e300])
@pytest.mark.parametrize("compared", [False, True])
def test_a_dead_sender_with_a_wrong_clock_is_not_shown_for_ever(monkeypatch, ahead, compared):
    bench = Bench(monkeypatch, apart=123.0)
    if compared:
        bench.genuine()
        bench.compare_clocks()
        bench.time += 1.0
    bench.hear(1, captured=ahead)  # captured later than sent
    assert bench.receiver.latest() is None
    bench.hear(2, captured=ahead, sent=ahead)  # both stamps
    bench.time += 0.3
    assert bench.receiver.latest() is None and bench.receiver.age() > 0.29
    assert bench.statistics.future == 1 + compared  # with clocks that were never compared the second cannot be told
    assert f"captured in the future {1 + compared}" in "\n".join(statistics_text(bench.receiver))


def test_what_never_fits_the_clock_is_said_while_it_comes(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(5):
        bench.hear(captured=0.06)
    assert bench.receiver.packet is None and "5 packets captured in the future, not used" in _line(bench.receiver)
    assert statistics_text(bench.receiver)[0].endswith("; 5 captured in the future")
    bench.hear(captured=0.04)  # within the tolerance
    assert bench.receiver.latest() is not None


def test_a_pose_grows_old_though_the_clock_given_stands_still_or_steps_back(monkeypatch):
    bench, shift = Bench(monkeypatch), [0.0]
    bench.receiver.clock = lambda: 1000.0 - shift[0]
    bench.genuine()
    assert bench.receiver.latest() is not None
    bench.time, shift[0] = bench.time + 0.3, 3600.0
    assert bench.receiver.latest() is None


@pytest.mark.parametrize("number", [2**64 - 1, 2**63, 50_000])
@pytest.mark.parametrize("compared", [False, True])
def test_one_forged_number_changes_nothing(monkeypatch, number, compared):
    bench = Bench(monkeypatch, apart=-5.0)
    bench.genuine(10)
    if compared:
        bench.compare_clocks()
    bench.hear(number)
    assert bench.newest() == 9
    assert bench.genuine(50) == 50
    assert (bench.statistics.jumped, bench.statistics.lost, bench.statistics.duplicated) == (1, 0, 0)
    assert "not continuing the stream 1" in "\n".join(statistics_text(bench.receiver))


@pytest.mark.parametrize("sent", [0.0, 0.02, 0.04])
@pytest.mark.parametrize("compared", [False, True])
def test_a_forged_number_that_fits_costs_a_few_poses_at_most(monkeypatch, sent, compared):
    """It cannot be told from the packet after a thousand lost ones; the genuine ones then contradict it."""
    bench = Bench(monkeypatch)
    bench.genuine(10)
    if compared:
        bench.compare_clocks()
    bench.hear(1024 + 9, sent=sent, captured=sent - 0.01)
    assert bench.newest() == 1033
    given = bench.genuine(50)
    assert 45 <= given < 50


def test_forged_numbers_between_all_genuine_ones_are_not_followed(monkeypatch):
    bench, given = Bench(monkeypatch), 0
    bench.genuine(10)
    for i in range(50):
        bench.hear(10**12 + 2 * i)
        bench.hear(10**12 + 2 * i + 1)
        given += bench.genuine()
    assert given == 50 and bench.statistics.jumped == 100


def test_a_forged_time_of_sending_is_forgotten_though_no_clock_request_is_answered(monkeypatch):
    bench = Bench(monkeypatch)
    bench.genuine(10)
    bench.hear(10, sent=1e9, captured=1e9)  # far ahead of the arrivals: set aside
    assert bench.statistics.jumped == 1 and bench.genuine(20) == 20
    bench.hear(30, sent=0.9, captured=0.9)  # makes the others look 0.9 s late
    bench.number = 31
    assert bench.genuine(600) > 0 and bench.genuine(20) == 20


def test_a_sender_that_numbers_anew_is_followed_after_three_packets(monkeypatch):
    bench = Bench(monkeypatch)
    bench.genuine(10)
    bench.number = 10**9
    assert bench.genuine(10) == 8
    found = bench.statistics
    assert (found.received, found.jumped, found.lost, found.reordered, found.duplicated) == (18, 2, 0, 0, 0)
    bench.number = 0  # and back
    assert bench.genuine(10) == 8 and found.lost == 0


def test_a_long_silence_and_a_burst_after_a_hold_up_are_no_forgery(monkeypatch):
    bench = Bench(monkeypatch)
    bench.genuine(10)
    bench.time, bench.number = bench.time + 600.0, 10 + 30_000  # ten minutes without a network, at 50 poses a second
    assert bench.genuine(5) == 5 and bench.statistics.lost == 30_000
    base = bench.number
    bench.time += 0.9
    for i in range(45):  # what was held up for 0.9 s comes at once, the newest is given
        bench.hear(base + i, sent=-0.9 + 0.02 * i, captured=-0.91 + 0.02 * i)
    assert bench.newest() == base + 44 and bench.statistics.jumped == 0


def test_a_future_packet_in_a_pause_does_not_take_the_stream_over(monkeypatch):
    bench = Bench(monkeypatch)
    bench.genuine(10)
    bench.time += 1.0
    bench.hear(0, stream=99, captured=60.0)
    assert (bench.statistics.received, bench.statistics.future, bench.statistics.restarts) == (10, 1, 0)
    bench.number = 60
    assert bench.genuine(3) == 3 and bench.statistics.lost == 50


def test_a_clock_reply_from_before_its_request_is_not_believed(monkeypatch):
    bench = Bench(monkeypatch)
    bench.genuine()
    echo = decode(bench.asked[-1])
    assert isinstance(echo, Echo)
    forged = Echo(echo.stream, echo.number, echo.asked, 1000.0, 1e9, reply=True)
    bench.receiver.datagram_received(encode(forged), SENDER)
    assert bench.statistics.offset is None and "a clock reply that took -1e+09 s" in bench.statistics.last_error
    assert bench.genuine(5) == 5 and not math.isnan(bench.statistics.latency()["latency_p95"])


def test_openigtlink_sends_no_pose_that_was_captured_in_the_future(monkeypatch):
    igtl = pytest.importorskip("holotorch.tracking.streaming.igtl")
    pytest.importorskip("pyigtl", reason="pip install 'holotorch[slicer]'")
    sent: list[bytes] = []

    async def work():
        async with igtl.TransformServer(0, host="127.0.0.1") as server:
            monkeypatch.setattr(server, "_clients", [type("Client", (), {"offer": staticmethod(sent.append)})])
            server.send(pose(), now() + 60.0)
            server.send(pose(), now())
            counted = server.future
            server._clients = set()
            return counted

    counted = asyncio.run(work())
    assert b"TRANSFORM" not in sent[0] and b"UNCERTAIN: capture time 60 s in the future: age unknown" in sent[0]
    assert b"TRANSFORM" in sent[1] and counted == 1
