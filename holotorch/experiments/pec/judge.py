"""Scores of heater phases by simulations of their own, in float64, independent of what the solver computed."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.weight import zone_scores
from holotorch.metrics import SSIM_WINDOW, psnr, ssim
from holotorch.optics import CroppedKernel

_METRICS = {"ssim": ssim, "psnr": psnr}


@dataclass(frozen=True)
class Result:
    """One method's outcome.

    Attributes:
        phase: Heater phases in rad, [F, C, H, W].
        picture: Intensity on the picture's own scale, float64 [C, h, w].
        isolated: The same for a chip that stands alone; None in the far field.
        numbers: What summary.json says of the method.
    """

    phase: Tensor
    picture: Tensor
    isolated: Tensor | None
    numbers: dict[str, Any]


def quality(experiment: PECExperiment, phase: Tensor) -> float:
    """Mean of the first metric over the lit colours for phases [F, C, H, W] of these; cheap, for progress bars."""
    name = experiment.settings.report.metrics[0]
    seen = experiment.seen(experiment.formed(phase.double())).cpu()
    picture = _as_picture(experiment, seen, at_best_scale=experiment.scale_free)
    return _scores(experiment, picture, experiment.image)[f"{name}_mean"]


def judge(experiment: PECExperiment, phase: Tensor) -> Result:
    """Score heater phases of the lit colours, [F, C, H, W]: in the model of the run, between its samples, and alone."""
    phase = phase.detach().double()
    seen = experiment.seen(experiment.formed(phase)).cpu()
    picture = _as_picture(experiment, seen, at_best_scale=experiment.scale_free)
    warm = experiment.array.temperature(experiment.array.crosstalk(phase))
    driven = experiment.array.temperature(phase)
    numbers = _scores(experiment, picture, experiment.image) | {
        "frames": len(phase),
        "efficiency": _per_colour(experiment, _share(experiment, seen)),
        "peak_phase_rad": experiment.array.crosstalk(phase).max().item(),
        "peak_temperature_rise_K": _per_colour(experiment, warm.amax((0, -2, -1))),
        "mean_temperature_rise_K": _per_colour(experiment, warm.mean((0, -2, -1))),
        "heating_power_K_per_pixel": _per_colour(experiment, driven.mean((0, -2, -1))),
    }
    alone = None
    if experiment.distances:
        alone, numbers["isolated"], between = _alone(experiment, phase)
    else:
        (y, x), (height, width) = experiment.grid.coordinates(phase.device), experiment.grid.extent
        half_a_sample = torch.exp(-1j * math.pi * (y / height + x / width))
        shifted = [intensity(experiment.propagator(experiment.array(each) * half_a_sample)) for each in phase]
        between = experiment.seen(torch.stack(shifted).mean(0)).cpu()
        if experiment.scale_free:
            between = between * best_scale(seen, experiment.wanted)[:, None, None]
    numbers["between_samples"] = _between_scores(experiment, between)
    if weight := experiment.settings.target.weight:
        numbers["zones"] = zone_scores(weight, picture, experiment.image, experiment.lit)
    return Result(_all_colours(experiment, phase.cpu()), picture, alone, numbers)


def _share(experiment: PECExperiment, seen: Tensor) -> Tensor:
    """Share of the array's light that the picture gets, [C]."""
    return seen.sum((-2, -1)) / math.prod(experiment.grid.shape)


def _alone(experiment: PECExperiment, phase: Tensor) -> tuple[Tensor, dict[str, Any], Tensor]:
    """What a single chip forms by the exact kernel: the picture, its scores, and the intensity between the samples."""
    shape = (len(experiment.wavelengths), len(experiment.distances), *experiment.grid.shape)
    formed, between = (torch.zeros(shape, dtype=torch.float64) for _ in range(2))
    half = experiment.grid.pitch[0] / 2, experiment.grid.pitch[1] / 2
    for i, wave in enumerate(experiment.wavelengths):  # one colour and one depth at a time: float64 kernels are large
        for j, distance in enumerate(experiment.distances):
            for offset, total in (((0.0, 0.0), formed), (half, between)):
                exact = CroppedKernel(experiment.grid, wave, distance, offset=offset).to(experiment.device)
                for each in phase:
                    total[i, j] += intensity(exact(experiment.array(each)[i : i + 1]))[0].cpu() / len(phase)
    if len(experiment.distances) == 1:
        formed, between = formed[:, 0], between[:, 0]
    formed, between = experiment.seen(formed), experiment.seen(between)
    picture = _as_picture(experiment, formed, at_best_scale=True)
    numbers = _scores(experiment, picture, experiment.image)
    numbers["efficiency"] = _per_colour(experiment, _share(experiment, formed))
    scale = best_scale(formed, experiment.wanted)[:, None, None]
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
    """Relative intensity of the lit colours [C, h, w] to the picture's own scale, dark colours black."""
    if at_best_scale:
        formed = formed * best_scale(formed, experiment.wanted)[:, None, None]
    mean = experiment.image[experiment.lit].mean((-2, -1), keepdim=True)
    return _all_colours(experiment, formed * mean)


def _all_colours(experiment: PECExperiment, lit: Tensor) -> Tensor:
    """[..., C, h, w] or [C] of the lit colours to all, zero in the dark ones."""
    axis = 0 if lit.ndim == 1 else lit.ndim - 3
    shape = list(lit.shape)
    shape[axis] = len(experiment.lit)
    return lit.new_zeros(shape).index_copy(axis, experiment.lit.nonzero()[:, 0], lit)


def _per_colour(experiment: PECExperiment, values: Tensor) -> list[float]:
    return _all_colours(experiment, values.double().cpu()).tolist()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
