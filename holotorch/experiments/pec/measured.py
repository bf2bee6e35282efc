"""Measured errors of the parts that share the tolerance of a run of kind ``pec``, for its result."""

from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core.complex import phasor
from holotorch.correction import Solution
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.seconds import extra_steps_seconds, simulation_seconds
from holotorch.experiments.planning.correction import (
    HEAT,
    NO_STEP,
    PROPAGATION,
    STOPPING,
    complete_kernel,
    scaled_error,
    spread_completely,
)
from holotorch.experiments.planning.errors import LIMIT, Comparison, not_measured
from holotorch.experiments.planning.machine import Machine, machine_speed


def pec_errors(experiment: PECExperiment, solution: Solution, limit: float = LIMIT) -> list[Comparison]:
    """Predicted and measured errors of the parts; ``limit``: longest time of each measurement, see LIMIT."""
    here, phase = machine_speed(experiment.device), experiment.heater_phases(solution.x)
    affordable = simulation_seconds(experiment, Machine()) <= limit
    compared = []
    for part, measure in ((HEAT, _heat), (PROPAGATION, _propagation)):
        if part not in experiment.budget.parts:
            continue
        error = experiment.budget.error(part)
        if affordable:
            compared.append(Comparison(part, error, *measure(experiment, phase)))
        else:
            compared.append(not_measured(part, error, simulation_seconds(experiment, here)))
    error = experiment.budget.error(STOPPING)
    if extra_steps_seconds(experiment, Machine()) <= limit:
        compared.append(Comparison(STOPPING, error, *_stopping(experiment, solution)))
    else:
        compared.append(not_measured(STOPPING, error, extra_steps_seconds(experiment, here)))
    return compared


def _heat(experiment: PECExperiment, phase: Tensor) -> tuple[float, str]:
    """Error of the kernel's taps, in double precision."""
    sigma_px = experiment.settings.modulator.sigma_px
    assert sigma_px is not None
    complete = experiment.mean_intensity(lambda frame: phasor(spread_completely(sigma_px, frame.double())), phase)
    formed = experiment.intensity(phase, torch.float64)
    error = scaled_error(experiment.picture_in(formed), experiment.picture_in(complete))
    taps = experiment.array.crosstalk.kernel.shape[0]
    return error, f"{taps} taps against {complete_kernel(sigma_px).kernel.shape[0]}, in complex128"


def _propagation(experiment: PECExperiment, phase: Tensor) -> tuple[float, str]:
    """Error of the precision of the solver."""
    exact, solved = (experiment.intensity(phase, dtype) for dtype in (torch.float64, experiment.dtype))
    error = scaled_error(experiment.picture_in(solved), experiment.picture_in(exact))
    return error, f"{experiment.dtype} phases against the same propagation in complex128".removeprefix("torch.")


def _stopping(experiment: PECExperiment, solution: Solution) -> tuple[float | None, str]:
    """Change of the picture in further steps, as many as the solver's patience."""
    stage, steps = experiment.stages()[-1], experiment.settings.solver.patience
    problem = experiment.problem()
    try:
        solver = replace(stage.solver, max_steps=steps, tolerance=0.0)  # type: ignore[type-var]  # all are dataclasses
        further = solver(stage.objective, solution.x, stage.box)
    except ValueError as error:  # the gradient vanishes if the picture is exact
        return None, f"not measured: {error}"
    if torch.equal(further.x, solution.x):  # says nothing about the distance from an optimum
        return None, NO_STEP
    with torch.no_grad():
        before, after = (experiment.picture_in(problem.intensity(x)) for x in (solution.x, further.x))
    how = "met its stopping rule" if bool(solution.converged.all()) else "took all of its steps or stalled"
    return scaled_error(before, after), f"change of the picture in {steps} further steps; the solver {how}"
