"""Cases of a study with a checkpoint, so that a resumed study computes only the cases that are missing."""

import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from tqdm import tqdm

from holotorch.experiments.runs.saving import Checkpoint

Case = TypeVar("Case")


class Cases:
    """Progress of a study: the table rows computed so far, and the cases that remain.

    Attributes:
        rows: Rows of all cases so far; a study appends to this list.
        saved: Number of cases whose rows are in the checkpoint.
        checkpoint: File that keeps the rows.
    """

    def __init__(self, checkpoint: Checkpoint):
        self.checkpoint, self.rows, self.saved, self._count = checkpoint, [], 0, 0
        self._before, self._started = 0.0, time.perf_counter()
        if content := checkpoint.load():
            try:
                self.rows: list[dict[str, Any]] = content["rows"]
                self.saved, self._before = content["cases"], content["seconds"]
            except KeyError as error:
                raise checkpoint.unreadable(error) from None

    @property
    def seconds(self) -> float:
        """Time so far, including the runs before an interruption."""
        return self._before + time.perf_counter() - self._started

    def each(self, cases: Iterable[Case], desc: str, unit: str) -> Iterator[Case]:
        """The cases that are not in the checkpoint; requesting the next case marks the one before as complete."""
        for case in tqdm(cases, desc=desc, unit=unit):
            self._count += 1
            if self._count <= self.saved:
                continue
            yield case
            if self.checkpoint.save({"rows": self.rows, "cases": self._count, "seconds": self.seconds}):
                self.saved = self._count
