"""The section of a report page for what an observer sees."""

from statistics import fmean
from typing import Any

from holotorch.experiments.planning.errors import error_line, error_sentence
from holotorch.experiments.runs.page import element, figure, heading, plain, table
from holotorch.experiments.runs.record import RunRecord

_COLOURS = (
    "Colours are those of light of {} nm, mixed to white. The pictures of the volume itself (holotorch check "
    "--preview, kind volume) have the colours of its transfer function as a screen shows them, which differ."
)
_COLUMNS = {
    "focus_mm": "focus (mm)",
    "wavelengths": "wavelengths of the spectrum",
    "followed": "of them propagated",
    "contrast_predicted": "predicted contrast",
    "ssim": "SSIM",
    "grain_y": "grain along y",
    "grain_x": "grain along x",
    "best_fwhm_nm_by_formula": "best width of the spectrum by formula (nm)",
}
_PREDICTED = (
    "The predicted contrast is that of an evenly filled round pupil and fully developed speckle; a scene with "
    "structure has neither and measures lower. Grains are measured in samples of the picture, with the scene divided "
    "out; anisotropy is their length over their width."
)


def by_wavelength(row: dict[str, Any], wavelengths: list[float]) -> dict[str, Any]:
    """Replace each list in a table row by columns such as ``contrast_636nm``, one for each of ``wavelengths`` in nm."""
    flat = {}
    for key, value in row.items():
        columns = [f"{key}_{wavelength:.0f}nm" for wavelength in wavelengths] if isinstance(value, list) else [key]
        flat |= dict(zip(columns, value if isinstance(value, list) else [value], strict=True))
    return flat


def eye_outcome(summary: dict[str, Any]) -> list[str]:
    """Lines to print: scores of each light source, mean over foci and colours, and the errors of the calculation."""
    rows: list[dict[str, Any]] = summary.get("rows", [])  # none after an early interruption
    each = []
    for source in dict.fromkeys(row["source"] for row in rows):
        scores = [
            _mean([v for row in rows if row["source"] == source for v in row[key]]) for key in ("ssim", "contrast")
        ]
        each.append("{}: SSIM {}, speckle contrast {}".format(source.replace("_", " "), *scores))
    text = (
        "Result     of the picture on the retina, against the mean of other realisations, mean over foci and colours: "
    )
    return [*([text + "; ".join(each)] if each else []), *error_line(summary)]


def _mean(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{fmean(known):.2f}" if known else "-"


def eye_section(run: RunRecord) -> list[str]:
    """HTML of a run: pictures by focus, numbers by source, and the plan."""
    summary, plan = run.summary, run.plan
    parts = [heading(run.title, summary["status"]), element("p", "What the observer sees.")]
    if summary["synthetic"]:
        parts.append(element("p", f"Synthetic volume: {summary['synthetic']}.", "warn"))
    synthetic = ", synthetic volume" if summary["synthetic"] else ""
    captions = {f"comparison_{f}": f"focus {depth:.4g} mm{synthetic}" for f, depth in enumerate(plan["focus_mm"])}
    captions |= {"speckle": "spectrum of the speckle, at the first focus: the scene is divided out"}
    captions |= {"focus": "the eye's focus swept over the scene", "geometry": "geometry and sources"}
    parts += [figure(source, caption, "wide") for name, caption in captions.items() if (source := run.picture(name))]
    if len(summary["wavelengths_nm"]) == 3:
        parts.append(element("p", _COLOURS.format(" / ".join(f"{each:.0f}" for each in summary["wavelengths_nm"]))))
    first = summary["rows"][0]
    at = " / ".join(f"{wavelength:.0f}" for wavelength in summary["wavelengths_nm"])
    parts += [element("p", f"Warning: {warning}.", "warn") for warning in plan.get("warnings", [])]
    cells = [[_cell(value) for value in row.values()] for row in summary["rows"]]
    parts.append(table([_COLUMNS.get(str(key), str(key).replace("_", " ")) for key in first], cells))
    parts.append(element("p", f"Where a cell has several values, they are those at {at} nm. {_PREDICTED}"))
    if sentence := error_sentence(summary):
        parts.append(element("p", sentence))
    return [*parts, element("h2", "Plan"), element("pre", plan.get("text", plain(plan)))]


def _cell(value: Any) -> str:
    if not isinstance(value, list):
        return plain(value).replace("_", " ")
    return "\u00a0/\u00a0".join("-" if item is None else f"{item:.3g}" for item in value)
