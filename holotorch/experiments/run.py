"""One run: a folder that is complete, or one that says it was interrupted; never half a file."""

import datetime
import os
import platform
import re
import resource
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
import yaml
from tqdm import tqdm

import holotorch
from holotorch.correction import Solution
from holotorch.experiments import pictures
from holotorch.experiments.config import NearFieldSettings, PECSettings
from holotorch.experiments.pec import PECExperiment, Result, build
from holotorch.experiments.plan import plan, plan_text
from holotorch.experiments.report import write_report
from holotorch.io.files import replacing, save_array, write_bytes, write_json, write_text
from holotorch.io.images import encode_png

_CHECK_EVERY = 10  # steps between two measurements of SSIM, which costs about as much as a step


def run(settings: PECSettings, out: Path) -> bool:
    """Carry a run out and fill the folder ``out``. Returns False if it was interrupted; what was found is saved then.

    Raises:
        ValueError: The folder holds a run already or cannot be written, or the picture cannot be used.
    """
    experiment = build(settings)
    values = plan(experiment)
    print(plan_text(experiment, values), flush=True)
    _check_memory(values["predicted_peak_bytes"])
    _prepare(out)
    write_text(out / "config.yaml", yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
    write_json(out / "env.json", environment(settings, experiment))
    write_json(out / "plan.json", values)

    log = _Log(experiment)
    started = time.perf_counter()
    interrupted = False
    try:
        solution = experiment.solve(log)
    except KeyboardInterrupt:
        interrupted, solution = True, log.last
        if solution is None:
            raise
    finally:
        log.close()
    seconds = time.perf_counter() - started - log.seconds_spent

    results = {"corrected": experiment.judge(solution.x)}
    results["corrected"].numbers.update(_effort(experiment, solution, seconds))
    try:
        for name in () if interrupted else settings.report.baselines:
            results[name] = _baseline(experiment, name)
    except KeyboardInterrupt:
        interrupted = True
    _write_results(out, experiment, results, log, solution)
    summary = {
        "experiment": settings.experiment,
        "status": "interrupted" if interrupted else "complete",
        "methods": {name: result.numbers for name, result in results.items()},
        "peak_memory_bytes": peak_memory(),
    }
    name = "interrupted.json" if interrupted else "summary.json"
    write_json(out / name, summary)
    write_report([out], out / "report.html")
    return not interrupted


def next_folder(name: str) -> Path:
    """``runs/NAME-001`` or the next free number; the default place of a run."""
    parent = Path("runs")
    taken = [int(match[1]) for path in parent.glob(f"{name}-*") if (match := re.search(r"-(\d+)$", path.name))]
    return parent / f"{name}-{max(taken, default=0) + 1:03d}"


def environment(settings: PECSettings, experiment: PECExperiment) -> dict[str, Any]:
    """Versions, device, seed and git state: what is needed to repeat the run."""
    packages = ("torch", "numpy", "kornia", "scikit-image", "opencv-contrib-python-headless")
    gpu = torch.cuda.get_device_name(experiment.device) if experiment.device.type == "cuda" else None
    return {
        "holotorch": holotorch.__version__,
        "git": _git_state(),
        "python": platform.python_version(),
        "packages": {name: metadata.version(name) for name in packages},
        "platform": platform.platform(),
        "device": gpu or f"CPU, {torch.get_num_threads()} threads",
        "seed": settings.seed,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": ["holotorch", *sys.argv[1:]],
    }


def peak_memory() -> int:
    """Largest resident size of this process so far, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


class _Log:
    """Callback of the solver: progress bar, rows of metrics.csv, and the last state for an interrupted run."""

    def __init__(self, experiment: PECExperiment):
        self.experiment, self.last = experiment, None
        self.rows: list[list[str]] = []
        self.checked: list[tuple[int, float]] = []
        self.seconds_spent = 0.0
        self.started = time.perf_counter()
        self.bar = tqdm(total=experiment.settings.solver.max_steps, desc="correcting", unit="step", dynamic_ncols=True)

    def __call__(self, solution: Solution) -> None:
        entered = time.perf_counter()
        self.last = solution
        step = len(solution.losses) - 1
        quality = ""
        if step % _CHECK_EVERY == 0 and "ssim" in self.experiment.settings.report.metrics:
            score = self.experiment.judge(solution.x).numbers["ssim_mean"]
            self.checked.append((step, score))
            quality = f"{score:.6f}"
        losses = solution.losses[-1].tolist()
        elapsed = entered - self.started - self.seconds_spent
        self.rows.append([str(step), str(solution.evaluations), f"{elapsed:.4f}", quality, *map(repr, losses)])
        relative = (solution.losses[-1] / solution.losses[0].clamp(min=1e-30)).mean().item()
        shown = {"loss": f"{relative:.2e}", "mem": f"{peak_memory() / 1e9:.2f}GB"}
        if self.checked:
            shown["ssim"] = f"{self.checked[-1][1]:.4f}"
        self.bar.set_postfix(shown, refresh=False)
        self.bar.update()
        self.seconds_spent += time.perf_counter() - entered

    def close(self) -> None:
        self.bar.close()

    def table(self) -> str:
        colours = [f"loss_{wave * 1e9:.0f}nm" for wave in self.experiment.wavelengths]
        header = ["step", "evaluations", "seconds", "ssim_mean", *colours]
        return "\n".join(",".join(row) for row in [header, *self.rows]) + "\n"


def _prepare(out: Path) -> None:
    for name in ("summary.json", "interrupted.json"):
        if (out / name).exists():
            raise ValueError(f"{out} holds a run already ({name}); choose another --out or delete it")
    try:
        for folder in (out, out / "arrays", out / "images"):
            folder.mkdir(parents=True, exist_ok=True)
        with replacing(out / "plan.json") as stream:
            stream.write(b"{}\n")
    except OSError as error:
        raise ValueError(f"cannot write to {out}: {error.strerror}; choose another place with --out") from None


def _check_memory(needed: int) -> None:
    meminfo = Path("/proc/meminfo")
    match = re.search(r"MemAvailable:\s+(\d+) kB", meminfo.read_text()) if meminfo.is_file() else None
    if match and needed > int(match[1]) * 1024:
        raise ValueError(
            f"the run needs about {needed / 1e9:.1f} GB and {int(match[1]) / 1e6:.1f} GB are free; use a smaller "
            "grid, a shorter distance or less padding (propagator.pad)"
        )


def _baseline(experiment: PECExperiment, name: str) -> Result:
    started = time.perf_counter()
    solution = experiment.baseline(name)
    seconds = time.perf_counter() - started
    result = experiment.judge(solution.x)
    result.numbers.update(_effort(experiment, solution, seconds))
    return result


def _effort(experiment: PECExperiment, solution: Solution, seconds: float) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "evaluations": solution.evaluations,
        "steps": solution.steps.tolist(),
        "converged": solution.converged.tolist(),
        "stalled": solution.stalled.tolist(),
        "seconds": round(seconds, 4),
    }
    if isinstance(experiment.settings.propagator, NearFieldSettings):
        numbers["isolated"] = experiment.judge_isolated(solution.x)
    return numbers


def _write_results(
    out: Path, experiment: PECExperiment, results: dict[str, Result], log: _Log, solution: Solution
) -> None:
    corrected = results["corrected"]
    write_text(out / "metrics.csv", log.table())
    save_array(out / "arrays" / "phase.npy", corrected.phase.float()[None])  # [F, C, H, W] with one frame
    save_array(out / "arrays" / "intensity.npy", corrected.picture)
    save_array(out / "arrays" / "target.npy", experiment.image)
    write_bytes(out / "images" / "target.png", encode_png(experiment.image))
    for name, result in results.items():
        write_bytes(out / "images" / f"{name}.png", encode_png(result.picture))
    names = [f"{wave * 1e9:.0f} nm" for wave in experiment.wavelengths]
    phase = corrected.phase[experiment.lit]
    warm = experiment.array.temperature(experiment.crosstalk(phase))
    shown = {"target": experiment.image} | {name: results[name].picture for name in _CAPTIONS if name in results}
    captions = ["Target", *(f"{_CAPTIONS[name]}{_score(results[name])}" for name in shown if name in results)]
    figures = {
        "comparison": pictures.comparison(list(shown.values()), captions),
        "phase": pictures.channel_maps(phase, names, "heater phase (rad)", "viridis"),
        "temperature": pictures.channel_maps(warm, names, "temperature rise (K)", "inferno", (0, None)),
        "convergence": pictures.convergence(solution.losses, names, log.checked),
    }
    for name, data in figures.items():
        write_bytes(out / "images" / f"{name}.png", data)


_CAPTIONS = {"none": "No correction", "basic_ipec": "Basic iterative correction", "corrected": "Corrected"}


def _score(result: Result) -> str:
    return f", SSIM {result.numbers['ssim_mean']:.3f}" if "ssim_mean" in result.numbers else ""


def _git_state() -> str | None:
    folder = os.path.dirname(os.path.abspath(holotorch.__file__))
    try:
        words = ["git", "-C", folder, "describe", "--always", "--dirty", "--abbrev=12"]
        answer = subprocess.run(words, capture_output=True, text=True, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None
