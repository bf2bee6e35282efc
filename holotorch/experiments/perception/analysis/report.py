"""The part of a report page that shows the analysis of a perception study."""

from typing import Any

from holotorch.experiments.runs.markup import element, figure, heading, table
from holotorch.experiments.runs.record import RunRecord

_CAPTIONS = {
    "time_surface": "Fig. 2.3: quartiles of the perception time",
    "time_map": "Fig. 2.4: median perception time of all conditions",
    "participant": "Fig. 2.5: times of one participant",
    "time_slices": "Fig. 2.6: perception time over eccentricity",
    "scale_lines": "Fig. 2.7: equal-efficiency scales",
    "power": "Power of the study",
}


def analysis_section(record: RunRecord) -> list[str]:
    """HTML of an analysis: what it found in words, its lines, its figures, and the power of the study."""
    summary = record.summary
    parts = [heading(record.title, summary["status"]), element("pre", "\n".join(summary["lines"]))]
    parts.append(_table(summary["rows"]))
    for name, caption in _CAPTIONS.items():
        if source := record.picture(name):
            parts.append(figure(source, caption, "wide"))
    return parts + ([_table(summary["power"])] if summary["power"] else [])


def _table(rows: list[dict[str, Any]]) -> str:
    def cell(value: Any) -> str:
        return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)

    return table([key.replace("_", " ") for key in rows[0]], [[cell(value) for value in row.values()] for row in rows])
