"""The part of a report page that shows the analysis of a perception study."""

from typing import Any

from holotorch.experiments.runs.page import element, figure, heading, table
from holotorch.experiments.runs.record import RunRecord

_CAPTIONS = {
    "time_surface": "Fig. 2.3: quartiles of the perception time",
    "time_map": "Fig. 2.4: median perception time of all conditions",
    "participant": "Fig. 2.5: times of one participant",
    "time_slices": "Fig. 2.6: perception time over eccentricity",
    "scale_lines": "Fig. 2.7: equal-efficiency scales",
    "power": "Power of the study",
}


def analysis_outcome(summary: dict[str, Any]) -> list[str]:
    """A line to print for each target: the size at which a pattern at the side is perceived as soon as the target."""
    people = f"{summary['participants']} {'simulated ' if summary['simulated'] else ''}participants"
    return [
        f"Result     E deg from the centre, a pattern of {row['alpha']:.3g} E {row['beta']:+.3g} deg is perceived "
        f"as fast as {row['target']} ({people})"
        for row in summary["rows"]
        if row["alpha"] is not None
    ]


def analysis_section(record: RunRecord) -> list[str]:
    """HTML of an analysis: the results in words and numbers, the figures, and the power of the study."""
    summary = record.summary
    parts = [heading(record.title, summary["status"]), element("pre", "\n".join(summary["lines"]))]
    parts.append(_results(summary["rows"]))
    for name, caption in _CAPTIONS.items():
        if source := record.picture(name):
            parts.append(figure(source, caption, "wide"))
    if power := summary["power"]:
        parts.append(table([_words(key) for key in power[0]], [[_cell(v) for v in row.values()] for row in power]))
    return parts


def _results(rows: list[dict[str, Any]]) -> str:
    """A table with one column per target and one line per quantity, without quantities that no target has."""
    lines = [[_words(key), *(_cell(row[key]) for row in rows)] for key in rows[0]]
    (_, *targets), *lines = lines
    return table(["target", *targets], [line for line in lines if any(line[1:])])


def _words(key: str) -> str:
    return key.replace("_", " ")


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
