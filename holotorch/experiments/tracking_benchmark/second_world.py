"""Trackers on the second synthetic world: refusals, errors and coverage for each condition, on seeds not tuned on."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import chain

import torch
from tqdm import tqdm

from holotorch.experiments.tracking_benchmark import bench, methods
from holotorch.experiments.tracking_benchmark.bench import Row
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, FIT, Answer
from holotorch.tracking.pose.rolling_shutter import READOUT
from holotorch.tracking.simulation.varied import CONDITIONS, NEGATIVES, TUNING_SEEDS, Trial, VariedWorld
from holotorch.tracking.simulation.world import World

_FEW = 48  # scenes below which further processes take longer to start than they save
# Largest percentages of refusals over all and in the worst condition, number of wrong poses, and median errors in mm.
_GOALS = {"refused": 8.0, "worst": 20.0, "wrong": 0.0, "median": 0.15, "clean": 0.06}
_ALL, _NONE = "all conditions", "all without the catheter"


def second_world(world: VariedWorld, frames: int, negatives: int) -> list[Row]:
    """One row for each condition or kind of negative and each method, and one for all of them.

    Args:
        world: Scenes; the seeds start behind :data:`TUNING_SEEDS`.
        frames: Number of scenes with the catheter; the conditions take turns.
        negatives: Number of scenes without it; their kinds take turns.
    """
    with_catheter = list(_answers(partial(_seen, world, world.trial), frames))
    without = list(_answers(partial(_seen, world, world.negative), negatives))
    rows = []
    for answers, whole in ((with_catheter, _ALL), (without, _NONE)):
        groups = {whole: answers} | {name: [a for a in answers if a.name == name] for name in _names(answers)}
        for name, group in groups.items():
            for method in dict.fromkeys(answer.method for answer in group):
                rows.append(_row(name, method, [answer for answer in group if answer.method == method]))
    return rows


def verdict(rows: list[Row], goal: Callable[[float, float], str]) -> list[str]:
    """Lines on all conditions, on the worst of them, and on the scenes without the catheter.

    ``goal`` turns a value and the largest one that is aimed at into text; only the tracker has such goals.
    """

    def aim(method: object, value: float | str, limit: float) -> str:
        return goal(float(value), limit) if method == COLD and value != "" else ""

    lines = []
    for row in rows:
        method = row["method"]
        own = {other["condition"]: other for other in rows if other["method"] == method}
        text = f"second world, {row['condition']}, {method}: {row['wrong']} of {row['frames']} frames "
        if row["condition"] == _NONE:
            kinds = ", ".join(
                f"{own[kind]['wrong']} of {own[kind]['frames']} {kind}" for kind in NEGATIVES if kind in own
            )
            lines.append(f"{text}answered{aim(method, row['wrong'], _GOALS['wrong'])}: {kinds}")
        elif row["condition"] == _ALL:
            single = [own[name] for name in CONDITIONS if name in own and own[name]["answerable"]]
            worst = max(single, key=lambda other: other["refused_percent"])
            lost, most = row["refused_percent"], worst["refused_percent"]
            text += f"wrong by more than 5 mm{aim(method, row['wrong'], _GOALS['wrong'])}, {lost} % of "
            text += (
                f"{row['answerable']} answerable refused{aim(method, lost, _GOALS['refused'])}, at worst {most} % of "
            )
            text += f"{worst['condition']}{aim(method, most, _GOALS['worst'])}, median {row['median_mm']} mm"
            text += (
                f"{aim(method, row['median_mm'], _GOALS['median'])}, p95 {row['p95_mm']} mm, the 95 % ellipsoid holds "
            )
            text += f"the truth in {row['coverage']} of the answers"
            if "clean" in own:
                median = own["clean"]["median_mm"]
                text += f"; clean scenes: median {median} mm{aim(method, median, _GOALS['clean'])}"
            lines.append(text)
    return lines


def _names(answers: list[Answer]) -> list[str]:
    return list(dict.fromkeys(answer.name for answer in answers))


def _answers(seen: partial[list[Answer]], count: int) -> Iterator[Answer]:
    """Answers to ``count`` scenes, in the order of their seeds; many scenes are shared among all cores."""
    seeds = range(TUNING_SEEDS, TUNING_SEEDS + count)
    bar = partial(tqdm, desc="second world", total=count, unit="frame", dynamic_ncols=True)
    if count < _FEW:
        yield from chain.from_iterable(bar(map(seen, seeds)))
        return
    context = multiprocessing.get_context("spawn")  # a copy of a process with threads may hang
    with ProcessPoolExecutor(os.cpu_count(), context, torch.set_num_threads, (1,)) as pool:
        yield from chain.from_iterable(bar(pool.map(seen, seeds, chunksize=8)))


def _seen(world: VariedWorld, scene: Callable[[int], Trial], seed: int) -> list[Answer]:
    """Answers of all methods to the scene of a seed."""
    trial = scene(seed)
    own = World(world.size, trial.camera, world.catheter)
    # The kind of the camera's shutter is known, as its intrinsics are; the motion while the rows are read is not.
    readout = READOUT if trial.rolling_shutter else 0.0
    trackers = methods.methods(own, (BASE, COLD, FIT), readout=readout)
    return list(methods.answers([trial.case], trackers, None))


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
