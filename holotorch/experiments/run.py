"""One run: a folder that is complete, or one that says it was interrupted; never half a file."""

import signal
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from torch import Tensor

from holotorch.correction import Solution
from holotorch.experiments import pictures
from holotorch.experiments.baselines import baseline
from holotorch.experiments.config import PECSettings, load_config
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.fingerprint import Fingerprint, fingerprint
from holotorch.experiments.judge import Result, judge
from holotorch.experiments.memory import peak_memory
from holotorch.experiments.pec import PECExperiment, build
from holotorch.experiments.perception_weight import ZONES, eccentricities, weight_map
from holotorch.experiments.plan import plan, plan_text, shortage
from holotorch.experiments.progress import Log
from holotorch.experiments.report import write_report
from holotorch.experiments.run_folder import Run, conclude, open_run, tidied
from holotorch.experiments.saving import Checkpoint, Results
from holotorch.experiments.settings import Settings
from holotorch.experiments.signals import deferred
from holotorch.experiments.source import read_source
from holotorch.io.files import save_array, write_bytes, write_json, write_text
from holotorch.io.images import encode_png

_CAPTIONS = {
    "none": "No correction",
    "chopping": "Inverse, chopped",
    "shifting": "Inverse, shifted",
    "nonnegative": "Non-negative deconvolution",
    "basic_ipec": "Basic iterative correction",
    "ipec": "Iterative correction",
    "unweighted": "Corrected, all errors alike",
    "corrected": "Corrected",
}


def run(settings: PECSettings, out: Path | None, name: str = "run") -> tuple[Path, bool]:
    """Carry a run out and fill a folder: ``out``, or the next free ``runs/NAME-001``.

    An ``out`` that holds an unfinished run of the same settings is gone on with.

    Returns:
        The folder, and whether the run is complete; if it was interrupted, what it had found is in the folder.

    Raises:
        ConfigError: The folder holds files already or cannot be written, the picture cannot be used, the run does not
            fit into memory, or the solver cannot start.
    """
    experiment = build(settings)
    values = plan(experiment)
    print(plan_text(experiment, values), flush=True)
    if text := shortage(values):
        raise ConfigError([text])
    with open_run(out, name, settings, experiment.device, settings.seed) as opened:
        return opened.path, _fill(opened, experiment, values)


def start(settings: Settings, out: Path | None, name: str) -> tuple[Path, bool]:
    """Carry out the run of any kind that the settings are of; returns and raises as :func:`run`."""
    module, function = _KINDS[settings.experiment]  # type: ignore[attr-defined]
    return getattr(import_module(f"holotorch.experiments.{module}"), function)(settings, out, name)


_KINDS = {
    "pec": ("run", "run"),
    "pec_study": ("study", "run_study"),
    "volume": ("volume_run", "run_volume"),
    "eye": ("eye_run", "run_observer"),
    "perception_layout": ("perception_layout", "run_layout"),
    "perception_analysis": ("perception_analysis_run", "run_analysis"),
}


def resume(folder: Path) -> tuple[Path, bool]:
    """Go on with an interrupted run in its folder, as if it had never stopped; returns as :func:`run`.

    Raises:
        ConfigError: The folder holds no run of this program, or its configuration no longer works, or is no longer that
            of its checkpoint.
    """
    config = folder / "config.yaml"
    held = read_source(config, []).data if config.is_file() else {}
    if held.get("experiment") == "track":
        again = f"its poses are kept, and all is tracked anew by: holotorch track {held.get('source', 'SOURCE')}"
        frames = f", the frames that it kept by: holotorch track {folder / 'recording'}"
        frames = frames if (folder / "recording").is_dir() else ""
        raise ConfigError([f"{folder} holds a tracking run, which is not resumed: {again}{frames}"])
    if not config.is_file() or not (folder / "env.json").is_file():
        raise ConfigError([f"{folder} holds no run to resume: config.yaml and env.json are not both there"])
    if (folder / "summary.json").is_file():
        print("this run is complete; nothing is left to do")
        if tidied(folder) and held.get("experiment") in ("pec", "volume", "eye"):
            write_report([folder], folder / "report.html")
        return folder, True
    return start(load_config(config), folder, folder.resolve().name)


def _fill(opened: Run, experiment: PECExperiment, values: dict[str, Any]) -> bool:
    settings, out, pressed = experiment.settings, opened.path, opened.pressed
    (out / "arrays").mkdir(exist_ok=True)
    write_json(out / "plan.json", values)
    log, files = Log(experiment, Checkpoint(out / "checkpoint.pt", _fingerprint(experiment))), Results()
    with log.saved_on_failure():
        try:
            solution = experiment.solve(log, log.resume)
        except KeyboardInterrupt:
            solution = log.last
        finally:
            log.close()
        if solution is None:
            raise KeyboardInterrupt
        seconds = log.seconds
        with deferred(pressed):  # from here on Ctrl-C is remembered; what was found is saved first
            if pressed:
                log.save()
            results = {"corrected": _result(experiment, solution, seconds)}
            files.write(save_array, out / "arrays" / "phase.npy", results["corrected"].phase.float())
        several = len(experiment.distances) > 1
        if several and settings.report.baselines:
            print("baselines are left out: they know one distance only", file=sys.stderr)
        for name in () if several else settings.report.baselines:
            try:
                if not pressed:
                    started = time.perf_counter()
                    alike = name == "unweighted"
                    found = experiment.unweighted.solve() if alike else baseline(experiment, name)
                    results[name] = _result(experiment, found, time.perf_counter() - started, single=not alike)
            except KeyboardInterrupt:
                pressed.append(signal.SIGINT)
            except ValueError as error:
                print(f"{name} is left out: {error}", file=sys.stderr)
        with deferred(pressed):
            if pressed:
                log.save()
            _write_results(out, experiment, results, log, solution, files)
            summary = {
                "experiment": settings.experiment,
                "status": "",
                "methods": {name: result.numbers for name, result in results.items()},
                "peak_memory_bytes": peak_memory(),
            }
            page, done = (lambda path: write_report([out], path)), not pressed
            return conclude(opened, summary, files, page, done=done, checkpoint=log.checkpoint)


def _fingerprint(experiment: PECExperiment) -> Fingerprint:
    """Without what a solver in steps that know nothing of their number, and the comparison after it, may have anew."""
    free = {"device", "report.baselines"}
    if experiment.settings.solver.kind != "lbfgs":  # whose stages share the steps
        free.add("solver.max_steps")
    return fingerprint(experiment.settings, {"target.image": (experiment.source,)}, free)


def _result(experiment: PECExperiment, solution: Solution, seconds: float, *, single: bool = False) -> Result:
    """Score a solution; ``single`` for phases [C, H, W] of one frame, whatever the run has."""
    result = judge(experiment, solution.x[None] if single else experiment.frames_of(solution.x))
    result.numbers.update(
        evaluations=solution.evaluations,
        steps=solution.steps.flatten().tolist(),
        converged=solution.converged.flatten().tolist(),
        stalled=solution.stalled.flatten().tolist(),
        seconds=round(seconds, 4),
    )
    return result


def _write_results(
    out: Path, experiment: PECExperiment, results: dict[str, Result], log: Log, solution: Solution, files: Results
) -> None:
    corrected = results["corrected"]
    files.write(write_text, out / "metrics.csv", log.table())
    files.write(save_array, out / "arrays" / "intensity.npy", corrected.picture)
    files.write(save_array, out / "arrays" / "target.npy", experiment.image)
    shown = {"target": experiment.image} | {name: results[name].picture for name in _CAPTIONS if name in results}
    captions = ["Target", *(_CAPTIONS[name] + _score(results[name].numbers) for name in shown if name in results)]
    if corrected.isolated is not None and not experiment.isolated:
        shown["isolated"] = corrected.isolated
        captions.append("Corrected, on a chip that stands alone" + _score(corrected.numbers["isolated"]))
    for name, picture in shown.items():
        files.write(write_bytes, out / "images" / f"{name}.png", encode_png(picture))
    names = [f"{wave * 1e9:.0f} nm" for wave in experiment.wavelengths]
    phase = corrected.phase[0][experiment.lit].to(experiment.device)  # of several frames, the first
    warm = experiment.array.temperature(experiment.array.crosstalk(phase)).cpu()
    figures = {
        "comparison": pictures.comparison(list(shown.values()), captions),
        "phase": pictures.channel_maps(phase.cpu(), names, "heater phase (rad)", "viridis"),
        "temperature": pictures.channel_maps(warm, names, "temperature rise (degC)", "inferno", (0, None)),
        "convergence": pictures.convergence(_per_colour(solution.losses, len(names)), names, log.checked, log.metric),
    }
    if weight := experiment.settings.target.weight:
        shape, rings = experiment.grid.shape, [zone[0] for zone in ZONES[1:]]
        away = eccentricities(weight, shape)
        figures["weight"] = pictures.visual_field(weight_map(weight, shape), away, weight.field_deg, rings, "weight")
    for name, data in figures.items():
        files.write(write_bytes, out / "images" / f"{name}.png", data)


def _per_colour(losses: Tensor, colours: int) -> Tensor:
    """Losses [steps, ..., C] as [steps, C], the mean of independent frames."""
    return losses.reshape(len(losses), -1, colours).mean(1)


def _score(numbers: dict[str, Any]) -> str:
    return f", SSIM {numbers['ssim_mean']:.3f}" if "ssim_mean" in numbers else ""
