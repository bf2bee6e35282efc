"""A sweep of one method beyond the limits of its validity, and the outcome at each point."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

SILENT = 10  # factor on the tolerance: a larger error without a warning is a failure
DEFAULT = 1e-3  # tolerance of methods that have no such argument and document no error
ASKED, DOCUMENTED, DEFAULTED = "asked", "documented", "1e-3 by default"  # where a tolerance comes from

Value = float | str


class Answer(NamedTuple):
    """What a method returned for one value of the swept quantity.

    ``predicted`` is the error that it predicts or documents, NaN without one, and ``chosen`` the method that a planner
    chose, "" where nothing is chosen. ``tolerance`` replaces that of the sweep where it depends on the value.
    """

    result: Tensor
    predicted: float = math.nan
    chosen: str = ""
    tolerance: float | None = None


class Refused(ValueError):
    """Raised by an ``answer`` whose method refuses by a status instead of an exception."""


@dataclass(frozen=True)
class Point:
    """One row of the table.

    Attributes:
        method, swept, value: The method, the swept quantity with its unit, and its value.
        tolerance: Largest accepted error; ``tolerance_from`` says whether it was asked, documented, or is 1e-3.
        predicted: Error that the method predicted or documents; NaN without a prediction, and for refusals.
        measured: True error; NaN for refusals.
        said: "nothing", "warned", "switched" (a planner chose another method than for the value before) or "refused".
        words: Name of the chosen method, or the beginning of the warning or refusal.
    """

    method: str
    swept: str
    value: Value
    tolerance: float
    tolerance_from: str
    predicted: float
    measured: float
    said: str
    words: str

    @property
    def ok(self) -> bool:
        """Whether the error is small enough, or the method warned that it may not be."""
        return self.said in ("warned", "refused") or self.measured <= SILENT * self.tolerance

    @property
    def label(self) -> str:
        """Method, swept quantity and value, for a list."""
        value = self.value if isinstance(self.value, str) else f"{self.value:.3g}"
        return f"{self.method}, {self.swept} = {value}"


def relative(result: Tensor, exact: Tensor) -> float:
    """Relative L2 error of a tensor, computed in double precision; 0 if both are 0."""
    double = torch.complex128 if result.is_complex() or exact.is_complex() else torch.float64
    off, norm = (result.to(double) - exact.to(double)).norm().item(), exact.to(double).norm().item()
    return off / norm if norm else (0.0 if off == 0 else math.inf)


def absolute(result: Tensor, exact: Tensor) -> float:
    """L2 norm of the difference."""
    return (result - exact).norm().item()


@dataclass(frozen=True)
class Sweep:
    """A method at several values of one quantity, with an independent reference.

    Attributes:
        method: Name of the method.
        swept: Name of the quantity, with its unit.
        values: Values from inside the domain of validity to beyond it.
        answer: What the method returns for a value. Its warnings count, and ValueError or MemoryError is a refusal.
        exact: The exact result for a value.
        tolerance: Largest accepted error.
        tolerance_from: ASKED, DOCUMENTED or DEFAULTED.
        error: Difference of ``answer`` and ``exact``.
    """

    method: str
    swept: str
    values: tuple[Value, ...]
    answer: Callable[..., Answer]
    exact: Callable[..., Tensor]
    tolerance: float = DEFAULT
    tolerance_from: str = DEFAULTED
    error: Callable[[Tensor, Tensor], float] = relative

    @property
    def name(self) -> str:
        """Method and swept quantity."""
        return f"{self.method}: {self.swept}"

    def thinned(self, count: int) -> "Sweep":
        """The same sweep at ``count`` of its values, evenly chosen, with both ends."""
        last = len(self.values) - 1
        if last < count:
            return self
        return replace(self, values=tuple(self.values[round(i * last / (count - 1))] for i in range(count)))

    def points(self) -> list[Point]:
        """Measure all values in their order."""
        points, before = [], ""
        for value in self.values:
            point, chosen = self._point(value, before)
            points.append(point)
            before = chosen or before
        return points

    def _point(self, value: Value, before: str) -> tuple[Point, str]:
        """The point of one value, and the chosen method; ``before`` is that of the previous value."""
        row = self.method, self.swept, value
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                answer = self.answer(value)
            except (ValueError, MemoryError) as refusal:
                nothing = math.nan, math.nan, "refused", _beginning(refusal)
                asked = float(value) if self.swept == "tolerance" else self.tolerance
                return Point(*row, asked, self.tolerance_from, *nothing), ""
        said, words = "nothing", answer.chosen
        if caught:
            said, words = "warned", _beginning(caught[0].message)
        elif before and answer.chosen != before:
            said = "switched"
        tolerance = self.tolerance if answer.tolerance is None else answer.tolerance
        with warnings.catch_warnings(action="ignore"):  # warnings of the reference are not those of the method
            error = self.error(answer.result, self.exact(value))
        # A result that is not finite is wrong by any measure.
        measured = math.inf if math.isnan(error) else error
        return Point(*row, tolerance, self.tolerance_from, answer.predicted, measured, said, words), answer.chosen


def _beginning(message: object) -> str:
    return str(message).split("\n")[0][:160]
