"""Trackers on the second synthetic world: refusals, errors and coverage for each condition, on seeds not tuned on."""

from collections.abc import Iterator

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.tracking_benchmark import bench, methods
from holotorch.experiments.tracking_benchmark.bench import Row
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, Answer, Method
from holotorch.tracking.detection.photometric import PhotometricFit
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.varied import CONDITIONS, NEGATIVES, TUNING_SEEDS, Trial, VariedWorld
from holotorch.tracking.simulation.world import Case, World

FIT = "ours, cold, photometric fit"  # the fit starts from the pose of COLD
_ALL, _NONE = "all conditions", "all without the catheter"


def second_world(world: VariedWorld, frames: int, negatives: int) -> list[Row]:
    """One row for each condition or kind of negative and each method, and one for all of them.

    Args:
        world: Scenes; the seeds start behind :data:`TUNING_SEEDS`.
        frames: Number of scenes with the catheter; the conditions take turns.
        negatives: Number of scenes without it; their kinds take turns.
    """
    with_catheter = list(_answers(world, (world.trial(TUNING_SEEDS + i) for i in range(frames)), frames))
    without = list(_answers(world, (world.negative(TUNING_SEEDS + i) for i in range(negatives)), negatives))
    rows = []
    for answers, whole in ((with_catheter, _ALL), (without, _NONE)):
        groups = {whole: answers} | {name: [a for a in answers if a.name == name] for name in _names(answers)}
        for name, group in groups.items():
            for method in dict.fromkeys(answer.method for answer in group):
                rows.append(_row(name, method, [answer for answer in group if answer.method == method]))
    return rows


def verdict(rows: list[Row]) -> list[str]:
    """Lines on all conditions, on the worst of them, and on the scenes without the catheter."""
    lines = []
    for row in rows:
        own = [other for other in rows if other["method"] == row["method"]]
        text = f"second world, {row['condition']}, {row['method']}: {row['wrong']} of {row['frames']} frames "
        if row["condition"] == _NONE:
            kinds = ", ".join(
                f"{o['wrong']} of {o['frames']} {o['condition']}" for o in own if o["condition"] in NEGATIVES
            )
            lines.append(f"{text}answered ({kinds})")
        elif row["condition"] == _ALL:
            single = [other for other in own if other["condition"] in CONDITIONS and other["answerable"]]
            worst = max(single, key=lambda other: other["refused_percent"])
            text += (
                f"wrong by more than 5 mm, {row['refused_percent']} % of {row['answerable']} answerable refused (worst "
            )
            text += (
                f"condition: {worst['condition']}, {worst['refused_percent']} %), median {row['median_mm']} mm, p95 "
            )
            inside = f"the 95 % ellipsoid holds the truth in {row['coverage']} of the answers"
            lines.append(f"{text}{row['p95_mm']} mm, {inside}")
    return lines


def _names(answers: list[Answer]) -> list[str]:
    return list(dict.fromkeys(answer.name for answer in answers))


def _answers(world: VariedWorld, trials: Iterator[Trial], count: int) -> Iterator[Answer]:
    for trial in tqdm(trials, "second world", count, unit="frame", dynamic_ncols=True):
        own = World(world.size, trial.camera, world.catheter)
        trackers = methods.methods(own, (BASE, COLD))
        trackers[FIT] = _fitted(own, trackers[COLD])
        yield from methods.answers([trial.case], trackers, None)


def _fitted(world: World, track: Method) -> Method:
    """The method whose poses are those of ``track`` after a photometric fit."""
    fit = PhotometricFit(world.camera, world.catheter)

    def refine(frame: Tensor, case: Case) -> Pose:
        pose = track(frame, case)
        if not pose.answered:
            return pose
        fitted = fit(frame[None], pose.tip[None], pose.direction[None])
        if not bool(fitted.tip.isfinite().all()):
            return Pose.refused(Status.INCONSISTENT, "the photometric fit diverges")
        chi_square = (fitted.shift / fitted.shift_sd).square()[fitted.used].sum()
        freedom = fitted.used.sum().double() - 3
        return Pose(fitted.tip[0], fitted.direction[0], fitted.covariance[0], chi_square, freedom, Status.OK)

    return refine


def _row(condition: str, method: str, own: list[Answer]) -> Row:
    answerable = [answer for answer in own if answer.answerable]
    refused = sum(not answer.answered for answer in answerable)
    errors = torch.tensor([1e3 * answer.error for answer in answerable if answer.answered], dtype=torch.float64)
    row: Row = {"condition": condition, "method": method, "frames": len(own), "answerable": len(answerable)}
    row |= {"refused": refused, "refused_percent": round(100 * refused / len(answerable), 1) if answerable else ""}
    row |= {"wrong": sum(answer.wrong for answer in own), "median_mm": "", "p95_mm": "", "worst_mm": ""}
    if len(errors):
        row |= {
            key: round(float(errors.quantile(q)), 4)
            for key, q in (("median_mm", 0.5), ("p95_mm", 0.95), ("worst_mm", 1.0))
        }
    statuses = bench.count_statuses(answer.status for answer in own)
    return row | {"coverage": bench.covered([a for a in own if a.answerable]), "statuses": statuses}
