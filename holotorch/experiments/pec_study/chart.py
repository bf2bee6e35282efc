"""Chart of proximity effect correction (PEC): SSIM of every solver against time and number of evaluations."""

import csv
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import yaml
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.correction import APG, LBFGS, ProjectedAdam, Stage, run_stages, spread_preconditioner
from holotorch.correction.run import Callback
from holotorch.experiments.pec.config import SIGMA_MEANING
from holotorch.experiments.pec_study.bench import Bench, Track
from holotorch.experiments.runs.figures import draw_front, figure_png

# Values of SSIM at which solvers are compared, for each sigma; Algorithm 2 reaches all of them.
LEVELS = {0.66: (0.9, 0.95, 0.98), 1.0: (0.8, 0.9, 0.92), 1.5: (0.35, 0.4, 0.45), 2.0: (0.15, 0.2, 0.25)}
KINDS = ("fourier", "fresnel")
BASE = "Algorithm 2 (APG)"  # the solver that the others are compared with
CHOSEN = "L-BFGS, amplitude first"  # the solver ``lbfgs`` of a configuration of a periodic array, with its start
# Goals of the comparison. The file is part of the repository but not of an installed package.
GOALS = Path(__file__).parents[3] / "scripts" / "charts" / "pec" / "goals.yaml"


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    levels: Mapping[float, tuple[float, ...]]  # for each width of the heat kernel in pixels, as LEVELS
    size: int = 128  # pixels of the array along each axis
    steps: int = 400  # of the solvers, half as many for L-BFGS
    runs: int = 3  # of each solver, of which the one with the median time counts
    goals: bool = True  # whether the verdict compares with the goals


FULL = Amount(LEVELS)
QUICK = Amount({0.66: (0.5, 0.7)}, size=64, steps=40, runs=1, goals=False)


def pec(quick: bool = False) -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Table rows of the curves, table rows of the comparisons, PNG pictures by name, and lines of text."""
    amount = QUICK if quick else FULL
    rows, compared = [], []
    for kind in KINDS:
        for sigma in tqdm(amount.levels, desc=f"pec, {kind}", unit="sigma"):
            bench = Bench(size=amount.size, sigma_px=sigma, kind=kind)
            tracks = _tracks(bench, amount)
            for name, track in tracks.items():
                for seconds, evaluations, quality, _ in track.rows:
                    numbers = {"evaluations": evaluations, "seconds": f"{seconds:.4f}", "ssim": f"{quality:.5f}"}
                    rows.append({"kind": kind, "sigma_px": sigma, "solver": name, **numbers})
            compared += _compared(kind, sigma, tracks, amount.levels[sigma])
    return rows, compared, {"chart": _draw(rows)}, _verdict(compared, amount)


def _solvers(bench: Bench, steps: int) -> dict[str, Callable[[Callback], Any]]:
    """Functions by name that run a solver with a callback. The start is hot (thesis) unless the name states another."""
    hot, quadratic, problem = bench.start("hot"), bench.start("quadratic"), bench.experiment.problem()
    apg = APG(max_steps=steps, tolerance=0.0)
    plain = LBFGS(max_steps=steps // 2, tolerance=0.0)
    lbfgs = replace(plain, precondition=spread_preconditioner(bench.crosstalk.kernel))
    staged = [Stage(bench.experiment.problem(amplitude=True), replace(lbfgs, max_steps=20)), Stage(problem, lbfgs)]
    runs: dict[str, tuple[list[Stage], Tensor]] = {
        BASE: ([Stage(problem, apg)], hot),
        "APG, growing step, restart": ([Stage(problem, replace(apg, grow=1.3, restart=True))], hot),
        "projected Adam": ([Stage(problem, ProjectedAdam(max_steps=steps, tolerance=0.0))], hot),
        "L-BFGS": ([Stage(problem, plain)], hot),
        "L-BFGS, preconditioned": ([Stage(problem, lbfgs)], hot),
        # This run separates the effect of the quadratic start from that of the solver.
        "APG, quadratic start": ([Stage(problem, apg)], quadratic),
        "L-BFGS, amplitude first": (staged, hot),
        "L-BFGS, amplitude first, quadratic start": (staged, quadratic),
    }
    if bench.kind == "fresnel":
        runs["L-BFGS, amplitude first, cool start"] = staged, bench.start("cool")
    return {
        name: lambda callback, stages=stages, start=start: run_stages(stages, start, callback=callback)
        for name, (stages, start) in runs.items()
    }


def _tracks(bench: Bench, amount: Amount) -> dict[str, Track]:
    """Track of the run with the median time, for each solver, after one run that warms up."""
    solvers = _solvers(bench, amount.steps)
    tracks: dict[str, list[Track]] = {name: [] for name in solvers}
    for _ in range(1 + amount.runs):
        for name, solve in solvers.items():
            tracks[name].append(Track(bench, every=2))
            solve(tracks[name][-1])
    return {
        name: sorted(runs[1:], key=lambda track: track.rows[-1][0])[amount.runs // 2] for name, runs in tracks.items()
    }


def _compared(kind: str, sigma: float, tracks: dict[str, Track], levels: Sequence[float]) -> list[dict]:
    """Rows that compare every solver with ``BASE`` at each level of SSIM. Cells are empty if a level is not reached."""
    rows = []
    for name, track in tracks.items():
        for level in levels:
            row: dict[str, Any] = {"kind": kind, "sigma_px": sigma, "solver": name, "ssim": level}
            row |= dict.fromkeys(("evaluations", "seconds", "peak_rad", "evaluations_ratio", "seconds_ratio"), "")
            if reached := track.reached(level):
                seconds, evaluations, _, peak = reached
                row |= {"evaluations": evaluations, "seconds": f"{seconds:.3f}", "peak_rad": f"{peak:.1f}"}
                if base := tracks[BASE].reached(level):
                    row["evaluations_ratio"] = round(base[1] / evaluations, 2)
                    row["seconds_ratio"] = round(base[0] / max(seconds, 1e-9), 2)
            rows.append(row)
    return rows


def _verdict(compared: list[dict], amount: Amount) -> list[str]:
    """Lines of text: the ratios of every solver for each kind and sigma, and whether the goals are met."""
    lines = [
        _headline(compared),
        f"torch {torch.__version__}, {torch.get_num_threads()} threads; mean SSIM of four photographs at {amount.size} "
        f"px; how many times fewer evaluations / less time than {BASE} to equal SSIM, at its lowest and highest level",
        f"sigma: {SIGMA_MEANING}",
    ]
    goals: dict[str, dict] = {"solver": {}}
    if amount.goals and GOALS.is_file():
        goals = yaml.safe_load(GOALS.read_text(encoding="utf-8"))
    for kind, sigma in product(KINDS, amount.levels):
        ratios: dict[str, list[tuple[float, float]]] = {}
        for row in compared:
            if (row["kind"], row["sigma_px"]) == (kind, sigma) and row["solver"] != BASE and row["seconds_ratio"]:
                ratios.setdefault(row["solver"], []).append((row["evaluations_ratio"], row["seconds_ratio"]))
        parts = [f"{name} {each[0][0]}/{each[0][1]} .. {each[-1][0]}/{each[-1][1]}" for name, each in ratios.items()]
        lines.append(f"{kind}, sigma {sigma:g}: " + "; ".join(parts))
        if goal := goals["solver"].get(sigma):
            limits = goal["evaluations"], goal["seconds"]
            met = [name for name, each in ratios.items() if all(a >= limits[0] and b >= limits[1] for a, b in each)]
            lines[-1] += f" (goal {limits[0]:g}/{limits[1]:g}: {'met by ' + '; '.join(met) if met else 'not met'})"
    return lines + _tables(goals.get("thesis", {}), "reproduced") + _tables(goals.get("goals", {}), "met")


def _headline(compared: list[dict]) -> str:
    ratios = [row["seconds_ratio"] for row in compared if row["solver"] == CHOSEN and row["seconds_ratio"]]
    times = (
        f"in {1 / max(ratios):.2f} to {1 / min(ratios):.2f} of the time" if ratios else "at no level that both reach"
    )
    return f"{CHOSEN} reaches the SSIM of {BASE} {times}"


def _tables(statements: dict[str, list[dict[str, Any]]], word: str) -> list[str]:
    """Verdicts on the committed tables of the studies: a line for each table, and one for each statement about it."""
    lines = []
    for name, about in statements.items():
        path = GOALS.parent / name / "table.csv"
        if not path.is_file():
            continue
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        judged = [(_judged(_statistic(rows, statement), statement, word), statement) for statement in about]
        counts = Counter(verdict for (verdict, _), _ in judged)
        lines.append(f"{name}: " + ", ".join(f"{counts[each]} {each}" for each in counts) + f" of {len(about)}")
        lines += [f"  {verdict}: {goal['says']} ({value})" for (verdict, value), goal in judged if verdict != "met"]
    return lines


def _judged(value: float, statement: dict[str, Any], word: str) -> tuple[str, str]:
    """Verdict on a statement, and the value beside the expected one."""
    if math.isnan(value):
        return "not testable here", "no such rows"
    if "printed" in statement:
        printed, margin = statement["printed"], statement["margin"]
        verdict = word if abs(value - printed) <= margin else "exceeded" if value > printed else f"not {word}"
        return verdict, f"{value:.3g}, printed {printed:g}, margin {margin:g}"
    low, high = statement["within"]
    return word if low <= value <= high else f"not {word}", f"{value:.3g}, expected {low:g} to {high:g}"


def _statistic(rows: list[dict[str, str]], statement: dict[str, Any]) -> float:
    """Mean, range, ratio of means, or onset of a table column, as goals.yaml says; NaN without matching rows.

    The onset is the smallest sigma at which the value has fallen by the share ``fall`` below that at the first one.
    """

    def column(cells: dict[str, Any]) -> list[float]:
        allowed = {key: list(map(str, cell if isinstance(cell, list) else [cell])) for key, cell in cells.items()}
        chosen = [row for row in rows if all(row[key] in each for key, each in allowed.items())]
        return [float(row[name]) for row in chosen if row[name]]

    name = statement.get("column", "ssim")
    values = column(statement["rows"])
    if not values:
        return math.nan
    if statement.get("statistic") == "onset":
        least = (1 - statement["fall"]) * values[0]
        sigmas = [float(sigma) for sigma in statement["rows"]["sigma_px"]]
        return next((sigma for sigma, value in zip(sigmas, values, strict=True) if value < least), math.inf)
    if statement.get("statistic") == "range":
        return max(values) - min(values)
    base = column(statement["rows"] | statement["over"]) if "over" in statement else [1.0]
    return fmean(values) / fmean(base) if base else math.nan


def _draw(rows: list[dict]) -> bytes:
    """PNG of the error, 1 - SSIM, against seconds and against evaluations, with a column of panels for each sigma."""
    names = list(dict.fromkeys(row["solver"] for row in rows))
    sigmas = list(dict.fromkeys(row["sigma_px"] for row in rows))
    figure = Figure(figsize=(max(8, 4 * len(sigmas)), 3 * 2 * len(KINDS)), layout="constrained")
    panels = figure.subplots(2 * len(KINDS), len(sigmas), squeeze=False)
    for (i, kind), (j, sigma), (k, measure) in product(
        enumerate(KINDS), enumerate(sigmas), enumerate(("seconds", "evaluations"))
    ):
        axes, points = panels[2 * i + k][j], []
        for c, name in enumerate(names):
            chosen = [row for row in rows if (row["kind"], row["sigma_px"], row["solver"]) == (kind, sigma, name)]
            if chosen:
                positions = [max(float(row[measure]), 1e-3) for row in chosen]
                errors = [1 - float(row["ssim"]) for row in chosen]
                label, width = (f"{name} (the default)", 2.5) if name == CHOSEN else (name, 1.2)
                axes.loglog(positions, errors, color=f"C{c}", label=label, linewidth=width)
                points += zip(positions, errors, strict=True)
        draw_front(axes, points)
        axes.set_title(f"{kind}, sigma {sigma:g} px", fontsize=9)
        axes.set(xlabel=measure, ylabel="1 - mean SSIM")
        axes.grid(alpha=0.3)
    figure.legend(*panels[-1][0].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=9)
    return figure_png(figure)
