"""``holotorch stream --check``: a test of streaming on this computer, which also prints its address for senders."""

import asyncio
import importlib.util
import random
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import torch

from holotorch.experiments.streaming.stream import own_address
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now
from holotorch.tracking.streaming.stream import PORT, PoseReceiver, PoseSender

_EVERY = 50  # one of this many packets has no pose but the status of a refused frame
_FAST = 1e-3  # seconds: largest accepted median transit on the loopback


def check(port: int = PORT, *, packets: int = 1000, show: Callable[[str], None] = print) -> bool:
    """Send ``packets`` packets over the loopback to two receivers, and through a lossy relay to a third one.

    Prints the results with ``show``. Returns whether all of them are good.
    """
    sound = True
    for fine, text in asyncio.run(_rows(port, packets)):
        sound &= fine
        show(f"{'OK  ' if fine else 'FAIL'}  {text}")
    return sound


async def _rows(port: int, packets: int) -> list[tuple[bool, str]]:
    rows = [await _port(port)]
    here = "127.0.0.1"
    async with PoseReceiver(0, host=here) as one, PoseReceiver(0, host=here) as two:
        async with PoseReceiver(0, host=here) as behind, Relay(behind.port) as relay:
            ports = (one.port, two.port, relay.port)
            async with PoseSender([(here, each) for each in ports]) as sender:
                await _send(sender, packets)
                for _ in range(200):
                    if one.statistics.received == two.statistics.received == packets and relay.came == packets:
                        break
                    await asyncio.sleep(0.01)
                relay.release()
                await asyncio.sleep(0.05)
        for i, receiver in enumerate((one, two)):
            rows += _direct(f"receiver {i + 1}", receiver, packets)
    rows.append(_lossy(behind, relay))
    if importlib.util.find_spec("pyigtl") is None:
        rows.append((True, "slicer: pyigtl not installed (optional); to add: pip install 'holotorch[slicer]'"))
    else:
        rows.append((True, "slicer: pyigtl installed; holotorch stream ... --igtl 18944"))
    place = f"{own_address()}:{port}"
    rows.append((True, f"address: senders reach this computer by --to {place}; its firewall must let UDP {port} in"))
    return rows


async def _port(port: int) -> tuple[bool, str]:
    try:
        async with PoseReceiver(port):
            return True, f"port: UDP {port} is free"
    except OSError as error:
        return False, f"port: {error.strerror or error}: --port NUMBER"


async def _send(sender: PoseSender, packets: int) -> None:
    direction = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    one, small = torch.ones((), dtype=torch.float64), torch.eye(6, dtype=torch.float64) * 1e-8
    refusal = Pose.refused(Status.NO_CATHETER, "a refusal of the self-test")
    for i in range(packets):
        tip = torch.tensor([1e-6 * i, 0.0, 0.5], dtype=torch.float64)
        pose = Pose(tip, direction, small, one, one, Status.OK)
        sender.send(refusal if i % _EVERY == _EVERY - 1 else pose, now())
        await asyncio.sleep(1e-3)


def _direct(name: str, receiver: PoseReceiver, packets: int) -> Iterator[tuple[bool, str]]:
    statistics = receiver.statistics
    whole = statistics.received == packets and not (
        statistics.lost or statistics.reordered or statistics.duplicated or statistics.invalid
    )
    advice = "" if whole else "; look at the firewall's rules for the loopback, and at how busy this computer is"
    yield whole, f"{name}: {statistics.received} of {packets} packets, {statistics.refused} refusals{advice}"
    times = statistics.latency()
    fast = times["transit_median"] < _FAST
    advice = "" if fast else f"; above {_FAST * 1e3:g} ms: close what keeps this computer busy, and try again"
    text = f"median {times['transit_median'] * 1e3:.3f} ms, p95 {times['transit_p95'] * 1e3:.3f} ms"
    yield fast, f"{name}: added latency {text}, jitter {statistics.jitter * 1e3:.3f} ms{advice}"
    if statistics.offset is None or statistics.round_trip is None:
        yield False, f"{name}: clock request not answered; packets reach it, but none get back to the sender"
    else:
        offset, bound = statistics.offset * 1e3, statistics.round_trip * 5e2
        yield True, f"{name}: clock offset {offset:+.3f} ms, within {bound:.3f} ms"


def _lossy(receiver: PoseReceiver, relay: "Relay") -> tuple[bool, str]:
    statistics = receiver.statistics
    text = (
        f"lossy way: of {relay.came} packets {relay.dropped} lost, {relay.overtaken} reordered, {relay.repeated} twice"
    )
    got = (statistics.received, statistics.reordered, statistics.duplicated)
    wanted = (relay.came - relay.dropped, relay.overtaken, relay.repeated)
    newest = receiver.packet is not None and receiver.packet.sequence == relay.newest
    if got == wanted and newest:
        return True, f"{text}; the receiver counted the same and kept the newest"
    return False, f"{text}; the receiver counted {got}, not {wanted}: please report this"


class Relay(asyncio.DatagramProtocol):
    """A simulated bad network: it loses 20 % of the packets, delays 10 % by up to three packets, and repeats 2 %.

    Attributes:
        came, dropped, overtaken, repeated: Numbers of received, lost, delayed and repeated packets. A packet counts as
            overtaken if it was sent on after a later one.
        newest: Largest number of a forwarded packet; packets are numbered in the order of arrival.
    """

    def __init__(self, port: int, seed: int = 7):
        self._to, self._dice = ("127.0.0.1", port), random.Random(seed)
        self.came, self.dropped, self.overtaken, self.repeated, self.newest = 0, 0, 0, 0, -1
        self._held: deque[tuple[int, int, bytes]] = deque()  # (number at which it is due, number, content)
        self._transport: Any = None

    async def __aenter__(self) -> "Relay":
        loop = asyncio.get_running_loop()
        await loop.create_datagram_endpoint(lambda: self, local_addr=("127.0.0.1", 0))
        self.port = self._transport.get_extra_info("sockname")[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._transport.close()
        await asyncio.sleep(0)

    def connection_made(self, transport: Any) -> None:
        """Called by asyncio."""
        self._transport = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Called by asyncio; clock requests of the receiver are dropped."""
        if addr[1] == self._to[1]:
            return
        number, self.came = self.came, self.came + 1
        draw = self._dice.random()
        if draw < 0.2:
            self.dropped += 1
        elif draw < 0.3:
            self._held.append((number + self._dice.randint(1, 3), number, data))
        else:
            self._pass(number, data)
            if draw < 0.32:
                self.repeated += 1
                self._transport.sendto(data, self._to)
        self.release(number)

    def release(self, upto: int | None = None) -> None:
        """Send on the held packets that are due at packet ``upto``, or all of them."""
        for item in list(self._held):
            if upto is None or item[0] <= upto:
                self._held.remove(item)
                self._pass(item[1], item[2])

    def _pass(self, number: int, data: bytes) -> None:
        self.overtaken += number < self.newest
        self.newest = max(self.newest, number)
        self._transport.sendto(data, self._to)
