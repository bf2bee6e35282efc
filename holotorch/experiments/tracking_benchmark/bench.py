"""Measurements of catheter trackers on synthetic frames: each part streams over its frames and returns rows."""

import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import torch

from holotorch.experiments.tracking_benchmark.bound import tip_bounds
from holotorch.experiments.tracking_benchmark.methods import Answer, Method, answers, tips_of, truth_of
from holotorch.tracking.evaluation import protocols
from holotorch.tracking.pose.status import Status
from holotorch.tracking.simulation.trials import conditions, negatives, occlusions
from holotorch.tracking.simulation.world import World

Row = dict[str, Any]

# Poses of catheters at rest: distance in mm, tilt in degrees. The first three have a goal for S_RMS (Eq. 3.13) in
# mm. The others (None) have a goal for the efficiency: the Cramér-Rao bound divided by the measured variance.
STILL: dict[tuple[int, int], float | None] = {(450, 20): 0.05, (520, 5): 0.12, (700, 30): 1.1}
STILL |= dict.fromkeys([(350, 20), (520, 0), (520, 20)])
# Point of the catheter that lies at the distance given in ``STILL``, in metres from the tip; None is the middle of the
# bands. The goals refer to the tip. A tilted catheter has its bands nearer to the camera than its tip, so the choice of
# the point changes S_RMS by up to 50 %.
TIP, MIDDLE = "tip", "middle of the bands"
POINTS: dict[str, float | None] = {TIP: 0.0, MIDDLE: None}
# Changes of a world's ``Look`` for each codec, and for each light.
_CODECS: dict[str, dict[str, Any]] = {"none": {}, "video 4:2:0": {"video": True}}
_CODECS |= {f"JPEG {quality}, 4:2:0": {"jpeg_quality": quality} for quality in (95, 75)}
_LIGHTS: dict[str, dict[str, Any]] = {
    "as everywhere here": {},
    "even, without gloss": {"ambient": 1.0, "highlight": 0.0},
    "a quarter more": {"gain": 1.25},
    "half of it": {"gain": 0.5},
    "a quarter of it": {"gain": 0.25},
}
_POSITIONS = 5  # positions of a catheter at rest, less than a pixel apart
_INVISIBLE = {Status.NO_CATHETER, Status.BANDS_MISSING, Status.NO_AXIS}
# Statuses that count as correct reasons for refusing an unanswerable scene, by the beginning of the scene's name.
_FITTING: dict[str, set[Status]] = {
    "motion across": _INVISIBLE | {Status.TOO_NARROW, Status.EDGES_UNCLEAR, Status.INCONSISTENT},
    "tilt": {Status.UNCERTAIN, Status.EDGES_UNCLEAR, Status.TOO_NARROW},
    "1200 mm away": {Status.TOO_NARROW, Status.UNCERTAIN},
    "rear out": {Status.OUT_OF_FRAME, Status.BANDS_MISSING},
    "tip out": {Status.OUT_OF_FRAME, Status.BANDS_MISSING},
    "line of sight": _INVISIBLE,
    "over": {Status.BANDS_MISSING, Status.EDGES_UNCLEAR},
}


def still(
    world: World,
    trackers: dict[str, Method],
    count: int,
    resting: Iterable[tuple[str, tuple[int, int]]] | None = None,
) -> tuple[list[Row], list[Answer]]:
    """Stability, bias, coverage and efficiency for catheters at rest, ``count`` frames at each of ``resting``.

    These are a point of ``POINTS`` and a pose of ``STILL`` each. By default each pose is measured twice: with the tip
    at the given distance, and with the middle of the bands at that distance. The middle of the bands appears at the
    centre of the frame in both cases.

    Each pose is measured at five positions less than a pixel apart. S_RMS and the standard deviation are root mean
    squares over these positions, since their values vary by 10 % or more with the subpixel position of the edges.
    """
    rows, all_answers = [], []
    pixel = 1 / float(world.camera.matrix[0, 0])
    generator = torch.Generator().manual_seed(world.seed)
    offsets = (pixel * (torch.rand(_POSITIONS, 2, generator=generator) - 0.5)).tolist()
    for where, (depth, tilt) in product(POINTS, STILL) if resting is None else resting:
        point, goal = POINTS[where], STILL[depth, tilt]
        pose = (1e-3 * depth, math.radians(tilt))
        bounds = tip_bounds(world, world.pose(*pose, point=point))
        bound, edges_bound = (1e3 * math.sqrt(covariance.trace()) for covariance in bounds)
        cases = [world.still(*pose, max(2, count // _POSITIONS), at, point) for at in offsets]
        label = f"still, {depth} mm, {tilt} deg"
        groups = [_by(answers(part, trackers, label), lambda answer: answer.method) for part in cases]
        for name in trackers:
            own = [answer for group in groups for answer in group[name]]
            row: Row = {"depth_mm": depth, "point": where, "tilt_deg": tilt, "method": name, "frames": len(own)}
            row |= {"answered": sum(answer.answered for answer in own), "s_rms_mm": "", "s_rms_error_mm": ""}
            row |= {"s_rms_goal_mm": goal or "", "sd_mm": "", "bias_mm": "", "bound_mm": round(bound, 4)}
            row |= {"edges_bound_mm": round(edges_bound, 4), "efficiency": "", "coverage": ""}
            stabilities = [_stability(group[name]) for group in groups]
            if known := [stability for stability in stabilities if stability is not None]:
                spreads = [stability.s_rms for stability in known]
                sd = _rms([stability.sd for stability in known])
                bias = float((tips_of(own) - truth_of(own)).nanmean(0).norm())
                row |= {"s_rms_mm": _mm(_rms(spreads)), "s_rms_error_mm": _mm(_error(spreads))}
                row |= {"sd_mm": _mm(sd), "bias_mm": _mm(bias)}
                row |= {"efficiency": round((bound / (1e3 * sd)) ** 2, 3), "coverage": covered(own)}
            rows.append(row)
        all_answers += [answer for group in groups for own in group.values() for answer in own]
    return rows, all_answers


def _stability(own: list[Answer]) -> protocols.Stability | None:
    """Stability of a resting tip; None without two consecutive poses."""
    known = any(a.answered and b.answered for a, b in pairwise(own))
    return protocols.s_rms(tips_of(own)) if known else None


def grids(world: World, trackers: dict[str, Method], share: float = 1.0) -> tuple[list[Row], list[Answer]]:
    """Errors of the tip on a ``share`` of the points of the grids: 2-D (Sec. 3.5.2) and faces of 3-D (Sec. 3.5.3).

    The rows contain absolute errors, errors after a rigid fit, and Acc; see :class:`protocols.GridAccuracy`.
    """
    parts = {"2D": world.grid_2d()} | {f"3D {face}": cases for face, cases in world.grid_3d().items()}
    every = max(1, round(1 / share))
    answered = {part: list(answers(cases[::every], trackers, f"grid {part}")) for part, cases in parts.items()}
    rows = []
    for name in trackers:
        own_rows = [_grid_row(part, name, given) for part, given in answered.items()]
        whole = _grid_row("3D", name, [answer for part, given in answered.items() if part != "2D" for answer in given])
        known = [row["acc_mm"] for row in own_rows[1:] if row["acc_mm"] != ""]
        whole["acc_mm"] = round(sum(known) / len(known), 4) if known else ""  # mean over the faces, as in the thesis
        rows += [*own_rows, whole]
    return rows, [answer for given in answered.values() for answer in given]


def codecs(world: World, trackers: dict[str, Method], share: float = 1.0) -> tuple[list[Row], list[Answer]]:
    """Errors on every fourth point of the 2-D grid, for frames without compression and with several codecs."""
    every = max(1, round(4 / share))
    rows, all_answers = [], []
    for codec, changes in _CODECS.items():
        cases = replace(world, look=replace(world.look, **changes)).grid_2d()[::every]
        answered = list(answers(cases, trackers, codec))
        for name in trackers:
            row = _grid_row("2D", name, answered)
            kept = ("method", "points", "refused", "median_mm", "p95_mm", "worst_mm", "coverage")
            rows.append({"codec": codec} | {key: row[key] for key in kept})
        all_answers += answered
    return rows, all_answers


def lights(world: World, tracker: Method, count: int, share: float = 1.0) -> list[Row]:
    """Influence of light on S_RMS (``count`` frames per pose) and on errors on every second point of the 2-D grid."""
    rows = []
    for light, changes in _LIGHTS.items():
        lit = replace(world, look=replace(world.look, **changes))
        row: Row = {"light": light}
        for (depth, tilt), goal in STILL.items():
            if goal is not None:
                cases = lit.still(1e-3 * depth, math.radians(tilt), max(2, count), point=POINTS[TIP])
                stability = _stability(list(answers(cases, {light: tracker}, f"light, {light}")))
                row[f"s_rms_mm_{depth}_{tilt}"] = _mm(stability.s_rms) if stability else ""
        cases = lit.grid_2d()[:: max(1, round(2 / share))]
        grid = _grid_row("2D", light, list(answers(cases, {light: tracker}, f"light, {light}")))
        rows.append(row | {key: grid[key] for key in ("points", "refused", "median_mm", "p95_mm", "coverage")})
    return rows


def scenes(
    world: World, trackers: dict[str, Method], count: int, kind: str, share: float = 1.0
) -> tuple[list[Row], list[Answer]]:
    """Outcomes of difficult scenes, one row for each scene and method.

    Args:
        world: World of the scenes; each seed of the conditions uses three of its photographs.
        trackers: Methods by name.
        count: Number of seeds of conditions, or of poses of occlusions.
        kind: "conditions" or "occlusions".
        share: Share of the cases that is measured.
    """
    if kind == "conditions":
        worlds = [_seeded(world, i) for i in range(count)]
        cases = [replace(case, name=f"{case.name}, seed {one.seed}") for one in worlds for case in conditions(one)]
    else:
        cases = occlusions(world, count)
    answered = list(answers(cases[:: max(1, round(1 / share))], trackers, kind))
    rows = []
    for (name, method), own in _by(answered, lambda answer: (_scene(answer.name), answer.method)).items():
        errors = sorted(answer.error for answer in own if answer.answered)
        refused = [answer for answer in own if not answer.answered]
        fitting: Any = ""
        if not own[0].answerable:
            statuses = next(statuses for start, statuses in _FITTING.items() if name.startswith(start))
            fitting = sum(answer.status in statuses for answer in refused)
        row: Row = {"scene": name, "method": method, "answerable": own[0].answerable} | outcomes(own)
        row |= {"reason_fits": fitting, "median_error_mm": _mm(errors[len(errors) // 2]) if errors else ""}
        row |= {"worst_error_mm": _mm(errors[-1]) if errors else ""}
        row["statuses"] = count_statuses(answer.status for answer in own)
        rows.append(row | {"reason": next((answer.reason for answer in refused), "")})
    return rows, answered


def empty(world: World, trackers: dict[str, Method], count: int) -> tuple[list[Row], list[Answer]]:
    """Outcomes of ``count`` frames without the catheter, one row for each kind and method.

    ``numbers_of_false`` lists the numbers of the frames in which the method found a pose.
    """
    answered = list(answers(negatives(world, count), trackers, "negatives"))
    rows = []
    for (kind, method), own in _by(answered, lambda answer: (answer.name.split(", ")[1], answer.method)).items():
        false = [answer.name.split(",")[0].split()[-1] for answer in own if answer.answered]
        row: Row = {"kind": kind, "method": method, "frames": len(own), "false": len(false)}
        row["statuses"] = count_statuses(answer.status for answer in own)
        rows.append(row | {"seed": world.seed, "numbers_of_false": " ".join(false)})
    return rows, answered


def one(rows: list[Row], **wanted: Any) -> Row:
    """The first row that has these values."""
    return next(row for row in rows if all(row[key] == value for key, value in wanted.items()))


def covered(own: Sequence[Answer]) -> float | str:
    """Share of poses whose 95 % ellipsoid contains the true tip; "" without any pose."""
    known = [answer for answer in own if answer.answered and answer.truth is not None]
    if not known:
        return ""
    covariance = torch.tensor([answer.covariance for answer in known], dtype=torch.float64)
    return round(protocols.coverage(tips_of(known), covariance, truth_of(known))[0], 3)


def outcomes(own: Sequence[Answer]) -> Row:
    """Numbers of frames: all, right, wrong, and refused."""
    right, wrong = sum(answer.right for answer in own), sum(answer.wrong for answer in own)
    return {"frames": len(own), "right": right, "wrong": wrong, "refused": len(own) - sum(a.answered for a in own)}


def count_statuses(statuses: Iterable[Status]) -> str:
    """Statuses with their numbers of frames, the most frequent one first."""
    return ", ".join(f"{status.name} {times}" for status, times in Counter(statuses).most_common())


def _grid_row(part: str, name: str, given: list[Answer]) -> Row:
    """Errors of one method on a part of a grid."""
    own = [answer for answer in given if answer.method == name]
    tips, truth = tips_of(own), truth_of(own)
    row: Row = {"grid": part, "method": name, "points": len(own), "refused": int(tips.isnan().any(-1).sum())}
    row |= dict.fromkeys(
        ("median_mm", "p95_mm", "worst_mm", "acc_mm", "in_plane_mm", "rigid_median_mm", "rigid_p95_mm"), ""
    )
    row["coverage"] = covered(own)
    known = tips.isfinite().all(-1).nonzero()[:, 0].tolist()
    right, down, _ = torch.eye(3, dtype=torch.float64)
    if len(known) >= 3:
        # The reference is the point with a pose that is nearest to the middle of the grid.
        reference = min(known, key=lambda i: abs(i - len(own) // 2))
        accuracy = protocols.grid_accuracy(tips, truth, reference, truth)
        row |= dict(zip(("median_mm", "p95_mm", "worst_mm"), map(_mm, accuracy.absolute), strict=True))
        row |= {"acc_mm": _mm(accuracy.acc)}
        row |= dict(zip(("rigid_median_mm", "rigid_p95_mm"), map(_mm, accuracy.rigid), strict=False))
        if part == "2D":
            row["in_plane_mm"] = _mm(protocols.planar_accuracy(tips, truth[:, :2], right, down, reference).in_plane)
    return row


def _by(given: Iterable[Answer], key: Callable[[Answer], Any]) -> dict[Any, list[Answer]]:
    """Answers grouped by a key, in the order in which the keys first occur."""
    groups: dict[Any, list[Answer]] = {}
    for answer in given:
        groups.setdefault(key(answer), []).append(answer)
    return groups


def _seeded(world: World, i: int) -> World:
    """The same world with another seed and the next three photographs."""
    images = [world.photographs[(3 * i + k) % len(world.photographs)] for k in range(min(3, len(world.photographs)))]
    return replace(world, photographs=tuple(images), seed=world.seed + i)


def _scene(name: str) -> str:
    """Name of a case without the number of its pose; all photographs have the same name."""
    return "photograph" if name.startswith("photograph") else name.split(",")[0]


def _rms(values: list[float]) -> float:
    return math.hypot(*values) / math.sqrt(len(values))


def _error(values: list[float]) -> float:
    """Standard error of the root mean square of a few values; NaN for a single value."""
    squares = [value * value for value in values]
    if len(values) < 2:
        return math.nan
    return statistics.stdev(squares) / math.sqrt(len(values)) / (2 * math.sqrt(statistics.fmean(squares)))


def _mm(metres: float) -> float:
    return round(1e3 * metres, 4)
