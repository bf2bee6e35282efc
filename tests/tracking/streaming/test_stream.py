"""Sender and receivers on the loopback: order, counts, clocks; nothing old is ever given. No times are asserted."""

import asyncio
import math
import re
import socket

import pytest
import torch
from paths import ROOT

from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.arrivals import Statistics
from holotorch.tracking.streaming.packet import PosePacket, decode, encode, now
from holotorch.tracking.streaming.stream import PORT, Link, PoseReceiver, PoseSender

HOME = "127.0.0.1"
REFUSED = Pose.refused(Status.NO_CATHETER, "none here")


def pose(x: float = 0.0) -> Pose:
    one = torch.ones((), dtype=torch.float64)
    tip, direction = torch.tensor([[x, 0, 0.5], [0.6, 0, -0.8]], dtype=torch.float64)
    return Pose(tip, direction, torch.eye(6, dtype=torch.float64) * 1e-8, one, one, Status.OK)


def run(work):
    asyncio.run(asyncio.wait_for(work, 20))


async def until(condition):
    while not condition():
        await asyncio.sleep(0.002)


def test_two_receivers_get_everything_and_a_dead_one_harms_nobody():
    async def work():
        with socket.socket(type=socket.SOCK_DGRAM) as probe:
            probe.bind((HOME, 0))
            dead = probe.getsockname()[1]
        async with PoseReceiver(0, host=HOME) as one, PoseReceiver(0, host=HOME) as two:
            async with PoseSender([(HOME, dead), (HOME, one.port), (HOME, two.port)]) as sender:
                for i in range(300):
                    assert sender.send(pose(i * 1e-3) if i % 10 else REFUSED, now()) == i
                    await asyncio.sleep(0)
                await until(lambda: one.statistics.received == two.statistics.received == 300)
                assert sender.links[0].errors > 0 and "refused" in sender.links[0].last_error
                assert not any(link.errors or link.dropped for link in sender.links[1:])
            for receiver in (one, two):
                found = receiver.statistics
                counts = (found.lost, found.reordered, found.duplicated, found.invalid, found.foreign, found.refused)
                assert counts == (0, 0, 0, 0, 0, 30)
                assert receiver.packet is not None and receiver.packet.stream == sender.stream
                assert receiver.packet.pose.tip[0].item() == 0.299

    run(work())


def test_the_receiver_of_the_guide_prints_poses_and_refusals(capsys):
    page = (ROOT / "scripts" / "docs" / "tracking.md").read_text()
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.S) if "PoseReceiver" in block)
    definition, _, call = code.partition("asyncio.run(")
    assert f"port={PORT})" in definition and call == "receive(10))\n"
    names: dict = {}
    exec(definition, names)

    async def work():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((HOME, 0))
            port = probe.getsockname()[1]
        receiving = asyncio.create_task(names["receive"](2, port))
        async with PoseSender([(HOME, port)]) as sender:
            number = 0
            while not receiving.done():
                sender.send(REFUSED if number % 2 else pose(0.125), now())
                number += 1
                await asyncio.sleep(0.005)

    run(work())
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and all(line.startswith("[0.125, ") or line == REFUSED.reason for line in lines)


def test_a_slow_reader_gets_the_newest_not_a_backlog():
    async def work():
        async with PoseReceiver(0, host=HOME) as receiver, PoseSender([(HOME, receiver.port)]) as sender:
            seen = []
            for burst in range(5):
                for _ in range(20):
                    sender.send(pose(), now())
                await until(lambda: receiver.statistics.received == 20 * (burst + 1))  # noqa: B023
                seen.append((await receiver.next()).sequence)
            assert seen == [19, 39, 59, 79, 99]

    run(work())


def test_the_clock_offset_is_measured():
    async def work():
        apart = 1234.5
        async with PoseReceiver(0, host=HOME, clock=lambda: now() - apart) as receiver:
            assert receiver.statistics.offset is None and receiver.age() == math.inf and receiver.latest() is None
            async with PoseSender([(HOME, receiver.port)]) as sender:
                while receiver.statistics.offset is None:
                    sender.send(pose(), now())
                    await asyncio.sleep(0.005)
                await asyncio.sleep(0.01)
            found = receiver.statistics
            assert found.offset is not None and receiver.packet is not None
            assert found.round_trip is not None and found.round_trip >= 0
            # Half the round trip bounds the error; the clocks' numbers near 1.7e9 are multiples of 2.4e-7.
            assert abs(found.offset - apart) <= found.round_trip / 2 + 2e-6
            bound = found.round_trip / 2 + 2e-6
            before, age, after = now(), receiver.age(), now()
            assert before - bound <= receiver.packet.captured + age <= after + bound

    run(work())


def test_an_old_pose_and_a_refusal_are_not_given():
    async def work():
        shift = [0.0]
        receiver = PoseReceiver(0, host=HOME, oldest=500.0, late=100.0, clock=lambda: now() + shift[0])
        async with receiver, PoseSender([(HOME, receiver.port)]) as sender:
            sender.send(pose(), now())
            await receiver.next()
            assert receiver.latest() is receiver.packet
            shift[0] = 600.0  # time passes
            assert receiver.latest() is None
            shift[0] = 0.0
            sender.send(pose(), now() - 700.0)  # tracked too slowly
            await receiver.next()
            assert receiver.latest() is None and receiver.statistics.late == 1
            sender.send(pose(), now())
            await receiver.next()
            assert receiver.latest() is not None
            sender.send(REFUSED, now())
            refusal = await receiver.next()
            assert receiver.latest() is None and refusal.pose.reason == "none here"

    run(work())


def test_noise_and_a_second_sender_do_no_harm_and_a_restart_is_followed():
    async def work():
        shift = [0.0]
        async with PoseReceiver(0, host=HOME, clock=lambda: now() + shift[0]) as receiver:
            receiver.oldest = 100.0
            async with PoseSender([(HOME, receiver.port)]) as one, PoseSender([(HOME, receiver.port)]) as other:
                with socket.socket(type=socket.SOCK_DGRAM) as noise:
                    noise.sendto(b"", (HOME, receiver.port))
                    noise.sendto(b"hello", (HOME, receiver.port))
                await until(lambda: receiver.statistics.invalid == 2)
                assert "not a pose packet: 5 bytes" in receiver.statistics.last_error
                one.send(pose(), now())
                await receiver.next()
                other.send(pose(), now())
                await until(lambda: receiver.statistics.foreign == 1)
                assert receiver.packet is not None and receiver.packet.stream == one.stream
                shift[0] = 200.0  # the first falls silent
                other.send(pose(), now())
                await receiver.next()
                assert receiver.packet.stream == other.stream and receiver.statistics.restarts == 1
                assert receiver.statistics.received == 1

    run(work())


def heard(sequences, *, offset=None):
    """Packets that arrive in this order, 0.25 s after sending or later; number 5 is sent at 100.1 s."""
    statistics, fresh, arrived = Statistics(offset=offset), [], 0.0
    for number in sequences:
        sent = 100 + 0.02 * number
        arrived = max(arrived, sent + 0.25)
        if statistics.heard(PosePacket(pose(), sent - 0.5, sent, number), arrived, late=1.0, ahead=0.05):
            fresh.append(number)
    return statistics, fresh


def counts(statistics):
    return statistics.received, statistics.lost, statistics.reordered, statistics.duplicated


@pytest.mark.parametrize(
    ("sequences", "wanted", "fresh"),
    [
        ([5, 6, 7], (3, 0, 0, 0), [5, 6, 7]),
        ([5, 8], (2, 2, 0, 0), [5, 8]),
        ([5, 8, 6, 7], (4, 0, 2, 0), [5, 8]),
        ([5, 5, 6, 5, 6], (2, 0, 0, 3), [5, 6]),
        ([5, 3, 6], (3, 1, 1, 0), [5, 6]),  # the first came late
        ([0, 1020, 2000, 1], (3, 1998, 0, 1), [0, 1020, 2000]),  # too old to say
        ([0, 5000, 1], (2, 4999, 0, 1), [0, 5000]),  # 100 s without a packet
    ],
)
def test_loss_order_and_repetition_are_counted(sequences, wanted, fresh):
    statistics, found = heard(sequences)
    assert counts(statistics) == wanted and found == fresh


def test_counts_fit_a_bad_network_whatever_it_does():
    """20 % lost, others swapped and doubled at random, counted here by sets."""
    generator = torch.Generator().manual_seed(11)
    kept = [i for i in range(2000) if torch.rand((), generator=generator) > 0.2]
    delay = 6 * torch.rand(len(kept), generator=generator)
    order = [kept[i] for i in torch.argsort(torch.arange(len(kept)) + delay).tolist()]
    order = [number for number in order for _ in range(2 if number % 17 == 0 else 1)]
    statistics, fresh = heard(order)
    newest, behind, seen = -1, 0, set()
    for number in order:
        behind += number < newest and number not in seen
        newest = max(newest, number)
        seen.add(number)
    assert counts(statistics) == (len(seen), max(seen) - min(seen) + 1 - len(seen), behind, len(order) - len(seen))
    assert behind > 100 and fresh == sorted(set(fresh)) and fresh[-1] == max(order)


def test_delays_are_those_of_the_clocks():
    statistics, _ = heard(range(100), offset=-0.05)  # the sender's clock is behind
    times = statistics.latency()
    assert times["transit_median"] == pytest.approx(0.2) and times["latency_p95"] == pytest.approx(0.7)
    assert statistics.late == 0 and statistics.jitter == pytest.approx(0, abs=1e-12)
    assert heard(range(9), offset=0.5)[0].late == 9
    # Without an answer from the sender the fastest packet counts as having taken no time.
    assert heard(range(9))[0].latency()["transit_median"] == 0
    assert math.isnan(Statistics().latency()["latency_p95"])


def test_a_full_buffer_keeps_the_newest_only():
    class Transport:
        def __init__(self):
            self.taken = []

        def set_write_buffer_limits(self, high):
            assert high == 0

        def is_closing(self):
            return False

        def sendto(self, data):
            self.taken.append(data)

    link, transport = Link("host", 1), Transport()
    link.connection_made(transport)
    link.offer(b"1")
    link.pause_writing()
    for data in (b"2", b"3", b"4"):
        link.offer(data)
    link.resume_writing()
    link.offer(b"5")
    assert transport.taken == [b"1", b"4", b"5"] and (link.sent, link.dropped) == (3, 2)
    link.error_received(ConnectionRefusedError(111, "nobody"))
    assert link.errors == 1


def test_a_sender_answers_clock_requests_and_nothing_else():
    from holotorch.tracking.streaming.packet import Echo

    async def work():
        with socket.socket(type=socket.SOCK_DGRAM) as device:
            device.bind((HOME, 0))
            device.setblocking(False)
            loop = asyncio.get_running_loop()
            async with PoseSender([device.getsockname()]) as sender:
                sender.send(pose(), 1.0)
                data, source = await loop.sock_recvfrom(device, 2048)
                assert isinstance(decode(data), PosePacket)
                for junk in (
                    b"",
                    b"HTPS",
                    data,
                    encode(Echo(1, 2, 3.0, 4.0, 5.0, reply=True)),
                    encode(Echo(9, 8, 7.0)),
                ):
                    device.sendto(junk, source)
                reply = decode(await loop.sock_recv(device, 2048))
                assert isinstance(reply, Echo) and reply.reply
                assert (reply.stream, reply.number, reply.asked) == (9, 8, 7.0) and reply.heard <= reply.answered

    run(work())


def test_what_cannot_work_is_said():
    async def taken():
        async with PoseReceiver(0, host=HOME) as one:
            with pytest.raises(OSError, match=f"UDP port {one.port} is in use, by another receiver"):
                async with PoseReceiver(one.port, host=HOME):
                    pass

    run(taken())

    async def nowhere():
        with pytest.raises(OSError, match="no way to"):
            async with PoseSender([("no such host", 5)]):
                pass

    run(nowhere())
    with pytest.raises(ValueError, match="pairs"):
        PoseSender([])
    with pytest.raises(ValueError, match="pairs"):
        PoseSender((HOME, 5))  # type: ignore[arg-type]
    for wrong, message in ((99999, "port must be at most 65535, got 99999"), (0, "port must be at least 1, got 0")):
        with pytest.raises(ValueError, match=message):
            PoseSender([(HOME, 5), (HOME, wrong)])
    for wrong, message in ((70000, "port must be at most 65535, got 70000"), (-1, "port must be at least 0, got -1")):
        with pytest.raises(ValueError, match=message):
            PoseReceiver(wrong)
    assert PoseReceiver(65535).port == 65535
    with pytest.raises(ValueError, match="oldest must be above zero"):
        PoseReceiver(0, oldest=0.0)
