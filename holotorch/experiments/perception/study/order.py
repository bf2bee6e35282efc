"""The order in which trials are shown: the trials of the design, and repeats of trials with broken fixation."""

from dataclasses import asdict, dataclass
from typing import Any

from holotorch.experiments.perception.study.design import Design, Trial


@dataclass(frozen=True)
class Appearance:
    """A trial that is shown for the first time (``attempt`` 1), or again."""

    trial: Trial
    attempt: int = 1

    def to_json(self) -> dict[str, Any]:
        """Data of the trial for the page."""
        return asdict(self.trial) | {"goal": self.trial.goal, "attempt": self.attempt}


class Order:
    """The trials shown to one participant, in order. A broken fixation adds a repeat at the end of the round.

    Practice trials are not repeated. ``attempts`` is the largest number of times that a trial is shown.
    """

    def __init__(self, design: Design, attempts: int = 1):
        self.appearances = [Appearance(trial) for trial in design.trials]
        self._attempts = attempts
        self._repeats: dict[int, int] = {}  # index of the repeat by that of the broken appearance

    def record(self, index: int, fixated: bool | None) -> None:
        """Note the result of appearance ``index``, once for each and in order; False adds a repeat."""
        trial, attempt = self.appearances[index].trial, self.appearances[index].attempt
        if fixated is not False or trial.practice or attempt >= self._attempts:
            return
        end = max(k for k, other in enumerate(self.appearances) if other.trial.round == trial.round) + 1
        self.appearances.insert(end, Appearance(trial, attempt + 1))
        self._repeats[index] = end

    def repeat_of(self, index: int) -> int | None:
        """Index at which the repeat of appearance ``index`` was inserted, None if it is not repeated."""
        return self._repeats.get(index)
