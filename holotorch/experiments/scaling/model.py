"""Model of the seconds of a run that several processes share."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any


def _assumed(value: float, unit: str, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "source": source})


@dataclass(frozen=True)
class Cluster:
    """GPUs and their connections, as assumed; none of these numbers was measured."""

    fft: float = _assumed(
        3e12, "flop/s", "assumed, of complex64 transforms counted as 5 n log2 n; memory permits 4 times as much"
    )
    memory: float = _assumed(2e12, "byte/s", "assumed, 60 % of the 3.35 TB/s in the data sheet of the H100 SXM")
    overhead: float = _assumed(2e-3, "s", "assumed, of Python and kernel launches in each round")
    node: int = _assumed(8, "GPUs", "a DGX H100")
    nvlink: float = _assumed(4.5e11, "byte/s", "data sheet of the H100 SXM, 900 GB/s in both directions, within a node")
    network: float = _assumed(5e10, "byte/s", "400 Gbit/s (InfiniBand NDR) for each GPU, between nodes")
    near: float = _assumed(1e-5, "s", "assumed latency of a step of an all-reduce within a node")
    far: float = _assumed(3e-5, "s", "assumed latency of a step of an all-reduce between nodes")
    reading: float = _assumed(2e9, "byte/s", "assumed, of one process that reads a file")
    storage: float = _assumed(5e10, "byte/s", "assumed, of the file system, for all processes together")

    def link(self, count: int) -> "Link":
        """The connection between ``count`` processes; the slowest one decides."""
        return Link(self.nvlink, self.near) if count <= self.node else Link(self.network, self.far)

    def table(self) -> list[dict[str, Any]]:
        """The assumptions as rows of a table."""
        return [{"name": field.name, "value": getattr(self, field.name), **field.metadata} for field in fields(self)]


@dataclass(frozen=True)
class Link:
    """A connection of processes: bytes per second of each, and seconds of latency of a step."""

    bandwidth: float
    latency: float

    def all_reduce(self, size: float, messages: int, count: int) -> float:
        """Seconds to add up ``size`` bytes in ``messages`` parts over ``count`` processes.

        In a ring, each process sends 2 (N - 1) / N of the bytes (Thakur, Rabenseifner, Gropp 2005); the latency is
        that of a tree.
        """
        if count == 1:
            return 0.0
        return 2 * (count - 1) / count * size / self.bandwidth + messages * self.latency * math.log2(count)


@dataclass(frozen=True)
class Work:
    """The work of a run, which consists of equal rounds: realisations, or evaluations of a loss.

    Attributes:
        name: What is computed.
        units: Number of equal parts that are not divided further, such as planes or frames times colours.
        largest: Function from the number of processes to the number of units in the largest share.
        divided: Seconds of all units of a round on one processor.
        repeated: Seconds of a round that every process spends.
        size: Bytes of the tensors that the processes add up in a round.
        messages: Number of these tensors.
        rounds: Number of rounds.
        file: Bytes that every process reads first.
    """

    name: str
    units: int
    largest: Callable[[int], int]
    divided: float
    repeated: float
    size: float
    messages: int
    rounds: int = 1
    file: float = 0.0

    def seconds(self, count: int, link: Link, cluster: Cluster | None = None) -> dict[str, float]:
        """Seconds of each part on ``count`` processes; without a ``cluster``, the input has been read."""
        reading = 0.0 if cluster is None else self.file * max(1 / cluster.reading, count / cluster.storage)
        return {
            "reading": reading,
            "divided": self.rounds * self.divided * self.largest(count) / self.units,
            "repeated": self.rounds * self.repeated,
            "exchange": self.rounds * link.all_reduce(self.size, self.messages, count),
        }
