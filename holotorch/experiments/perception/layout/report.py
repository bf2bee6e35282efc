"""The section of a report page for a layout over a wide field."""

from holotorch.experiments.runs.page import element, figure, heading, table
from holotorch.experiments.runs.record import RunRecord


def layout_section(record: RunRecord) -> list[str]:
    """HTML parts: the picture, its description, the table of icon sizes, and the table of displays."""
    rows = record.summary["items"]
    parts = [heading(record.title, record.summary["status"])]
    caption = "Icons with their sizes. Icons framed in grey are not scaled"
    caption += "; * extrapolated." if any(row["note"].startswith("extrapolated") for row in rows) else "."
    if source := record.picture("layout"):
        parts.append(figure(source, caption, "wide"))
    parts.append(element("pre", "\n".join(record.summary["lines"])))
    displays = "Displays, those of thesis Table 2.1 and your own: greatest eccentricity at which they show the sizes"
    for title, lines in (("Sizes", rows), (displays, record.rows("displays.csv"))):
        parts.append(element("h2", title))
        if lines:
            names = [key.replace("_", " ") for key in lines[0]]
            parts.append(table(names, [[str(value) for value in line.values()] for line in lines]))
    return parts
