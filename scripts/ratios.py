"""Ratios of speed as a file, and the comparison of two such files; it needs nothing of holotorch or torch."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

FACTOR = 1.25  # by which the median of a ratio must have grown to count


@dataclass(frozen=True)
class Ratio:
    """Seconds of a contender over those of its baseline in the same round: median and quartiles over the rounds."""

    subject: str
    case: str
    contender: str
    median: float
    lower: float  # quartile
    upper: float  # quartile
    milliseconds: float  # median time of one call

    @property
    def key(self) -> tuple[str, str, str]:
        """What is compared with the same of another file."""
        return self.subject, self.case, self.contender


@dataclass(frozen=True)
class Change:
    """A contender before and after; ``factor`` above 1 is slower."""

    before: Ratio
    after: Ratio

    @property
    def factor(self) -> float:
        """How many times its ratio grew."""
        return self.after.median / self.before.median

    def __str__(self) -> str:
        spreads = [f"{each.median:.3f} ({each.lower:.3f} to {each.upper:.3f})" for each in (self.before, self.after)]
        name = f"{self.after.subject:12} {self.after.case:30} {self.after.contender:30}"
        return f"{name} {spreads[0]} -> {spreads[1]}: {self.factor:.2f} times"


def ratios(subject: str, case: str, times: Mapping[str, Sequence[float]]) -> list[Ratio]:
    """Ratios of a case from the seconds of each contender in each round; the first contender is the baseline."""
    base = next(iter(times.values()))
    found = []
    for name, seconds in times.items():
        each = [one / two for one, two in zip(seconds, base, strict=True)]
        lower, median, upper = statistics.quantiles(each, n=4, method="inclusive")
        found.append(Ratio(subject, case, name, median, lower, upper, 1e3 * statistics.median(seconds)))
    return found


def slower(before: Sequence[Ratio], after: Sequence[Ratio], factor: float = FACTOR) -> list[Change]:
    """Contenders whose ratio grew by more than ``factor``, and whose quartiles do not overlap with those before.

    A baseline is always 1 of itself. If it becomes slower, its contenders become faster, see :func:`faster`.
    """
    changes = _pairs(before, after)
    return [each for each in changes if each.factor > factor and each.after.lower > each.before.upper]


def faster(before: Sequence[Ratio], after: Sequence[Ratio], factor: float = FACTOR) -> list[Change]:
    """Contenders whose ratio fell by more than ``factor``, beyond the quartiles.

    Either they are faster, or their baseline is slower.
    """
    changes = _pairs(before, after)
    return [each for each in changes if each.factor < 1 / factor and each.after.upper < each.before.lower]


def missing(before: Sequence[Ratio], after: Sequence[Ratio]) -> list[tuple[str, str, str]]:
    """Contenders of the same subjects that only one side has."""
    subjects = {each.subject for each in after}
    keys = [{each.key for each in side if each.subject in subjects} for side in (before, after)]
    return sorted(keys[0] ^ keys[1])


def _pairs(before: Sequence[Ratio], after: Sequence[Ratio]) -> list[Change]:
    known = {each.key: each for each in before}
    return [Change(known[each.key], each) for each in after if each.key in known]


def to_json(found: Sequence[Ratio], about: dict[str, Any]) -> dict[str, Any]:
    """Content of the file: ``about`` (machine, commit, date) and the ratios by subject, case and contender."""
    tree: dict[str, Any] = {}
    for each in found:
        numbers = {name: getattr(each, name) for name in ("median", "lower", "upper", "milliseconds")}
        tree.setdefault(each.subject, {}).setdefault(each.case, {})[each.contender] = numbers
    return about | {"ratios": tree}


def from_json(content: dict[str, Any]) -> list[Ratio]:
    """The ratios of a file."""
    return [
        Ratio(subject, case, contender, **numbers)
        for subject, cases in content["ratios"].items()
        for case, contenders in cases.items()
        for contender, numbers in contenders.items()
    ]
