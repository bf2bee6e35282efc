"""Predicted seconds of a run of kind ``pec``: solver, baselines, scores, figures and start-up."""

import math

import torch

from holotorch.experiments.pec.baselines import PASSES
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.progress import CHECK_STEPS
from holotorch.experiments.planning.machine import Machine

# Seconds on one core of the reference machine of ``planning.machine``, from grids of 32 to 512 px.
# An evaluation is one computation of the loss; L-BFGS needs the gradient in each of them, APG in every second one.
_CALL = {"apg": 6e-4, "adam": 1e-3, "lbfgs": 1.6e-3}  # per evaluation, whatever its size
_PIXEL = {"apg": 3e-9, "adam": 1.6e-8, "lbfgs": 3.3e-8}  # per evaluation and pixel of all colours and frames
_IMAGE = 1.2e-8  # per evaluation and pixel of all images
_FFT = 8e-10  # / (n log2 n) per evaluation for n padded samples of all colours and frames
_DOUBLE = 2.0  # time of double over that of single precision
_EVALUATIONS = {"apg": 2, "adam": 1, "lbfgs": 1}  # per step
_PASS, _PASS_PIXEL = 3e-4, 1.5e-8  # per pass of Gerchberg-Saxton, and per pixel of it besides the transforms
_DECONVOLUTION, _DECONVOLUTION_PIXEL = 1e-2, 1.9e-7  # of each pass of IPEC, and per pixel
_NONNEGATIVE, _NONNEGATIVE_PIXEL = 0.1, 2.3e-6  # of the non-negative deconvolution, and per pixel
_EXACT, _EXACT_SAMPLE = 3.5e-3, 1.2e-7  # per exact float64 image of a single chip, and per padded sample of it
_DRAWN = 6e-7  # per value of a picture, to encode it and draw it in a figure
_FIGURES = 4  # comparison, phases, temperatures, convergence


def evaluations(experiment: PECExperiment) -> int:
    """Evaluations of the loss, if the solver takes all of its steps."""
    solver = experiment.settings.solver
    return _EVALUATIONS[solver.kind] * solver.max_steps


def seconds_of(experiment: PECExperiment, machine: Machine) -> dict[str, float]:
    """Seconds of each part of the whole command, if the solver takes all of its steps."""
    settings = experiment.settings
    methods = 1 + len(settings.report.baselines)
    checks = settings.solver.max_steps / CHECK_STEPS * _simulation(experiment, machine)
    pictures = _DRAWN * _values(experiment) * 2 * (1 + methods) * machine.interpreter
    weight = settings.target.weight is not None
    return {
        "solver": evaluations(experiment) * _evaluation(experiment, machine) + checks,
        "baselines": sum(_baseline(experiment, name, machine) for name in settings.report.baselines),
        "evaluation": methods * (2.2 * _simulation(experiment, machine) + _single_chip(experiment, machine)),
        "measured error": 2 * simulation_seconds(experiment, machine) + extra_steps_seconds(experiment, machine),
        "start-up and figures": machine.around(figures=_FIGURES + weight) + pictures,
    }


def simulation_seconds(experiment: PECExperiment, machine: Machine) -> float:
    """Two float64 simulations of all frames, which one part of the measured error needs."""
    return 2 * _simulation(experiment, machine)


def extra_steps_seconds(experiment: PECExperiment, machine: Machine) -> float:
    """As many further steps as the solver's patience."""
    solver = experiment.settings.solver
    return _EVALUATIONS[solver.kind] * solver.patience * _evaluation(experiment, machine)


def padded_samples(experiment: PECExperiment) -> int:
    """Samples of the propagation of one field, over all distances."""
    padded = math.prod(experiment.grid.padded(2 if experiment.isolated else 1).shape)
    return padded * max(1, (1 + len(experiment.distances)) // 2)


def _values(experiment: PECExperiment) -> int:
    """Values of the picture, all colours."""
    return len(experiment.lit) * math.prod(experiment.settings.target.region or experiment.grid.shape)


def _transforms(experiment: PECExperiment, fields: int, machine: Machine) -> float:
    samples, padded = padded_samples(experiment), math.prod(experiment.grid.padded(1).shape)
    return _FFT * fields * samples * math.log2(max(2, samples)) * machine.fft(padded)


def _evaluation(experiment: PECExperiment, machine: Machine) -> float:
    """One evaluation of the loss with the share of a gradient that the solver needs."""
    kind, fields = experiment.settings.solver.kind, len(experiment.wavelengths) * experiment.settings.frames
    pixels = fields * math.prod(experiment.grid.shape)
    double = _DOUBLE if experiment.dtype == torch.float64 else 1.0
    elementwise = pixels * (_PIXEL[kind] + _IMAGE * max(1, len(experiment.distances))) * machine.elementwise
    return _CALL[kind] * machine.interpreter + double * (elementwise + _transforms(experiment, fields, machine))


def _baseline(experiment: PECExperiment, name: str, machine: Machine) -> float:
    """A method of comparison, which computes a single frame."""
    if name == "unweighted":
        return evaluations(experiment) * _evaluation(experiment, machine)
    fields = len(experiment.wavelengths)
    pixels = fields * math.prod(experiment.grid.shape)
    seconds = PASSES * (_PASS * machine.interpreter + _PASS_PIXEL * pixels * machine.elementwise)
    seconds += PASSES * _transforms(experiment, fields, machine)
    if name == "ipec":
        seconds += PASSES * (_DECONVOLUTION * machine.interpreter + _DECONVOLUTION_PIXEL * pixels * machine.elementwise)
    if name == "nonnegative":
        seconds += _NONNEGATIVE * machine.interpreter + _NONNEGATIVE_PIXEL * pixels * machine.elementwise
    return seconds


def _simulation(experiment: PECExperiment, machine: Machine) -> float:
    """A float64 simulation of all frames with the scores of its picture."""
    fields = len(experiment.wavelengths) * experiment.settings.frames
    scored = machine.score(_values(experiment), double=True)
    pixels = fields * math.prod(experiment.grid.shape)
    return 2 * _transforms(experiment, fields, machine) + 2 * _IMAGE * pixels * machine.elementwise + scored


def _single_chip(experiment: PECExperiment, machine: Machine) -> float:
    """The exact near-field image of a single chip, at the samples and midway between them."""
    images = 2 * len(experiment.wavelengths) * len(experiment.distances)
    samples = math.prod(experiment.grid.padded(2).shape)
    return images * (_EXACT * machine.interpreter + _EXACT_SAMPLE * samples * machine.fft(samples))
