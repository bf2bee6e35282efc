"""Scores of heater phases from a simulation in float64."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.weight import zone_scores
from holotorch.experiments.planning.heat_kernel import NOISY, continued, even, is_cut_off, opposite_noise
from holotorch.metrics import SSIM_WINDOW, dark_spots, psnr, ssim
from holotorch.modulator import PhasedArray, ThermalCrosstalk
from holotorch.optics import CroppedKernel

_AT_LIMIT = 0.97  # fraction of the limit above which it is what bounds the phases
NOISY_KERNELS = 4  # chips on which a run with report.kernel_noise tries its phases


@dataclass(frozen=True)
class Result:
    """Result of one method, for all C colours of the configuration.

    Attributes:
        phase: Heater phases in rad, [F, C, H, W] for F frames, as the solver gives them.
        picture: Intensity at the pixels of the target, scaled to the values of the target, float64 [C, h, w].
        between: The same midway between four samples, of a single chip in the near field.
        isolated: ``picture`` of a single chip, without periodic repetition; None in the far field.
        numbers: Entry of summary.json for the method.
    """

    phase: Tensor
    picture: Tensor
    between: Tensor
    isolated: Tensor | None
    numbers: dict[str, Any]


def quality(experiment: PECExperiment, phase: Tensor) -> float:
    """First metric of ``report.metrics`` for heater phases [F, C, H, W], mean over the lit colours."""
    return observed(experiment, phase, torch.float64)[1][f"{experiment.settings.report.metrics[0]}_mean"]


def observed(
    experiment: PECExperiment, phase: Tensor, dtype: torch.dtype | None = None
) -> tuple[Tensor, dict[str, Any]]:
    """Picture [all colours, h, w] that heater phases [F, C, H, W] form, with the values of the target, and its scores.

    The phases are propagated in their precision, or in ``dtype``. The scores are those of ``report.metrics`` and the
    efficiency.
    """
    formed = experiment.picture_in(experiment.intensity(phase, dtype)).cpu()
    picture = _as_picture(experiment, formed, at_best_scale=experiment.scale_free)
    scores = _scores(experiment, picture, experiment.image)
    return picture, scores | {"efficiency": _efficiency(experiment, formed)}


def evaluate(experiment: PECExperiment, phase: Tensor) -> Result:
    """Score heater phases [F, C, H, W] of the lit colours.

    The scores are those at the image samples, midway between them, and, in the near field, those of a single chip.
    """
    phase = phase.detach()
    formed = experiment.picture_in(experiment.intensity(phase, torch.float64)).cpu()
    picture = _as_picture(experiment, formed, at_best_scale=experiment.scale_free)
    numbers = _scores(experiment, picture, experiment.image) | {
        "frames": len(phase),
        "efficiency": _efficiency(experiment, formed),
        "dark_spots": [int(count) for count in _per_colour(experiment, _spots(experiment, formed))],
        **_heating(experiment, phase),
    }
    isolated = None
    if experiment.distances:
        isolated, numbers["isolated"], between = _isolated(experiment, phase)
    else:
        (y, x), (height, width) = experiment.grid.coordinates(phase.device), experiment.grid.extent
        half_a_sample = torch.exp(-1j * math.pi * (y / height + x / width))
        between = experiment.mean_intensity(lambda frame: experiment.array(frame.double()) * half_a_sample, phase)
        between = experiment.picture_in(between).cpu()
        if experiment.scale_free:
            between = between * _scale(experiment, formed)
    between = _as_picture(experiment, between, at_best_scale=False)
    numbers["between_samples"] = _between_scores(experiment, between)
    if weight := experiment.settings.target.weight:
        numbers["zones"] = zone_scores(weight, picture, experiment.image, experiment.lit)
    return Result(_all_colours(experiment, phase.cpu()), picture, between, isolated, numbers)


def with_noisy_kernels(experiment: PECExperiment, phase: Tensor, noise: float) -> dict[str, Any]:
    """Scores of heater phases [F, C, H, W] on chips whose heat spreads a little otherwise than was measured.

    The kernel of each chip is the assumed one with Gaussian noise of standard deviation ``noise`` in every tap but the
    centre, which is 1; a rise stays within 0 and 1. The means over the lit colours are lists, a value for each chip.
    """
    assumed = experiment.array.crosstalk.kernel.detach().cpu().double()
    generator, scores = torch.Generator().manual_seed(experiment.settings.seed), []
    for _ in range(NOISY_KERNELS):
        kernel = assumed + noise * torch.randn(assumed.shape, generator=generator, dtype=assumed.dtype)
        kernel = kernel.clamp(0, 1)
        kernel[kernel.shape[0] // 2, kernel.shape[1] // 2] = 1
        scores.append(_with_kernel(experiment, phase, kernel))
    return {"noise": noise} | {name: [score[name] for score in scores] for name in scores[0]}


def with_even_kernel(experiment: PECExperiment, phase: Tensor) -> dict[str, Any] | None:
    """Scores of heater phases [F, C, H, W] where heat spreads equally to opposite sides.

    None for a Gaussian kernel, and for a measured one whose opposite taps hardly differ.
    """
    kernel = experiment.array.crosstalk.kernel
    if experiment.settings.modulator.kernel is None or (noise := opposite_noise(kernel)) <= NOISY:
        return None
    return _with_kernel(experiment, phase, even(kernel)) | {"noise": noise}


def with_continued_kernel(experiment: PECExperiment, phase: Tensor) -> dict[str, Any] | None:
    """Scores of heater phases [F, C, H, W] where the heat beyond the table of a measured kernel spreads, too.

    None for a Gaussian kernel, for a measured one whose table holds nearly all of the heat, and for one that does not
    tell how the heat falls beyond it (see :func:`continued`).
    """
    kernel = experiment.array.crosstalk.kernel
    if experiment.settings.modulator.kernel is None or not is_cut_off(kernel):
        return None
    whole = continued(kernel, experiment.grid.shape)
    return None if whole is None else _with_kernel(experiment, phase, whole) | {"taps": list(whole.shape)}


def _with_kernel(experiment: PECExperiment, phase: Tensor, kernel: Tensor) -> dict[str, float]:
    """Means of the scores over the lit colours where heat spreads by ``kernel`` [h, w] with 1 at its centre."""
    chip = PhasedArray(experiment.wavelengths, ThermalCrosstalk.from_patch(kernel)).to(experiment.device)
    formed = experiment.mean_intensity(lambda frame: chip(frame.double()), phase.detach())
    picture = _as_picture(experiment, experiment.picture_in(formed).cpu(), at_best_scale=experiment.scale_free)
    scores = _scores(experiment, picture, experiment.image)
    return {name: scores[name] for metric in experiment.settings.report.metrics if (name := f"{metric}_mean")}


def _heating(experiment: PECExperiment, phase: Tensor) -> dict[str, Any]:
    """Peak phase, and peak and mean temperature rises over all frames of heater phases [F, C, H, W]."""
    array, rows = experiment.array, []
    for frame in phase:  # one frame at a time, to save memory
        driven = frame.double()
        spread = array.crosstalk(driven)
        warm = array.temperature(spread)
        means = warm.mean((-2, -1)), array.temperature(driven).mean((-2, -1))
        rows.append(torch.stack([spread.amax((-2, -1)), warm.amax((-2, -1)), *means]))
    frames = torch.stack(rows)  # [F, 4, C]
    return {
        "peak_phase_rad": (peak := frames[:, 0].max().item()),
        "at_limit": experiment.limit is not None and peak > _AT_LIMIT * experiment.limit,
        "peak_temperature_rise_K": _per_colour(experiment, frames[:, 1].amax(0)),
        "mean_temperature_rise_K": _per_colour(experiment, frames[:, 2].mean(0)),
        "heating_power_K_per_pixel": _per_colour(experiment, frames[:, 3].mean(0)),
    }


def speckle_spots(experiment: PECExperiment, phase: Tensor) -> Tensor:
    """Number of bright pixels that come out dark for heater phases [F, C, H, W], of each lit colour, [C]."""
    return _spots(experiment, experiment.picture_in(experiment.intensity(phase, torch.float64)).cpu())


def _spots(experiment: PECExperiment, formed: Tensor) -> Tensor:
    return dark_spots(formed / formed.mean((-2, -1), keepdim=True), experiment.normalised)


def _efficiency(experiment: PECExperiment, formed: Tensor) -> list[float]:
    """Fraction of the array's light that falls in the picture, for each colour."""
    return _per_colour(experiment, formed.sum((-2, -1)) / math.prod(experiment.grid.shape))


def _scale(experiment: PECExperiment, formed: Tensor) -> Tensor:
    """Factors [C, 1, 1] that fit an intensity [C, h, w] to the target by least squares."""
    return best_scale(formed, experiment.normalised)[:, None, None]


def _isolated(experiment: PECExperiment, phase: Tensor) -> tuple[Tensor, dict[str, Any], Tensor]:
    """Picture of a single chip by the exact kernel, scores of the picture, and intensity midway between samples."""
    grid, axes = experiment.grid, (2, len(experiment.wavelengths), len(experiment.distances))
    images = torch.zeros(*axes, *grid.shape, dtype=torch.float64)  # [at samples or midway, C, D, H, W]
    for i, wavelength in enumerate(experiment.wavelengths):  # one kernel at a time, since float64 kernels are large
        for j, distance in enumerate(experiment.distances):
            for k, offset in enumerate(((0.0, 0.0), (grid.pitch[0] / 2, grid.pitch[1] / 2))):
                exact = CroppedKernel(grid, wavelength, distance, offset=offset).to(experiment.device)
                for frame in phase:
                    field = experiment.array(frame.double())[i : i + 1]
                    images[k, i, j] += intensity(exact(field))[0].cpu() / len(phase)
    formed, between = experiment.picture_in(images[:, :, 0] if len(experiment.distances) == 1 else images)
    picture = _as_picture(experiment, formed, at_best_scale=True)
    numbers = _scores(experiment, picture, experiment.image)
    numbers["efficiency"] = _efficiency(experiment, formed)
    return picture, numbers, between * _scale(experiment, formed)


def _between_scores(experiment: PECExperiment, between: Tensor) -> dict[str, Any]:
    """Scores of the picture midway between four samples, against the mean of the four pixels of the target."""
    picture = between[..., :-1, :-1]
    image = experiment.image
    reference = (image[..., 1:, 1:] + image[..., 1:, :-1] + image[..., :-1, 1:] + image[..., :-1, :-1]) / 4
    return _scores(experiment, picture, reference) if min(reference.shape[-2:]) >= SSIM_WINDOW else {}


def _scores(experiment: PECExperiment, picture: Tensor, image: Tensor) -> dict[str, Any]:
    """Each metric of the report, one value for every colour and the mean over the lit colours; None if infinite."""
    numbers: dict[str, Any] = {}
    for name in experiment.settings.report.metrics:
        values = (ssim if name == "ssim" else psnr)(picture.clamp(0, 1), image, data_range=1.0)
        numbers[name] = [_finite(value) for value in values.tolist()]
        numbers[f"{name}_mean"] = _finite(values[experiment.lit].mean().item())
    return numbers


def _as_picture(experiment: PECExperiment, formed: Tensor, *, at_best_scale: bool) -> Tensor:
    """Intensity [C, h, w] of each lit colour times the mean of its target; zeros for the other colours."""
    mean = experiment.image[experiment.lit].mean((-2, -1), keepdim=True)
    return _all_colours(experiment, (formed * _scale(experiment, formed) if at_best_scale else formed) * mean)


def _all_colours(experiment: PECExperiment, lit: Tensor) -> Tensor:
    """Values [..., C, h, w] or [C] of the lit colours, extended to all colours by zeros."""
    axis = 0 if lit.ndim == 1 else lit.ndim - 3
    shape = list(lit.shape)
    shape[axis] = len(experiment.lit)
    return lit.new_zeros(shape).index_copy(axis, experiment.lit.nonzero()[:, 0], lit)


def _per_colour(experiment: PECExperiment, values: Tensor) -> list[float]:
    return _all_colours(experiment, values.double().cpu()).tolist()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
