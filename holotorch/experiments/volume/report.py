"""The section of a report page for a volume's run."""

from typing import Any

from holotorch.experiments.planning.errors import error_line, error_sentence
from holotorch.experiments.runs.page import element, figure, heading, plain, table
from holotorch.experiments.runs.record import RunRecord

# What the names of the methods and of the edges of a cone of light mean, for plans and reports.
METHODS = "axial nodes: a few planes stand for all planes; convolution: the light of each plane is propagated by itself"
EDGES = {
    "taper": "each point lights a cone, with a soft edge",
    "band": "each point lights a cone, with a sharp edge in frequency",
    "box": "each point lights a rectangular cone, with a sharp edge",
    "disc": "each point lights a round cone, with a sharp edge",
    "full": "each point lights all pixels",
}
_CAPTIONS = {
    "rendering": "Direct volume rendering",
    "in_focus": "Hologram, every ray refocused at its own depth",
}


def volume_outcome(summary: dict[str, Any]) -> list[str]:
    """Lines to print: how the refocused hologram compares with the rendering, and the errors of the calculation."""
    if summary.get("nothing_visible"):
        return ["Result     nothing of the volume is visible, so there is no score: change transfer"]
    scores = []
    if "ssim_in_focus" in summary:
        scores.append(
            f"SSIM {summary['ssim_in_focus']:.3f} of the hologram, refocused, with the rendering of the volume"
        )
    if summary["speckle_contrast"] is not None:
        count = summary["realisations"]
        less = "; the mean of more of them (report.seeds) has less" if count == 1 else ""
        scores.append(
            f"speckle contrast {summary['speckle_contrast']:.2f} in {count} realisation(s) of the phases{less}"
        )
    return [*([f"Result     {', '.join(scores)}"] if scores else []), *error_line(summary)]


def volume_section(record: RunRecord) -> list[str]:
    """HTML of a run: pictures side by side, scores, time and plan."""
    summary, plan = record.summary, record.plan
    parts = [heading(record.title, summary["status"])]
    if summary["synthetic"]:
        parts.append(element("p", f"Synthetic volume: {summary['synthetic']}.", "warn"))
    depths: list[float] = summary["refocused_m"]
    captions = _CAPTIONS | {f"focus_{f}": f"Refocused at {depth * 1e3:.4g} mm" for f, depth in enumerate(depths)}
    synthetic = ", synthetic" if summary["synthetic"] else ""
    parts.append('<div class="row">')
    for name, caption in captions.items():
        if source := record.picture(name):
            parts.append(figure(source, caption + synthetic, "picture"))
    parts.append("</div>")
    if source := record.picture("depth"):
        parts.append(figure(source, "Mean depth along each ray", "wide"))
    parts += [element("p", f"Warning: {warning}.", "warn") for warning in plan.get("warnings", [])]
    parts += [_scores(summary, depths), element("p", _cost(summary))]
    if sentence := error_sentence(summary):
        parts.append(element("p", sentence))
    rows = [
        [name.replace("_", " "), plain(plan[name])] for name in plan if name not in ("notes", "warnings", "holograms")
    ]
    rows += [[f"{hologram['wavelength_nm']:.0f} nm", plain(hologram)] for hologram in plan["holograms"]]
    parts += [element("h2", "Plan"), table(["", ""], rows, head=False)]
    words = f"{METHODS}. The cone of light of a point is as wide as the pixels can bend light."
    parts.append(element("p", words[0].upper() + words[1:]))
    return parts + [element("p", note, "warn") for note in plan["notes"]]


def _scores(summary: dict[str, Any], depths: list[float]) -> str:
    names = ["sources near", *(f"refocused at {depth * 1e3:.4g} mm" for depth in depths)]
    rows = [
        [f"{depth * 1e3:.4g} mm", *("" if value is None else f"{value:.3f}" for value in errors)]
        for depth, errors in zip(depths, summary["error_of_band_at_depth"], strict=True)
    ]
    scores = [f"{summary['realisations']} realisation(s) of the random phases"]
    if "ssim_in_focus" in summary:
        scores.insert(0, f"SSIM between the picture in focus and the rendering {summary['ssim_in_focus']:.3f}")
    if summary["speckle_contrast"] is not None:
        scores.append(f"speckle contrast {summary['speckle_contrast']:.2f}")
    caption = f"{'; '.join(scores)}. Relative error of each part of the scene, by focus:"
    return element("p", caption) + table(names, rows)


def _cost(summary: dict[str, Any]) -> str:
    share = summary["rendering_seconds"] / max(summary["seconds"], 1e-9)
    return (
        f"Holograms took {summary['seconds']:.2f} s, {100 * share:.0f} % of it for rendering, and refocusing them "
        f"{summary['refocus_seconds']:.2f} s. Peak memory {summary['peak_memory_bytes'] / 1e9:.2f} GB. Waves are "
        "exp(+ikr) / r, so the scene is a virtual image behind the hologram, whose depth is right for an observer in "
        "front of it with view.front=near; the conjugate field forms the scene in front, for view.front=far."
    )
