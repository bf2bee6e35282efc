"""The plan of a joint run: cost and physics, before anything is optimised."""

import math
from dataclasses import replace
from typing import Any

import torch

from holotorch.experiments.joint.budget import COARSE_PLANES, FEW_PLANES, PATIENCE, SLABS, stop
from holotorch.experiments.joint.config import BASELINES, MOST_PLANES, JointSettings
from holotorch.experiments.joint.experiment import JointExperiment, with_planes
from holotorch.experiments.joint.seconds import seconds_of, step_views, view_samples
from holotorch.experiments.planning.colours import colours_in_words
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.planning.heat_kernel import NOISY, cut_off_note, opposite_noise, response_note
from holotorch.experiments.planning.machine import machine_speed, seconds_in_words
from holotorch.experiments.volume.plan import cut_off, dark_picture, preset_note, unlit, viewpoint
from holotorch.optics.light.coherence import depth_of_focus

_SAMPLE_BYTES = 55  # bytes per padded sample of a view of a frame and colour, kept for the gradient
_KERNEL_BYTES = 8  # bytes per padded sample of a view of a colour, of the transfer functions of all views
_BASE_BYTES = 430e6  # memory of the libraries
_STRETCHED = 0.1  # logarithm of a stretch above which it is noted
_SPACING = 0.75  # of planes, in depths of focus, above which foci between them are worse (10 dB at 0.94)


def plan_values(experiment: JointExperiment) -> dict[str, Any]:
    """Cost and physics as plain JSON values."""
    settings, foci, padded = experiment.settings, experiment.foci, view_samples(experiment)
    eye, colours = settings.eye, len(settings.wavelengths)
    views = len(foci) + eye.parallax
    samples = settings.frames * colours * step_views(experiment)
    kernels = 0 if eye.per_step is None else _KERNEL_BYTES * colours * views  # of views that few steps take
    seconds = seconds_of(experiment, machine_speed(experiment.device))
    peak = _BASE_BYTES + (_SAMPLE_BYTES * samples + kernels) * math.prod(padded) + experiment.scene.volume.values.nbytes
    return {
        "volume": {"shape": list(experiment.scene.volume.shape), "synthetic": experiment.scene.synthetic},
        "planes_mm": [depth * 1e3 for depth in sorted(experiment.depths)],
        "foci_mm": [focus * 1e3 for focus in foci],
        "stretched": experiment.stretched,
        "pupil_deg": 2 * math.degrees(math.asin(experiment.radius)),
        "depth_of_focus_mm": depth_of_focus(min(settings.wavelengths), experiment.radius) * 1e3,
        "views": views,
        "samples": list(padded),
        **experiment.budget.values(),
        "taps": experiment.crosstalk.kernel.shape[0],
        "stop_below": stop(settings, experiment.budget),
        "precision": "complex64" if experiment.dtype == torch.float32 else "complex128",
        "predicted_seconds": round(sum(seconds.values()), 2),
        "seconds_of": {name: round(each, 2) for name, each in seconds.items()},
        "predicted_peak_bytes": round(peak),
        "device": str(experiment.device),
        "notes": _notes(experiment),
    }


def plan_text(experiment: JointExperiment, values: dict[str, Any]) -> str:
    """The plan in words."""
    settings, display = experiment.settings, experiment.settings.display
    volume = values["volume"]
    source = settings.volume.path or settings.volume.scene or settings.volume.phantom
    if volume["synthetic"]:
        source = f"{settings.volume.phantom} (synthetic: {volume['synthetic']})"
    heat = settings.heat
    spread = f"heat spreads over {display.sigma_px:g} px"
    if display.kernel is not None:
        size = " x ".join(map(str, experiment.crosstalk.kernel.shape))
        spread = f"heat spreads by the measured kernel {display.kernel}, {size} px"
        if (noise := opposite_noise(experiment.crosstalk.kernel)) > NOISY:
            spread += f", whose opposite taps differ as by noise of {noise:.1g} of the centre"
    usual = display.rad_per_K == type(display).model_fields["rad_per_K"].default
    thesis = ", that of the thesis's chip" if usual else ""
    memory = "" if heat is None else f"; {_left(settings):.1%} of the heat is left after a frame"
    fewer = ""
    if (count := len(values["foci_mm"])) < len(values["planes_mm"]):
        fewer = f"; {count} foci, half a depth of focus apart, stand for those of all planes"
    lines = [
        f"Volume     {source}, {' x '.join(map(str, volume['shape']))} voxels, {experiment.scene.width * 1e3:.3g} mm "
        f"wide, on {len(values['planes_mm'])} planes from "
        f"{values['planes_mm'][0]:.4g} to {values['planes_mm'][-1]:.4g} mm behind the array, its "
        f"front nearest, {experiment.scene.samples} sample(s) of the volume for each",
        f"View       {viewpoint(experiment.scene)}",
        f"Display    {display.shape[0]} x {display.shape[1]} px of {display.pitch[1] * 1e6:.4g} um, {settings.frames} "
        f"frame{'s' * (settings.frames > 1)} in turn; {spread}, phases up to "
        f"{settings.limit / math.pi:.3g} pi, {_temperatures(settings)} degC above ambient "
        f"(display.rad_per_K={display.rad_per_K:.4g} at {display.rad_per_K_at * 1e9:.4g} nm{thesis}){memory}",
        f"Eye        pupil of {values['pupil_deg']:.3g} deg, depth of focus {values['depth_of_focus_mm']:.3g} mm; "
        f"{values['views']} views are corrected together, {settings.eye.parallax} of them through parts of the "
        f"pupil{fewer}",
        *colours_in_words("volume", settings.wavelengths),
        f"Solver     {_steps(values, experiment)}; compared with {_compared(settings)}",
        f"{experiment.budget.text}; {values['taps']} taps, {values['precision']} in the solver",
        f"Cost       about {duration(values['predicted_seconds'])} ({seconds_in_words(values['seconds_of'])}); "
        f"{values['predicted_peak_bytes'] / 1e9:.2g} GB of memory at the peak",
    ]
    return "\n".join(lines + [f"Note       {note}" for note in values["notes"]])


def _steps(values: dict[str, Any], experiment: JointExperiment) -> str:
    settings = experiment.settings
    if settings.eye.per_step is not None:
        return f"Adam, {settings.steps} steps, each with {step_views(experiment)} of the views at random"
    if settings.tolerance is None:
        return f"L-BFGS, {settings.steps} steps"
    few = f"{PATIENCE} in a row change the loss by less than {values['stop_below']:.1e} of it"
    return f"L-BFGS, at most {settings.steps} steps, until {few}"


def _compared(settings: JointSettings) -> str:
    left_out = settings.comparisons != settings.report.baselines
    few = " (slabs, one plane a frame, needs as many frames)" if left_out else ""
    return (", ".join(settings.comparisons) or "nothing") + few


def _temperatures(settings: JointSettings) -> str:
    """Temperature of the hottest pixel that the limit allows, for each wavelength."""
    display = settings.display
    response = [display.rad_per_K * display.rad_per_K_at / wavelength for wavelength in settings.wavelengths]
    return " / ".join(f"{settings.limit / each:.0f}" for each in response)


def _left(settings: JointSettings) -> float:
    assert settings.heat is not None
    return math.exp(-settings.heat.frame_us / settings.heat.time_constant_us)


def _far_apart(experiment: JointExperiment, step: float, focus: float) -> str:
    """A note on planes ``step`` apart, for an eye with a depth of focus of ``focus``, both in metres."""
    settings, count = experiment.settings, len(experiment.depths)
    words = (
        f"the planes are {step * 1e3:.3g} mm apart, more than {_SPACING:g} of the depth of focus of "
        f"{focus * 1e3:.3g} mm: images between them may be worse, and the light of a slab is where its plane is; "
    )
    more = min(MOST_PLANES, math.ceil(count * step / (_SPACING * focus)))
    if more <= count:
        return words + "use a smaller pupil or display.depth"
    # Where it is asked for by name, the comparison "slabs" needs a frame for each plane.
    names = settings.report.baselines
    frames = f" frames={more}" if "slabs" in names and names != BASELINES else ""
    now, then = (
        sum(seconds_of(each, machine_speed(experiment.device)).values())
        for each in (experiment, replace(experiment, scene=with_planes(experiment.scene, settings, more)))
    )
    ratio = f"in about {then / now:.2g} times the time"
    return f"{words}display.planes={more}{frames} puts it where it belongs, {ratio}, or use a smaller pupil"


def _notes(experiment: JointExperiment) -> list[str]:
    settings, foci = experiment.settings, experiment.foci
    notes = dark_picture(experiment.scene) + cut_off(experiment.scene, "array") + unlit(experiment.scene)
    if words := preset_note(experiment.scene):
        notes.append(words)
    if (error := experiment.budget.error(SLABS)) > FEW_PLANES:
        shown = "slices of it" if error > COARSE_PLANES else "thin parts of it broken"
        notes.append(
            f"the rendering is {error:.0%} off this volume: pictures show {shown}; without view.samples, slabs are "
            "sampled as often as needed"
        )
    depth, stretched = settings.display.depth, experiment.stretched
    if depth is not None and abs(math.log(stretched)) > _STRETCHED:
        notes.append(
            f"the volume is stretched {stretched:.3g} times along the axis to fill display.depth, so that an eye sees "
            f"depth in it; display.depth={depth / stretched * 1e3:.3g}mm keeps its proportions"
        )
    notes += response_note(settings.display.model_fields_set, "display", settings.wavelengths)
    if settings.display.kernel is not None:
        notes += cut_off_note(experiment.crosstalk.kernel)
    focus = depth_of_focus(min(settings.wavelengths), experiment.radius)
    if len(foci) > 1 and (step := (foci[-1] - foci[0]) / (len(foci) - 1)) > _SPACING * focus:
        notes.append(_far_apart(experiment, step, focus))
    if 0 < (deep := foci[-1] - foci[0]) < focus:
        notes.append(
            f"the planes lie within {deep * 1e3:.3g} mm, less than the depth of focus of {focus * 1e3:.3g} mm: every "
            "focus shows the same picture; use a larger display.depth or a wider pupil"
        )
    if settings.eye.pupil > 0.5:
        notes.append("the pupil is wider than half the band of the pixels, which do not resolve its image fully")
    if settings.limit < math.pi:
        notes.append("phases below pi cannot form images of high contrast; expect little light in them")
    return notes
