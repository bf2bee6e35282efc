"""Scores of what a method shows: errors of the images in trained and in held-back views, light and heat."""

import math
from typing import Any

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.methods import Shown
from holotorch.metrics import ssim

_AT_LIMIT = 0.97  # fraction of the limit above which it is what bounds the phases
_BRIGHT = 0.3  # fraction of the peak of the wanted images above which a pixel counts in the contrast


def evaluate(experiment: JointExperiment, shown: Shown) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Scores, and the images [C, V, H, W] of each set of views, scaled like the wanted images.

    One scale for each colour, that of the stack, is used for all views, since the power of a laser does not depend on
    where the eye looks.
    """
    views = {"stack": experiment.stack, "held": experiment.held_back}
    views |= {"half": experiment.halves, "part": experiment.held_parts}
    images, numbers = {}, {}
    scale = torch.ones(())
    with torch.no_grad():
        for name, each in views.items():
            if each is None:
                continue
            observed = shown.images(each.operator)
            if name == "stack":
                scale = best_scale(observed, each.images, -3)[:, None, None, None]
            images[name] = observed * scale
            numbers |= {f"{name}_{key}": value for key, value in errors(images[name], each.images).items()}
        field = experiment.stack.operator(shown.fields)[:, :, len(experiment.foci) // 2]
        numbers["light_in_pupil"] = (intensity(field).sum() / intensity(shown.fields).sum()).item()
        if shown.phase is not None:
            peaks = experiment.heat(shown.phase).amax((0, 2, 3))  # of each colour
            peak, display = peaks.max().item(), experiment.settings.display
            kelvin = (
                peaks * peaks.new_tensor(experiment.settings.wavelengths) / display.rad_per_K_at / display.rad_per_K
            )
            numbers |= {"peak_phase_pi": peak / math.pi, "at_limit": peak > _AT_LIMIT * experiment.settings.limit}
            numbers["peak_temperature_K"] = kelvin.max().item()
    return numbers, images


def errors(images: Tensor, wanted: Tensor) -> dict[str, float]:
    """PSNR in dB over all images together, their relative L2 error, mean SSIM, and contrast.

    ``images`` [C, V, H, W] are scaled as ``wanted``.

    The contrast is the standard deviation of shown / wanted over its mean, where the wanted image is bright. Unlike the
    PSNR it does not profit from a black background.
    """
    peak = wanted.amax((1, 2, 3), keepdim=True)  # of each colour
    images, wanted = (images / peak).cpu(), (wanted / peak).cpu()
    bright = wanted > _BRIGHT
    ratio = images[bright] / wanted[bright]
    square = (images - wanted).square().mean().item()
    return {
        "psnr": -10 * math.log10(square),
        "error": math.sqrt(square / wanted.square().mean().item()),
        "ssim": ssim(images.clamp(0, 1), wanted, data_range=1.0).mean().item(),
        "contrast": (ratio.std() / ratio.mean()).item(),
    }


def per_view(experiment: JointExperiment, shown: Shown) -> tuple[Tensor, Tensor, list[dict[str, Any]]]:
    """Wanted and shown intensities [V, C, H, W] of all views, trained ones first, and a row for each view and colour.

    With the rows, anybody can compute the same pictures from the phases: focus, pupil in cycles per metre, wavelength.
    """
    held = experiment.held_back, experiment.halves, experiment.held_parts
    sets = [("trained", experiment.trained), *(("held", views) for views in held)]
    wavelengths, (pitch_y, pitch_x) = experiment.settings.wavelengths, experiment.grid.pitch
    wanted, images, rows = [], [], []
    with torch.no_grad():
        stack = experiment.stack
        scale = best_scale(shown.images(stack.operator), stack.images, -3)[:, None, None, None]
        for use, views in sets:
            if views is None:
                continue
            observed = shown.images(views.operator) * scale
            for v, view in enumerate(views.operator.views):
                for c, wavelength in enumerate(wavelengths):
                    numbers = errors(observed[c : c + 1, v : v + 1], views.images[c : c + 1, v : v + 1])
                    y, x, radius = (sine / wavelength for sine in (*view.centre, view.radius))
                    rows.append(
                        {
                            "view": len(wanted) + v,
                            "use": use,
                            "focus_m": view.focus,
                            "pupil_y_per_m": y,
                            "pupil_x_per_m": x,
                            "pupil_radius_per_m": radius,
                            "covered_y": view.covered[0],
                            "covered_x": view.covered[1],
                            "wavelength_m": wavelength,
                            "pitch_y_m": pitch_y,
                            "pitch_x_m": pitch_x,
                            **{key: round(value, 4) for key, value in numbers.items()},
                        }
                    )
            wanted += views.images.movedim(1, 0).cpu().unbind(0)
            images += observed.movedim(1, 0).cpu().unbind(0)
    return torch.stack(wanted), torch.stack(images), rows
