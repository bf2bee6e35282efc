"""The part of a report page that shows a study."""

from holotorch.experiments.runs.markup import element, figure, heading
from holotorch.experiments.runs.record import RunRecord


def study_section(record: RunRecord) -> list[str]:
    """HTML of a study: its curves and its table; of an interrupted one, how many cases are complete."""
    summary = record.summary
    parts = [heading(f"{record.title}: {summary['study']}", summary["status"])]
    if source := record.picture("table"):
        parts.append(figure(source, "Each line is a method, each point the mean over the photographs", "wide"))
    if text := record.text("table.txt"):
        parts.append(element("pre", text))
    if "cases" in summary:
        parts.append(element("p", f"{summary['cases']} cases are complete; the table follows when all are.", "warn"))
    return parts
