"""Chart of PEC: SSIM by time and by evaluations of every solver, on the same photographs in one process."""

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.correction import APG, LBFGS, ProjectedAdam, Solution, Stage, run_stages, spread_preconditioner
from holotorch.correction.run import Callback
from holotorch.experiments.pec.config import SIGMA_MEANING
from holotorch.experiments.pec_study.bench import Bench, Track

SIGMAS = (0.66, 1.0, 1.5, 2.0)
KINDS = ("fourier", "fresnel")
SIZE, STEPS = 128, 400
# SSIM at which times and evaluations are compared, by sigma: up to the highest that Algorithm 2 reaches.
LEVELS = {0.66: (0.9, 0.95, 0.98), 1.0: (0.8, 0.9, 0.92), 1.5: (0.35, 0.4, 0.45), 2.0: (0.15, 0.2, 0.25)}
BASE = "Algorithm 2 (APG)"
# In a checkout, beside the committed charts.
GOALS = Path(__file__).parents[3] / "scripts" / "charts" / "pec" / "goals.yaml"


def pec() -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Rows of the curves, rows of the comparisons, pictures by name, and the verdict."""
    rows, compared = [], []
    for kind in KINDS:
        for sigma in tqdm(SIGMAS, desc=f"pec, {kind}", unit="sigma"):
            bench = Bench(size=SIZE, sigma_px=sigma, kind=kind)
            tracks = _tracks(bench)
            for name, track in tracks.items():
                for seconds, evaluations, quality, _ in track.rows:
                    numbers = {"evaluations": evaluations, "seconds": f"{seconds:.4f}", "ssim": f"{quality:.5f}"}
                    rows.append({"kind": kind, "sigma_px": sigma, "solver": name, **numbers})
            compared += _compared(kind, sigma, tracks)
    return rows, compared, {"chart": _draw(rows)}, _verdict(compared)


def _solvers(bench: Bench) -> dict[str, Callable[[Callback], Any]]:
    """Solvers by name, from the thesis's hot start unless their entry uses another; only a step count stops them."""
    hot, quadratic = bench.start("hot"), bench.start("quadratic")
    problem, amplitude = bench.problem(), bench.problem(amplitude=True)
    precondition = spread_preconditioner(bench.crosstalk.kernel)

    def lbfgs(steps: int, *, preconditioned: bool = True) -> LBFGS:
        return LBFGS(precondition=precondition if preconditioned else None, max_steps=steps, tolerance=0.0)

    def staged(start: Tensor, callback: Callback) -> Solution:
        stages = [Stage(amplitude, lbfgs(20)), Stage(problem, lbfgs(STEPS // 2))]
        return run_stages(stages, start, callback=callback)

    single = {
        BASE: (APG(max_steps=STEPS, tolerance=0.0), hot),
        "APG, growing step, restart": (APG(max_steps=STEPS, grow=1.3, restart=True, tolerance=0.0), hot),
        "projected Adam": (ProjectedAdam(max_steps=STEPS, tolerance=0.0), hot),
        "L-BFGS": (lbfgs(STEPS // 2, preconditioned=False), hot),
        "L-BFGS, preconditioned": (lbfgs(STEPS // 2), hot),
        # The quadratic start helps Algorithm 2 too; this separates its share from that of the solver.
        "APG, quadratic start": (APG(max_steps=STEPS, tolerance=0.0), quadratic),
    }
    solvers: dict[str, Callable[[Callback], Any]] = {
        name: lambda callback, solver=solver, start=start: solver(problem, start, callback=callback)
        for name, (solver, start) in single.items()
    }
    starts = {"": hot, ", quadratic start": quadratic}
    if bench.kind == "fresnel":
        starts[", cool start"] = bench.start("cool")
    for words, start in starts.items():
        solvers[f"L-BFGS, amplitude first{words}"] = lambda callback, start=start: staged(start, callback)
    return solvers


def _tracks(bench: Bench) -> dict[str, Track]:
    """Track of each solver: the run with the median time of three, as times are noisy."""
    solvers = _solvers(bench)
    tracks: dict[str, list[Track]] = {name: [] for name in solvers}
    for round_ in range(4):
        for name, work in solvers.items():
            track = Track(bench, every=2)
            work(track)
            if round_:  # the first warms up
                tracks[name].append(track)
    return {name: sorted(runs, key=lambda track: track.rows[-1][0])[1] for name, runs in tracks.items()}


def _compared(kind: str, sigma: float, tracks: dict[str, Track]) -> list[dict]:
    """Rows of the comparison of every solver with the base at each level of SSIM."""
    rows = []
    for name, track in tracks.items():
        for level in LEVELS[sigma]:
            reached, base = track.reached(level), tracks[BASE].reached(level)
            ratios = {"evaluations_ratio": "", "seconds_ratio": ""}
            if reached and base:
                ratios = {
                    "evaluations_ratio": round(base[1] / reached[1], 2),
                    "seconds_ratio": round(base[0] / max(reached[0], 1e-9), 2),
                }
            seconds, evaluations, _, peak = reached if reached else ("", "", "", "")
            rows.append(
                {
                    "kind": kind,
                    "sigma_px": sigma,
                    "solver": name,
                    "ssim": level,
                    "evaluations": evaluations,
                    "seconds": f"{seconds:.3f}" if reached else "",
                    "peak_rad": f"{peak:.1f}" if reached else "",
                    **ratios,
                }
            )
    return rows


def _verdict(compared: list[dict]) -> list[str]:
    """Ratios of every solver, a line per kind and sigma, and whether the goals of the checkout are met."""
    lines = [
        f"torch {torch.__version__}, {torch.get_num_threads()} threads; mean SSIM of four photographs at {SIZE} px; "
        f"how many times fewer evaluations / less time than {BASE} to equal SSIM, at its lowest and highest level",
        f"sigma: {SIGMA_MEANING}",
    ]
    goals = yaml.safe_load(GOALS.read_text(encoding="utf-8")) if GOALS.is_file() else {"solver": {}, "tables": {}}
    for kind in KINDS:
        for sigma in SIGMAS:
            rows = [row for row in compared if (row["kind"], row["sigma_px"]) == (kind, sigma)]
            ratios: dict[str, list[tuple[float, float]]] = {}
            for row in rows:
                if row["solver"] != BASE and row["seconds_ratio"]:
                    ratios.setdefault(row["solver"], []).append((row["evaluations_ratio"], row["seconds_ratio"]))
            parts = [
                f"{name} {each[0][0]}/{each[0][1]} .. {each[-1][0]}/{each[-1][1]}" for name, each in ratios.items()
            ]
            lines.append(f"{kind}, sigma {sigma:g}: " + "; ".join(parts))
            if goal := goals["solver"].get(sigma):
                wanted = goal["evaluations"], goal["seconds"]
                met = [name for name, each in ratios.items() if all(a >= wanted[0] and b >= wanted[1] for a, b in each)]
                lines[-1] += f" (goal {wanted[0]:g}/{wanted[1]:g}: {'met by ' + '; '.join(met) if met else 'not met'})"
    return lines + _tables(goals["tables"])


def _tables(goals: dict[str, list[dict[str, Any]]]) -> list[str]:
    """A line for each committed table of a study: how many of its goals and statements of the thesis are met."""
    lines = []
    for name, statements in goals.items():
        path = GOALS.parent / name / "table.csv"
        if not path.is_file():
            continue
        with open(path, newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        missed = []
        for statement in statements:
            value, (low, high) = _statistic(rows, statement), statement["within"]
            if not low <= value <= high:
                missed.append(f"; not met: {statement['says']} ({value:.3g}, expected {low:g} to {high:g})")
        lines.append(f"{name}: {len(statements) - len(missed)} of {len(statements)} met" + "".join(missed))
    return lines


def _statistic(rows: list[dict[str, str]], statement: dict[str, Any]) -> float:
    """Mean, range or ratio of means that a statement asks for, as goals.yaml explains; NaN without such rows."""

    def column(cells: dict[str, Any]) -> list[float]:
        allowed = {key: list(map(str, cell if isinstance(cell, list) else [cell])) for key, cell in cells.items()}
        chosen = [row for row in rows if all(row[key] in each for key, each in allowed.items())]
        return [float(row[name]) for row in chosen if row[name]]

    name = statement.get("column", "ssim")
    values = column(statement["rows"])
    if not values:
        return math.nan
    if statement.get("statistic") == "range":
        return max(values) - min(values)
    base = column(statement["rows"] | statement["over"]) if "over" in statement else [1.0]
    return fmean(values) / fmean(base) if base else math.nan


def _draw(rows: list[dict]) -> bytes:
    """SSIM against seconds and against evaluations, a column per sigma."""
    names = list(dict.fromkeys(row["solver"] for row in rows))
    figure = Figure(figsize=(4 * len(SIGMAS), 3 * 2 * len(KINDS)), layout="constrained")
    panels = figure.subplots(2 * len(KINDS), len(SIGMAS), squeeze=False)
    for i, kind in enumerate(KINDS):
        for j, sigma in enumerate(SIGMAS):
            for k, measure in enumerate(("seconds", "evaluations")):
                axes = panels[2 * i + k][j]
                for c, name in enumerate(names):
                    chosen = [r for r in rows if (r["kind"], r["sigma_px"], r["solver"]) == (kind, sigma, name)]
                    if chosen:
                        positions = [max(float(row[measure]), 1e-3) for row in chosen]
                        axes.semilogx(positions, [float(row["ssim"]) for row in chosen], color=f"C{c}", label=name)
                axes.set_title(f"{kind}, sigma {sigma:g} px", fontsize=9)
                axes.set_xlabel(measure)
                axes.set_ylabel("mean SSIM")
                axes.grid(alpha=0.3)
    handles, labels = panels[-1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, fontsize=9)
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()
