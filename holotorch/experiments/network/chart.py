"""Chart of a network that predicts heater phases: its quality and time beside L-BFGS, alone and as a warm start."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.core.grid import Grid
from holotorch.correction import LBFGS, Box, PECProblem
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.network.training import Crops, train
from holotorch.experiments.network.unet import PhaseUNet
from holotorch.experiments.runs.figures import draw_front, figure_png, fitted_pictures
from holotorch.metrics import ssim
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import CroppedKernel

GRID, WAVELENGTH, DISTANCE, SIGMA = Grid(96, 9e-6), 530e-9, 10e-3, 0.66
LIMIT = 4 * np.pi  # largest heater phase in rad
PHOTOGRAPHS = (
    "HOLOTORCH_PHOTOGRAPHS"  # variable that names a folder of further photographs; the last quarter is held back
)
BUNDLED = ("astronaut", "chelsea", "camera", "brick", "grass", "moon")  # for training
HELD_BACK = ("coffee", "coins", "text")  # never trained on
ROUNDS = 3  # timings of each contender, of which the median counts


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    training: int = 1200  # steps of 8 pictures
    crops: int = 4000  # of the training pictures
    scored: int = 2  # crops of each picture that is held back
    steps: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100)  # of L-BFGS


FULL = Amount()
QUICK = Amount(training=10, crops=80, scored=1, steps=(1, 2, 5, 10))


def network(quick: bool = False) -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Table rows of the scores, table rows of the training, PNG pictures by name, and lines of text."""
    amount = QUICK if quick else FULL
    trained, held = _sources()
    propagator = CroppedKernel(GRID, WAVELENGTH, DISTANCE)
    crosstalk = ThermalCrosstalk(SIGMA, 7)
    problem = PECProblem(crosstalk, propagator, scale_free=True, amplitude=True)
    torch.manual_seed(0)
    model = PhaseUNet(propagator, limit=LIMIT)
    start = time.perf_counter()
    losses = train(model, problem, Crops(trained, GRID.shape[0], amount.crops), steps=amount.training)
    seconds = time.perf_counter() - start
    pictures = Crops(held, GRID.shape[0], amount.scored * len(held), seed=99)
    rows, shown = [], {}
    for k in tqdm(range(len(pictures)), desc="scoring", unit="picture"):
        rows += _scores(model, problem, pictures[k][None], k, amount.steps, shown if k == 0 else {})
    training = [{"step": k + 1, "loss": loss} for k, loss in enumerate(losses)]
    text = _verdict(rows, seconds, len(trained), len(held), amount)
    return rows, training, {"chart": _draw(rows), "pictures": fitted_pictures(shown)}, text


def _sources() -> tuple[list[str | Path], list[str | Path]]:
    """Pictures for training, and pictures that are held back from it."""
    folder = os.environ.get(PHOTOGRAPHS)
    files = sorted(Path(folder).glob("*.png")) if folder else []
    if folder and not files:
        raise ConfigError([f"{PHOTOGRAPHS} must name a folder with PNG photographs, got {folder}"])
    files = [path for path in files if path.stem not in BUNDLED + HELD_BACK]  # copies of bundled ones would leak
    kept = len(files) - len(files) // 4
    return [*BUNDLED, *files[:kept]], [*HELD_BACK, *files[kept:]]


def _scores(
    model: PhaseUNet,
    problem: PECProblem,
    target: Tensor,
    picture: int,
    budgets: Sequence[int],
    shown: dict[str, Tensor],
) -> list[dict[str, Any]]:
    """Table rows of every contender on one target [1, 1, H, W]."""
    scored = PECProblem(problem.crosstalk, problem.propagator, target, scale_free=True, amplitude=True)
    cool = 3 + 0.3 * torch.rand(target.shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        warm, ahead = _timed(lambda: model(target))
    shown["wanted"], shown["network"] = target, problem.intensity(warm).detach()
    rows = [_row(picture, "network", 0, quality(problem, warm, target), ahead)]
    for steps in budgets:
        solver = LBFGS(max_steps=steps)
        for name, start, before in (("L-BFGS", cool, 0.0), ("L-BFGS from the network", warm, ahead)):
            phase, seconds = _timed(lambda s=solver, x=start: s(scored, x, Box(0.0, LIMIT)).x)
            rows.append(_row(picture, name, steps, quality(problem, phase, target), before + seconds))
            if steps == 10:
                shown[f"10 steps of {name}"] = problem.intensity(phase)
    return rows


def quality(problem: PECProblem, phase: Tensor, target: Tensor) -> float:
    """SSIM of the picture that ``phase`` forms, at the gain that fits the target best."""
    with torch.no_grad():
        formed = problem.intensity(phase)
        formed = formed * ((formed * target).sum() / formed.square().sum())
        top = target.max().item()
        return ssim(formed.clamp(0, top), target, data_range=top).item()


def _timed(function) -> tuple[Tensor, float]:
    """The result, and the median of the seconds of a few calls."""
    seconds, result = [], torch.empty(0)
    for _ in range(ROUNDS):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return result, float(np.median(seconds))


def _row(picture: int, method: str, steps: int, score: float, seconds: float) -> dict[str, Any]:
    return {"picture": picture, "method": method, "steps": steps, "ssim": score, "milliseconds": 1e3 * seconds}


def _means(rows: list[dict], method: str) -> dict[int, tuple[float, float]]:
    """Mean SSIM and milliseconds by number of steps."""
    steps = sorted({row["steps"] for row in rows if row["method"] == method})
    chosen = {k: [row for row in rows if (row["method"], row["steps"]) == (method, k)] for k in steps}
    return {
        k: (float(np.mean([r["ssim"] for r in of])), float(np.mean([r["milliseconds"] for r in of])))
        for k, of in chosen.items()
    }


def _verdict(rows: list[dict], seconds: float, trained: int, held: int, amount: Amount) -> list[str]:
    ((score, milliseconds),) = _means(rows, "network").values()
    cold, warm = _means(rows, "L-BFGS"), _means(rows, "L-BFGS from the network")
    equal = max((k for k, (_, ms) in cold.items() if ms <= milliseconds), default=amount.steps[0])
    lines = [
        f"network alone: SSIM {score:.3f} in {milliseconds:.0f} ms; {equal} step(s) of L-BFGS: {cold[equal][0]:.3f} in "
        f"{cold[equal][1]:.0f} ms",
        f"trained for {seconds:.0f} s on crops of {trained} pictures; scored on {amount.scored * held} crops of {held} "
        f"others, {GRID.shape[0]} px, one colour, one frame, on {torch.get_num_threads()} threads",
    ]
    for steps in (count for count in (1, 10, 100) if count in amount.steps):
        lines.append(
            f"{steps} step(s) of L-BFGS: SSIM {cold[steps][0]:.3f} in {cold[steps][1]:.0f} ms; from the network "
            f"{warm[steps][0]:.3f} in {warm[steps][1]:.0f} ms, network included"
        )
    return lines


def _draw(rows: list[dict]) -> bytes:
    """PNG of the mean error, 1 - SSIM, against the mean time."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes, points = figure.subplots(), []
    for method, marker in (("L-BFGS", "o-"), ("L-BFGS from the network", "s-"), ("network", "k*")):
        means = _means(rows, method)
        axes.loglog([ms for _, ms in means.values()], [1 - score for score, _ in means.values()], marker, label=method)
        points += [(ms, 1 - score) for score, ms in means.values()]
        for steps, (score, ms) in means.items():
            if steps:
                axes.annotate(str(steps), (ms, 1 - score), fontsize=7, textcoords="offset points", xytext=(3, -9))
    draw_front(axes, points)
    axes.set(xlabel="milliseconds for one picture (numbers: steps)", ylabel="1 - SSIM of held-back pictures, mean")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure_png(figure)
