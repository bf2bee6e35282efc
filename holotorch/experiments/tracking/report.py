"""Report of a tracking run: counts by status, time per stage, stability, and the section of the report page."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.page import element, figure, heading, plain, table
from holotorch.experiments.runs.pictures import save_picture
from holotorch.experiments.runs.record import RunRecord
from holotorch.io.files import write_bytes
from holotorch.io.video import Frame, Frames
from holotorch.tracking import Pose, Status
from holotorch.tracking.evaluation.protocols import counts, s_rms
from holotorch.tracking.pose.status import BEYOND_TIP

# Columns of poses.csv, which has a line per frame. Lengths are in metres in the camera's coordinates (x right, y down,
# z forward), directions point from the tip to the rear, the covariance of the tip is given by its upper triangle, and
# ``milliseconds`` is the time of the tracker alone. Floats are written exactly. A refused frame has empty cells instead
# of a pose, and ``stage`` names the stage that refused it.
COLUMNS = (
    *("frame", "time_s", "status", "stage", "reason"),
    *("tip_x_m", "tip_y_m", "tip_z_m", "direction_x", "direction_y", "direction_z"),
    *("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"),
    *("chi_square", "freedom", "milliseconds"),
)

_STATED = "the uncertainty from the frames alone, without that of the calibration of the camera and of the band edges"
_MOVED = 3.0  # largest spread of the tips of a resting catheter, as a multiple of the tracker's standard deviation
_MANY = 5  # ratio of answered to refused frames above which the files of camera and catheter are hardly the cause
MOVED = "was the catheter at rest?"  # how the note on a larger spread begins
_SHOWN = 4  # number of kinds of refusals that are counted with their first frame


class Tracked(NamedTuple):
    """One frame and its pose."""

    number: int  # number of the frame, from 0
    frame: Frame
    pose: Pose  # pose or refusal; its status is BAD_FRAME if the frame could not be read
    seconds: float  # time that the tracker took; 0 for a frame that could not be read
    stages: dict[str, float]  # seconds of each stage of the tracker, if it measures them

    @property
    def status(self) -> Status:
        """Status of the single pose."""
        assert isinstance(self.pose.status, Status)
        return self.pose.status


def row(item: Tracked) -> list[str]:
    """Cells of the frame's line in poses.csv, in the order of ``COLUMNS``."""
    pose = item.pose
    cells = [str(item.number), repr(item.frame.seconds), item.status.name]
    cells += ["" if pose.answered else item.status.stage, " ".join(pose.reason.split())]
    numbers = [""] * (len(COLUMNS) - len(cells) - 1)
    if pose.answered:
        i, j = torch.triu_indices(3, 3)
        values = [*pose.tip.tolist(), *pose.direction.tolist(), *pose.covariance[i, j].tolist()]
        numbers = [repr(value) for value in (*values, float(pose.chi_square), float(pose.freedom))]
    return [*cells, *numbers, "" if item.frame.pixels is None else f"{1e3 * item.seconds:.3f}"]


@dataclass
class Log:
    """Results of all frames of a run, and the first overlay of each status."""

    images: Path  # folder of the overlays
    statuses: list[Status] = field(default_factory=list)
    times: list[float] = field(default_factory=list)  # time stamps of the frames in seconds
    tips: list[list[float]] = field(default_factory=list)  # metres; NaN for a refusal
    deviations: list[float] = field(default_factory=list)  # standard deviations of the tips in metres
    seconds: list[float] = field(default_factory=list)  # time of the tracker for each frame that could be read
    stages: list[dict[str, float]] = field(default_factory=list)  # seconds of each stage of the tracker, by frame
    pictures: dict[str, str] = field(default_factory=dict)  # captions of the overlays by status
    first: Pose | None = None  # the first of all
    beyond: int = 0  # frames in which the tube goes on beyond the tip of the pose
    # Refused frames and the first of them, by status and reason without its numbers.
    refused: dict[tuple[str, str], tuple[int, str]] = field(default_factory=dict)
    unverified: dict[tuple[str, str], tuple[int, str]] = field(default_factory=dict)  # the same of UNVERIFIED poses

    def wants(self, item: Tracked) -> bool:
        """Whether the page will show the overlay of this frame."""
        return item.status.name not in self.pictures

    def take(self, item: Tracked, drawn: Tensor | None) -> None:
        """Add a frame and its overlay, uint8 [3, H, W]."""
        pose = item.pose
        self.beyond += pose.reason == BEYOND_TIP
        if drawn is not None and self.wants(item):
            smaller = avg_pool2d(drawn.double() / 255, max(1, min(drawn.shape[-2:]) // 400))
            save_picture(self.images / item.status.name, smaller)
            self.pictures[item.status.name] = _caption(item)
        if pose.answered and self.first is None:
            self.first = pose
        if item.status is not Status.OK:
            kinds = self.unverified if pose.answered else self.refused
            kind = item.status.name, re.sub(r"\d+(\.\d+)?", "#", pose.reason)
            count, first = kinds.get(kind, (0, _caption(item)))
            kinds[kind] = count + 1, first
        self.statuses.append(item.status)
        self.times.append(item.frame.seconds)
        self.tips.append(pose.tip.tolist() if pose.answered else [math.nan] * 3)
        self.deviations.append(float(pose.tip_sd) if pose.answered else math.nan)
        if item.frame.pixels is not None:
            self.seconds.append(item.seconds)
        if item.stages:
            self.stages.append(item.stages)


def _caption(item: Tracked) -> str:
    return f"frame {item.number}, {item.status.name}" + (f": {item.pose.reason}" if item.pose.reason else "")


def summarise(log: Log, frames: Frames, method: str, still: bool) -> dict[str, Any]:
    """The summary of a run as plain JSON values; keys name their units (mm, ms)."""
    answered = sum(status.answered for status in log.statuses)
    summary: dict[str, Any] = {"experiment": "track", "status": "", "source": frames.name, "method": method}
    summary |= {"frames": len(log.statuses), "answered": answered, "statuses": counts(log.statuses)}
    for name, kinds in (("refused", log.refused), ("unverified", log.unverified)):
        common = sorted(kinds.items(), key=lambda each: -each[1][0])[:_SHOWN]
        summary[name] = [{"status": kind[0], "frames": n, "first": first} for kind, (n, first) in common]
    summary |= {"seconds": log.times[-1] - log.times[0], "stated_rate_hz": frames.rate}
    stated = torch.tensor([value for value in log.deviations if math.isfinite(value)], dtype=torch.float64)
    if answered:
        summary["tip_sd_mm"] = {"median": 1e3 * quantile(stated, 0.5), "largest": 1e3 * quantile(stated, 1.0)}
        summary["tip_sd_holds"] = _STATED
        away = torch.tensor(log.tips, dtype=torch.float64).norm(dim=-1)
        summary["tip_distance_m"] = [float(bound) for bound in away[away.isfinite()].aminmax()]
    if log.seconds:
        taken = 1e3 * torch.tensor(log.seconds, dtype=torch.float64)
        shares = (("median", 0.5), ("p95", 0.95), ("largest", 1.0))
        summary["milliseconds"] = {"first": float(taken[0])} | {name: quantile(taken, share) for name, share in shares}
    if log.stages:
        counted = log.stages[1:] or log.stages  # without the first call, which also builds tables
        names = dict.fromkeys(name for counts in counted for name in counts)
        means = {name: fmean(counts.get(name, 0.0) for counts in counted) for name in names}
        total = max(sum(means.values()), 1e-12)
        summary["stages"] = [
            {"stage": name, "milliseconds": 1e3 * mean, "percent": 100 * mean / total} for name, mean in means.items()
        ]
    notes = list(frames.notes)
    if 2 * log.beyond > answered:
        notes.append(
            f"wrong tips: in {log.beyond} of {answered} poses, UNVERIFIED for that, the tube goes on beyond the tip; "
            "are `edges` counted from the tip, in their order, and the bands named from the tip on?"
        )
    if still:
        try:
            stability = s_rms(torch.tensor(log.tips, dtype=torch.float64))
            summary["stability"] = {"s_rms_mm": 1e3 * stability.s_rms, "sd_mm": 1e3 * stability.sd}
            summary["stability"] |= {"differences": stability.differences, "answered": stability.answered}
            allowed = float(stated.square().mean().sqrt()) if len(stated) else math.inf
            if stability.sd > _MOVED * allowed:
                notes.append(
                    f"{MOVED} The tips spread by {1e3 * stability.sd:.3f} mm about their mean, more "
                    f"than {_MOVED:g} times their stated deviation of {1e3 * allowed:.3f} mm (root mean squares); "
                    "S_RMS of a moving catheter says nothing of stability"
                )
        except ValueError as error:
            notes.append(f"no stability: {error}")
    return summary | {"notes": notes, "pictures": log.pictures, "peak_memory_bytes": peak_memory()}


_LONGER = "longer bands, a nearer camera or more pixels help, and colours at full resolution (a camera's --record)"
_COLOURS = "are the colours of the catheter's file those of this video? holotorch calibrate catheter reads them"
_ADVICE = {
    Status.BAD_FRAME: "is the video of the camera's size, and neither black nor white?",
    Status.NO_CATHETER: _COLOURS,
    Status.BANDS_MISSING: f"is a band covered? Or {_COLOURS}; {_LONGER}",
    Status.NO_AXIS: _COLOURS,
    Status.TOO_NARROW: _LONGER,
    Status.EDGES_UNCLEAR: f"are `edges` right, and the bands named from the tip on? Or {_LONGER}",
    Status.OUT_OF_FRAME: "the bands must lie within the picture",
    Status.OUTSIDE_CAMERA: "the camera's file says nothing there: calibrate with boards near the picture's edges",
    Status.INCONSISTENT: "no pose explains what was measured: are `edges`, `radius` (half the thickness) and camera "
    "right, the bands named from the tip on, and all of them free and in view?",
    Status.UNCERTAIN: f"are the lengths of the bands in their order, from the tip on? Or {_LONGER}",
}


_THIS_CAMERA = "are `edges` counted from the tip, and is the camera's file that of this camera, at this focus?"
_SINGLE = (
    "the files fit the other frames: is something across or beside a band there, a highlight on it, or are its colours "
    "coarse, as in compressed video?"
)


def verdict(summary: dict[str, Any]) -> str:
    """The summary in one line."""
    statuses = ", ".join(f"{name} {count}" for name, count in summary["statuses"].items())
    text = f"Frames     {summary['answered']} of {summary['frames']} with a pose ({statuses})"
    if "milliseconds" in summary:
        text += f"; {summary['milliseconds']['median']:.1f} ms each, slowest {summary['milliseconds']['largest']:.1f}"
    if nearest := summary.get("tip_distance_m"):  # none in runs of before
        text += f"; tips {nearest[0]:.2f} to {nearest[1]:.2f} m from the camera"
    if "stability" in summary:
        text += f"; S_RMS {summary['stability']['s_rms_mm']:.3f} mm unfiltered"
    return text


def camera_line(summary: dict[str, Any]) -> list[str]:
    """What the calibration of the camera adds to the stated deviations, as a line to print; none where unknown."""
    if (added := summary.get("calibration_sd_mm")) is None or "tip_sd_mm" not in summary:
        return []
    return [
        f"Camera     its calibration adds about {added:.2g} mm (sd) to the tips, the same in all frames, to the "
        f"{summary['tip_sd_mm']['median']:.2g} mm that the frames leave open (sd in the overlay, covariances in "
        "poses.csv)"
    ]


def refusals(summary: dict[str, Any]) -> list[str]:
    """The common refusals and what to look at, if one frame in fifty or more has no pose."""
    refused = summary.get("refused")  # none in runs of before
    if not refused or 50 * (summary["frames"] - summary["answered"]) < summary["frames"]:
        return []
    common = [each for each in refused if 2 * each["frames"] >= refused[0]["frames"]]
    few = summary["answered"] > _MANY * (summary["frames"] - summary["answered"])
    advice = _ADVICE | ({Status.INCONSISTENT: _SINGLE, Status.UNCERTAIN: _LONGER} if few else {})
    lines = [f"Refused    {each['frames']} like {each['first']}; {advice[Status[each['status']]]}" for each in common]
    if rest := summary["frames"] - summary["answered"] - sum(each["frames"] for each in common):
        lines[-1] += f"; {rest} more for other reasons (poses.csv)"
    wrong = summary.get("statuses", {}).get(Status.INCONSISTENT.name, 0)
    if summary["answered"] and wrong > 3 * summary["answered"]:
        lines.append(f"Warning    the {summary['answered']} poses beside so many contradictions may be wrong, too")
    return lines


def doubts(summary: dict[str, Any]) -> list[str]:
    """Why poses are UNVERIFIED, if one frame in fifty or more is so for one reason."""
    many = [each for each in summary.get("unverified", ()) if 50 * each["frames"] >= summary["frames"]]
    return [
        f"Unverified {each['frames']} like {each['first']}; "
        + (_THIS_CAMERA if each["first"].endswith(BEYOND_TIP) else "is a band covered or out of the picture there?")
        for each in many
    ]


def save_figure(folder: Path, log: Log) -> None:
    """Draw the tip over time to ``images/track.png``."""
    from holotorch.experiments.runs.figures import figure_png

    write_bytes(folder / "images" / "track.png", figure_png(drawn_track(log)))


def track_section(record: RunRecord) -> list[str]:
    """HTML of a tracking run: share of frames with a pose, their precision, the time, and a frame of each status."""
    summary = record.summary
    parts = [heading(f"{record.title}: {summary['source']}", summary["status"])]
    if "failure" in summary:
        parts.append(element("p", summary["failure"], "warn"))
    share = 100 * summary["answered"] / summary["frames"]
    text = f"{summary['answered']} of {summary['frames']} frames have a pose ({share:.1f} %)"
    text += "; every other says why it has none. " if share < 100 else ". "
    text += "" if "truth" in summary else "Errors against the truth are not known here. "
    parts.append(element("p", text + f"Deviations (sd) are the tracker's own estimate: {_STATED}, which adds to them."))
    parts += [element("p", f"Camera: {words.removeprefix('Camera').strip()}.") for words in camera_line(summary)]
    parts += [_truth(summary["truth"])] if "truth" in summary else []
    parts += [element("p", f"Note: {note}.") for note in summary["notes"]]
    parts.append(table(["status", "frames"], [[name, str(count)] for name, count in summary["statuses"].items()]))
    names = [name for name in ("tip_sd_mm", "stability", "milliseconds") if name in summary]
    parts.append(table(["", ""], [[name.replace("_", " "), plain(summary[name])] for name in names], head=False))
    if "stages" in summary:
        cells = [[each["stage"], f"{each['milliseconds']:.2f}", f"{each['percent']:.2f}"] for each in summary["stages"]]
        total = sum(each["milliseconds"] for each in summary["stages"])
        cells.append(["Total", f"{total:.2f}", "100.00"])
        parts.append(table(["stage", "mean time per frame (ms), without the first", "share (%)"], cells))
    pictures = {"track": "Tip in the camera's frame; gaps are refusals", **summary.get("pictures", {})}
    parts += [figure(source, pictures[name], "wide") for name in pictures if (source := record.picture(name))]
    return parts


def _truth(truth: dict[str, float]) -> str:
    """HTML of the distances between the tips and the truth of a synthetic recording."""
    text = f"The recording is synthetic, so the true tip is known. Of {truth['frames']} frames with a pose "
    text = element("p", text + f"{truth.get('wrong', 0)} are wrong by more than 5 mm.")
    lengths = {name: length for name in ("median", "p95", "worst") if (length := truth.get(f"{name}_mm")) is not None}
    rows = [[f"{name} (mm)", f"{length:.3f}"] for name, length in lengths.items()]
    if "coverage" in truth:
        rows.append(["truth within the stated 95 % ellipsoid", f"{100 * truth['coverage']:.1f} % of the frames"])
    return text + table(["tip's distance from the truth", ""], rows)


def quantile(values: Tensor, share: float) -> float:
    """Quantile of values [n] at the nearest rank, without interpolation; NaN if there are no values."""
    return float(values.sort().values[round(share * (len(values) - 1))]) if len(values) else math.nan


def drawn_track(log: Log) -> Any:
    """Figure of the tip and its stated deviation over time, with the words "no pose" if there is no pose."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(9, 4.5), layout="constrained")
    upper, lower = drawn.subplots(2, 1, sharex=True)
    start = log.times[0]
    seconds = [value - start for value in log.times]
    poses = sum(map(math.isfinite, log.deviations))
    size = 2 if poses > 1 else 6
    if len(seconds) == 1:
        upper.set_xticks([0])
    if poses == 1:
        upper.set_yticks([0])  # the offset of a single tip from the median is 0
    if not poses:
        upper.set_xlim(0, seconds[-1] or None)
        for axes in (upper, lower):
            axes.text(0.5, 0.5, "no pose", transform=axes.transAxes, ha="center", va="center", color="0.4")
            axes.set_yticks([])
    tips = torch.tensor(log.tips, dtype=torch.float64)
    for name, offsets in zip("xyz", (1e3 * (tips - tips.nanmedian(0).values)).T.tolist(), strict=True):
        upper.plot(seconds, offsets, ".-", linewidth=0.8, markersize=size, label=name)
    upper.legend(ncols=3)
    lower.plot(seconds, [1e3 * value for value in log.deviations], ".", markersize=size)
    lower.set_xlabel("time (s)")
    for axes, label in ((upper, "tip from its median (mm)"), (lower, "sd of the tip (mm)")):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    return drawn
