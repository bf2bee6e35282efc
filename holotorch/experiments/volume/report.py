"""The part of a report page that shows a volume's run."""

from collections.abc import Callable
from typing import Any

from holotorch.experiments.runs.markup import element, figure, heading, plain, table

_FIGURES = {
    "rendering": "Direct volume rendering",
    "in_focus": "Hologram, every ray refocused at its own depth",
}


def volume_section(
    title: str, summary: dict[str, Any], plan: dict[str, Any], picture: Callable[[str], str]
) -> list[str]:
    """HTML of a run: pictures side by side, scores, time and plan; ``picture`` gives an image's data URL or nothing."""
    parts = [heading(title, summary["status"])]
    if summary["synthetic"]:
        parts.append(element("p", f"Synthetic volume: {summary['synthetic']}.", "warn"))
    parts.append('<div class="row">')
    captions = dict(_FIGURES)
    depths: list[float] = summary["refocused_m"]
    captions |= {f"focus_{f}": f"Refocused at {depth * 1e3:.4g} mm" for f, depth in enumerate(depths)}
    for name, caption in captions.items():
        if source := picture(name):
            parts.append(figure(source, caption + (", synthetic" if summary["synthetic"] else ""), "picture"))
    parts.append("</div>")
    if source := picture("depth"):
        parts.append(figure(source, "Mean depth of what a ray sees", "wide"))
    parts.append(_scores(summary, depths))
    parts.append(element("p", _cost(summary)))
    shown = {name.replace("_", " "): value for name, value in plan.items() if name not in ("notes", "holograms")}
    rows = [[name, plain(value)] for name, value in shown.items()]
    rows += [[f"{each['wavelength_nm']:.0f} nm", plain(each)] for each in plan["holograms"]]
    parts.append("<h2>Plan</h2>" + table(["", ""], rows, head=False))
    return parts + [element("p", note, "warn") for note in plan["notes"]]


def _scores(summary: dict[str, Any], depths: list[float]) -> str:
    names = ["sources near", *(f"refocused at {depth * 1e3:.4g} mm" for depth in depths)]
    rows = [
        [f"{depth * 1e3:.4g} mm", *("" if value is None else f"{value:.3f}" for value in errors)]
        for depth, errors in zip(depths, summary["error_of_band_at_depth"], strict=True)
    ]
    scores = [
        f"SSIM of the picture in focus to the rendering {summary['ssim_in_focus']:.3f}"
        if "ssim_in_focus" in summary
        else "",
        f"{summary['realisations']} realisation(s) of the phases",
        "" if summary["speckle_contrast"] is None else f"speckle contrast {summary['speckle_contrast']:.2f}",
    ]
    words = "; ".join(score for score in scores if score)
    return element("p", f"{words}. Relative error of each part of the scene, by focus:") + table(names, rows)


def _cost(summary: dict[str, Any]) -> str:
    share = summary["rendering_seconds"] / max(summary["seconds"], 1e-9)
    return (
        f"Holograms took {summary['seconds']:.2f} s, {100 * share:.0f} % of it for rendering, and refocusing them "
        f"{summary['refocus_seconds']:.2f} s. Peak memory {summary['peak_memory_bytes'] / 1e9:.2f} GB. Waves are "
        "exp(+ikr) / r: the hologram is that of a scene behind it; its conjugate forms a real image in front."
    )
