"""The section of a report page for a joint run."""

import math
from typing import Any

from holotorch.experiments.joint.budget import COARSE_PLANES, FEW_PLANES
from holotorch.experiments.joint.names import NAMES, SETS
from holotorch.experiments.planning.correction import HEAT, PROPAGATION
from holotorch.experiments.planning.errors import error_line, error_sentence
from holotorch.experiments.runs.page import element, figure, heading, plain, table
from holotorch.experiments.runs.record import RunRecord

_PICTURES = {
    "stack": "What an eye sees through the whole pupil, by focus",
    "parallax": "What it sees through half of the pupil; no method was given these views",
    "sweep": "Focus moving through the volume: wanted (left) and shown by the joint correction (right)",
    "phase": "Heater phases",
}


_POOR = 30.0  # dB of the corrected pictures below which a binding limit is named
_POOR_PARTS = 25.0  # dB of the pictures through half pupils below which parts of the pupil are named
_CLOSE = 0.5  # dB by which the error of the calculation changes a PSNR, above which both are named
_LITTLE = 0.05  # share of the light in pupil and window below which that is said beside the scores


def joint_outcome(summary: dict[str, Any]) -> list[str]:
    """Lines to print: PSNR of the joint correction and of the best other method, and the errors of the calculation."""
    methods: dict[str, Any] = summary["methods"]
    corrected = methods["joint"]
    scores = [
        f"{_score(summary, corrected, key)} {SETS[key]}" for key in ("stack", "half") if f"{key}_psnr" in corrected
    ]
    others = {name: each["stack_psnr"] for name, each in methods.items() if name != "joint"}
    if others:
        best = max(others, key=others.__getitem__)
        ideal = " (no chip shows such fields)" if best == "random" else ""
        scores.append(f"the best other method, {NAMES[best]}{ideal}: {others[best]:.1f} dB at the corrected foci")
        scores += _behind(methods)
    poor = []
    if corrected.get("half_psnr", math.inf) < _POOR_PARTS and corrected["stack_psnr"] > _POOR:
        poor.append(
            "Note       a pupil that moves sees less: eye.parallax=200 eye.per_step=6 corrects parts of the pupil, "
            "too, in more time"
        )
    if (hottest := corrected.get("peak_temperature_K")) is not None:
        scores.append(f"hottest pixel {hottest:.0f} degC above ambient")
    if corrected.get("at_limit") and corrected["stack_psnr"] < _POOR:
        poor.append(
            "Note       the phases are at their limit: a higher one (display.max_temperature or max_phase), more "
            "frames or a narrower spread of the heat come closer"
        )
    error, notes = summary.get("measured_error", summary.get("predicted_error", 0.0)), []
    if error > FEW_PLANES:
        shown = "slices of it" if error > COARSE_PLANES else "thin parts of it broken"
        notes.append(
            f"Warning    the rendering is {error:.0%} off the volume: pictures show {shown}; more planes, or slabs "
            "sampled as often as needed (without view.samples), come closer"
        )
        scores[0] += f", of pictures that are {error:.0%} off the volume"
    return [*notes, f"Result     PSNR {'; '.join(scores)}", *poor, *error_line(summary)]


def _behind(methods: dict[str, Any]) -> list[str]:
    """In words, the views in which another method is ahead of the joint correction, if any."""
    lines = []
    for key, where in SETS.items():
        scores = {name: each[f"{key}_psnr"] for name, each in methods.items() if f"{key}_psnr" in each}
        best = max(scores, key=scores.__getitem__, default="joint")
        if "joint" in scores and scores[best] > scores["joint"]:
            lines.append(f"{where}, {scores['joint']:.1f} dB against {scores[best]:.1f} of: {NAMES[best]}")
    return lines


def _score(summary: dict[str, Any], scores: dict[str, Any], key: str) -> str:
    """The PSNR in words: that of an exact calculation of heat and light, and the run's own where it is another one.

    The error of the calculation is added to that of the pictures in squares, since neither knows of the other.
    """
    errors = {each["part"]: each["measured"] for each in summary.get("errors", ())}
    own = math.hypot(errors.get(HEAT) or 0.0, errors.get(PROPAGATION) or 0.0)  # predicted ones may be much too large
    off = scores.get(f"{key}_error", math.inf)  # runs of before have none
    lost = 20 * math.log10(math.hypot(1, own / off)) if off > 0 else math.inf
    score = scores[f"{key}_psnr"]
    if not _CLOSE < lost < math.inf:
        return f"{score:.1f} dB"
    return f"{score - lost:.1f} dB by exact heat and light ({score:.1f} dB by the run's own calculation)"


def joint_section(record: RunRecord) -> list[str]:
    """HTML of a run: scores of the methods, pictures, scores by view, and the plan."""
    summary, plan = record.summary, record.plan
    parts = [heading(record.title, summary["status"])]
    synthetic = ""
    if summary["synthetic"]:
        parts.append(element("p", f"Synthetic volume: {summary['synthetic']}.", "warn"))
        synthetic = ", synthetic volume"
    parts += [element("p", note, "warn") for note in plan.get("notes", [])]
    if (light := summary["methods"].get("joint", {}).get("light_in_pupil", 1.0)) < _LITTLE:
        words = (
            f"Warning: only {light:.1%} of the light reaches the pupil and the window (said below {_LITTLE:.0%}); "
            "scores do not count the rest. light_weight asks the solver for more, and a wider eye.pupil takes more."
        )
        parts.append(element("p", words, "warn"))
    parts += [element("p", _WORDS), _methods(summary["methods"])]
    if words := error_sentence(summary):
        parts.append(element("p", words))
    parts += [
        figure(source, caption + synthetic, "wide")
        for name, caption in _PICTURES.items()
        if (source := record.picture(name))
    ]
    if rows := record.rows("views.csv"):
        parts += [element("h2", "Joint correction, view by view"), _views(rows)]
    rows = [[name.replace("_", " "), plain(plan[name])] for name in plan if name != "notes"]
    return [*parts, element("h2", "Plan"), table(["", ""], rows, head=False)]


_WORDS = (
    "PSNR of the intensity over all images of a set together, mean SSIM, and contrast: the standard deviation of "
    "shown / wanted where the wanted image is bright. One scale for each colour serves all views. Light is the "
    "fraction of the emitted light that enters the pupil and lands in the window. The solver was given the views "
    "called trained, and not those called held."
)


def _views(rows: list[dict[str, str]]) -> str:
    columns = ["view", "use", "focus", "pupil (sines: y, x; radius)", "wavelength", "PSNR", "SSIM", "contrast"]
    lines = []
    for row in rows:
        wavelength = float(row["wavelength_m"])
        y, x, radius = (float(row[f"pupil_{name}_per_m"]) * wavelength for name in ("y", "x", "radius"))
        pupil = f"{y:.4f}, {x:.4f}; {radius:.4f}{_covered(row)}"
        place = row["view"], row["use"], f"{1e3 * float(row['focus_m']):.3f} mm", pupil
        lines.append([*place, f"{1e9 * wavelength:.0f} nm", f"{row['psnr']} dB", row["ssim"], row["contrast"]])
    return table(columns, lines)


def _covered(row: dict[str, str]) -> str:
    """Where the covered half of a pupil lies, if it has one."""
    y, x = float(row["covered_y"]), float(row["covered_x"])
    return f", half covered towards {math.degrees(math.atan2(y, x)):.0f} deg" if y or x else ""


def _methods(methods: dict[str, dict[str, Any]]) -> str:
    columns = ["method", *(f"{words}: dB / SSIM / contrast" for words in SETS.values()), "light"]
    columns += ["largest phase", "hottest pixel (degC above ambient)", "seconds"]
    rows = []
    for name, each in methods.items():
        scores = [
            f"{each[f'{key}_psnr']:.1f} / {each[f'{key}_ssim']:.3f} / {each[f'{key}_contrast']:.3f}"
            if f"{key}_psnr" in each
            else ""
            for key in SETS
        ]
        peak = f"{each['peak_phase_pi']:.2f} pi" if "peak_phase_pi" in each else ""
        hottest = f"{each['peak_temperature_K']:.0f}" if each.get("peak_temperature_K") is not None else ""
        rows.append([NAMES[name], *scores, f"{each['light_in_pupil']:.1%}", peak, hottest, f"{each['seconds']:.1f}"])
    return table(columns, rows)
