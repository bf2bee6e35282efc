"""Measured errors of the parts that share the tolerance of a joint run, for its result."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core.complex import phasor
from holotorch.correction import Solution
from holotorch.experiments.joint.budget import PATIENCE, SLABS
from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.methods import Shown, show
from holotorch.experiments.joint.seconds import shown_seconds, step_seconds
from holotorch.experiments.planning.correction import (
    HEAT,
    NO_STEP,
    PROPAGATION,
    STOPPING,
    scaled_error,
    spread_completely,
)
from holotorch.experiments.planning.errors import LIMIT, Comparison, not_measured
from holotorch.experiments.planning.machine import Machine, machine_speed
from holotorch.experiments.volume.measured import relative_error
from holotorch.experiments.volume.plan import rendering_seconds
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import PupilViews

_FINER = 2  # factor on the padded samples of a view along each axis, in the reference of the propagation
_THINNER = 4  # factor on the number of samples in the reference of the rendering

Measure = Callable[[JointExperiment, Solution], tuple[float | None, str]]


def joint_errors(experiment: JointExperiment, solution: Solution, limit: float = LIMIT) -> list[Comparison]:
    """Predicted and measured errors of the parts; ``limit``: longest time of each measurement, see LIMIT."""
    parts: dict[str, tuple[Measure, Callable[[Machine], float]]] = {
        HEAT: (_heat, lambda machine: 2 * shown_seconds(experiment, machine)),
        SLABS: (_planes, lambda machine: (1 + _THINNER) * rendering_seconds(experiment.scene, machine)),
        PROPAGATION: (_propagation, lambda machine: (1 + _FINER**2) * shown_seconds(experiment, machine)),
        STOPPING: (_stopping, lambda machine: PATIENCE * step_seconds(experiment, machine)),
    }
    compared = []
    for part in experiment.budget.parts:  # a run without tolerance has no stopping rule
        (measure, seconds), error = parts[part], experiment.budget.error(part)
        if seconds(Machine()) <= limit:
            compared.append(Comparison(part, error, *measure(experiment, solution)))
        else:
            compared.append(not_measured(part, error, seconds(machine_speed(experiment.device))))
    return compared


def _shown(experiment: JointExperiment, solution: Solution) -> Shown:
    """Fields that the phases of the solution emit, in double precision."""
    return show(experiment, solution.x.double())


def _heat(experiment: JointExperiment, solution: Solution) -> tuple[float, str]:
    """Error of the kernel's taps in the images at all corrected foci."""
    shown, views = _shown(experiment, solution), experiment.stack.operator
    assert shown.phase is not None
    # Heat left from earlier frames is a sum for each pixel, which may be taken before or after the spreading.
    left = experiment.heat_after(ThermalCrosstalk(0.0).to(experiment.device))
    exact = Shown(phasor(left(spread_completely(experiment.settings.display.sigma_px, shown.phase))))
    with torch.no_grad():
        error = scaled_error(shown.images(views), exact.images(views))
    return error, f"{experiment.crosstalk.kernel.shape[0]} taps against all, in complex128"


def _propagation(experiment: JointExperiment, solution: Solution) -> tuple[float, str]:
    """Error of padding and precision in the images at all corrected foci."""
    own, grid = experiment.stack.operator, experiment.grid
    # The padding is proportional to the distance, so a larger grid is requested by a longer distance.
    room = max((_FINER * n - m) / (n - m) for n, m in zip(own.padded.shape, grid.shape, strict=True) if n > m)
    longest = experiment.padding * max(experiment.foci) * room
    finer = PupilViews(grid, experiment.settings.wavelengths, own.views, longest=longest).to(experiment.device)
    shown = _shown(experiment, solution)
    with torch.no_grad():
        single = replace(shown, fields=experiment.emitted(solution.x.to(experiment.dtype)))
        error = scaled_error(single.images(own), shown.images(finer))
    sizes = (" x ".join(map(str, each.padded.shape)) for each in (own, finer))
    return error, " samples of a view against ".join(sizes) + " in complex128"


def _planes(experiment: JointExperiment, _: Solution) -> tuple[float, str]:
    """Error of the rendering along the axis."""
    scene = experiment.scene
    numbers = scene.samples, _THINNER * scene.samples
    with torch.no_grad():
        pictures: list[Tensor] = [scene.sampler(samples=n).render(scene.volume)[0] for n in numbers]
    error = relative_error(*pictures) / math.sqrt(1 - _THINNER**-2)
    of, against = (n * len(experiment.depths) for n in numbers)
    return error, f"the rendering by {of} samples along each ray against {against}"


def _stopping(experiment: JointExperiment, solution: Solution) -> tuple[float | None, str]:
    """Change of the images in further steps, as many as the solver's patience."""
    problem = experiment.problem(experiment.heat, experiment.trained, experiment.settings.limit)
    solver = replace(experiment.solver(experiment.crosstalk), max_steps=PATIENCE, tolerance=0.0)
    try:
        further = solver(problem, solution.x)
    except ValueError as error:  # the gradient vanishes if the images are exact
        return None, f"not measured: {error}"
    if torch.equal(further.x, solution.x):  # says nothing about the distance from an optimum
        return None, NO_STEP
    views = experiment.stack.operator
    with torch.no_grad():
        before, after = (show(experiment, x).images(views) for x in (solution.x, further.x))
    how = "met its stopping rule" if bool(solution.converged.all()) else "took all of its steps or stalled"
    return scaled_error(before, after), f"change of the images in {PATIENCE} further steps; the solver {how}"
