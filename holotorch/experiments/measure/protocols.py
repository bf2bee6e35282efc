"""Evaluation of a measurement: from the poses of its sources to numbers, a table and a figure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure import figures
from holotorch.experiments.measure.calibration import catheter_rows, measure_camera, measure_catheter
from holotorch.experiments.measure.config import MeasureSettings
from holotorch.experiments.measure.grid import Grid, accuracy, need_all, visit
from holotorch.experiments.measure.rests import Rests
from holotorch.experiments.measure.source import Track, read_reference
from holotorch.experiments.tracking.report import quantile
from holotorch.tracking.evaluation.latency import latency
from holotorch.tracking.evaluation.prediction import METHODS, prediction_errors


@dataclass
class Result:
    """Numbers, notes, table and figure of a measurement.

    Attributes:
        summary: JSON values; keys name their units.
        table: Name of the CSV table, and its rows.
        figure: PNG, and its caption.
        notes: Remarks for the user.
        saved: Functions that write further files, by the names of these files.
    """

    summary: dict[str, Any]
    table: tuple[str, list[dict[str, Any]]]
    figure: tuple[bytes, str]
    notes: list[str] = field(default_factory=list)
    saved: dict[str, Callable[[Path], None]] = field(default_factory=dict)


def new_rests(settings: MeasureSettings, grid: Grid) -> Rests:
    """The detector of rests of a configuration."""
    rest = settings.rest
    return Rests(grid.spacing / 2, seconds=rest.seconds, frames=rest.frames, spread=rest.spread)


def measure_still(settings: MeasureSettings, tracks: Sequence[Track]) -> Result:
    """Stability, Eq. 3.13 and standard deviation. ConfigError if no two neighbouring frames have a pose."""
    (track,) = tracks
    tracked = track.summary(still=True)
    if "stability" not in tracked:
        raise ConfigError([f"{track.source.name}: {tracked['notes'][-1]}"])
    names = ("frame", "time_s", "tip_x_m", "tip_y_m", "tip_z_m", "tip_sd_m")
    each = zip(range(len(track.poses)), track.log.times, track.log.tips, track.log.deviations, strict=True)
    rows: list[dict[str, Any]] = [dict(zip(names, (i, seconds, *tip, sd), strict=True)) for i, seconds, tip, sd in each]
    caption = "Tip in the camera's frame; gaps are refusals"
    summary = tracked["stability"] | {"stated_sd_mm": tracked["tip_sd_mm"]["median"]}
    return Result(summary, ("tips.csv", rows), (figures.track_figure(track.log), caption), tracked["notes"])


def measure_grid(settings: MeasureSettings, tracks: Sequence[Track]) -> Result:
    """Accuracy over one or several grids. ConfigError if points are missing or the rests do not form the grid."""
    grid = Grid.of(settings)
    faces, rows, notes, visits = [], [], [], {}
    for number, track in enumerate(tracks):
        rests = new_rests(settings, grid)
        for seconds, pose in zip(track.log.times, track.poses, strict=True):
            rests(seconds, pose)
        name = chr(ord("A") + number) if len(tracks) > 1 else track.source.name
        prefix = f"face {name}: " if len(tracks) > 1 else ""
        try:
            visited = visit(rests.completed, grid)
            if not (settings.grid.partial or track.source.live):
                need_all(visited, grid)
            summary, table = accuracy(visited, grid, track.board)
        except ConfigError as error:
            raise ConfigError([prefix + line for line in error.mistakes]) from None
        faces.append({"face": name, "source": track.source.name} | summary)
        rows += [{"face": name} | row for row in table]
        notes += [prefix + note for note in visited.notes]
        notes += [f"{prefix}no rest at {', '.join(map(str, summary['missing'][:5]))}"] if visited.missing else []
        visits[name] = visited
    text = f"{grid.rows} x {grid.columns} points, {1e3 * grid.spacing:g} mm apart"
    summary: dict[str, Any] = {"grid": text, "reference": grid.name(grid.reference), "faces": faces}
    summary["acc_mm"] = fmean(face["acc_mm"] for face in faces)
    caption = "Points of the grid, and the tips moved onto them as a rigid body"
    return Result(summary, ("points.csv", rows), (figures.grid_figure(visits, grid), caption), notes)


def measure_latency(settings: MeasureSettings, tracks: Sequence[Track]) -> Result:
    """Lag behind a reference tracker. ConfigError if the curves do not overlap or do not show the same motion."""
    (track,) = tracks
    path = Path(settings.reference_log or "")
    reference = read_reference(path)
    times, tips = (torch.tensor(values, dtype=torch.float64) for values in (track.log.times, track.log.tips))
    other_times, other = (torch.tensor(values, dtype=torch.float64) for values in reference)
    try:
        lag = latency(times, tips, other_times, other)
    except ValueError as error:
        spans = f"{track.source.name} lasts from {times[0]:.3f} to {times[-1]:.3f} s"
        raise ConfigError([f"{spans}, {path} from {other_times[0]:.3f} to {other_times[-1]:.3f} s: {error}"]) from None
    summary: dict[str, Any] = {"lag_ms": 1e3 * lag.seconds, "sd_ms": 1e3 * lag.sd}
    summary |= {"correlation": lag.correlation, "overlap_s": lag.overlap}
    tracked = track.summary()
    if "milliseconds" in tracked:
        taken = tracked["milliseconds"]["median"]
        summary |= {"tracker_ms": taken, "total_ms": summary["lag_ms"] + taken}
    if "stages" in tracked:
        summary["stages"] = tracked["stages"]
    curves = {}
    rows = []
    for name, seconds, positions in (("tracker", times, tips), ("reference", other_times, other)):
        known = positions.isfinite().all(-1)
        distance = 1e3 * (positions[known] - positions[known][0]).norm(dim=-1)
        curves[name] = (seconds[known], distance)
        pairs = zip(seconds[known].tolist(), distance.tolist(), strict=True)
        rows += [{"curve": name, "time_s": second, "distance_mm": value} for second, value in pairs]
    caption = "Distance of the tip from its first place, by both trackers, as in Fig. 3.11 (a)"
    drawn = figures.curves_figure(curves, "distance from the first place (mm)")
    return Result(summary, ("curves.csv", rows), (drawn, caption))


def measure_prediction(settings: MeasureSettings, tracks: Sequence[Track]) -> Result:
    """Errors of poses that are shown late, by method. ConfigError if no pose has later ones to compare it with."""
    (track,) = tracks
    try:
        seconds, errors = prediction_errors(
            torch.tensor(track.log.times, dtype=torch.float64), track.poses, settings.delay
        )
    except ValueError as error:
        raise ConfigError([f"{track.source.name}: {error}"]) from None
    millimetres = 1e3 * errors
    methods = [
        {"method": name, "rms_mm": float(each.square().mean().sqrt())}
        | {"median_mm": quantile(each, 0.5), "p95_mm": quantile(each, 0.95)}
        for name, each in zip(METHODS, millimetres.mT, strict=True)
    ]
    summary: dict[str, Any] = {"delay_ms": 1e3 * settings.delay, "compared": len(errors), "methods": methods}
    names = ("time_s", *(f"{name.replace(' ', '_')}_mm" for name in METHODS))
    pairs = zip(seconds.tolist(), millimetres.tolist(), strict=True)
    rows: list[dict[str, Any]] = [dict(zip(names, (second, *each), strict=True)) for second, each in pairs]
    curves = {name: (seconds, each) for name, each in zip(METHODS, millimetres.mT, strict=True)}
    caption = f"Distance between the tip shown {1e3 * settings.delay:g} ms late and the tip measured at that time"
    return Result(summary, ("errors.csv", rows), (figures.curves_figure(curves, "error (mm)"), caption))


def measure_edges(settings: MeasureSettings, tracks: Sequence[Track]) -> Result:
    """Positions of the band edges, and a file of the corrected catheter. ConfigError if the frames do not suffice."""
    (track,) = tracks
    measured = measure_catheter(track.edges, track.source, settings.known, settings.resting)
    rows = catheter_rows(measured)
    summary: dict[str, Any] = {"edges": rows, "frames_used": measured.used, "frames_left_out": measured.left_out}
    summary |= {"rms_px": measured.rms_px, "known": list(settings.known), "resting": settings.resting}
    caption = "Change of the distance of each edge from the tip; bars: two standard deviations"
    drawn = figures.edges_figure([row["change_mm"] for row in rows], [row["sd_mm"] for row in rows])
    return Result(summary, ("edges.csv", rows), (drawn, caption), saved={"catheter.yaml": measured.save})


def measure_tone(settings: MeasureSettings, tracks: Sequence[Track]) -> Result:
    """Tone curve of the camera, and its file with this curve. ConfigError if the photographs do not suffice."""
    (track,) = tracks
    tone, save = measure_camera(track.source, settings)
    levels = torch.arange(256, dtype=torch.float64) / 255
    srgb = torch.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    summary: dict[str, Any] = {"photographs": len(settings.exposures), "exposures_s": list(settings.exposures)}
    summary["from_srgb"] = float((tone - srgb).abs().max())
    rows: list[dict[str, Any]] = [
        {"level": i, "light": light, "srgb": standard}
        for i, (light, standard) in enumerate(zip(tone.tolist(), srgb.tolist(), strict=True))
    ]
    drawn = figures.tone_figure({"measured": tone, "sRGB": srgb})
    caption = "Light of each 8-bit level, relative to that of level 255"
    return Result(summary, ("tone.csv", rows), (drawn, caption), saved={"camera.yaml": save})


PROTOCOLS: dict[str, Callable[[MeasureSettings, Sequence[Track]], Result]] = {
    "still": measure_still,
    "grid2d": measure_grid,
    "grid3d": measure_grid,
    "latency": measure_latency,
    "prediction": measure_prediction,
    "edges": measure_edges,
    "tone": measure_tone,
}
