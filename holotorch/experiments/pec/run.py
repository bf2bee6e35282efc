"""A run of the kind ``pec``: solved, judged beside the baselines, drawn."""

import signal
import sys
import time
from pathlib import Path
from typing import Any

from torch import Tensor

from holotorch.correction import Solution
from holotorch.experiments.pec.baselines import baseline
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.judge import Result, judge
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.pec.weight import ZONES, eccentricities, weight_map
from holotorch.experiments.runs import pictures
from holotorch.experiments.runs.fingerprint import Fingerprint, fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.io.files import save_array, write_bytes, write_text
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


def run_pec(experiment: PECExperiment, opened: RunFolder) -> bool:
    """Solve for the phases, judge them beside the baselines, fill the folder; whether the run is complete."""
    settings, out, pressed = experiment.settings, opened.path, opened.pressed
    (out / "arrays").mkdir(exist_ok=True)
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
            return conclude(opened, summary, files, done=not pressed, checkpoint=log.checkpoint)


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
