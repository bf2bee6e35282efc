"""Scores of heater phases by simulations of their own, in float64, independent of what the solver computed."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.config import NearFieldSettings
from holotorch.experiments.pec import PECExperiment
from holotorch.metrics import SSIM_WINDOW, psnr, ssim
from holotorch.optics import CroppedKernel

_METRICS = {"ssim": ssim, "psnr": psnr}


@dataclass(frozen=True)
class Result:
    """One method's outcome.

    Attributes:
        phase: Heater phases in rad, [C, H, W].
        picture: Intensity on the picture's own scale, float64 [C, H, W].
        isolated: The same for a chip that stands alone; None in the far field.
        numbers: What summary.json says of the method.
    """

    phase: Tensor
    picture: Tensor
    isolated: Tensor | None
    numbers: dict[str, Any]


def quality(experiment: PECExperiment, phase: Tensor) -> float:
    """Mean of the first metric over the lit colours for phases [C, H, W] of these; cheap, for progress bars."""
    name = experiment.settings.report.metrics[0]
    formed = experiment.problem(torch.float64).intensity(phase.detach().double()).cpu()
    picture = _as_picture(experiment, formed, at_best_scale=experiment.isolated)
    return _scores(experiment, picture, experiment.image)[f"{name}_mean"]


def judge(experiment: PECExperiment, phase: Tensor) -> Result:
    """Score heater phases of the lit colours, [C, H, W]: in the model of the run, between its samples, and alone."""
    phase = phase.detach().double()
    emitted = experiment.array(phase)
    formed = intensity(experiment.propagator(emitted)).cpu()
    picture = _as_picture(experiment, formed, at_best_scale=experiment.isolated)
    warm = experiment.array.temperature(experiment.array.crosstalk(phase))
    driven = experiment.array.temperature(phase)
    numbers = _scores(experiment, picture, experiment.image) | {
        "efficiency": _per_colour(experiment, formed.mean((-2, -1))),
        "peak_temperature_rise_K": _per_colour(experiment, warm.amax((-2, -1))),
        "mean_temperature_rise_K": _per_colour(experiment, warm.mean((-2, -1))),
        "heating_power_K_per_pixel": _per_colour(experiment, driven.mean((-2, -1))),
    }
    alone = None
    if isinstance(experiment.settings.propagator, NearFieldSettings):
        alone, numbers["isolated"], between = _alone(experiment, emitted)
    else:
        (y, x), (height, width) = experiment.grid.coordinates(phase.device), experiment.grid.extent
        half_a_sample = torch.exp(-1j * math.pi * (y / height + x / width))
        between = intensity(experiment.propagator(emitted * half_a_sample)).cpu()
    numbers["between_samples"] = _between_scores(experiment, between)
    return Result(_all_colours(experiment, phase.cpu()), picture, alone, numbers)


def _alone(experiment: PECExperiment, emitted: Tensor) -> tuple[Tensor, dict[str, Any], Tensor]:
    """What a single chip forms by the exact kernel: the picture, its scores, and the intensity between the samples."""
    light = experiment.settings.propagator
    assert isinstance(light, NearFieldSettings)
    formed, between = (torch.empty(experiment.target.shape, dtype=torch.float64) for _ in range(2))
    half = experiment.grid.pitch[0] / 2, experiment.grid.pitch[1] / 2
    for i, wave in enumerate(experiment.wavelengths):  # one colour at a time: float64 kernels are large
        exact = CroppedKernel(experiment.grid, wave, light.distance).to(experiment.device)
        aside = CroppedKernel(experiment.grid, wave, light.distance, offset=half).to(experiment.device)
        formed[i] = intensity(exact(emitted[i : i + 1]))[0].cpu()
        between[i] = intensity(aside(emitted[i : i + 1]))[0].cpu()
    picture = _as_picture(experiment, formed, at_best_scale=True)
    numbers = _scores(experiment, picture, experiment.image)
    numbers["efficiency"] = _per_colour(experiment, formed.mean((-2, -1)))
    scale = best_scale(formed, experiment.target)[:, None, None]
    return picture, numbers, between * scale


def _between_scores(experiment: PECExperiment, between: Tensor) -> dict[str, Any]:
    """Scores half a sample off the image's samples, against the mean of the picture's four neighbours there."""
    picture = _as_picture(experiment, between, at_best_scale=False)[..., :-1, :-1]
    image = experiment.image
    middle = (image[..., 1:, 1:] + image[..., 1:, :-1] + image[..., :-1, 1:] + image[..., :-1, :-1]) / 4
    return _scores(experiment, picture, middle) if min(middle.shape[-2:]) >= SSIM_WINDOW else {}


def _scores(experiment: PECExperiment, picture: Tensor, image: Tensor) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name in experiment.settings.report.metrics:
        values = _METRICS[name](picture.clamp(0, 1), image, data_range=1.0)
        numbers[name] = [_finite(value) for value in values.tolist()]
        numbers[f"{name}_mean"] = _finite(values[experiment.lit].mean().item())
    return numbers


def _as_picture(experiment: PECExperiment, formed: Tensor, *, at_best_scale: bool) -> Tensor:
    """Relative intensity of the lit colours to the picture's own scale, dark colours black."""
    if at_best_scale:
        formed = formed * best_scale(formed, experiment.target)[:, None, None]
    mean = experiment.image[experiment.lit].mean((-2, -1), keepdim=True)
    return _all_colours(experiment, formed * mean)


def _all_colours(experiment: PECExperiment, lit: Tensor) -> Tensor:
    whole = lit.new_zeros(len(experiment.lit), *lit.shape[1:])
    whole[experiment.lit] = lit
    return whole


def _per_colour(experiment: PECExperiment, values: Tensor) -> list[float]:
    return _all_colours(experiment, values.double().cpu()).tolist()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
