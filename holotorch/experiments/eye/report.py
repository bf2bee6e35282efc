"""The part of a report page that shows what an observer sees."""

from collections.abc import Callable
from typing import Any

from holotorch.experiments.runs.markup import element, figure, heading, plain, table

_PREDICTED = (
    "The predicted contrast is that of an evenly filled round pupil and fully developed speckle; a scene with "
    "structure has neither and measures lower."
)


def by_wavelength(row: dict[str, Any], wavelengths: list[float]) -> dict[str, Any]:
    """A row of a run for a table: what is known for each wavelength (nm) in a column of its own, as contrast_636nm."""
    flat = {}
    for key, value in row.items():
        several = isinstance(value, list)
        flat |= (
            {f"{key}_{w:.0f}nm": each for w, each in zip(wavelengths, value, strict=True)} if several else {key: value}
        )
    return flat


def eye_section(title: str, summary: dict[str, Any], plan: dict[str, Any], picture: Callable[[str], str]) -> list[str]:
    """HTML of a run: pictures by focus, numbers by source, plan; ``picture`` gives an image's data URL or nothing."""
    parts = [heading(title, summary["status"]), "<p>What the observer sees.</p>"]
    if summary["synthetic"]:
        parts.append(element("p", f"Synthetic volume: {summary['synthetic']}.", "warn"))
    for f, depth in enumerate(plan["focus_mm"]):
        if source := picture(f"comparison_{f}"):
            kind = ", synthetic volume" if summary["synthetic"] else ""
            parts.append(figure(source, f"focus {depth:.4g} mm{kind}", "wide"))
    for name, caption in (("focus", "the eye's focus swept over the scene"), ("geometry", "geometry and sources")):
        if source := picture(name):
            parts.append(figure(source, caption, "wide"))
    first = summary["rows"][0]
    at = f" at {' / '.join(f'{wave:.0f}' for wave in summary['wavelengths_nm'])} nm"
    names = [key.replace("_", " ") + (at if isinstance(first[key], list) else "") for key in first]
    parts.append(table(names, [[_cell(value) for value in row.values()] for row in summary["rows"]]))
    parts.append(element("p", _PREDICTED))
    parts.append("<h2>Plan</h2>" + element("pre", plan.get("text", plain(plan))))
    return parts


def _cell(value: Any) -> str:
    return " / ".join(f"{each:.3g}" for each in value) if isinstance(value, list) else plain(value)
