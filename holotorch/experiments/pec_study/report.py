"""Section of the report page for a study of proximity effect correction."""

from typing import Any

from holotorch.experiments.pec.config import SIGMA_MEANING
from holotorch.experiments.pec_study.config import METHODS
from holotorch.experiments.runs.page import element, figure, heading
from holotorch.experiments.runs.record import RunRecord


def study_outcome(summary: dict[str, Any]) -> list[str]:
    """The line to print for a complete study, whose table the run has printed."""
    if "rows" not in summary:
        return []
    return [
        f"Result     study of {summary['study']}: {summary['rows']} rows, above and in table.csv; drawn in table.png"
    ]


def study_section(record: RunRecord) -> list[str]:
    """HTML of a study: its curves and its table, or the number of complete cases if it was interrupted."""
    summary = record.summary
    parts = [heading(f"{record.title}: {summary['study']}", summary["status"])]
    if source := record.picture("table"):
        caption = "Each line is a method or a number of frames, each point "
        caption += "a median of rounds" if summary["study"] == "time" else "the mean over the photographs"
        parts.append(figure(source, caption, "wide"))
        parts.append(element("p", f"{METHODS}. Sigma: {SIGMA_MEANING}."))
    if text := record.text("table.txt"):
        parts.append(element("pre", text))
    if "cases" in summary:
        parts.append(element("p", f"{summary['cases']} cases are complete; the table follows when all are.", "warn"))
    return parts
