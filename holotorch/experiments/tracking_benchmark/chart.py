"""Chart of catheter trackers on synthetic frames: error against time, precision against its bound, refusals."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import torch

from holotorch.experiments.tracking_benchmark.bench import (
    STILL,
    TIP,
    Row,
    codecs,
    covered,
    empty,
    grids,
    lights,
    one,
    scenes,
    still,
)
from holotorch.experiments.tracking_benchmark.methods import (
    BASE,
    COLD,
    FEWER,
    LITERAL,
    PRIOR,
    Answer,
    methods,
    photographs,
)
from holotorch.experiments.tracking_benchmark.picture import draw
from holotorch.experiments.tracking_benchmark.timing import spread, stages, timing
from holotorch.tracking.simulation.world import World


class Amount(NamedTuple):
    """Numbers of frames that are measured."""

    still: int = 1000  # frames of each catheter at rest
    seeds: int = 2  # seeds of the conditions
    poses: int = 4  # poses of the occlusions
    negatives: int = 1000  # frames without a catheter
    rounds: int = 15  # repetitions of each measurement of time
    share: float = 1.0  # share of the grids, conditions, occlusions, and of the frames whose times are compared


AMOUNT = Amount()
_PLAIN, _ALL = "plain desk", "all with a catheter but at rest"


def scene(folder: Path | None = None) -> World:
    """World of the chart, 1920 x 1080 pixels; backgrounds are photographs of ``folder``, or else of scikit-image."""
    return World(photographs=photographs(folder))


def tracking(
    photographs_folder: Path | None = None,
) -> tuple[list[Row], dict[str, list[Row]], dict[str, bytes], list[str]]:
    """Measure all trackers; this takes about 20 minutes on two cores.

    Args:
        photographs_folder: Folder with photographs for backgrounds; without it, those of scikit-image.

    Returns:
        Rows of the methods, further tables by name, pictures by name, and lines of text that compare the results with
        the goals.
    """
    world, amount = scene(photographs_folder), AMOUNT
    trackers = methods(world, (BASE, COLD, PRIOR, FEWER))
    three = {name: trackers[name] for name in (BASE, COLD, PRIOR)}
    tables: dict[str, list[Row]] = {"times": timing(world, amount.rounds), "stages": stages(world, amount.rounds)}
    tables["slowest"] = spread(world, amount.seeds, amount.share)
    said: dict[str, list[Answer]] = {}
    tables["still"], said["still"] = still(world, trackers, amount.still)
    tables["grids"], said["grids"] = grids(world, trackers, amount.share)
    tables["codecs"], said["codecs"] = codecs(world, three, amount.share)
    tables["lights"] = lights(world, trackers[COLD], amount.still // 4, amount.share)
    for kind, count in (("conditions", amount.seeds), ("occlusions", amount.poses)):
        tables[kind], said[kind] = scenes(world, three, count, kind, amount.share)
    two = {name: trackers[name] for name in (BASE, COLD)}
    tables["negatives"], said["negatives"] = empty(world, two, amount.negatives)
    # The frames of catheters at rest are left out: they repeat a few poses.
    some = (found for kind, found in said.items() if kind not in ("negatives", "still"))
    said[_ALL] = [answer for found in some for answer in found]
    tables["reliability"] = [
        _share(kind, name, own)
        for kind, found in said.items()
        for name in trackers
        if (own := [answer for answer in found if answer.method == name])
    ]
    rows = _methods(tables, said)
    return rows, tables, {"chart": draw(rows, tables)}, _verdict(world, rows, tables)


def _share(kind: str, name: str, own: list[Answer]) -> Row:
    """Outcomes of one method on one kind of frames; a frame without a catheter should be refused."""
    refused = [answer for answer in own if not answer.answered]
    answerable = sum(answer.answerable for answer in own)
    lost = sum(answer.answerable for answer in refused)
    unseen = len(refused) - lost
    return {
        "frames_of": kind,
        "method": name,
        "frames": len(own),
        "right": sum(answer.right for answer in own),
        "wrong": sum(answer.wrong for answer in own),
        "refused": len(refused),
        "answerable": answerable,
        "refused_though_answerable": lost,
        "refused_though_answerable_percent": round(100 * lost / answerable, 2) if answerable else "",
        "refused_unanswerable": unseen,
        "wrong_cases": "; ".join(answer.name for answer in own if answer.wrong and name != BASE),
    }


def _methods(tables: dict[str, list[Row]], said: dict[str, list[Answer]]) -> list[Row]:
    """Accuracy and time, one row for each method."""
    rows = []
    for name in (BASE, COLD, PRIOR, FEWER):
        row: Row = {"method": name, "data": "synthetic"}
        timed = one(tables["times"], frame=_PLAIN, method=name)
        row |= {"milliseconds": timed["milliseconds"], "ratio": timed["ratio"]}
        worst = max(each["ratio"] for each in tables["times"] if each["method"] == name)
        row |= {"worst_ratio_of_frames": worst}
        for grid in ("2D", "3D"):
            found = one(tables["grids"], grid=grid, method=name)
            row |= {f"{grid}_{key}": found[key] for key in ("median_mm", "p95_mm", "rigid_median_mm", "acc_mm")}
        for depth, tilt in STILL:
            found = one(tables["still"], depth_mm=depth, tilt_deg=tilt, point=TIP, method=name)
            row[f"s_rms_mm_{depth}_{tilt}"] = found["s_rms_mm"]
        # Both kinds are counted separately, since frames of catheters at rest repeat only a few errors.
        for kind in ("grids", "still"):
            row[f"coverage_{kind}"] = covered([answer for answer in said[kind] if answer.method == name])
        rows.append(row)
    printed = {"method": "dissertation", "data": "real camera, as printed", "milliseconds": 22.6}
    printed |= {"2D_acc_mm": 0.58, "3D_acc_mm": 0.85}
    return [*rows, dict.fromkeys(rows[0], "") | printed]


def _verdict(world: World, rows: list[Row], tables: dict[str, list[Row]]) -> list[str]:
    size, focal = f"{world.size[1]} x {world.size[0]}", float(world.camera.matrix[0, 0])
    look = f"noise {world.look.noise_dn:g} DN, blur {world.look.blur_px:g} px"
    lines = [
        f"torch {torch.__version__}, {torch.get_num_threads()} threads, {os.cpu_count()} cores; all frames synthetic, "
        f"{size}, fx {focal:.0f} px, {look}, {len(world.photographs)} photographs for backgrounds"
    ]
    lines += [f"synthetic {line}" for name in (COLD, PRIOR) for line in _accuracy(name, rows, tables)]
    for row in tables["reliability"]:
        if row["frames_of"] in ("still", "grids", "codecs"):
            continue  # their errors are listed separately, and the sum over all kinds includes the grids and codecs
        lines += [f"synthetic {line}" for line in _reliability(row)]
    for row in tables["codecs"]:
        error = f"median {row['median_mm']} mm, worst {row['worst_mm']} mm, {row['refused']} of {row['points']} refused"
        inside = f"the 95 % ellipsoid holds the truth in {row['coverage']} of the answers"
        lines.append(f"synthetic 2D grid through codec {row['codec']}, {row['method']}: {error}, {inside}")
    for row in tables["lights"]:
        rest = ", ".join(f"{row[f's_rms_mm_{d}_{t}']} at {d} mm, {t} deg" for (d, t), goal in STILL.items() if goal)
        grid = f"2D grid median {row['median_mm']} mm, p95 {row['p95_mm']} mm of {row['points']} tips"
        lines.append(f"synthetic light {row['light']}, {COLD}: S_RMS in mm {rest}; {grid}")
    lines += [f"synthetic {line}" for line in _unanswerable(tables)]
    for row in tables["times"]:
        goal, took = {COLD: 0.5, PRIOR: 0.2}.get(row["method"], math.inf), row["milliseconds"]
        anew = took / one(tables["times"], frame=row["frame"], method=LITERAL)["milliseconds"]
        text = f"{row['frame']}: {row['method']} {took:.1f} ms ({row['status']}), of the thesis in OpenCV with "
        text += f"cv2.undistort for every frame {anew:.2f}{_goal(anew, goal, '<=')}, with maps made once "
        lines.append(f"synthetic {text}{row['ratio']:.2f}{_goal(row['ratio'], goal, '<=')}")
    for row in tables["slowest"]:
        text = f"{row['method']}: slowest of {row['frames']} frames {row['slowest_ms']:.1f} ms ({row['slowest']})"
        goal = math.inf if row["method"] == BASE else 2.0
        lines.append(f"synthetic {text}, {row['ratio']:.2f} times the median" + _goal(row["ratio"], goal, "<="))
    for name in dict.fromkeys(row["method"] for row in tables["stages"]):
        parts = [row for row in tables["stages"] if row["method"] == name]
        text = "; ".join(f"{row['stage']} {row['milliseconds']:.2f} ms {row['percent']:.1f} %" for row in parts)
        lines.append(f"synthetic stages, {name}: {text}")
    return lines


def _accuracy(name: str, rows: list[Row], tables: dict[str, list[Row]]) -> list[str]:
    lines = []
    for grid, (median, p95), printed in (("2D", (0.10, 0.20), 0.58), ("3D", (0.20, 0.70), 0.85)):
        row, base = (one(tables["grids"], grid=grid, method=method) for method in (name, BASE))
        lines.append(
            f"{grid} grid, {name}: absolute median {row['median_mm']} mm{_goal(row['median_mm'], median, '<=')}, p95 "
            f"{row['p95_mm']} mm{_goal(row['p95_mm'], p95, '<=')}, {row['refused']} of {row['points']} refused, Acc "
            f"{row['acc_mm']} mm; thesis in OpenCV {base['median_mm']}, {base['p95_mm']}, {base['refused']} refused, "
            f"Acc {base['acc_mm']} (dissertation, real camera: Acc {printed})"
        )
    for row in tables["still"]:
        if row["method"] != name:
            continue
        where, goal = f"{row['point']} at {row['depth_mm']} mm, {row['tilt_deg']} deg, {name}", row["s_rms_goal_mm"]
        if goal != "":
            least = round(math.sqrt(2) * row["edges_bound_mm"], 4)
            text = f"{where}: S_RMS unfiltered {row['s_rms_mm']} mm{_goal(row['s_rms_mm'], goal, '<=')}"
            lines.append(
                f"{text}, standard error {row['s_rms_error_mm']} mm, least from edges in this light {least} mm"
            )
        else:
            text = f"{where}: efficiency {row['efficiency']}{_goal(row['efficiency'], 0.4, '>=')}"
            lines.append(f"{text}, sd {row['sd_mm']} mm, Cramer-Rao {row['bound_mm']} mm, bias {row['bias_mm']} mm")
    row = one(rows, method=name)
    share = row["coverage_grids"]
    met = "" if share == "" else " (goal 0.90 to 0.98: " + ("met)" if 0.9 <= share <= 0.98 else "missed)")
    text = f"grids, {name}: the 95 % ellipsoid holds the truth in {share} of the answers{met}"
    return [*lines, f"{text}, at rest in {row['coverage_still']}"]


def _reliability(row: Row) -> list[str]:
    kind, name = row["frames_of"], row["method"]
    of = f"{kind}, {name}"
    if kind == "negatives":
        text = f"{of}: {row['wrong']} false poses in {row['frames']} frames"
        lines = [text + ("" if name == BASE else _goal(row["wrong"], 0, "<="))]
    else:
        wrong, lost = 100 * row["wrong"] / row["frames"], row["refused_though_answerable_percent"]
        limit = 0.1 if kind == _ALL and name != BASE else math.inf
        lines = [
            f"{of}: {row['wrong']} of {row['frames']} wrong by more than 5 mm, {wrong:.2f} %" + _goal(wrong, limit, "<")
        ]
        limit = math.inf if name == BASE else {"occlusions": 30, "conditions": 12}.get(kind, math.inf)
        text = f"{of}: {row['refused_though_answerable']} of {row['answerable']} answerable refused, {lost} %"
        lines.append(text + _goal(lost, limit, "<"))
    return lines + ([f"{of}: answered wrongly: {row['wrong_cases']}"] if row["wrong_cases"] else [])


def _unanswerable(tables: dict[str, list[Row]]) -> list[str]:
    """Unanswerable scenes: how many refusals give a fitting reason."""
    lines = []
    for name in (COLD, PRIOR):
        found = [row for kind in ("conditions", "occlusions") for row in tables[kind]]
        found = [row for row in found if row["method"] == name and not row["answerable"]]
        refused, fitting = (sum(row[key] for row in found) for key in ("refused", "reason_fits"))
        odd = [f"{row['scene']} ({row['statuses']})" for row in found if row["reason_fits"] < row["refused"]]
        frames, right = (sum(row[key] for row in found) for key in ("frames", "right"))
        text = f"unanswerable scenes, {name}: {frames} frames, {refused} refused, {fitting} with a fitting reason"
        lines.append(text + f", {right} answered and right" + (f"; another reason: {'; '.join(odd)}" if odd else ""))
        out = [row for row in tables["conditions"] if row["method"] == name and "out of frame" in row["scene"]]
        frames, right, wrong = (sum(row[key] for row in out) for key in ("frames", "right", "wrong"))
        text = f"half out of the frame, {name}: {frames} frames, {right} right, {wrong} wrong"
        lines.append(text + _goal(wrong, 0, "<=") + ", the others refused")
    return lines


def _goal(value: float | str, limit: float, sign: str) -> str:
    """The goal, and whether it is met, as text for the verdict; empty for an infinite limit."""
    if not math.isfinite(limit):
        return ""
    if isinstance(value, str):
        return f" (goal {sign} {limit:g}: no number)"
    met = {"<=": value <= limit, "<": value < limit, ">=": value >= limit}[sign]
    return f" (goal {sign} {limit:g}: {'met' if met else 'missed'})"
