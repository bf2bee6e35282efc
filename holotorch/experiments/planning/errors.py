"""Predicted errors beside measured ones, for summary.json and the report."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from holotorch.experiments.planning.duration import duration

# Longest time of a measurement, in seconds on the reference machine of ``machine``: every machine measures the same.
LIMIT = 30.0


@dataclass(frozen=True)
class Comparison:
    """The error of a part as the plan predicts it, and as it was measured against a more exact reference.

    Attributes:
        part: In words.
        predicted: Relative L2 error.
        measured: The same, or None if it was not measured.
        note: What was compared with what, or why nothing was.
    """

    part: str
    predicted: float
    measured: float | None
    note: str


def not_measured(part: str, predicted: float, seconds: float) -> Comparison:
    """A part whose reference is not affordable; ``seconds`` is its predicted time."""
    return Comparison(part, predicted, None, f"not measured: reference would take {duration(seconds)}")


def error_values(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Entries of summary.json; the errors of the measured parts are added in squares."""
    measured = [comparison for comparison in comparisons if comparison.measured is not None]
    return {
        "predicted_error": math.hypot(*(comparison.predicted for comparison in measured or comparisons)),
        "measured_error": math.hypot(*(comparison.measured or 0.0 for comparison in measured)) if measured else None,
        "errors": [vars(comparison) for comparison in comparisons],
    }


def measured_values(measure: Callable[[], Sequence[Comparison]]) -> dict[str, Any] | None:
    """Entries of summary.json; empty if memory is short, since the rest of the run is complete by then.

    None if a signal interrupts the measurement: the run is then not complete, and resuming it measures the errors.
    """
    try:
        return error_values(measure())
    except KeyboardInterrupt:
        return None
    except MemoryError:
        return {}
    except RuntimeError as error:  # raised by torch if memory runs out
        if not re.search(r"(?i)can.t allocate memory|out of memory", str(error)):
            raise
        return {}


def error_line(summary: dict[str, Any]) -> list[str]:
    """The errors in a summary as a line to print; none for a summary without any."""
    if "predicted_error" not in summary:
        return []
    predicted, measured = summary["predicted_error"], summary["measured_error"]
    words = "not measured" if measured is None else f"{100 * measured:.2g} % measured"
    parts = summary.get("errors", ())
    compared = sum(part["measured"] is not None for part in parts)
    words += f", {100 * predicted:.2g} % predicted"
    words += f" in {compared} of {len(parts)} parts, the others unmeasured" if 0 < compared < len(parts) else ""
    return [f"Error      of the calculation itself: {words}; the report names its parts"]


def error_sentence(summary: dict[str, Any]) -> str:
    """The line of a report about the errors in a summary; empty for a summary without any."""
    parts = []
    for error in summary.get("errors", ()):
        measured = "" if error["measured"] is None else f"{error['measured']:.1e} measured: "
        parts.append(f"{error['part']} {error['predicted']:.1e} predicted, {measured}{error['note']}")
    return f"Relative L2 error. {'; '.join(parts)}." if parts else ""
