"""Cases of a study with a checkpoint: a resumed study computes only the missing cases."""

import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from tqdm import tqdm

from holotorch.experiments.runs.saving import Checkpoint

Case = TypeVar("Case")


class Cases:
    """Progress of a study: the table rows computed so far, and the cases that remain.

    Attributes:
        rows: Rows of all cases so far; the caller of :meth:`each` appends the rows of each case.
        saved: Number of cases whose rows are in the checkpoint.
        checkpoint: The file that stores the rows.
    """

    def __init__(self, checkpoint: Checkpoint):
        self.checkpoint, self.rows, self.saved, self._count = checkpoint, [], 0, 0
        self._started = time.perf_counter()
        if content := checkpoint.load():
            try:
                self.rows: list[dict[str, Any]] = content["rows"]
                self.saved, self._started = content["cases"], self._started - content["seconds"]
            except KeyError as error:
                raise checkpoint.unreadable(error) from None

    @property
    def seconds(self) -> float:
        """Seconds spent so far, including those before an interruption."""
        return time.perf_counter() - self._started

    def each(self, cases: Iterable[Case], desc: str, unit: str) -> Iterator[Case]:
        """Yield the cases that are not in the checkpoint. A request for the next case first saves all rows so far."""
        for case in tqdm(cases, desc=desc, unit=unit):
            self._count += 1
            if self._count <= self.saved:
                continue
            yield case
            if self.checkpoint.save({"rows": self.rows, "cases": self._count, "seconds": self.seconds}):
                self.saved = self._count
