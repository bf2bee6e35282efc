"""Chart of catheter trackers on synthetic frames: error against time, precision against its bound, refusals."""

import math
import os
import re
from pathlib import Path
from typing import NamedTuple

import torch

from holotorch.experiments.tracking_benchmark import bench, methods
from holotorch.experiments.tracking_benchmark.bench import STILL, TIP, Row, one
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, FEWER, LITERAL, PRIOR, Answer
from holotorch.experiments.tracking_benchmark.picture import draw
from holotorch.experiments.tracking_benchmark.real_pixels import real_pixels, shared_photographs
from holotorch.experiments.tracking_benchmark.second_world import second_world, verdict
from holotorch.experiments.tracking_benchmark.timing import spread, stages, timing
from holotorch.tracking.simulation.photographs import drawn_photograph
from holotorch.tracking.simulation.varied import VariedWorld
from holotorch.tracking.simulation.world import World


class Amount(NamedTuple):
    """Size of the measurement: numbers of frames, seeds, poses and repetitions, and the share of the cases."""

    still: int = 1000  # frames of each catheter at rest
    seeds: int = 2  # seeds of the conditions
    poses: int = 4  # poses of the occlusions
    negatives: int = 1000  # frames without a catheter
    rounds: int = 15  # repetitions of each measurement of time
    varied: int = 2064  # scenes of the second world with the catheter
    lookalikes: int = 2000  # scenes of the second world without it
    placed: int = 4  # poses of the catheter in each photograph of a calibration board
    resting: tuple[tuple[str, tuple[int, int]], ...] | None = None  # points and poses of the catheters at rest; all
    stream: int = 6  # different frames of each kind whose times are measured
    repeats: int = 9  # repetitions of a call whose time is compared with the median frame's
    share: float = 1.0  # share of the grids, conditions, occlusions, and of the frames whose times are compared


FULL = Amount()
_RESTING = ((TIP, (520, 20)),)
QUICK = Amount(4, 1, 1, 5, 1, varied=1, lookalikes=1, placed=1, resting=_RESTING, stream=1, repeats=1, share=0.06)
_PLAIN, _ALL = "plain desk", "all with a catheter but at rest"


def scene(folder: Path | None = None) -> World:
    """World of the chart, 1920 x 1080 pixels; backgrounds are photographs of ``folder``, or else of scikit-image."""
    return World(photographs=methods.photographs(folder))


def tracking(
    photographs_folder: Path | None = None,
    boards_folder: Path | None = None,
    *,
    quick: bool = False,
) -> tuple[list[Row], dict[str, list[Row]], dict[str, bytes], list[str]]:
    """Measure all trackers; this takes about an hour and a half on two cores, or seconds on few frames.

    Args:
        photographs_folder: Folder with photographs for backgrounds; without it, those of scikit-image.
        boards_folder: Folder with the calibration photographs of scikit-surgerybard and OpenCV, into which the catheter
            is rendered; without it, into one drawn board.
        quick: Few frames of each kind, and no comparison with the goals.

    Returns:
        Rows of the methods, further tables by name, pictures by name, and lines of text that compare the results with
        the goals.
    """
    amount = QUICK if quick else FULL
    world = scene(photographs_folder)
    # This world exposes all rows at the same time, as a camera with a global shutter does.
    trackers = methods.methods(world, (BASE, COLD, PRIOR, FEWER), readout=0.0)
    two, three = ({name: trackers[name] for name in names} for names in ((BASE, COLD), (BASE, COLD, PRIOR)))
    tables: dict[str, list[Row]] = {"times": timing(world, amount.rounds, amount.stream)}
    tables["stages"] = stages(world, amount.rounds)
    tables["slowest"] = spread(world, amount.seeds, amount.share, amount.repeats)
    answers: dict[str, list[Answer]] = {}
    tables["still"], answers["still"] = bench.still(world, trackers, amount.still, amount.resting)
    tables["grids"], answers["grids"] = bench.grids(world, trackers, amount.share)
    tables["codecs"], answers["codecs"] = bench.codecs(world, three, amount.share)
    tables["lights"] = bench.lights(world, trackers[COLD], amount.still // 4, amount.share)
    for kind, count in (("conditions", amount.seeds), ("occlusions", amount.poses)):
        tables[kind], answers[kind] = bench.scenes(world, three, count, kind, amount.share)
    tables["negatives"], answers["negatives"] = bench.empty(world, two, amount.negatives)
    varied = VariedWorld(photographs=world.photographs)
    tables["second_world"] = second_world(varied, amount.varied, amount.lookalikes)
    boards = shared_photographs(boards_folder) if boards_folder else [drawn_photograph()]
    tables["real_pixels"], sheet, found = real_pixels(boards, amount.placed)
    # The frames of catheters at rest are left out of the sum: they repeat a few poses.
    answers[_ALL] = [answer for kind in ("grids", "codecs", "conditions", "occlusions") for answer in answers[kind]]
    tables["reliability"] = [
        _share(kind, name, own)
        for kind, given in answers.items()
        for name in trackers
        if (own := [answer for answer in given if answer.method == name])
    ]
    rows = _methods(tables, answers)
    pictures = {"chart": draw(rows, tables), "real_pixels": sheet}
    lines = _verdict(world, rows, tables) + [f"synthetic {line}" for line in found]
    if quick:  # the goals are those of the full number of frames
        lines = [re.sub(r" \(goal [^()]*\)", "", line) for line in lines]
    return rows, tables, pictures, lines


def _share(kind: str, name: str, own: list[Answer]) -> Row:
    """Outcomes of one method on one kind of frames; a frame without a catheter should be refused."""
    row: Row = {"frames_of": kind, "method": name} | bench.outcomes(own)
    row["answerable"] = answerable = sum(answer.answerable for answer in own)
    lost = sum(answer.answerable and not answer.answered for answer in own)
    row["refused_though_answerable"] = lost
    row["refused_though_answerable_percent"] = round(100 * lost / answerable, 2) if answerable else ""
    row["refused_unanswerable"] = row["refused"] - lost
    return row | {"wrong_cases": "; ".join(answer.name for answer in own if answer.wrong and name != BASE)}


def _methods(tables: dict[str, list[Row]], answers: dict[str, list[Answer]]) -> list[Row]:
    """Accuracy and time, one row for each method."""
    rows = []
    for name in (BASE, COLD, PRIOR, FEWER):
        row: Row = {"method": name, "data": "synthetic"}
        timed = one(tables["times"], frame=_PLAIN, method=name)
        row |= {"milliseconds": timed["milliseconds"], "ratio": timed["ratio"]}
        worst = max(row["ratio"] for row in tables["times"] if row["method"] == name)
        row |= {"worst_ratio_of_frames": worst}
        for grid in ("2D", "3D"):
            errors = one(tables["grids"], grid=grid, method=name)
            row |= {f"{grid}_{key}": errors[key] for key in ("median_mm", "p95_mm", "rigid_median_mm", "acc_mm")}
        for depth, tilt in dict.fromkeys((row["depth_mm"], row["tilt_deg"]) for row in tables["still"]):
            still = one(tables["still"], depth_mm=depth, tilt_deg=tilt, point=TIP, method=name)
            row[f"s_rms_mm_{depth}_{tilt}"] = still["s_rms_mm"]
        # Grids and rest are counted separately, since frames of catheters at rest repeat only a few errors.
        for kind in ("grids", "still"):
            row[f"coverage_{kind}"] = bench.covered([answer for answer in answers[kind] if answer.method == name])
        rows.append(row)
    printed = {"method": "dissertation", "data": "real camera, as printed", "milliseconds": 22.6}
    printed |= {"2D_acc_mm": 0.58, "3D_acc_mm": 0.85}
    return [*rows, dict.fromkeys(rows[0], "") | printed]


def _verdict(world: World, rows: list[Row], tables: dict[str, list[Row]]) -> list[str]:
    size, focal = f"{world.size[1]} x {world.size[0]}", float(world.camera.matrix[0, 0])
    look = f"noise {world.look.noise_dn:g} DN, blur {world.look.blur_px:g} px"
    lines = [line for name in (COLD, PRIOR) for line in _accuracy(name, rows, tables)]
    for row in tables["reliability"]:
        # The errors of the other kinds are listed separately, and the sum over all kinds includes grids and codecs.
        lines += _reliability(row) if row["frames_of"] not in ("still", "grids", "codecs") else []
    for row in tables["codecs"]:
        error = f"median {row['median_mm']} mm, worst {row['worst_mm']} mm, {row['refused']} of {row['points']} refused"
        inside = f"the 95 % ellipsoid holds the truth in {row['coverage']} of the answers"
        lines.append(f"2D grid through codec {row['codec']}, {row['method']}: {error}, {inside}")
    for row in tables["lights"]:
        rest = ", ".join(f"{row[f's_rms_mm_{d}_{t}']} at {d} mm, {t} deg" for (d, t), goal in STILL.items() if goal)
        grid = f"2D grid median {row['median_mm']} mm, p95 {row['p95_mm']} mm of {row['points']} tips"
        lines.append(f"light {row['light']}, {COLD}: S_RMS in mm {rest}; {grid}")
    lines += [line for name in (COLD, PRIOR) for line in _unanswerable(name, tables)]
    lines += verdict(tables["second_world"], _goal)
    for row in tables["times"]:
        goal, milliseconds = {COLD: 0.5, PRIOR: 0.2}.get(row["method"], math.inf), row["milliseconds"]
        ratio = milliseconds / one(tables["times"], frame=row["frame"], method=LITERAL)["milliseconds"]
        text = f"{row['frame']}: {row['method']} {milliseconds:.1f} ms ({row['status']}), of the thesis in OpenCV with "
        text += f"cv2.undistort for every frame {ratio:.2f}{_goal(ratio, goal)}, with maps made once "
        lines.append(f"{text}{row['ratio']:.2f}{_goal(row['ratio'], goal)}")
    for row in tables["slowest"]:
        text = f"{row['method']}: slowest of {row['frames']} frames {row['slowest_ms']:.1f} ms ({row['slowest']})"
        goal = math.inf if row["method"] == BASE else 2.5
        lines.append(f"{text}, {row['ratio']:.2f} times the median" + _goal(row["ratio"], goal))
    for name in dict.fromkeys(row["method"] for row in tables["stages"]):
        parts = [row for row in tables["stages"] if row["method"] == name]
        text = "; ".join(f"{row['stage']} {row['milliseconds']:.2f} ms {row['percent']:.1f} %" for row in parts)
        lines.append(f"stages, {name}: {text}")
    first = (
        f"torch {torch.__version__}, {torch.get_num_threads()} threads, {os.cpu_count()} cores; all frames synthetic, "
        f"{size}, fx {focal:.0f} px, {look}, {len(world.photographs)} photographs for backgrounds"
    )
    headline, *others = (f"synthetic {line}" for line in lines)
    return [headline, first, *others]


def _accuracy(name: str, rows: list[Row], tables: dict[str, list[Row]]) -> list[str]:
    """Errors of a method on the grids and at rest, and how often its stated covariance holds."""
    lines = []
    for grid, median_goal, p95_goal, printed in (("2D", 0.10, 0.20, 0.58), ("3D", 0.20, 0.70, 0.85)):
        row, base = (one(tables["grids"], grid=grid, method=method) for method in (name, BASE))
        median = f"absolute median {row['median_mm']} mm{_goal(row['median_mm'], median_goal)}"
        p95 = f"p95 {row['p95_mm']} mm{_goal(row['p95_mm'], p95_goal)}"
        lines.append(
            f"{grid} grid, {name}: {median}, {p95}, {row['refused']} of {row['points']} refused, Acc {row['acc_mm']} "
            f"mm; thesis in OpenCV {base['median_mm']}, {base['p95_mm']}, {base['refused']} refused, "
            f"Acc {base['acc_mm']} (dissertation, real camera: Acc {printed})"
        )
    for row in tables["still"]:
        if row["method"] != name:
            continue
        text, goal = f"{row['point']} at {row['depth_mm']} mm, {row['tilt_deg']} deg, {name}", row["s_rms_goal_mm"]
        if goal != "":
            text += f": S_RMS unfiltered {row['s_rms_mm']} mm{_goal(row['s_rms_mm'], goal)}, standard error "
            least = round(math.sqrt(2) * row["edges_bound_mm"], 4)
            lines.append(f"{text}{row['s_rms_error_mm']} mm, least from edges in this light {least} mm")
        else:
            text += f": efficiency {row['efficiency']}{_goal(row['efficiency'], 0.4, '>=')}"
            lines.append(f"{text}, sd {row['sd_mm']} mm, Cramer-Rao {row['bound_mm']} mm, bias {row['bias_mm']} mm")
    row = one(rows, method=name)
    share = row["coverage_grids"]
    met = "" if share == "" else " (goal 0.90 to 0.98: " + ("met)" if 0.9 <= share <= 0.98 else "missed)")
    text = f"grids, {name}: the 95 % ellipsoid holds the truth in {share} of the answers{met}"
    return [*lines, f"{text}, at rest in {row['coverage_still']}"]


def _reliability(row: Row) -> list[str]:
    """Wrong poses and refusals of a method on a kind of frames; there are no goals for the thesis's method."""
    kind, name = row["frames_of"], row["method"]
    goals = {"negatives": 0.0, _ALL: 0.1, "occlusions": 30.0, "conditions": 12.0} if name != BASE else {}
    of, goal = f"{kind}, {name}", goals.get(kind, math.inf)
    if kind == "negatives":
        lines = [f"{of}: {row['wrong']} false poses in {row['frames']} frames" + _goal(row["wrong"], goal)]
    else:
        wrong, lost = 100 * row["wrong"] / row["frames"], row["refused_though_answerable_percent"]
        goal_wrong, goal_lost = (goal, math.inf) if kind == _ALL else (math.inf, goal)
        text = f"{of}: {row['wrong']} of {row['frames']} wrong by more than 5 mm, {wrong:.2f} %"
        lines = [text + _goal(wrong, goal_wrong, "<")]
        text = f"{of}: {row['refused_though_answerable']} of {row['answerable']} answerable refused, {lost} %"
        lines.append(text + _goal(lost, goal_lost, "<"))
    return lines + ([f"{of}: answered wrongly: {row['wrong_cases']}"] if row["wrong_cases"] else [])


def _unanswerable(name: str, tables: dict[str, list[Row]]) -> list[str]:
    """How many refusals of unanswerable scenes give a fitting reason, and outcomes of scenes half out of the frame."""
    scenes = [row for kind in ("conditions", "occlusions") for row in tables[kind] if row["method"] == name]
    unanswerable = [row for row in scenes if not row["answerable"]]
    keys = ("frames", "refused", "reason_fits", "right")
    frames, refused, fitting, right = (sum(row[key] for row in unanswerable) for key in keys)
    odd = [f"{row['scene']} ({row['statuses']})" for row in unanswerable if row["reason_fits"] < row["refused"]]
    text = f"unanswerable scenes, {name}: {frames} frames, {refused} refused, {fitting} with a fitting reason"
    lines = [f"{text}, {right} answered and right" + (f"; another reason: {'; '.join(odd)}" if odd else "")]
    out = [row for row in scenes if "out of frame" in row["scene"]]
    frames, right, wrong = (sum(row[key] for row in out) for key in ("frames", "right", "wrong"))
    text = f"half out of the frame, {name}: {frames} frames, {right} right, {wrong} wrong{_goal(wrong, 0)}"
    return [*lines, f"{text}, the others refused"]


def _goal(value: float | str, limit: float, sign: str = "<=") -> str:
    """The goal, and whether it is met, as text for the verdict; empty for an infinite limit."""
    if not math.isfinite(limit):
        return ""
    if isinstance(value, str):
        return f" (goal {sign} {limit:g}: no number)"
    met = {"<=": value <= limit, "<": value < limit, ">=": value >= limit}[sign]
    return f" (goal {sign} {limit:g}: {'met' if met else 'missed'})"
