"""Report of a measurement: its numbers beside those of the dissertation, and what they mean and do not mean."""

from collections.abc import Mapping
from typing import Any

from holotorch.experiments.runs.page import element, figure, heading, table
from holotorch.experiments.runs.record import RunRecord
from holotorch.experiments.tracking.report import MOVED

_GRID = [
    ("acc_mm", "Acc: mean error of the distances to the reference (mm)"),
    ("in_plane_mm", "mean error in the plane of the sheet, relative to the reference (mm)"),
    ("in_space_mm", "the same with the error along the sheet's normal (mm)"),
    ("median_mm", "after the best rigid fit: median (mm)"),
    ("p95_mm", "after the best rigid fit: 95th percentile (mm)"),
    ("largest_mm", "after the best rigid fit: largest (mm)"),
    ("points", "points"),
]
# Keys of the summary and their texts, in the order of the table.
ROWS: dict[str, list[tuple[str, str]]] = {
    "still": [
        ("s_rms_mm", "S_RMS: root mean square change from frame to frame (mm)"),
        ("sd_mm", "sd: root mean square distance from the mean (mm)"),
        ("stated_sd_mm", "median deviation that the tracker states (mm)"),
        ("differences", "pairs of neighbouring frames"),
    ],
    "grid2d": _GRID,
    "grid3d": _GRID,
    "latency": [
        ("lag_ms", "lag of the frames' times behind the reference (ms)"),
        ("sd_ms", "its standard deviation, for independent noise (ms)"),
        ("tracker_ms", "median time of the tracker for a frame (ms)"),
        ("total_ms", "lag and tracker (ms)"),
        ("correlation", "correlation of the curves"),
        ("overlap_s", "time that both cover (s)"),
    ],
    "edges": [
        ("rms_px", "root mean square residual of the edges (px)"),
        ("frames_used", "frames in the fit"),
        ("frames_left_out", "frames left out, whose edges disagree with the others"),
    ],
    "tone": [
        ("photographs", "photographs"),
        ("from_srgb", "largest difference from the sRGB curve, of the light of level 255"),
    ],
    "prediction": [
        ("rms_mm", "root mean square error (mm)"),
        ("median_mm", "median (mm)"),
        ("p95_mm", "95th percentile (mm)"),
    ],
}
# Numbers of the dissertation by protocol and key.
THESIS: dict[str, dict[str, str]] = {
    "still": {"s_rms_mm": "0.33"},
    "grid2d": {"in_plane_mm": "0.58"},
    "grid3d": {"acc_mm": "0.49, 0.93, 1.12; mean 0.85"},
    "latency": {"total_ms": "95.01"},
    "prediction": {},
    "edges": {},
    "tone": {},
}
_ACC = (
    "Acc compares distances to the reference point only (Sec. 3.5.3). It is blind to an error that is the same at all "
    "points, such as that of a wrong distance from the tip to the bands, and to errors across the direction to the "
    "reference. The error after the best rigid fit is blind to a shift and a turn of the whole grid. Neither says how "
    "far the tip is from its true place in the camera's frame; both include how well the hand hit the points. The mean "
    "is over the points without the reference, whose error is zero by construction; the dissertation divides by all. "
)
MEANING: dict[str, str] = {
    "still": "S_RMS (Eq. 3.13) is how much the tip jumps from one frame to the next, unfiltered, with the catheter at "
    "rest. For independent noise it is sqrt(2) times sd; a drift raises sd alone. Neither is an error of the place: a "
    "tip that is off by a centimetre in all frames alike has the same S_RMS.",
    "grid2d": _ACC + "The error in the plane (Sec. 3.5.2) takes the directions of the sheet from a chessboard printed "
    "on it, and thus includes a turn of the grid.",
    "grid3d": _ACC,
    "latency": "The lag is where the distances from the first place, by the tracker and by the reference, correlate "
    "best (Sec. 3.5.4). It holds for the time stamps of the frames, relative to the reference's own latency, and only "
    "if both have one clock. The time of the tracker comes on top, and that of a display is not in it.",
    "edges": "catheter.yaml in this folder has the measured positions of the edges: use it in place of the nominal "
    "one. The deviations hold for independent errors of 0.1 px of the edges (or more, where the residuals say so) in "
    "each frame, and for known distances that are exact. An error that is the same in all frames, as of a highlight or "
    "of the camera's focal length, is in none of them; neither is one of the known distances, which scales or shifts "
    "all others. Frames that the tracker refuses because their edges contradict the nominal catheter are used as well.",
    "tone": "camera.yaml in this folder is the camera's file with the measured tone curve, by which the tracker turns "
    "levels into light. It holds for the camera's settings in these photographs: gain, contrast and gamma fixed, and "
    "automatic exposure and white balance off. It is the same for all three colours, and its lowest and highest three "
    "levels are extrapolated.",
    "prediction": "A pose is seen later than the frame was taken, and the hand has moved on. The error is the distance "
    "between the tip that is shown and the tip that the tracker measures for that time. Constant velocity is what the "
    "page of holotorch stream --view does; one euro is the filter of holotorch stream --smooth with its prediction. "
    "The later tip has the tracker's own noise, which all methods have alike, and its own bias, of which this says "
    "nothing. Which method is best depends on the motion: record one like that of your use.",
}
_NEEDS_BOARD = (
    "The dissertation's error in the plane (0.58 mm) is not here: it needs the directions of the sheet, from a "
    "chessboard on the same sheet that the first frames show. holotorch measure grid2d --print FILE.svg "
    "writes such a sheet."
)


def measure_section(record: RunRecord) -> list[str]:
    """HTML of a measurement, from the files of its folder."""
    summary, protocol = record.summary, record.summary["protocol"]
    parts = [heading(f"{record.title}: {protocol}", summary["status"])]
    if "failure" in summary:
        parts.append(element("p", summary["failure"], "warn"))
    about = f"Grid: {summary['grid']}." if "grid" in summary else ""
    about = f"Shown {summary['delay_ms']:g} ms after capture." if "delay_ms" in summary else about
    text = f"{', '.join(summary['sources'])}: {summary['answered']} of {summary['frames']} frames have a pose. "
    text = text if summary["frames"] else f"{', '.join(summary['sources'])}. "
    parts.append(element("p", text + about))
    faces = summary.get("faces", [summary])
    names = [str(face["face"]) for face in faces] if len(faces) > 1 else ["here"]
    if "methods" in summary:
        faces = summary["methods"]
        names = [method["method"] for method in faces]
    columns = [*zip(names, faces, strict=True), *([("mean", summary)] if len(summary.get("faces", [])) > 1 else [])]
    cells = [
        [label, *(_number(face.get(key)) for _, face in columns), THESIS[protocol].get(key, "")]
        for key, label in ROWS[protocol]
        if any(key in face for _, face in columns) or key in THESIS[protocol]
    ]
    parts.append(table(["", *(name for name, _ in columns), "dissertation"], cells))
    if "edges" in summary:
        names = ("nominal_mm", "measured_mm", "sd_mm", "change_mm")
        rows = [[str(edge["edge"]), *(f"{edge[name]:.3f}" for name in names)] for edge in summary["edges"]]
        parts.append(table(["edge", *(name.replace("_mm", " (mm)") for name in names)], rows))
    if "stages" in summary:
        rows = [[stage["stage"], f"{stage['milliseconds']:.2f}"] for stage in summary["stages"]]
        parts.append(table(["stage of the tracker", "mean time per frame (ms)"], rows))
    parts.append(element("p", MEANING[protocol]))
    if protocol == "grid2d" and not any("in_plane_mm" in face for face in faces):
        parts.append(element("p", _NEEDS_BOARD))
    parts += [element("p", f"Note: {note}.") for note in summary["notes"]]
    if source := record.picture("measure"):
        parts.append(figure(source, summary["caption"], "wide"))
    return parts


def verdict(summary: Mapping[str, Any]) -> str:
    """The main numbers in one line, with those of the dissertation."""
    protocol = summary["protocol"]
    if "methods" in summary:
        each = (f"{method['method']} {_number(method['rms_mm'])} mm" for method in summary["methods"])
        return f"{protocol:10} rms of a delay of {summary['delay_ms']:g} ms: " + "; ".join(each)
    if "edges" in summary:
        each = (f"{edge['measured_mm']:.2f} +- {edge['sd_mm']:.2f} mm" for edge in summary["edges"])
        return f"{protocol:10} " + "; ".join(each)
    if "from_srgb" in summary:
        return f"{protocol:10} differs from sRGB by {_number(summary['from_srgb'])} of the light of level 255 at most"
    faces = summary.get("faces", [])
    values = dict(summary) | (faces[0] if len(faces) == 1 else {})
    sentences = []
    for key, text in ROWS[protocol]:
        if isinstance(value := values.get(key), float) and key.endswith(("_mm", "_ms")):
            beside = THESIS[protocol].get(key)
            name = text.replace(" (mm)", "").replace(" (ms)", "")
            sentences.append(
                f"{name} {_number(value)} {key.rsplit('_')[-1]}" + (f" (dissertation {beside})" if beside else "")
            )
    moved = any(str(note).startswith(MOVED) for note in summary.get("notes", ()))
    return (
        f"{protocol:10} " + "; ".join(sentences[:4]) + "; a catheter that moves has no stability: see the Note" * moved
    )


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
