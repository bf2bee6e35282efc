"""Cases of a study: those that are complete are on the disk, and are not computed again."""

import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from tqdm import tqdm

from holotorch.experiments.runs.saving import Checkpoint

Case = TypeVar("Case")


class Cases:
    """Cases one after another, and the rows that they have given.

    Attributes:
        rows: Of all cases so far; a study appends to it.
        saved: Cases whose rows are in the checkpoint.
        checkpoint: Where they are kept.
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
        """Spent so far, also before an interruption."""
        return self._before + time.perf_counter() - self._started

    def each(self, cases: Iterable[Case], desc: str, unit: str) -> Iterator[Case]:
        """Those of the cases that are still to be computed; one is complete when the next one is asked for."""
        for case in tqdm(cases, desc=desc, unit=unit):
            self._count += 1
            if self._count <= self.saved:
                continue
            yield case
            if self.checkpoint.save({"rows": self.rows, "cases": self._count, "seconds": self.seconds}):
                self.saved = self._count
