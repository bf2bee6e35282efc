"""What a receiver counts of the packets that reach it, and which of them it does not believe.

Packets are not signed, so whoever can send to the port, or sees the stream's number on the network, can forge poses
that no check here tells from genuine ones. What the checks do: one damaged or forged packet, or a sender with a wrong
clock, neither keeps an old pose alive nor locks the genuine sender out. A number or a time of sending that does not
continue the stream is set aside; only when several such packets in a row continue each other does the receiver follow
them. A genuine sender therefore comes back after as many packets, unless forged ones keep coming.
"""

import itertools
import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from holotorch.tracking.streaming.packet import PosePacket

_WINDOW = 1024  # sequence numbers remembered to tell a late packet from a repeated one
_KEPT = 4096  # delays remembered for the median
_RECENT = 256  # packets after which the fastest is sought anew, so that neither a wrong stamp nor drift lasts
_RATE = 1000.0  # poses per second that no tracker exceeds: how far the sequence may run on while nothing arrives
_STEP = 1.0  # seconds by which the time of sending may run ahead of the arrivals: the longest hold-up of one packet
_AGREE = 3  # packets in a row, each continuing the one before, after which a receiver follows them


class _Mark(NamedTuple):
    """Where a packet stands in its stream: its number, the sender's time of sending and the receiver's of arrival."""

    sequence: int
    sent: float
    arrived: float

    def continued_by(self, later: "_Mark") -> bool:
        """Whether ``later`` may be a newer packet of the same stream, as far as its number and time of sending say."""
        passed = later.arrived - self.arrived
        step = later.sequence - self.sequence
        return 0 < step <= _WINDOW + _RATE * max(passed, 0.0) and 0 <= later.sent - self.sent <= passed + _STEP


@dataclass
class Statistics:
    """What happened to one stream on its way; times in seconds.

    Attributes:
        received: Packets, each counted once.
        reordered: Came after a newer one, and were not used.
        duplicated: Came again.
        late: Older than the receiver's ``late`` when they came.
        refused: Carried no pose.
        future: Captured in the future, by more than the receiver's ``ahead``; not used, and not among ``received``.
        jumped: Did not continue the stream in number and time of sending; not used, and not among ``received``.
        foreign: Of another stream while this one was alive, and were not used.
        invalid: Not readable, ``last_error`` why.
        restarts: Streams before this one.
        jitter: Smoothed difference of the transit of neighbouring packets (RFC 3550, Sec. 6.4.1).
        offset: The sender's clock minus the receiver's, by the clock request of the shortest round trip among the last
            eight; None as long as none was answered. Then a transit is counted from that of the fastest packet.
        round_trip: Of that request; half of it bounds the error of ``offset``.
    """

    received: int = 0
    reordered: int = 0
    duplicated: int = 0
    late: int = 0
    refused: int = 0
    future: int = 0
    jumped: int = 0
    foreign: int = 0
    invalid: int = 0
    restarts: int = 0
    last_error: str = ""
    jitter: float = 0.0
    offset: float | None = None
    round_trip: float | None = None
    _first: int = -1
    _highest: int = -1
    _seen: int = field(default=0, repr=False)  # bit i: the packet ``_highest - i`` came
    _counted: int = 0  # packets since ``_first``
    _missed: int = 0  # lost before ``_first``, in an earlier numbering
    _newest: "_Mark | None" = None
    _apart: "list[_Mark]" = field(default_factory=list, repr=False)  # continue each other, but not the stream
    _fastest: float = math.inf  # arrival minus sending, each by its own clock
    _previous: float | None = None
    _raw: deque = field(default_factory=lambda: deque(maxlen=_KEPT), repr=False)  # transit by two clocks, time before

    def heard(self, packet: PosePacket, arrived: float, late: float, ahead: float) -> bool:
        """Count a packet that ``arrived`` by the receiver's clock; whether it is to be used as the newest so far."""
        raw, waited = arrived - packet.sent, packet.sent - packet.captured
        if self._in_future(raw, waited, ahead):
            self.future += 1
            return False
        mark = _Mark(packet.sequence, packet.sent, arrived)
        if not self._believed(mark):
            self.jumped += 1
            return False
        behind = self._highest - packet.sequence if self._highest >= 0 else -1
        if behind >= _WINDOW or (behind >= 0 and self._seen >> behind & 1):
            # Beyond the window a late packet cannot be told from a repeated one, and is used no more than it.
            self.duplicated += 1
            return False
        self.received, self._counted = self.received + 1, self._counted + 1
        self.refused += not packet.answered
        self._first = packet.sequence if self._first < 0 else min(self._first, packet.sequence)
        self._raw.append((raw, waited))
        self._fastest = min(self._fastest, raw)
        if self._counted % _RECENT == 0:
            self._fastest = min(each for each, _ in itertools.islice(reversed(self._raw), _RECENT))
        self.late += self.transit(raw) + waited > late
        if behind >= 0:
            self.reordered += 1
            self._seen |= 1 << behind
            return False
        if self._previous is not None:
            self.jitter += (abs(raw - self._previous) - self.jitter) / 16
        self._previous, self._newest = raw, mark
        self._seen = (self._seen << min(-behind, _WINDOW) | 1) & ((1 << _WINDOW) - 1)
        self._highest = packet.sequence
        self._apart.clear()
        return True

    def _in_future(self, raw: float, waited: float, ahead: float) -> bool:
        """Captured after it was sent, or, where the clocks have been compared, after it arrived."""
        if -waited > ahead:
            return True
        if self.offset is None or self.round_trip is None:
            return False
        return -(raw + self.offset + waited) > ahead + self.round_trip / 2

    def _believed(self, mark: "_Mark") -> bool:
        """Whether a packet continues the stream, or the packets that were set aside now suffice to follow them."""
        if self._newest is None or (
            mark.sent <= self._newest.sent  # overtaken by the newest, or a copy of it
            if mark.sequence <= self._newest.sequence
            else self._newest.continued_by(mark)
        ):
            return True
        if self._apart and not self._apart[-1].continued_by(mark):
            self._apart.clear()
        self._apart.append(mark)
        if len(self._apart) < _AGREE:
            return False
        # The numbers begin anew here; what was counted before stays.
        self._missed, self._counted, self._first, self._highest, self._seen = self.lost, 0, -1, -1, 0
        self._fastest, self._previous = math.inf, None
        return True

    @property
    def lost(self) -> int:
        """Packets missing between the first and the newest."""
        return self._missed + (self._highest - self._first + 1 - self._counted if self._counted else 0)

    def transit(self, raw: Any) -> Any:
        """Seconds on the way, from arrivals by one clock minus the sending by the other."""
        return raw + self.offset if self.offset is not None else raw - self._fastest

    def latency(self) -> dict[str, float]:
        """Median and 95th percentile, of the transit and of the whole time since capture; NaN before a packet came."""
        raw = np.array(self._raw or [(math.nan, math.nan)], dtype=float)
        way = self.transit(raw[:, 0])
        found = [*np.quantile(way, (0.5, 0.95)).tolist(), *np.quantile(way + raw[:, 1], (0.5, 0.95)).tolist()]
        return dict(zip(("transit_median", "transit_p95", "latency_median", "latency_p95"), found, strict=True))
