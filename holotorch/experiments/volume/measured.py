"""Measured error of a volume's hologram, for a few planes of one colour, and of its refocusing."""

import math
import warnings

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.experiments.planning.errors import LIMIT, Comparison, not_measured
from holotorch.experiments.planning.machine import Machine, machine_speed
from holotorch.experiments.volume.experiment import HOLOGRAM, REFOCUSING, VolumeExperiment
from holotorch.experiments.volume.plan import FLOP_SECONDS, rendering_seconds
from holotorch.hologram import AxialHologram, ConvolutionHologram, refocused
from holotorch.hologram.plan import convolution_flops
from holotorch.optics import plan_propagation

_PLANES = 4  # number of the brightest planes of the first realisation whose hologram is compared
_DOUBLE = 2.0  # time of complex128 over that of complex64
_TIGHT = 1e-7  # tolerance of the reference of refocusing


def hologram_error(experiment: VolumeExperiment) -> Comparison:
    """Error of the colour with the largest predicted error, for the light of its brightest planes.

    Their hologram by the method of the plan is compared with a convolution of each plane in complex128.
    """
    colour = max(range(len(experiment.plans)), key=lambda c: experiment.plans[c].predicted_error)
    plan, wavelength = experiment.plans[colour], experiment.settings.wavelengths[colour]
    if plan.cone == "band":
        words = "not measured: the exact waves of this cone of light have an error of their own"
        return Comparison(HOLOGRAM, plan.predicted_error, None, words)
    setup = {"cone": plan.cone, "stride": experiment.stride}
    exact = ConvolutionHologram(experiment.grid, wavelength, experiment.depths, **setup)

    def seconds(machine: Machine, count: int) -> float:
        flops = _DOUBLE * convolution_flops(exact, experiment.rays.shape) * count / len(experiment.depths)
        return rendering_seconds(experiment, machine) + FLOP_SECONDS * flops * machine.fft(math.prod(plan.size))

    count = min(_PLANES, len(experiment.depths))
    while count and seconds(Machine(), count) > LIMIT:
        count -= 1
    if not count:
        return not_measured(HOLOGRAM, plan.predicted_error, seconds(machine_speed(experiment.device), 1))
    layers, planes = experiment.layers(), _brightest(experiment, colour, count)
    assert isinstance(plan.operator, AxialHologram | ConvolutionHologram)
    fields = []
    for operator, dtype in ((plan.operator, experiment.dtype), (exact, torch.complex128)):
        total = operator.accumulator(experiment.rays.shape, layers.phase)
        for j, plane in planes:
            total.add(j, plane.to(dtype) if dtype == torch.complex128 else plane)
        fields.append(total.finish())
    note = f"the {count} brightest plane(s) at {wavelength * 1e9:.0f} nm, against a convolution in complex128"
    return Comparison(HOLOGRAM, plan.predicted_error, relative_error(*fields), note)


def refocusing_error(experiment: VolumeExperiment, hologram: Tensor, depth: float) -> Comparison:
    """Error of refocusing the middle colour of ``hologram`` [C, H, W] at a depth in metres.

    The reference is propagated in complex128 within the smallest tolerance that some method reaches.
    """
    wavelengths, tolerance = experiment.settings.wavelengths, experiment.budget.share(REFOCUSING)
    middle = len(wavelengths) // 2
    wavelength = wavelengths[middle]
    scene = experiment.grid, wavelength, -depth
    predicted = plan_propagation(*scene, tolerance=tolerance, dtype=experiment.dtype).predicted_error
    plan = plan_propagation(*scene, tolerance=_TIGHT, dtype=torch.complex128)
    if plan.predicted_error > predicted / 2:
        note = f"not measured: the most exact method itself is predicted to err by {plan.predicted_error:.1e}"
        return Comparison(REFOCUSING, predicted, None, note)
    seconds = _DOUBLE * FLOP_SECONDS * plan.flops
    if seconds > LIMIT:
        speed = machine_speed(experiment.device).fft(math.prod(plan.padded))
        return not_measured(REFOCUSING, predicted, seconds * speed)
    setup = experiment.grid, wavelength, depth
    with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the note states the error
        exact = refocused(hologram[middle].to(torch.complex128), *setup, tolerance=_TIGHT)
    error = relative_error(refocused(hologram[middle].to(experiment.dtype), *setup, tolerance=tolerance), exact)
    note = f"{wavelength * 1e9:.0f} nm at {depth * 1e3:.4g} mm, against complex128 within {plan.predicted_error:.0e}"
    return Comparison(REFOCUSING, predicted, error, note)


def _brightest(experiment: VolumeExperiment, colour: int, count: int) -> list[tuple[int, Tensor]]:
    """Index and amplitudes [h, w] of the planes of a colour with the most light, in the order of the rays."""
    kept: list[tuple[float, int, Tensor]] = []
    with torch.no_grad():
        for j, plane in enumerate(experiment.layers().amplitudes()):
            light = plane[colour].abs().square().sum().item()
            if len(kept) < count or light > kept[-1][0]:
                kept = sorted([*kept, (light, j, plane[colour].clone())], key=lambda candidate: -candidate[0])[:count]
    return [(j, plane) for _, j, plane in sorted(kept, key=lambda candidate: candidate[1])]


def relative_error(field: Tensor, exact: Tensor) -> float:
    """Relative L2 error; 0 if both are 0."""
    norm = exact.norm().item()
    return (field - exact).norm().item() / norm if norm else 0.0
