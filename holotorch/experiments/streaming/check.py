"""``holotorch stream --check``: a test of streaming on this computer, which also prints its address for senders."""

import asyncio
import gc
import importlib.util
import json
import math
import random
import struct
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from aiohttp import WSMsgType

from holotorch.experiments.streaming.chromium import CHROMIUM, BrowserError, browser
from holotorch.experiments.streaming.stream import own_address
from holotorch.tracking import THESIS
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now
from holotorch.tracking.streaming.stream import PORT, PoseReceiver, PoseSender, UdpSocket

_LOOPBACK = "127.0.0.1"
_EVERY = 50  # every 50th packet carries a refusal instead of a pose
_SOON = 5e-3  # seconds: largest accepted median delay to a page; a quarter of the accepted 99th percentile
_PICTURE = 0.1  # seconds: largest accepted median delay of a picture to a page
_GROWTH = 100_000  # bytes by which the server may grow
_FAST = 1e-3  # seconds: largest accepted median transit on the loopback


def check(port: int = PORT, *, packets: int = 1000, show: Callable[[str], None] = print) -> bool:
    """Send ``packets`` packets over the loopback to two receivers, and through a lossy relay to a third one.

    Prints the results with ``show``. Returns whether all of them are good.
    """
    rows = asyncio.run(_rows(port, packets))
    for good, text in rows:
        show(f"{'OK  ' if good else 'FAIL'}  {text}")
    return all(good for good, _ in rows)


async def _rows(port: int, packets: int) -> list[tuple[bool, str]]:
    """Whether each test passed, and its result in words."""
    rows = [await _port(port)]
    async with (
        PoseReceiver(0, host=_LOOPBACK) as one,
        PoseReceiver(0, host=_LOOPBACK) as two,
        PoseReceiver(0, host=_LOOPBACK) as behind_relay,
        Relay(behind_relay.port) as relay,
        PoseSender([(_LOOPBACK, receiver.port) for receiver in (one, two, relay)]) as sender,
    ):
        await _send(sender, packets)
        for _ in range(200):
            if one.statistics.received == two.statistics.received == packets and relay.came == packets:
                break
            await asyncio.sleep(0.01)
        relay.release()
        await asyncio.sleep(0.05)
    rows += [*_direct("receiver 1", one, packets), *_direct("receiver 2", two, packets), _lossy(behind_relay, relay)]
    rows.append(await _page(min(300, packets // 5)))
    rows.append(await _panel(min(90, packets // 10)))
    rows.append(await _memory(packets))
    if CHROMIUM is not None:
        rows.append(await _drawn(min(90, packets // 10)))
    slicer = "not installed (optional); to add: pip install 'holotorch[slicer]'"
    if importlib.util.find_spec("pyigtl") is not None:
        slicer = "installed; holotorch stream ... --igtl 18944"
    to = f"--to {own_address()}:{port}; its firewall must let UDP {port} in"
    return [*rows, (True, f"slicer: pyigtl {slicer}"), (True, f"address: senders reach this computer by {to}")]


async def _port(port: int) -> tuple[bool, str]:
    try:
        async with PoseReceiver(port):
            return True, f"port: UDP {port} is free"
    except OSError as error:
        return False, f"port: {error.strerror or error}: --port NUMBER"


async def _send(sender: PoseSender, packets: int) -> None:
    direction = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    one, covariance = torch.ones((), dtype=torch.float64), torch.eye(6, dtype=torch.float64) * 1e-8
    refusal = Pose.refused(Status.NO_CATHETER, "a refusal of the self-test")
    for i in range(packets):
        tip = torch.tensor([1e-6 * i, 0.0, 0.5], dtype=torch.float64)
        pose = Pose(tip, direction, covariance, one, one, Status.OK)
        sender.send(refusal if i % _EVERY == _EVERY - 1 else pose, now())
        await asyncio.sleep(1e-3)


async def _page(count: int) -> tuple[bool, str]:
    """Whether poses at 60 per second reach a page on this computer in time, and the added latency in words."""
    from aiohttp import ClientSession

    from holotorch.experiments.streaming.page import PageServer

    delays: list[float] = []
    async with (
        PageServer(THESIS, port=0) as server,
        ClientSession() as session,
        session.ws_connect(server.address + "poses") as socket,
    ):

        async def read() -> None:
            async for message in socket:
                if (content := json.loads(message.data))["kind"] == "pose":
                    delays.append(now() - content["sent"])

        reader = asyncio.create_task(read())
        refusal = Pose.refused(Status.NO_CATHETER, "a refusal of the self-test")
        for _ in range(count):
            server.send(refusal, now())
            await asyncio.sleep(1 / 60)
        reader.cancel()
    median, p99 = (float(torch.tensor(delays or [math.inf]).quantile(share)) for share in (0.5, 0.99))
    good = len(delays) == count and median < _SOON and p99 < 4 * _SOON
    advice = (
        "" if good else f"; expected all, in {_SOON * 1e3:g} ms: close what keeps this computer busy, and try again"
    )
    text = f"{len(delays)} of {count} poses, added latency median {median * 1e3:.2f} ms, p99 {p99 * 1e3:.2f} ms{advice}"
    return good, f"page: {text}"


async def _panel(count: int) -> tuple[bool, str]:
    """Whether 1080p pictures at 30 per second reach a page on this computer in time, and the added latency in words.

    The latency includes encoding and transfer; a browser shows on its page how long it decodes and draws.
    """
    from aiohttp import ClientSession

    from holotorch.experiments.streaming.page import PageServer
    from holotorch.experiments.streaming.pictures import PATTERN, PanelSource

    delays: list[float] = []
    async with (
        PageServer(THESIS, port=0, panel=PanelSource(PATTERN)) as server,
        ClientSession() as session,
        session.ws_connect(server.address + "poses") as socket,
    ):
        start = now()
        while len(delays) < count and now() < start + count / 30 * 4 + 2:
            with suppress(TimeoutError):
                message = await asyncio.wait_for(socket.receive(), 1.0)
                if message.type is WSMsgType.BINARY:
                    delays.append(now() - struct.unpack_from("<d", message.data, 1)[0])
        rate = len(delays) / (now() - start)
    median = float(torch.tensor(delays or [math.inf]).median())
    good = median < _PICTURE
    advice = "" if good else f"; above {_PICTURE * 1e3:g} ms: close what keeps this computer busy, and try again"
    return good, f"panel: 1080p at {rate:.0f} of 30 Hz, added latency median {median * 1e3:.0f} ms{advice}"


async def _drawn(count: int) -> tuple[bool, str]:
    """Whether a Chromium of this computer draws the same pictures in time, and capture to frame in words."""
    from holotorch.experiments.streaming.page import PageServer
    from holotorch.experiments.streaming.pictures import PATTERN, PanelSource

    newest, delays = "view.pictures.pictures.panel", []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        try:
            async with (
                PageServer(THESIS, port=0, panel=PanelSource(PATTERN)) as server,
                browser(Path(folder)) as open_tab,
            ):
                tab = await open_tab(server.address)
                await tab.until("view.state.offset !== null")
                await tab.value("document.getElementById('panel').click()")
                await tab.until(f"{newest} && {newest}.count > 10")
                for _ in range(count):
                    delays.append(await tab.value(f"{newest}.latency"))
                    await asyncio.sleep(1 / 30)
        except (BrowserError, OSError) as error:
            return False, f"panel: Chromium failed: {error}"
    median = float(torch.tensor(delays or [math.inf]).median())
    return median < _PICTURE, f"panel: drawn by Chromium without a graphics card {median * 1e3:.0f} ms after capture"


async def _memory(count: int) -> tuple[bool, str]:
    """Whether the memory of the server stays the same while it sends ``count`` poses as fast as a page takes them."""
    from aiohttp import ClientSession

    from holotorch.experiments.streaming.page import PageServer

    refusal, received = Pose.refused(Status.NO_CATHETER, "a refusal of the self-test"), 0
    async with (
        PageServer(THESIS, port=0) as server,
        ClientSession() as session,
        session.ws_connect(server.address + "poses") as socket,
    ):
        await socket.receive()
        tracemalloc.start()
        before = 0
        for i in range(count):
            server.send(refusal, now())
            await socket.receive()
            received += 1
            if i == count // 10:  # everything has been used once
                gc.collect()
                before = tracemalloc.get_traced_memory()[0]
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
    good = received == count and grown < _GROWTH
    return good, f"memory: {grown / 1e3:+.0f} kB while {count - count // 10} messages went to a page"


def _direct(name: str, receiver: PoseReceiver, packets: int) -> Iterator[tuple[bool, str]]:
    """Results of a receiver on the loopback: counts, latency, and comparison of the clocks."""
    counts = receiver.statistics
    faults = counts.lost or counts.reordered or counts.duplicated or counts.invalid
    complete = counts.received == packets and not faults
    advice = "" if complete else "; look at the firewall's rules for the loopback, and at how busy this computer is"
    yield complete, f"{name}: {counts.received} of {packets} packets, {counts.refused} refusals{advice}"
    times = counts.latency()
    fast = times["transit_median"] < _FAST
    advice = "" if fast else f"; above {_FAST * 1e3:g} ms: close what keeps this computer busy, and try again"
    text = f"median {times['transit_median'] * 1e3:.3f} ms, p95 {times['transit_p95'] * 1e3:.3f} ms"
    yield fast, f"{name}: added latency {text}, jitter {counts.jitter * 1e3:.3f} ms{advice}"
    if counts.offset is None or counts.round_trip is None:
        yield False, f"{name}: clock request not answered; packets reach it, but none get back to the sender"
    else:
        yield True, f"{name}: clock offset {counts.offset * 1e3:+.3f} ms, within {counts.round_trip * 5e2:.3f} ms"


def _lossy(receiver: PoseReceiver, relay: "Relay") -> tuple[bool, str]:
    """Whether the receiver counted as the relay did and kept the newest packet, and the result in words."""
    counts = receiver.statistics
    dropped, overtaken, repeated = relay.dropped, relay.overtaken, relay.repeated
    text = f"lossy path: of {relay.came} packets {dropped} lost, {overtaken} reordered, {repeated} twice"
    counted = (counts.received, counts.reordered, counts.duplicated)
    expected = (relay.came - dropped, overtaken, repeated)
    if counted == expected and receiver.packet is not None and receiver.packet.sequence == relay.newest:
        return True, f"{text}; the receiver counted the same and kept the newest"
    return False, f"{text}; the receiver counted {counted}, not {expected}: please report this"


class Relay(UdpSocket):
    """A simulated bad network: it loses 20 % of the packets, delays 10 % by up to three packets, and repeats 2 %.

    Attributes:
        came, dropped, overtaken, repeated: Numbers of received, lost, overtaken and repeated packets. A packet counts
            as overtaken if it was forwarded after a later one.
        newest: Largest number of a forwarded packet; packets are numbered in the order of arrival.
    """

    def __init__(self, port: int):
        super().__init__(0, _LOOPBACK)
        self._to, self._random = (_LOOPBACK, port), random.Random(7)
        self.came, self.dropped, self.overtaken, self.repeated, self.newest = 0, 0, 0, 0, -1
        self._delayed: list[tuple[int, int, bytes]] = []  # number of the packet at which it is due, its number, content

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Called by asyncio; clock requests of the receiver are ignored."""
        if addr[1] == self._to[1]:
            return
        number, self.came = self.came, self.came + 1
        draw = self._random.random()
        if draw < 0.2:
            self.dropped += 1
        elif draw < 0.3:
            self._delayed.append((number + self._random.randint(1, 3), number, data))
        else:
            self._forward(number, data)
            if draw < 0.32:
                self.repeated += 1
                self.transport.sendto(data, self._to)
        self.release(number)

    def release(self, due: float = math.inf) -> None:
        """Forward the delayed packets that are due at packet number ``due``, by default all of them."""
        for at, number, data in self._delayed:
            if at <= due:
                self._forward(number, data)
        self._delayed = [packet for packet in self._delayed if packet[0] > due]

    def _forward(self, number: int, data: bytes) -> None:
        self.overtaken += number < self.newest
        self.newest = max(self.newest, number)
        self.transport.sendto(data, self._to)
