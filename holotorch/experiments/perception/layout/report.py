"""The part of a report page that shows a layout over a wide field."""

from collections.abc import Sequence
from typing import Any

from holotorch.experiments.runs.page import element, figure, heading, table
from holotorch.experiments.runs.record import RunRecord


def layout_section(record: RunRecord) -> list[str]:
    """HTML of a layout: the picture, its description, the sizes, and the displays that can show it."""
    rows = record.summary["items"]
    parts = [heading(record.title, record.summary["status"])]
    caption = "Icons of a notional theme park with their sizes. Icons framed in grey are not scaled"
    caption += "; * extrapolated." if any(row["note"].startswith("extrapolated") for row in rows) else "."
    if source := record.picture("layout"):
        parts.append(figure(source, caption, "wide"))
    parts.append(element("pre", "\n".join(record.summary["lines"])))
    displays = "Displays of thesis Table 2.1: greatest eccentricity at which they show the sizes"
    for title, lines in (("Sizes", rows), (displays, record.rows("displays.csv"))):
        parts += [element("h2", title), *_table(lines)]
    return parts


def _table(rows: Sequence[dict[str, Any]]) -> list[str]:
    names = [key.replace("_", " ") for key in rows[0]] if rows else []
    return [table(names, [[str(value) for value in row.values()] for row in rows])] if rows else []
