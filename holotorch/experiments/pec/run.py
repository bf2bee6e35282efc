"""Run of kind ``pec``: the solver, the baselines, their evaluation, and the files of the run folder."""

import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from holotorch.correction import Solution
from holotorch.experiments.pec.baselines import baseline
from holotorch.experiments.pec.evaluation import (
    Result,
    evaluate,
    speckle_spots,
    with_continued_kernel,
    with_even_kernel,
    with_noisy_kernels,
)
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.measured import pec_errors
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.pec.report import BETWEEN_NAME, ISOLATED_NAME, METHOD_NAMES
from holotorch.experiments.pec.weight import ZONES, eccentricities, weight_map
from holotorch.experiments.planning.errors import measured_values
from holotorch.experiments.runs import figures
from holotorch.experiments.runs.fingerprint import Fingerprint, fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.pictures import in_colour, save_picture
from holotorch.experiments.runs.processes import collected, from_first, process_count
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.timing import timed
from holotorch.io.files import save_array, write_bytes, write_text


def run_pec(experiment: PECExperiment, opened: RunFolder) -> bool:
    """Solve for the phases, evaluate them and the baselines, and fill the folder. True if the run is complete.

    Several processes share the solver and the baselines; only the first one fills the folder.
    """
    settings, out, signals = experiment.settings, opened.path, opened.signals
    if process_count()[0] > 0:
        solution = experiment.solve(resume=from_first(None))
        if settings.solver.reruns:
            rerun(experiment, solution, 0.0)
        _baselines(experiment, signals)
        return True
    (out / "arrays").mkdir(exist_ok=True)
    log, files = Log(experiment, Checkpoint(out / "checkpoint.pt", _fingerprint(experiment))), Results()
    with log.saved_on_failure(signals):
        try:
            solution = experiment.solve(log, from_first(log.resume))
        except KeyboardInterrupt:
            solution = log.last
        finally:
            log.bar.close()
        if solution is None:
            raise KeyboardInterrupt
        seconds = log.seconds
        attempts: dict[str, Any] = {}
        try:
            if settings.solver.reruns and not signals:
                solution, seconds, attempts["dark_spots_of_attempts"] = rerun(experiment, solution, seconds)
        except KeyboardInterrupt:
            signals.append(signal.SIGINT)
        with deferred(signals):  # from here on Ctrl-C takes effect only after the results are saved
            if signals:
                log.save()
            results = {"corrected": _result(experiment, solution, seconds)}
            results["corrected"].numbers.update(attempts)
            if not signals:
                results["corrected"].numbers.update(_with_other_kernels(experiment, results["corrected"].phase))
            files.write(save_array, out / "arrays" / "phase.npy", results["corrected"].phase.float())
        results |= _baselines(experiment, signals)
        errors = None if signals else measured_values(lambda: pec_errors(experiment, solution))
        with deferred(signals):
            if signals:
                log.save()
            _write_results(out, experiment, results, log, solution, files)
            summary = {
                "experiment": settings.experiment,
                "status": "",
                "methods": {name: result.numbers for name, result in results.items()},
                **(errors or {}),
                "peak_memory_bytes": peak_memory(),
            }
            return conclude(opened, summary, files, done=errors is not None and not signals, checkpoint=log.checkpoint)


def _fingerprint(experiment: PECExperiment) -> Fingerprint:
    """Settings and inputs that must not change before a run is resumed."""
    free = {"device", "report.baselines", "report.kernel_noise", "solver.reruns"}  # computed after the solver
    if experiment.settings.tolerance is None:
        free.add("tolerance")  # checkpoints of before there was one do not have it
    chip = experiment.settings.modulator
    if chip.rad_per_K_at == type(chip).model_fields["rad_per_K_at"].default:
        free.add("modulator.rad_per_K_at")  # the same
    if experiment.settings.solver.kind != "lbfgs":  # the stages of L-BFGS depend on max_steps
        free.add("solver.max_steps")
    inputs: dict[str, tuple[Any, ...]] = {"target.image": (experiment.source,)}
    if experiment.settings.modulator.kernel is not None:
        inputs["modulator.kernel"] = (experiment.array.crosstalk.kernel,)
    kept = fingerprint(experiment.settings, inputs, free)
    # This entry refuses checkpoints of version 0.1.0, whose joint frames are [C, F, H, W], the same shape if F = C.
    return kept | ({"axes of joint frames": "F, C, H, W"} if experiment.joint else {})


def _with_other_kernels(experiment: PECExperiment, phase: Tensor) -> dict[str, Any]:
    """Scores of the phases of all colours [F, C, H, W] on chips whose heat kernel is not quite the assumed one."""
    phase, numbers = phase[:, experiment.lit].to(experiment.device), dict[str, Any]()
    if (noise := experiment.settings.report.kernel_noise) is not None:
        numbers["kernel_noise"] = with_noisy_kernels(experiment, phase, noise)
    if (scores := with_even_kernel(experiment, phase)) is not None:
        numbers["kernel_even"] = scores
    if (scores := with_continued_kernel(experiment, phase)) is not None:
        numbers["kernel_continued"] = scores
    return numbers


def _result(experiment: PECExperiment, solution: Solution, seconds: float, *, single: bool = False) -> Result:
    """Scores of a solution; ``single`` if it has one frame [C, H, W] although the run has several."""
    result = evaluate(experiment, solution.x[None] if single else experiment.heater_phases(solution.x))
    result.numbers.update(
        evaluations=solution.evaluations,
        steps=solution.steps.flatten().tolist(),
        converged=solution.converged.flatten().tolist(),
        stalled=solution.stalled.flatten().tolist(),
        seconds=round(seconds, 4),
    )
    return result


def _baselines(experiment: PECExperiment, signals: list[int]) -> dict[str, Result]:
    """Results of the baselines by name. Each process computes some of them, and the first one receives all."""
    (rank, count), names = process_count(), experiment.settings.report.baselines
    results: dict[str, Result] = {}
    try:
        for index, name in enumerate(names):
            mine, unweighted = index % count == rank, name == "unweighted"
            if signals or not (mine or unweighted):  # all processes share the solver of the unweighted phases
                continue
            try:
                solve = experiment.unweighted.solve if unweighted else partial(baseline, experiment, name)
                solution, seconds = timed(solve)
                if mine:
                    results[name] = _result(experiment, solution, seconds, single=not unweighted)
            except ValueError as error:
                print(f"{name} is left out: {error}", file=sys.stderr)
        if not signals:
            for others in collected(results):
                results |= others
    except KeyboardInterrupt:
        signals.append(signal.SIGINT)
    return {name: results[name] for name in names if name in results}


def _write_results(
    out: Path, experiment: PECExperiment, results: dict[str, Result], log: Log, solution: Solution, files: Results
) -> None:
    corrected = results["corrected"]
    files.write(write_text, out / "metrics.csv", log.table())
    files.write(save_array, out / "arrays" / "intensity.npy", corrected.picture)
    files.write(save_array, out / "arrays" / "target.npy", experiment.image)
    shown = {"target": experiment.image} | {name: results[name].picture for name in METHOD_NAMES if name in results}
    captions = ["Target", *(_caption(experiment, name, results[name].numbers) for name in shown if name in results)]
    shown["between"] = corrected.between
    captions.append(BETWEEN_NAME + _score(corrected.numbers["between_samples"]))
    if corrected.isolated is not None and not experiment.isolated:
        shown["isolated"] = corrected.isolated
        captions.append(ISOLATED_NAME + _score(corrected.numbers["isolated"]))
    if len(experiment.settings.wavelengths) > 1:
        shown = {name: in_colour(picture, experiment.settings.wavelengths) for name, picture in shown.items()}
    for name, picture in shown.items():
        files.write(save_picture, out / "images" / name, picture)
    names = [f"{wavelength * 1e9:.0f} nm" for wavelength in experiment.wavelengths]
    frames = len(corrected.phase)
    maps = [f"{name}, frame 1 of {frames}" for name in names] if frames > 1 else names
    phase = corrected.phase[0][experiment.lit].to(experiment.device).double()
    warm = experiment.array.temperature(experiment.array.crosstalk(phase)).cpu()
    losses = solution.losses.reshape(len(solution.losses), -1, len(names)).mean(1)  # mean over independent frames
    drawn = {
        "comparison": figures.comparison(list(shown.values()), captions),
        "phase": figures.channel_maps(phase.cpu(), maps, "heater phase (rad)", "viridis"),
        "temperature": figures.channel_maps(warm, maps, "temperature rise (degC)", "inferno", (0, None)),
        "convergence": figures.convergence(losses, names, log.checked, log.metric),
    }
    if weight := experiment.settings.target.weight:
        shape, rings = experiment.grid.shape, [low for low, _ in ZONES.values()][1:]
        angles = eccentricities(weight, shape)
        drawn["weight"] = figures.visual_field(weight_map(weight, shape), angles, weight.field_deg, rings, "weight")
    for name, data in drawn.items():
        files.write(write_bytes, out / "images" / f"{name}.png", data)


def _caption(experiment: PECExperiment, name: str, numbers: dict[str, Any]) -> str:
    """Method and score of a picture, and in what it is not comparable with the corrected one."""
    frames = ", 1 frame" if numbers["frames"] == 1 < experiment.settings.frames else ""
    limit = experiment.limit
    above = ", above the limit" if limit is not None and numbers["peak_phase_rad"] > (1 + 1e-3) * limit else ""
    return METHOD_NAMES[name] + _score(numbers) + frames + above


def _score(numbers: dict[str, Any]) -> str:
    return f", SSIM {numbers['ssim_mean']:.3f}" if "ssim_mean" in numbers else ""


def rerun(experiment: PECExperiment, first: Solution, seconds: float) -> tuple[Solution, float, Sequence[int]]:
    """Solve again from other random phases while the best solution has dark spots, ``solver.reruns`` times at most.

    Returns the solution with the fewest dark spots, the seconds of all, and the dark spots of each attempt.

    Source: thesis Sec. 4.4.5.2.
    """
    best, spots = first, [_dark_spots(experiment, first)]
    for attempt in range(1, experiment.settings.solver.reruns + 1):
        if min(spots) == 0:
            break
        settings = experiment.settings.model_copy(update={"seed": experiment.settings.seed + attempt})
        other, took = timed(replace(experiment, settings=settings).solve)
        seconds += took
        spots.append(_dark_spots(experiment, other))
        if spots[-1] < min(spots[:-1]):
            best = other
    return best, seconds, spots


def _dark_spots(experiment: PECExperiment, solution: Solution) -> int:
    return int(speckle_spots(experiment, experiment.heater_phases(solution.x)).sum())
