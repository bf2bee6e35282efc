"""Poses over UDP: a sender to several receivers, and a receiver that counts lost, late and invalid packets.

Only the newest pose matters: a slow receiver has no queue, a lost packet is not sent again, and an older pose never
replaces a newer one. The packets are those of :mod:`holotorch.tracking.streaming.packet`. They are not signed;
:mod:`holotorch.tracking.streaming.arrivals` describes what a receiver detects.
"""

import asyncio
import errno
import itertools
import math
import secrets
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

from holotorch.core import checks
from holotorch.tracking.pose.status import Pose
from holotorch.tracking.streaming.arrivals import Statistics
from holotorch.tracking.streaming.packet import FRAME, Echo, PacketError, PosePacket, decode, encode, now

PORT = 18950
_ROUNDING = 2e-6  # seconds: bounds the rounding error of a round trip, whose four times are multiples of 2.4e-7


class PoseSender:
    """Sends every pose to every receiver: ``async with PoseSender([("10.0.0.7", 18950)]) as sender: sender.send(...)``.

    Sending never waits. While the system's buffer for a receiver is full, only the newest pose is kept for it; packets
    that cannot be delivered are only counted. The sender also answers the clock requests of its receivers.

    Args:
        receivers: Hosts (names or addresses) and ports.
        frame: Name of the matrix in the packets, such as "camera_from_tool".

    Raises:
        ValueError: No receivers, or a port outside 1 to 65535.
        OSError: A receiver's address cannot be used; raised by ``async with``.
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
        await asyncio.sleep(0)  # lets the sockets close before the event loop may end

    def send(self, pose: Pose, captured: float, *, lag: float = 0.0) -> int:
        """Send one pose or refusal and return its sequence number.

        Args:
            pose: A single pose, not a batch.
            captured: Time at which the camera took the frame, in seconds of the clock ``packet.now``.
            lag: Delay in seconds that smoothing added.

        Raises:
            ValueError, TypeError: As :func:`~holotorch.tracking.streaming.packet.encode`.
        """
        number = next(self._sequence)
        data = encode(PosePacket(pose, captured, now(), number, self.stream, self.frame, lag))
        for link in self.links:
            link.offer(data)
        return number


class Newest(asyncio.BaseProtocol):
    """Connection that writes at once; while the system's buffer is full, it keeps only the newest data.

    ``dropped`` counts the data that newer data replaced.
    """

    def __init__(self):
        self.transport: Any = None
        self.dropped = 0
        self._waiting, self._paused = b"", False

    def connection_made(self, transport: Any) -> None:
        """Called by asyncio."""
        self.transport = transport
        transport.set_write_buffer_limits(high=0)  # asyncio then calls pause_writing as soon as any data wait

    def offer(self, data: bytes) -> None:
        """Write ``data`` now or, if the system's buffer is full, later, unless newer data replace them before."""
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
        self.transport.write(data)


class Link(Newest, asyncio.DatagramProtocol):
    """Connection of a sender to one receiver; ``dropped`` counts packets that newer ones replaced before sending."""

    def __init__(self, host: str, port: int):
        super().__init__()
        self.host, self.port = host, port
        self.sent = 0  # packets handed to the system, without those that failed; UDP does not report arrivals
        self.errors, self.last_error = 0, ""  # number of packets that failed, and the reason of the last one

    def _write(self, data: bytes) -> None:
        self.sent += 1
        self.transport.sendto(data)

    def error_received(self, exc: Exception) -> None:
        """Called by asyncio: nobody listens at the address, or the network is down; either may end later."""
        self.errors, self.sent = self.errors + 1, max(0, self.sent - 1)
        self.last_error = getattr(exc, "strerror", None) or str(exc)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Called by asyncio: a clock request."""
        heard = now()
        try:
            request = decode(data)
        except PacketError:
            return
        if isinstance(request, Echo) and not request.reply and self.transport is not None:
            self.transport.sendto(encode(replace(request, heard=heard, answered=now(), reply=True)))


class UdpSocket(asyncio.DatagramProtocol):
    """UDP socket that ``async with`` opens and closes.

    Args:
        port: Port to listen on; 0 picks a free one, which the attribute ``port`` names once the socket is open.
        host: Address to listen on; by default all addresses of this computer.

    Raises:
        ValueError: A port outside 0 to 65535.
        OSError: The port is in use; raised by ``async with``.
    """

    def __init__(self, port: int, host: str = "0.0.0.0"):
        self.port, self.host = checks.port(port), host
        self.transport: Any = None

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_datagram_endpoint(lambda: self, local_addr=(self.host, self.port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            text = f"UDP port {self.port} is in use, by another receiver perhaps; end that or choose another port"
            raise OSError(error.errno, text) from None
        self.port = self.transport.get_extra_info("sockname")[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.transport.close()
        await asyncio.sleep(0)  # lets the socket close before the event loop may end

    def connection_made(self, transport: Any) -> None:
        """Called by asyncio."""
        self.transport = transport


class PoseReceiver(UdpSocket):
    """Receives one stream: ``async with PoseReceiver() as receiver: packet = receiver.latest()``.

    Args:
        port, host: See :class:`UdpSocket`.
        oldest: Largest age, in seconds since capture, of a pose that ``latest`` returns.
        late: Age, in seconds since capture, above which an arriving packet counts as late.
        ahead: Seconds that a capture time may lie in the future, because of errors of the clocks. A packet farther in
            the future is not used, and counted as ``statistics.future``.
        clock: Returns the time in seconds; by default the clock of the packets. The receiver measures the offset of the
            sender's clock from it.

    Raises:
        ValueError, OSError: As UdpSocket. ValueError also if ``oldest``, ``late`` or ``ahead`` is not above zero.
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
        super().__init__(port, host)
        self.clock = clock
        self.oldest, self.late = checks.positive("oldest", oldest, "s"), checks.positive("late", late, "s")
        self.ahead = checks.positive("ahead", ahead, "s")
        self.statistics = Statistics()
        self.packet: PosePacket | None = None  # the newest packet, of any status and age
        self._new_packet = asyncio.Event()
        self._arrived = self._arrived_monotonic = -math.inf  # by ``clock`` and by the monotonic clock
        self._asked: dict[int, float] = {}  # times of the last clock requests by their numbers
        self._last_asked = -math.inf
        self._echoes: deque[tuple[float, float]] = deque(maxlen=8)  # round trip and offset of each reply, in seconds
        self._numbers, self._name = itertools.count(), secrets.randbits(63)

    def latest(self) -> PosePacket | None:
        """The newest packet, or None if it is a refusal, is older than ``oldest``, or none has arrived."""
        packet = self.packet
        return packet if packet is not None and packet.answered and self.age() <= self.oldest else None

    async def next(self) -> PosePacket:
        """Wait for a packet, which may be a refusal, newer than at the last call; only the newest is returned."""
        await self._new_packet.wait()
        self._new_packet.clear()
        assert self.packet is not None
        return self.packet

    def age(self) -> float:
        """Seconds since the capture of the newest packet; infinite before the first.

        The age is never below the time since the packet arrived, even if the packet's time stamps are wrong.
        """
        if self.packet is None:
            return math.inf
        transit = self.statistics.transit(self._arrived - self.packet.sent)
        return max(self.packet.sent - self.packet.captured + transit, 0.0) + self._since_arrival()

    def _since_arrival(self) -> float:
        """Seconds since the newest packet arrived, by the clock on which more time passed."""
        return max(self.clock() - self._arrived, time.monotonic() - self._arrived_monotonic)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Called by asyncio."""
        arrived = self.clock()
        try:
            packet = decode(data)
            if isinstance(packet, Echo):
                self._compare(packet, arrived)
                return
        except PacketError as error:
            self.statistics.invalid, self.statistics.last_error = self.statistics.invalid + 1, str(error)
            return
        statistics = self.statistics
        if self.packet is not None and packet.stream != self.packet.stream:
            if self._since_arrival() <= self.oldest:
                self.statistics.foreign += 1
                return
            statistics = Statistics(restarts=self.statistics.restarts + 1)
        if statistics.heard(packet, arrived, self.late, self.ahead):
            if statistics is not self.statistics:
                # A sender was started anew, perhaps on another computer.
                self.statistics = statistics
                self._echoes.clear()
                self._last_asked = -math.inf
            self.packet, self._arrived, self._arrived_monotonic = packet, arrived, time.monotonic()
            self._new_packet.set()
        elif statistics is not self.statistics:
            self.statistics.future += statistics.future
            return
        self._ask(addr)

    def _ask(self, addr: Any) -> None:
        """Request the sender's clock, at most every 20 ms until eight replies came, then at most once a second."""
        asked = self.clock()
        if asked - self._last_asked > (0.02 if len(self._echoes) < 8 else 1.0):
            number, self._last_asked = next(self._numbers), asked
            self._asked = dict(list(self._asked.items())[-7:]) | {number: asked}
            self.transport.sendto(encode(Echo(self._name, number, asked)), addr)

    def _compare(self, echo: Echo, arrived: float) -> None:
        """Measure the offset of the sender's clock from its reply to a request of this receiver."""
        if not echo.reply or echo.stream != self._name or self._asked.pop(echo.number, None) != echo.asked:
            return
        round_trip = arrived - echo.asked - (echo.answered - echo.heard)
        if round_trip < -_ROUNDING:
            raise PacketError(f"a clock reply that took {round_trip:.3g} s on its way there and back")
        offset = (echo.heard - echo.asked + echo.answered - arrived) / 2
        self._echoes.append((round_trip, offset))
        self.statistics.round_trip, self.statistics.offset = min(self._echoes)
