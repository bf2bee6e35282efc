"""Statistics of the packets that reach a receiver, and checks of which of them continue the stream.

Packets are not signed. Anyone who can send to the port, or can read the number of the stream on the network, can forge
poses that no check here distinguishes from genuine ones. The checks ensure that a single damaged or forged packet, or a
sender with a wrong clock, neither keeps an old pose valid nor locks out the genuine sender. The receiver does not use a
packet whose number or time of sending does not continue the stream, until three such packets in a row continue each
other. A genuine sender is therefore accepted again after three packets, unless forged ones keep coming.
"""

import itertools
import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from holotorch.tracking.streaming.packet import PosePacket

_WINDOW = 1024  # sequence numbers that are stored to distinguish late packets from repeated ones
_KEPT = 4096  # packets whose delays are stored for the quantiles
_RECENT = 256  # packets after which the fastest transit is computed anew, so that wrong stamps and drift do not persist
_RATE = 1000.0  # poses per second: largest rate at which the sequence may advance while no packet arrives
_STEP = 1.0  # seconds: longest delay of one packet, by which times of sending may advance faster than arrivals
_AGREE = 3  # packets in a row that continue each other, after which a receiver accepts them as the stream


class _Mark(NamedTuple):
    """Number of a packet in its stream, time of sending (sender's clock) and time of arrival (receiver's clock)."""

    sequence: int
    sent: float
    arrived: float

    def continued_by(self, later: "_Mark") -> bool:
        """Whether ``later`` may be a newer packet of the same stream by its number and time of sending."""
        passed, step = later.arrived - self.arrived, later.sequence - self.sequence
        return 0 < step <= _WINDOW + _RATE * max(passed, 0.0) and 0 <= later.sent - self.sent <= passed + _STEP


@dataclass
class Statistics:
    """Statistics of one stream; times are in seconds."""

    received: int = 0  # packets received, each counted once
    reordered: int = 0  # packets that arrived after a newer one; not used
    duplicated: int = 0  # packets that arrived again
    late: int = 0  # packets that arrived more than the receiver's ``late`` after their capture
    refused: int = 0  # packets that carry a refusal instead of a pose
    future: int = 0  # packets captured more than the receiver's ``ahead`` in the future; not used, not ``received``
    jumped: int = 0  # packets whose number or time of sending did not continue the stream; not used, not ``received``
    foreign: int = 0  # packets of another stream while this one was active; not used
    invalid: int = 0  # unreadable packets
    restarts: int = 0  # number of streams before this one
    last_error: str = ""  # reason of the last unreadable packet
    jitter: float = 0.0  # smoothed absolute difference of successive transit times (RFC 3550, Sec. 6.4.1)
    # The sender's clock minus the receiver's, by the clock request with the shortest round trip among the last eight;
    # None before the first reply. Without it, the transit time of a packet is its excess over the fastest packet.
    offset: float | None = None
    round_trip: float | None = None  # of that clock request; half of it bounds the error of ``offset``
    _first: int = -1  # smallest sequence number; -1 before the first packet
    _highest: int = -1  # largest sequence number
    _arrived: int = field(default=0, repr=False)  # bit i is set if the packet ``_highest - i`` arrived
    _counted: int = 0  # packets received since the sequence numbers last started anew
    _missed: int = 0  # packets lost before the sequence numbers last started anew
    _newest: _Mark | None = None
    _candidates: list[_Mark] = field(default_factory=list, repr=False)  # continue each other, but not the stream
    _fastest: float = math.inf  # smallest recent ``raw`` (see ``transit``) in seconds
    _previous: float | None = None  # ``raw`` of the newest packet
    # ``raw`` and time from capture to sending of the last packets.
    _delays: deque = field(default_factory=lambda: deque(maxlen=_KEPT), repr=False)

    def heard(self, packet: PosePacket, arrived: float, late: float, ahead: float) -> bool:
        """Count a packet that arrived at ``arrived`` (receiver's clock). Returns whether it is the newest so far.

        ``late`` and ``ahead`` are those of :class:`~holotorch.tracking.streaming.stream.PoseReceiver`, in seconds.
        """
        raw, waited = arrived - packet.sent, packet.sent - packet.captured
        if self._in_future(raw, waited, ahead):
            self.future += 1
            return False
        mark = _Mark(packet.sequence, packet.sent, arrived)
        if not self._continues(mark):
            self.jumped += 1
            return False
        behind = self._highest - packet.sequence if self._highest >= 0 else -1
        if behind >= _WINDOW or (behind >= 0 and self._arrived >> behind & 1):
            # Beyond the window, late and repeated packets are indistinguishable, and neither is used.
            self.duplicated += 1
            return False
        self.received, self._counted = self.received + 1, self._counted + 1
        self.refused += not packet.answered
        self._first = packet.sequence if self._first < 0 else min(self._first, packet.sequence)
        self._delays.append((raw, waited))
        self._fastest = min(self._fastest, raw)
        if self._counted % _RECENT == 0:
            self._fastest = min(each for each, _ in itertools.islice(reversed(self._delays), _RECENT))
        self.late += self.transit(raw) + waited > late
        if behind >= 0:
            self.reordered += 1
            self._arrived |= 1 << behind
            return False
        if self._previous is not None:
            self.jitter += (abs(raw - self._previous) - self.jitter) / 16
        self._previous, self._newest, self._highest = raw, mark, packet.sequence
        self._arrived = (self._arrived << min(-behind, _WINDOW) | 1) & ((1 << _WINDOW) - 1)
        self._candidates.clear()
        return True

    def _in_future(self, raw: float, waited: float, ahead: float) -> bool:
        """Whether a packet was captured after it was sent or, if the clocks have been compared, after it arrived."""
        if self.offset is None or self.round_trip is None:
            return -waited > ahead
        return -waited > ahead or -(raw + self.offset + waited) > ahead + self.round_trip / 2

    def _continues(self, mark: _Mark) -> bool:
        """Whether a packet continues the stream, or is the last of three that continue each other."""
        if self._newest is None or (
            mark.sent <= self._newest.sent  # overtaken by the newest packet, or a copy of it
            if mark.sequence <= self._newest.sequence
            else self._newest.continued_by(mark)
        ):
            return True
        if self._candidates and not self._candidates[-1].continued_by(mark):
            self._candidates.clear()
        self._candidates.append(mark)
        if len(self._candidates) < _AGREE:
            return False
        # Sequence numbers start anew here, while the counts continue.
        self._missed, self._counted, self._first, self._highest, self._arrived = self.lost, 0, -1, -1, 0
        self._fastest, self._previous = math.inf, None
        return True

    @property
    def lost(self) -> int:
        """Number of packets that are missing between the first and the newest."""
        return self._missed + (self._highest - self._first + 1 - self._counted if self._counted else 0)

    def transit(self, raw: Any) -> Any:
        """Transit time in seconds from ``raw``, the arrival (receiver's clock) minus the sending (sender's clock)."""
        return raw + self.offset if self.offset is not None else raw - self._fastest

    def latency(self) -> dict[str, float]:
        """Median and 95th percentile of transit and of the time since capture; NaN before the first packet."""
        raw = np.array(self._delays or [(math.nan, math.nan)], dtype=float)
        transit = self.transit(raw[:, 0])
        values = np.quantile([transit, transit + raw[:, 1]], (0.5, 0.95), axis=1).T.flatten().tolist()
        return dict(zip(("transit_median", "transit_p95", "latency_median", "latency_p95"), values, strict=True))
