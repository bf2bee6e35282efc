"""Plan of a run of kind ``pec``: its choices with their reasons, its cost, and the physics of its setup."""

import math
from dataclasses import asdict
from typing import Any

import torch

from holotorch.correction.problem import FRAMES_AT_ONCE
from holotorch.experiments.pec.budget import stop
from holotorch.experiments.pec.config import SIGMA_MEANING
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.pec.seconds import evaluations, padded_samples, seconds_of
from holotorch.experiments.planning.colours import colours_in_words
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.planning.heat_kernel import NOISY, cut_off_note, opposite_noise, response_note
from holotorch.experiments.planning.machine import machine_speed, seconds_in_words
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import diffraction_angle, plan_propagation, unaliased_distance

# Memory in bytes, fitted to whole commands (scripts/predictions.py --memory).
_BASE_BYTES = 430e6  # the interpreter with its libraries, and the report
_PIXEL_BYTES = {"apg": 70, "adam": 90, "lbfgs": 190}  # in the solver, per pixel of all colours and frames
# The same where frames are propagated in turn, and what is saved of it if the arrays of each frame are not in the heap,
# in which they leave gaps.
_IN_TURN_BYTES, _GAPS_BYTES = {"apg": 85, "adam": 85, "lbfgs": 215}, 45
_SOLVER_BYTES = 60  # in the solver, per padded sample of the frames that are propagated at once
_SCORED_BYTES = 350  # in the float64 simulation of the result with its scores, per pixel of all colours of a frame
_SCORED_WITHOUT_GAPS = 260  # the same of arrays that are not in the heap
_EVALUATION_BYTES = 112  # the same in the near field, per grid sample of one colour besides
_BASELINE_BYTES = 330  # per pixel of all colours of a frame: the heap of small arrays after the methods of comparison
_MAPPED = 32e6  # bytes above which an array is not in the heap, but returned to the system at once


def plan_values(experiment: PECExperiment) -> dict[str, Any]:
    """Values of plan.json: choices with their reasons, predicted cost, and physics of the setup."""
    settings, grid = experiment.settings, experiment.grid
    padded = grid.padded(2 if experiment.isolated else 1)
    seconds = seconds_of(experiment, machine_speed(experiment.device))
    single = {}
    if experiment.isolated:
        propagation = plan_propagation(grid, experiment.wavelengths, list(experiment.distances))
        single = {"single_propagation": asdict(propagation)}
    crosstalk = experiment.array.crosstalk
    size_rule = "chosen so that no tap above 1e-6 is dropped" if settings.tolerance is None else "for the tolerance"
    size_rule = "as given" if settings.modulator.kernel_size else size_rule
    solver_dtype = "complex64" if experiment.dtype == torch.float32 else "complex128"
    free_scale = " at its best scale, since light may leave the picture" if experiment.scale_free else ""
    return {
        "propagator": settings.propagator.kind,
        "padding": {"samples": list(padded.shape), "reason": _padding_reason(experiment)},
        **single,
        "crosstalk": _measured(experiment)
        if settings.modulator.kernel
        else {
            "sigma_px": settings.modulator.sigma_px,
            "meaning": SIGMA_MEANING,
            "taps": crosstalk.kernel.shape[0],
            "lost_heat": crosstalk.lost_heat,
            "reason": size_rule,
        },
        "heat": _heat(experiment),
        "frames": settings.frames,
        "start": {"kind": experiment.start, "reason": _START_REASONS[experiment.start]},
        "loss": "intensity" + free_scale,
        "device": str(experiment.device),
        **experiment.budget.values(),
        "stop_below": stop(settings, experiment.budget),
        "precision": f"{solver_dtype} in the solver, complex128 in the evaluation",
        "predicted_evaluations": evaluations(experiment),
        "predicted_seconds": round(sum(seconds.values()), 2),
        "seconds_of": {name: round(each, 2) for name, each in seconds.items()},
        "predicted_peak_bytes": round(_peak_bytes(experiment)),
        "physics": _physics(experiment),
        "notes": _notes(experiment),
    }


def _peak_bytes(experiment: PECExperiment) -> float:
    """Peak memory of a run, which does not depend on the number of steps."""
    settings, frames = experiment.settings, experiment.settings.frames
    colours, samples = len(experiment.wavelengths), math.prod(experiment.grid.shape)
    frame, padded = colours * samples, colours * padded_samples(experiment)
    at_once = frames if frames * frame <= FRAMES_AT_ONCE or not experiment.joint else 1
    double = experiment.dtype.itemsize / 4
    per_pixel = (_PIXEL_BYTES if at_once == frames else _IN_TURN_BYTES)[settings.solver.kind]
    if at_once < frames and 4 * frame >= _MAPPED:
        per_pixel -= _GAPS_BYTES
    solver = double * (per_pixel * frames * frame + _SOLVER_BYTES * at_once * padded)
    images = frame * max(1, (1 + len(experiment.distances)) // 2)
    scored = (_SCORED_BYTES if 8 * frame < _MAPPED else _SCORED_WITHOUT_GAPS) * images
    if experiment.distances:
        scored += 16 * padded + _EVALUATION_BYTES * 5 * samples
    heap = _BASELINE_BYTES * images if settings.report.baselines and 8 * frame < _MAPPED else 0
    return _BASE_BYTES + max(solver, scored) + heap


def plan_text(experiment: PECExperiment, values: dict[str, Any]) -> str:
    """The plan as text for ``holotorch check`` and ``holotorch run``."""
    settings, physics, crosstalk = experiment.settings, values["physics"], values["crosstalk"]
    height, width = settings.grid.shape
    colours = "grey" if len(experiment.lit) == 1 else "colour"
    wavelengths = ", ".join(f"{wavelength * 1e9:.4g} nm" for wavelength in experiment.wavelengths)
    lines = [
        f"Picture    {settings.target.image}, {colours}, on {height} x {width} px{_framing(experiment)}",
        f"Array      {physics['width_mm']:.4g} x {physics['height_mm']:.4g} mm (width x height)",
        _crosstalk_line(crosstalk),
        f"Light      {wavelengths}; field of view {_listed(physics['field_of_view_deg'], '.2f')} deg across",
        f"Propagator {values['propagator']}, {values['padding']['reason']}",
    ]
    if len(settings.wavelengths) > 1:  # a single one shows the luminance
        lines += colours_in_words("picture", settings.wavelengths)
    if "distance_mm" in physics:
        periodic = f"; the periodic model is alias-free up to {_listed(physics['alias_free_mm'])} mm"
        unresolved = max(map(abs, physics["distance_mm"])) > physics["resolved_mm"]
        blurred = ": fine detail is blurred there, between the samples" if unresolved else ""
        lines.append(
            f"Image      at {_listed(physics['distance_mm'], 'g')} mm; smallest spot of each colour"
            f"{', at the farthest,' if len(physics['distance_mm']) > 1 else ''} {_listed(physics['spot_um'])} um, "
            f"sampled every {physics['pitch_um'][1]:.4g} um, which the array resolves up to "
            f"{physics['resolved_mm']:.3g} mm{blurred}{'' if experiment.isolated else periodic}"
        )
    if region := settings.target.region:
        lines.append(
            f"Region     the middle {region[0]} x {region[1]} px hold the picture; other pixels are not constrained"
        )
    if weight := settings.target.weight:
        lines.append(
            f"Weight     squared errors count (1 + E / {weight.e2_deg:g} deg)^-2 at E from the gaze; the picture spans "
            f"{weight.field_deg:g} deg"
        )
    if settings.frames > 1:
        how = "solved for together" if experiment.joint else "solved for one by one"
        lines.append(f"Frames     {settings.frames}, shown in turn and {how}; the eye sees their mean")
    lines += [
        f"Heat       {values['heat']}",
        f"Solver     {settings.solver.kind}, at most {settings.solver.max_steps} steps from a "
        f"{values['start']['kind']} start ({values['start']['reason']}); it stops when "
        f"{settings.solver.patience} steps in a row change the loss by less than {100 * values['stop_below']:.2g} %",
        f"{experiment.budget.text}; {values['precision']}",
        f"Cost       at most about {values['predicted_evaluations']} evaluations, "
        f"{duration(values['predicted_seconds'])} ({seconds_in_words(values['seconds_of'])}), "
        f"{values['predicted_peak_bytes'] / 1e9:.2g} GB of memory at the peak",
    ]
    for note in values["notes"]:
        warning = note.removeprefix(_WARNING)
        lines.append(f"Note       {note}" if warning == note else f"WARNING    {warning}")
    return "\n".join(lines)


_START_REASONS = {
    "hot": "random heater phases, uniform on [0, 2 pi): the light covers the whole image",
    "flat": "random heater phases, uniform on [0, 1): a nearly plane wave, whose light stays in the window",
    "cool": "random heater phases, so small that no phase after spreading exceeds 2 pi: little heat",
    "retrieved": "phases of Gerchberg-Saxton phase retrieval, deconvolved",
    "quadratic": "the phase of a lens after spreading, slope pi per pixel at the edge: much heat, few phase vortices",
}


def _measured(experiment: PECExperiment) -> dict[str, Any]:
    """The measured kernel, and the Gaussian that fits it best."""
    kernel = experiment.array.crosstalk.kernel
    values = {"kernel": experiment.settings.modulator.kernel, "taps": list(kernel.shape), "total": kernel.sum().item()}
    values["noise"] = opposite_noise(kernel)
    try:
        fitted = ThermalCrosstalk.fitted(kernel)
    except ValueError:  # a single pixel, or one that is as warm as its surroundings
        return values
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in kernel.shape)
    model = torch.exp(-(y[:, None] ** 2 + x**2) / fitted.sigma_px**2)
    residual = ((model - kernel).norm() / kernel.norm()).item()
    return values | {"fitted_sigma_px": fitted.sigma_px, "fit_residual": residual}


# Limit in the far field, over the root of the kernel's sum, below which pictures are lost: for sigmas of 0.66 to 2 px,
# SSIM of four joint frames at 64 px is 0.16 to 0.86 at 0.6 to 3.6, 0.79 to 1.0 at 4.05 to 4.5, and from 0.92 at 5.3.
_FAR_FIELD = 4.0
_WARNING = "Warning: "  # beginning of a note without which pictures cannot be understood
_SAME_ASPECT = 0.01  # relative change of an aspect ratio that nobody sees
_LITTLE = 1.0  # rad: of random phases that differ by less, over 0.9 of the light goes straight on (sinc^2(1/2))
_FEW_SPOTS = 0.1  # width of a spot, relative to the array, from which on hardly ten of them lie side by side
_NO_GAUSSIAN = 0.05  # rest of a fit above which corrections for the Gaussian lose much of their gain


def _crosstalk_line(values: dict[str, Any]) -> str:
    if "kernel" in values:
        line = f"Crosstalk  measured kernel {values['kernel']}, {' x '.join(map(str, values['taps']))} px"
        if "fit_residual" in values:
            line += (
                f"; the Gaussian that fits it best has sigma {values['fitted_sigma_px']:.3g} px and leaves "
                f"{values['fit_residual']:.2g} of it (rms)"
            )
            if values["fit_residual"] > _NO_GAUSSIAN:
                line += ": a sigma alone would not represent this kernel"
        if (noise := values["noise"]) > NOISY:
            line += (
                f"; opposite taps differ as by noise of {noise:.1g} of the centre: "
                f"report.kernel_noise={noise:.1g} tells what that costs"
            )
        return line
    return (
        f"Crosstalk  heat spreads with sigma {values['sigma_px']:g} px over {values['taps']} taps "
        f"({values['reason']}): {SIGMA_MEANING}"
    )


def _framing(experiment: PECExperiment) -> str:
    """Words on a picture whose aspect ratio is changed, empty for another."""
    target, (height, width) = experiment.settings.target, experiment.source.shape[-2:]
    rows, columns = target.region or experiment.grid.shape
    if abs(math.log(width * rows / (height * columns))) < _SAME_ASPECT:
        return ""
    wide = width * rows > height * columns
    if target.fit == "pad":
        how = f"padded with black {'above and below' if wide else 'on both sides'}"
    else:
        how = f"cropped {'on both sides' if wide else 'above and below'}; target.fit=pad shows all of it"
    return f"; of {height} rows and {width} columns, {how}"


def _listed(values: list[float], form: str = ".3g") -> str:
    return " / ".join(f"{value:{form}}" for value in values)


def _heat(experiment: PECExperiment) -> str:
    """Text on the temperature limit and the resolution of the heaters."""
    limit, bits = experiment.limit, experiment.settings.modulator.bits
    chip = experiment.settings.modulator
    steps = "" if bits is None else f"; heaters with {2**bits} steps"
    thesis = (
        ", that of the thesis's chip: give yours"
        if chip.rad_per_K == type(chip).model_fields["rad_per_K"].default
        else ""
    )
    steps += f"; modulator.rad_per_K={chip.rad_per_K:.4g} at {chip.rad_per_K_at * 1e9:.4g} nm{thesis}"
    if limit is None:
        return "no limit, as in the thesis: the hottest pixel is reported" + steps
    kelvin = [limit / response for response in experiment.array.response]
    which = "" if len(kelvin) == 1 else " of the colours, which share this limit"
    return f"the phase after spreading stays below {limit:.4g} rad, {_listed(kelvin)} degC above ambient{which}" + steps


def _padding_reason(experiment: PECExperiment) -> str:
    if experiment.isolated:
        kernel = "paraxial" if experiment.settings.propagator.kind == "fresnel" else "exact"
        return f"a chip that stands alone: its {kernel} kernel on twice the window, so that no light wraps around"
    if experiment.distances:
        return "unpadded: the periodic model of the thesis"
    return "unpadded: the far field of the array, sampled once per pixel"


def _notes(experiment: PECExperiment) -> list[str]:
    """Warnings about the limits of the model."""
    notes = []
    grid, distances, longest = experiment.grid, experiment.distances, max(experiment.wavelengths)
    if experiment.limit is not None and experiment.limit < _LITTLE:
        notes.append(
            f"the limit lets phases differ by {experiment.limit:.3g} rad at most, which steers little light: no solver "
            "and no number of frames makes a good picture of that"
        )
    elif experiment.limit is not None and not distances:
        least = _FAR_FIELD * math.sqrt(experiment.array.crosstalk.kernel.sum().item())
        if experiment.limit < least:
            warmest = max(least / response for response in experiment.array.response)
            notes.append(
                f"in the far field this kernel needs a limit of about {least:.3g} rad ({warmest:.0f} degC above "
                "ambient): below it much of the picture is lost; a picture at a distance needs less "
                "(propagator.kind=fresnel)"
            )
    if distances:
        limit, farthest = unaliased_distance(grid, longest, 1), max(map(abs, distances))
        if min(distances) < 0:
            notes.append("a distance is negative: that image is virtual, behind the array as seen from the observer")
        if not experiment.isolated:
            notes.append(
                "periodic boundary: the array repeats without end, as in the thesis; a single chip forms another "
                "picture, shown and scored beside it as 'isolated'"
            )
            if farthest > limit:
                notes.append(
                    f"the periodic kernel is undersampled beyond {limit * 1e3:.3g} mm at {longest * 1e9:.0f} nm; at "
                    f"{farthest * 1e3:.4g} mm this model aliases"
                )
        spot = longest * farthest / min(grid.extent)
        if spot > 1.5 * max(grid.pitch):
            nearer = farthest * max(grid.pitch) / spot
            if (share := spot / min(grid.extent)) > _FEW_SPOTS:
                notes.append(
                    f"{_WARNING}at {farthest * 1e3:.4g} mm a spot is {share:.2g} times as wide as the array, which "
                    f"forms no picture there{f'; is it {farthest:.4g}mm that was meant?' if farthest >= 1 else ''}"
                )
            notes.append(
                f"the array resolves {spot * 1e6:.3g} um at this distance, {spot / max(grid.pitch):.1f} samples: finer "
                "detail may be right at the samples, which SSIM and PSNR compare, but not between them (between.png); "
                f"a sample is resolved up to {nearer * 1e3:.3g} mm "
                f"(propagator.distance={nearer * 1e3:.3g}mm)"
            )
    elif len(experiment.wavelengths) > 1:
        notes.append(
            "each colour has its own field of view and is shown here sample by sample; on a display the shorter "
            "wavelengths' pictures are smaller and the targets must be scaled to overlap"
        )
    lost = experiment.array.crosstalk.lost_heat
    if lost > 0.01:
        notes.append(f"{100 * lost:.1f} % of the heat falls outside the kernel's taps; leave modulator.kernel_size out")
    chip = experiment.settings.modulator
    notes += response_note(chip.model_fields_set, "modulator", experiment.settings.wavelengths)
    if chip.kernel is not None:
        notes += cut_off_note(experiment.array.crosstalk.kernel)
    if dark := [i for i, on in enumerate(experiment.lit.tolist()) if not on]:
        notes.append(f"colour {', '.join(map(str, dark))} of the picture is black: its light source stays off")
    if experiment.source.mean() < 0.02:
        notes.append(
            "the picture is very dark: SSIM and PSNR, which compare with full white, are near their best anyway"
        )
    return notes


def _physics(experiment: PECExperiment) -> dict[str, Any]:
    """Sizes, angles and distances of the setup, as values of plan.json."""
    grid, distances, wavelengths = experiment.grid, experiment.distances, experiment.wavelengths
    values: dict[str, Any] = {
        "height_mm": grid.extent[0] * 1e3,
        "width_mm": grid.extent[1] * 1e3,
        "pitch_um": [step * 1e6 for step in grid.pitch],
        "field_of_view_deg": [2 * math.degrees(diffraction_angle(grid, wavelength)[1]) for wavelength in wavelengths],
        "phase_response_rad_per_K": list(experiment.array.response),
        "kernel_sum": experiment.array.crosstalk.total,
    }
    if distances:
        values |= {
            "distance_mm": [distance * 1e3 for distance in distances],
            "spot_um": [wavelength * max(map(abs, distances)) / min(grid.extent) * 1e6 for wavelength in wavelengths],
            "resolved_mm": max(grid.pitch) * min(grid.extent) / max(wavelengths) * 1e3,
            "alias_free_mm": [unaliased_distance(grid, wavelength, 1) * 1e3 for wavelength in wavelengths],
        }
    return values
