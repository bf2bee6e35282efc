"""Predicted seconds of a joint run: start, solver, other methods, evaluation, pictures and start-up."""

import math

from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.pictures import SWEEP
from holotorch.experiments.planning.machine import Machine
from holotorch.optics.viewing.pupil_views import View, view_padding

# Seconds on one core of the reference machine of ``planning.machine``, with displays of 48 to 256 px.
_CALL = 3e-3  # per step of the solver, whatever its size
_STEP = 2.4e-9  # / (n log2 n) per step, for each view of a frame and colour, padded to n samples
_SHOWN = 6e-10  # the same for an image that a method shows
_WANTED = 2.8e-9  # the same for the light of a plane in a view, in the images that are wanted
_SOURCES = 5e-9  # / (n log2 n) to propagate a plane of n pixels of a frame and colour to the array
_PLANNING = 0.02  # to plan that
_DECONVOLUTION = 2e-7  # per pixel of the heaters, of the phases at the start
_SWEEP_PIXEL = 4.7e-7  # per pixel of the animated sweep, which has the wanted pictures beside those shown
_PANEL = 0.02  # per picture in a table of pictures
_FIGURES = 3  # two tables of pictures, and the phases
_STEPS_OF = {"random": 0.0, "afterwards": 0.0, "unheated": 1.0, "retrieved": 0.7, "retrieved_pec": 1.2, "slabs": 0.4}


def view_samples(experiment: JointExperiment) -> tuple[int, int]:
    """Padded samples (y, x) of a view."""
    pupil = View(max(experiment.foci), experiment.radius)
    return view_padding(experiment.grid, experiment.settings.wavelengths, [pupil], max(experiment.foci)).shape


def seconds_of(experiment: JointExperiment, machine: Machine) -> dict[str, float]:
    """Seconds of each part of the whole command; the factors of the other methods are relative to the solver."""
    settings, planes = experiment.settings, len(experiment.foci)
    colours, fields = len(settings.wavelengths), settings.frames * len(settings.wavelengths)
    samples, pixels = math.prod(view_samples(experiment)), math.prod(experiment.grid.shape)
    transform = samples * math.log2(samples) * machine.fft(samples)
    trained, scored = planes + settings.eye.parallax, 4 * planes - 1
    sweep = SWEEP if planes > 1 else 1
    start = _SOURCES * fields * planes * pixels * math.log2(pixels) * machine.fft(pixels)
    start += _PLANNING * planes * machine.interpreter + _DECONVOLUTION * fields * pixels * machine.elementwise
    steps = settings.steps * (_CALL * machine.interpreter + _STEP * fields * trained * transform)
    wanted = 5 * planes - 1 + settings.eye.parallax + sweep
    scores = machine.score(colours * planes * pixels, double=False) * scored / planes
    evaluated = _SHOWN * fields * scored * transform + scores
    others, shown = settings.report.baselines, 2 + len(settings.report.baselines)
    pictures = 2 * _SWEEP_PIXEL * pixels * max(1, 2 * sweep - 2) + _PANEL * shown * (planes + 4)
    return {
        "wanted images": _WANTED * colours * planes * wanted * transform,
        "solver": start + steps,
        "other methods": sum(start + _STEPS_OF[name] * steps for name in others),
        "evaluation": (2 + len(others)) * evaluated,
        "pictures": _SHOWN * fields * sweep * transform + pictures * machine.interpreter,
        "start-up and figures": machine.around(figures=_FIGURES),
    }
