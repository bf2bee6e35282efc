"""Other methods to show a volume, for comparison with the joint correction: fields of F frames, laser powers."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction import gerchberg_saxton, iterative_pec
from holotorch.correction.problem import best_scale
from holotorch.experiments.joint.experiment import JointExperiment, deconvolved
from holotorch.experiments.joint.views.sampled import STEPS_OF_ADAM, Group, adam
from holotorch.experiments.runs.processes import added, process_count
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics.viewing.pupil_views import PupilViews

CIRCLES = 64  # smaller pupils of the light field

SHARED = ("unheated", "light_field", "slabs")  # methods whose work several processes divide


@dataclass(frozen=True)
class Shown:
    """What a method shows: fields of the frames, their laser powers, and the heater phases, if there are any."""

    fields: Tensor  # complex [F, C, H, W]
    phase: Tensor | None = None  # rad, [F, C, H, W]
    laser: Tensor | None = None  # relative power [F, C], 1 by default

    def images(self, views: PupilViews) -> Tensor:
        """Mean intensities of the frames in each view, [C, V, H, W]."""
        total = torch.zeros((), device=self.fields.device)
        for f, field in enumerate(self.fields):  # one by one, to save memory
            observed = intensity(views(field))
            total = total + (observed if self.laser is None else observed * self.laser[f, :, None, None, None])
        return total / len(self.fields)


def show(experiment: JointExperiment, phase: Tensor, laser: Tensor | None = None) -> Shown:
    """What heater phases show, after they are scaled below the limit."""
    with torch.no_grad():
        phase = experiment.within_limit(phase)
        return Shown(experiment.emitted(phase), phase, laser)


def baseline(experiment: JointExperiment, name: str) -> Shown:
    """One of the methods of ``names.NAMES``, other than the joint correction.

    Those of ``SHARED`` must be called by all processes of a run, and are the same in all.
    """
    if name == "random":
        return Shown(experiment.random_fields())
    if name == "afterwards":
        return show(experiment, experiment.kinoform(experiment.random_fields(), experiment.crosstalk))
    if name == "unheated":
        return show(experiment, _unheated(experiment))
    if name == "light_field":
        return show(experiment, _light_field(experiment))
    return _slabs(experiment) if name == "slabs" else show(experiment, _retrieved(experiment, name == "retrieved_pec"))


def _unheated(experiment: JointExperiment) -> Tensor:
    cold = ThermalCrosstalk(0.0).to(experiment.device)
    return deconvolved(experiment.crosstalk, experiment.optimise(cold, cold, None).x)


def _light_field(experiment: JointExperiment) -> Tensor:
    """One random view in each step: a focus of the whole pupil or, as often, a circle within it."""
    cold = ThermalCrosstalk(0.0).to(experiment.device)
    views, foci = experiment.with_parts(experiment.parts(2 * CIRCLES)[::2]), len(experiment.foci)
    group = Group([*(k % foci for k in range(CIRCLES)), *range(foci, foci + CIRCLES)], 1)
    steps = experiment.settings.steps * (STEPS_OF_ADAM if experiment.settings.eye.per_step is None else 1)
    start = experiment.kinoform(experiment.random_fields(), cold)
    loss = experiment.sampled(cold, views, [group], None)
    return deconvolved(experiment.crosstalk, adam(steps)(loss, start).x)


def _retrieved(experiment: JointExperiment, corrected: bool) -> Tensor:
    """Gerchberg-Saxton over all trained views, each frame from its own random phases; with Algorithm 1 or without."""
    views, steps = experiment.trained, experiment.settings.steps
    generator = torch.Generator().manual_seed(experiment.settings.seed)
    shape = experiment.settings.frames, *views.images.shape
    start = (2 * torch.pi * torch.rand(shape, generator=generator)).to(experiment.device)
    if corrected:
        crosstalk = experiment.crosstalk
        return iterative_pec(views.operator, crosstalk, views.images, start, max_steps=steps).x
    return gerchberg_saxton(views.operator, views.images, start, max_steps=steps).x


def _slabs(experiment: JointExperiment) -> Shown:
    """Each frame shows the light of one plane where it is in focus; a plane has the power of its light.

    The processes of a run divide the planes.
    """
    rank, count = process_count()
    frames, planes = experiment.settings.frames, len(experiment.depths)
    phase = torch.zeros(frames, len(experiment.settings.wavelengths), *experiment.grid.shape, device=experiment.device)
    laser = torch.zeros(phase.shape[:2], device=experiment.device)
    fields = experiment.random_fields
    for j in range(rank, planes, count):
        own, views = list(range(j, frames, planes)), experiment.plane(j)
        lit = views.images.flatten(1).amax(-1) > 0
        if not bool(lit.any()):
            continue
        start = experiment.kinoform(fields(slice(j, j + 1))[own], experiment.crosstalk)
        # A colour without light in this plane keeps the start, and its laser off.
        wanted = torch.where(lit[:, None, None, None], views.images, 1.0)
        limit = experiment.settings.limit
        problem = experiment.problem(experiment.crosstalk, replace(views, images=wanted), limit)
        x = experiment.solver(experiment.crosstalk)(problem, start).x
        formed = problem.intensity(x).detach()
        phase[own] = x
        laser[own] = best_scale(formed, views.images, -3) * lit * (frames / len(own))
    return show(experiment, added(phase), added(laser))
