"""Poses over UDP: a sender to several receivers, and a receiver that counts what goes wrong on the way.

Latest wins: nothing waits in a queue for a slow receiver, a lost packet is not sent again, and an older pose never
replaces a newer one. The packets are those of :mod:`holotorch.tracking.streaming.packet`; they are not signed, and
what a receiver does and does not detect is said in :mod:`holotorch.tracking.streaming.arrivals`.
"""

import asyncio
import errno
import itertools
import secrets
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from holotorch.core import checks
from holotorch.tracking.pose.status import Pose
from holotorch.tracking.streaming.arrivals import Statistics
from holotorch.tracking.streaming.packet import FRAME, Echo, PacketError, PosePacket, decode, encode, now

PORT = 18950
_ROUNDING = 2e-6  # seconds: four clock stamps near 1.7e9, multiples of 2.4e-7


class PoseSender:
    """Sends every pose to every receiver: ``async with PoseSender([("10.0.0.7", 18950)]) as sender: sender.send(...)``.

    Sending never waits: a receiver that is not there is counted and nothing more, and while the system's own buffer is
    full only the newest pose is kept for it. It also answers the receivers' clock requests, from these alone.

    Args:
        receivers: Hosts (names or addresses) and ports.
        frame: Name of the matrix that the packets carry.

    Raises:
        ValueError: No receivers, or a port outside 1 to 65535.
        OSError: No way to a receiver; when it is opened.
    """

    def __init__(self, receivers: Sequence[tuple[str, int]], *, frame: str = FRAME):
        if not receivers or isinstance(receivers[0], str):
            raise ValueError(f"receivers must be pairs (host, port), at least one, got {receivers!r}")
        self.links = [Link(host, checks.port(port, 1)) for host, port in receivers]
        self.frame, self.stream = frame, secrets.randbits(63)
        self._sequence = itertools.count()

    async def __aenter__(self) -> "PoseSender":
        loop = asyncio.get_running_loop()
        for link in self.links:
            try:
                await loop.create_datagram_endpoint(lambda each=link: each, remote_addr=(link.host, link.port))
            except OSError as error:
                await self.__aexit__()
                raise OSError(error.errno, f"no way to {link.host}:{link.port}: {error.strerror or error}") from None
        return self

    async def __aexit__(self, *_: object) -> None:
        for link in self.links:
            if link.transport is not None:
                link.transport.close()
        await asyncio.sleep(0)  # lets the sockets close before the loop may

    def send(self, pose: Pose, captured: float, *, lag: float = 0.0) -> int:
        """Send one pose or refusal and return its sequence number.

        Args:
            pose: A single one.
            captured: When the camera took its frame, by ``packet.now``.
            lag: Seconds that smoothing added.

        Raises:
            ValueError, TypeError: What ``packet.encode`` refuses.
        """
        number = next(self._sequence)
        data = encode(PosePacket(pose, captured, now(), number, self.stream, self.frame, lag))
        for link in self.links:
            link.offer(data)
        return number


class Newest(asyncio.BaseProtocol):
    """Writes at once, and keeps only the newest bytes while the system's buffer is full; ``dropped`` counts the others.

    A subclass says in ``_write`` how its transport takes bytes.
    """

    def __init__(self):
        self.transport: Any = None
        self.dropped = 0
        self._waiting, self._paused = b"", False

    def connection_made(self, transport: Any) -> None:
        """Called by asyncio."""
        self.transport = transport
        transport.set_write_buffer_limits(high=0)  # to be told as soon as something waits

    def offer(self, data: bytes) -> None:
        """Write ``data`` now, or when the system takes bytes again if none newer have come."""
        if self.transport is None or self.transport.is_closing():
            return
        if self._paused:
            self.dropped += bool(self._waiting)
            self._waiting = data
        else:
            self._write(data)

    def pause_writing(self) -> None:
        """Called by asyncio."""
        self._paused = True

    def resume_writing(self) -> None:
        """Called by asyncio."""
        self._paused = False
        data, self._waiting = self._waiting, b""
        if data:
            self.offer(data)

    def _write(self, data: bytes) -> None:
        raise NotImplementedError


class Link(Newest, asyncio.DatagramProtocol):
    """One receiver as its sender sees it: counts of packets ``sent``, ``dropped`` for newer ones, and ``errors``.

    ``sent`` has what the system took and nobody refused: UDP does not say what arrived. Each refusal is of one packet.
    """

    def __init__(self, host: str, port: int):
        super().__init__()
        self.host, self.port = host, port
        self.sent, self.errors, self.last_error = 0, 0, ""

    def _write(self, data: bytes) -> None:
        self.sent += 1
        self.transport.sendto(data)

    def error_received(self, exc: Exception) -> None:
        """Called by asyncio: nobody listens there, or the network is gone; both may pass."""
        self.errors, self.last_error, self.sent = self.errors + 1, _reason(exc), max(0, self.sent - 1)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Called by asyncio: a clock request."""
        heard = now()
        try:
            asked = decode(data)
        except PacketError:
            return
        if isinstance(asked, Echo) and not asked.reply and self.transport is not None:
            reply = Echo(asked.stream, asked.number, asked.asked, heard, now(), reply=True)
            self.transport.sendto(encode(reply))


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


class PoseReceiver(asyncio.DatagramProtocol):
    """Receives one stream: ``async with PoseReceiver() as receiver: packet = receiver.latest()``.

    Args:
        port: UDP; 0 picks a free one, then to be read from ``port``.
        host: Address to listen on; all of this computer's by default.
        oldest: Seconds since capture above which a pose is not given.
        late: Seconds since capture above which an arriving packet counts as late.
        ahead: Seconds that a capture time may lie in the future, by errors of the clocks. A packet beyond is not used,
            and counted as ``statistics.future``.
        clock: Seconds; by default that of the packets. The offset to the sender's is measured.

    Raises:
        ValueError: A port outside 0 to 65535, or times that are not above zero.
        OSError: The port is in use; when it is opened.
    """

    def __init__(
        self,
        port: int = PORT,
        *,
        host: str = "0.0.0.0",
        oldest: float = 0.25,
        late: float = 0.1,
        ahead: float = 0.05,
        clock: Callable[[], float] = now,
    ):
        self.port, self.host, self.clock = checks.port(port), host, clock
        self.oldest, self.late = checks.positive("oldest", oldest, "s"), checks.positive("late", late, "s")
        self.ahead = checks.positive("ahead", ahead, "s")
        self.statistics = Statistics()
        self.packet: PosePacket | None = None  # the newest, of any status and age
        self._arrived, self._fresh = -float("inf"), asyncio.Event()
        self._arrived_here = -float("inf")  # by this computer's monotonic clock, which nobody can set
        self._asked: dict[int, float] = {}
        self._last_asked = -float("inf")
        self._echoes: deque[tuple[float, float]] = deque(maxlen=8)  # round trip, offset
        self._numbers, self._name = itertools.count(), secrets.randbits(63)
        self._transport: Any = None

    async def __aenter__(self) -> "PoseReceiver":
        loop = asyncio.get_running_loop()
        try:
            await loop.create_datagram_endpoint(lambda: self, local_addr=(self.host, self.port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            text = f"UDP port {self.port} is in use, by another receiver perhaps; end that or choose another port"
            raise OSError(error.errno, text) from None
        self.port = self._transport.get_extra_info("sockname")[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._transport.close()
        await asyncio.sleep(0)

    def connection_made(self, transport: Any) -> None:
        """Called by asyncio."""
        self._transport = transport

    def latest(self) -> PosePacket | None:
        """The newest packet if it carries a pose not older than ``oldest``; an older pose never hides a refusal."""
        packet = self.packet
        if packet is None or not packet.answered or self.age() > self.oldest:
            return None
        return packet

    async def next(self) -> PosePacket:
        """Wait for a packet newer than at the last call; slow callers get the newest, not all. It may be a refusal."""
        await self._fresh.wait()
        self._fresh.clear()
        assert self.packet is not None
        return self.packet

    def age(self) -> float:
        """Seconds since the capture of the newest packet; infinite before the first.

        At least those since it arrived, whatever its stamps say.
        """
        if self.packet is None:
            return float("inf")
        way = self.statistics.transit(self._arrived - self.packet.sent)
        return max(self.packet.sent - self.packet.captured + way, 0.0) + self._silent()

    def _silent(self) -> float:
        """Seconds since the newest packet arrived, by the clock that says more."""
        return max(self.clock() - self._arrived, time.monotonic() - self._arrived_here)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Called by asyncio."""
        arrived = self.clock()
        try:
            packet = decode(data)
        except PacketError as error:
            self.statistics.invalid, self.statistics.last_error = self.statistics.invalid + 1, str(error)
            return
        if isinstance(packet, Echo):
            self._compare(packet, arrived)
            return
        statistics = self.statistics
        if self.packet is not None and packet.stream != self.packet.stream:
            if self._silent() <= self.oldest:
                self.statistics.foreign += 1
                return
            statistics = Statistics(restarts=self.statistics.restarts + 1)
        if statistics.heard(packet, arrived, self.late, self.ahead):
            if statistics is not self.statistics:
                # The sender was started anew, perhaps on another computer.
                self.statistics = statistics
                self._echoes.clear()
                self._last_asked = -float("inf")
            self.packet, self._arrived, self._arrived_here = packet, arrived, time.monotonic()
            self._fresh.set()
        elif statistics is not self.statistics:
            self.statistics.future += statistics.future
            return
        self._ask(addr)

    def _ask(self, addr: Any) -> None:
        """Ask for the sender's clock: often at first, then once a second."""
        asked = self.clock()
        if asked - self._last_asked > (0.02 if len(self._echoes) < 8 else 1.0):
            number, self._last_asked = next(self._numbers), asked
            self._asked = dict(list(self._asked.items())[-7:]) | {number: asked}
            self._transport.sendto(encode(Echo(self._name, number, asked)), addr)

    def _compare(self, echo: Echo, arrived: float) -> None:
        if not echo.reply or echo.stream != self._name or self._asked.pop(echo.number, None) != echo.asked:
            return
        round_trip = arrived - echo.asked - (echo.answered - echo.heard)
        if round_trip < -_ROUNDING:
            self.statistics.invalid += 1
            self.statistics.last_error = f"a clock reply that took {round_trip:.3g} s on its way there and back"
            return
        offset = (echo.heard - echo.asked + echo.answered - arrived) / 2
        self._echoes.append((round_trip, offset))
        self.statistics.round_trip, self.statistics.offset = min(self._echoes)
