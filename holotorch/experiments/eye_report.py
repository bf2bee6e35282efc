"""The part of a report page that shows what an observer sees."""

import html
from collections.abc import Callable
from typing import Any

from holotorch.experiments.markup import figure, plain, table


def eye_section(title: str, summary: dict[str, Any], plan: dict[str, Any], picture: Callable[[str], str]) -> list[str]:
    """HTML of a run: pictures by focus, numbers by source, plan; ``picture`` gives an image's data URL or nothing."""
    status = "" if summary["status"] == "complete" else f' <span class="warn">{summary["status"]}</span>'
    parts = [f"<h1>{html.escape(title)}{status}</h1>", "<p>What the observer sees.</p>"]
    if summary["synthetic"]:
        parts.append(f'<p class="warn">Synthetic volume: {html.escape(summary["synthetic"])}.</p>')
    for f, depth in enumerate(plan["focus_mm"]):
        if source := picture(f"comparison_{f}"):
            parts.append(figure(source, f"focus {depth:.4g} mm", "wide"))
    names = [key.replace("_", " ") for key in summary["rows"][0]]
    parts.append(table(names, [[html.escape(plain(value)) for value in row.values()] for row in summary["rows"]]))
    parts.append(f"<h2>Plan</h2><pre>{html.escape(plan.get('text', plain(plan)))}</pre>")
    return parts
