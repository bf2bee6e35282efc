"""Predicted seconds of a joint run: start, solver, other methods, evaluation, pictures and start-up."""

import math

import torch

from holotorch.experiments.joint.budget import PATIENCE
from holotorch.experiments.joint.config import FOCI_PER_STEP
from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.methods import CIRCLES
from holotorch.experiments.joint.pictures import SWEEP
from holotorch.experiments.planning.machine import Machine

# Seconds on one core of the reference machine of ``planning.machine``, with displays of 48 to 256 px.
_CALL = 3e-3  # per step of the solver, whatever its size
_STEP = 2.4e-9  # / (n log2 n) per step, for each view of a frame and colour, padded to n samples
_SHOWN = 6e-10  # the same for an image that a method shows
_WANTED = 2.8e-9  # the same for the light of a plane in a view, in the images that are wanted
_SOURCES = 5e-9  # / (n log2 n) to propagate a plane of n pixels of a frame and colour to the array
_PLANNING = 0.02  # to plan that propagation
_DECONVOLUTION = 2e-7  # per pixel of the heaters, of the phases at the start
_SWEEP_PIXEL = 4.7e-7  # per pixel of the animated sweep, which has the wanted pictures beside those shown
_PANEL = 0.02  # per picture in a table of pictures
_DOUBLE = 2.0  # time of double over that of single precision
_FINER = 4  # factor on the time for images with twice as many samples along each axis
_FIGURES = 3  # two tables of pictures, and the phases
_STEPS_OF = {
    "random": 0.0,
    "afterwards": 0.0,
    "unheated": 1.0,
    "light_field": 0.6,
    "retrieved": 0.7,
    "retrieved_pec": 1.2,
    "slabs": 0.4,
}


def view_samples(experiment: JointExperiment) -> tuple[int, int]:
    """Padded samples (y, x) of a view."""
    return experiment.padded(experiment.padding).shape


def step_views(experiment: JointExperiment) -> int:
    """Number of views in each step of the solver."""
    foci, eye = len(experiment.foci), experiment.settings.eye
    return foci + eye.parallax if eye.per_step is None else min(FOCI_PER_STEP, foci) + eye.per_step


def _transform(experiment: JointExperiment, machine: Machine) -> float:
    """N log2 n for the n samples of a view, times the ratio of the machine."""
    samples = math.prod(view_samples(experiment))
    return samples * math.log2(samples) * machine.fft(samples)


def step_seconds(experiment: JointExperiment, machine: Machine) -> float:
    """One step of the solver."""
    settings = experiment.settings
    views = settings.frames * len(settings.wavelengths) * step_views(experiment)
    double = _DOUBLE if experiment.dtype == torch.float64 else 1.0
    return _CALL * machine.interpreter + double * _STEP * views * _transform(experiment, machine)


def shown_seconds(experiment: JointExperiment, machine: Machine) -> float:
    """The images at all corrected foci, in double precision."""
    settings = experiment.settings
    views = settings.frames * len(settings.wavelengths) * len(experiment.foci)
    return _DOUBLE * _SHOWN * views * _transform(experiment, machine)


def seconds_of(experiment: JointExperiment, machine: Machine) -> dict[str, float]:
    """Seconds of each part of the whole command; the factors of the other methods are relative to the solver."""
    settings, planes, foci = experiment.settings, len(experiment.depths), len(experiment.foci)
    colours, fields = len(settings.wavelengths), settings.frames * len(settings.wavelengths)
    transform, pixels, scored = _transform(experiment, machine), math.prod(experiment.grid.shape), 6 * foci - 1
    sweep = SWEEP if foci > 1 else 1
    start = _SOURCES * fields * planes * pixels * math.log2(pixels) * machine.fft(pixels)
    start += _PLANNING * planes * machine.interpreter + _DECONVOLUTION * fields * pixels * machine.elementwise
    step = step_seconds(experiment, machine)
    steps = settings.steps * step
    wanted = 7 * foci - 1 + settings.eye.parallax + sweep
    scores = machine.score(colours * foci * pixels, double=False) * scored / foci
    evaluated = _SHOWN * fields * scored * transform + scores
    wanted += CIRCLES if "light_field" in settings.comparisons else 0
    others, shown = settings.comparisons, 2 + len(settings.comparisons)
    pictures = 2 * _SWEEP_PIXEL * pixels * max(1, 2 * sweep - 2) + _PANEL * shown * (foci + 4)
    return {
        "wanted images": _WANTED * colours * planes * wanted * transform,
        "solver": start + steps,
        "other methods": sum(start + _STEPS_OF[name] * steps for name in others),
        "evaluation": (2 + len(others)) * evaluated,
        "pictures": _SHOWN * fields * sweep * transform + pictures * machine.interpreter,
        "measured error": (3 + _FINER) * shown_seconds(experiment, machine)
        + (0.0 if settings.tolerance is None else PATIENCE * step),
        "start-up and figures": machine.around(figures=_FIGURES),
    }
