"""What a receiver counts of the packets that reach it."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from holotorch.tracking.packet import PosePacket

_WINDOW = 1024  # sequence numbers remembered to tell a late packet from a repeated one
_KEPT = 4096  # delays remembered for the median


@dataclass
class Statistics:
    """What happened to one stream on its way; times in seconds.

    Attributes:
        received: Packets, each counted once.
        reordered: Came after a newer one, and were not used.
        duplicated: Came again.
        late: Older than the receiver's ``late`` when they came.
        refused: Carried no pose.
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
    _fastest: float = math.inf  # arrival minus sending, each by its own clock
    _previous: float | None = None
    _raw: deque = field(default_factory=lambda: deque(maxlen=_KEPT), repr=False)  # transit by two clocks, time before

    def heard(self, packet: PosePacket, arrived: float, late: float) -> bool:
        """Count a packet that ``arrived`` by the receiver's clock; whether it is the newest so far."""
        behind = self._highest - packet.sequence if self._highest >= 0 else -1
        if behind >= _WINDOW or (behind >= 0 and self._seen >> behind & 1):
            # Beyond the window a late packet cannot be told from a repeated one, and is used no more than it.
            self.duplicated += 1
            return False
        raw, waited = arrived - packet.sent, packet.sent - packet.captured
        self.received += 1
        self.refused += not packet.answered
        self._first = packet.sequence if self._first < 0 else min(self._first, packet.sequence)
        self._fastest = min(self._fastest, raw)
        self._raw.append((raw, waited))
        self.late += self.transit(raw) + waited > late
        if behind >= 0:
            self.reordered += 1
            self._seen |= 1 << behind
            return False
        if self._previous is not None:
            self.jitter += (abs(raw - self._previous) - self.jitter) / 16
        self._previous = raw
        self._seen = (self._seen << min(-behind, _WINDOW) | 1) & ((1 << _WINDOW) - 1)
        self._highest = packet.sequence
        return True

    @property
    def lost(self) -> int:
        """Packets missing between the first and the newest."""
        return self._highest - self._first + 1 - self.received if self.received else 0

    def transit(self, raw: Any) -> Any:
        """Seconds on the way, from arrivals by one clock minus the sending by the other."""
        return raw + self.offset if self.offset is not None else raw - self._fastest

    def latency(self) -> dict[str, float]:
        """Median and 95th percentile, of the transit and of the whole time since capture; NaN before a packet came."""
        raw = np.array(self._raw or [(math.nan, math.nan)], dtype=float)
        way = self.transit(raw[:, 0])
        found = [*np.quantile(way, (0.5, 0.95)).tolist(), *np.quantile(way + raw[:, 1], (0.5, 0.95)).tolist()]
        return dict(zip(("transit_median", "transit_p95", "latency_median", "latency_p95"), found, strict=True))
