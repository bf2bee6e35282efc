"""Plan of a run of kind ``eye``: methods, cost and geometry, before anything is computed."""

import json
import math
from typing import Any

from holotorch.experiments.eye import geometry as eye_geometry
from holotorch.experiments.eye.experiment import RETINA, Observer
from holotorch.experiments.planning.colours import colours_in_words
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.planning.machine import machine_speed, seconds_in_words
from holotorch.experiments.runs.memory import shortage
from holotorch.experiments.runs.page import plain
from holotorch.experiments.volume import plan as volume_plan
from holotorch.optics.light.coherence import depth_of_focus
from holotorch.optics.viewing.imaging import retinal_scale

_METHODS = "collapse: eyepiece, eye and the space between as one filter; elements: one after the other, finely sampled"
# Costs on one core of the reference machine of ``planning.machine``.
FLOP_SECONDS = {"collapse": 2e-10, "elements": 4e-10}  # seconds per floating-point operation, by method
_DERIVED_SECONDS = 1e-9  # seconds / (n log2 n) to derive a picture of n samples from that at another wavelength
_BASE_BYTES = 600e6  # bytes of libraries, holograms of 512 px, and pictures of the report
_MARGIN = 1.1  # factor on the memory of a propagation: derived pictures need a margin around the picture
_DERIVED_BYTES = 96.0  # bytes per sample of the fields from which pictures at other wavelengths are derived
# A cheaper method is pointed out if it needs this many times fewer operations and misses the tolerance by this factor.
_FASTER, _NEARLY = 5.0, 2.0
_RETINA = (
    "method",
    "predicted_error",
    "adequate",
    "reason",
    "runner_up",
    "cost_ratio",
    "cheapest_error",
)  # reported attributes of a RetinaPlan


def plan_values(eye: Observer) -> dict[str, Any]:
    """The plan as JSON values: choices with their reasons, predicted cost, and geometry."""
    settings, scene, display = eye.settings, eye.scene, eye.display
    wavelengths, deepest = scene.settings.wavelengths, max(eye.focus)
    samples = {name: [eye.samples(name, each, deepest) for each in wavelengths] for name in settings.light.sources}
    counts = {name: [len(lengths) for lengths, _, _ in each] for name, each in samples.items()}
    propagated = {name: [count for _, _, count in each] for name, each in samples.items()}
    directions = [len(eye.points(wavelength, deepest)[0]) for wavelength in wavelengths]

    def pictures(per_source: dict[str, list[int]]) -> int:
        pairs = (pair for samples in per_source.values() for pair in zip(samples, directions, strict=True))
        return settings.seeds * sum(count * tilts for count, tilts in pairs)

    references = 8 * settings.seeds
    images = references * len(wavelengths) + pictures(propagated)
    derived = pictures(counts) - pictures(propagated)
    retina = [eye.retina(depth) for depth in eye.focus]
    eye.budget.predict(RETINA, max(choice.predicted_error for choice in retina))
    volume, machine, pixels = volume_plan.plan_values(scene), machine_speed(scene.device), math.prod(scene.grid.shape)
    fft = machine.fft(pixels)
    seconds = {
        "holograms": volume_plan.hologram_seconds(scene, machine) * (references + settings.seeds),
        "pictures": fft
        * (
            images * sum(choice.flops * FLOP_SECONDS[choice.method] for choice in retina)
            + derived * len(retina) * _DERIVED_SECONDS * pixels * math.log2(pixels)
        ),
        "start-up and figures": machine.around(figures=2 + len(retina)),
    }
    geometry = eye_geometry.geometry(eye)
    peaks = [_BASE_BYTES + _MARGIN * choice.memory_bytes + _DERIVED_BYTES * pixels for choice in retina]
    return {
        "scene": _scene(eye),
        "synthetic": scene.synthetic,
        "display": {
            "kind": settings.display.kind,
            "lens_distance_mm": float(display.lens_distance) * 1e3,
            "eye_distance_mm": float(display.eye_distance) * 1e3,
        },
        "focus_mm": [depth * 1e3 for depth in eye.focus],
        "accommodation_mm": [eye.accommodation(depth) * 1e3 for depth in eye.focus],
        "retinal_scale": [float(retinal_scale(display, eye.eye(depth), depth)) for depth in eye.focus],
        "aperture": [eye.aperture(depth) for depth in eye.focus],
        **eye.budget.values(),
        "retina": [{key: getattr(plan, key) for key in _RETINA} for plan in retina],
        "wavelengths": counts,
        "followed": propagated,
        "directions": directions,
        "images": images * len(eye.focus),
        "predicted_seconds": round(sum(seconds.values()), 1),
        "seconds_of": {name: round(each, 2) for name, each in seconds.items()},
        "predicted_peak_bytes": round(max(volume["predicted_peak_bytes"], *peaks)),
        "geometry": geometry,
        "warnings": [*eye_geometry.warnings(geometry), *_shallow(eye), *volume_plan.dark_picture(scene)],
    }


def _cheaper(eye: Observer, plans: list[dict[str, Any]]) -> list[str]:
    """A hint if a method that misses the tolerance of the retina by little takes far less time; otherwise none."""
    worst = max((plan["cheapest_error"] for plan in plans if plan["cost_ratio"] > 1), default=0.0)
    ratio = max(plan["cost_ratio"] for plan in plans)
    if ratio < _FASTER or not 0 < worst < _NEARLY * eye.budget.share(RETINA):
        return []
    step = 10 ** math.floor(math.log10(worst))
    enough = math.ceil(worst / step) * step
    return [f"Hint       eye.tolerance={enough:.1g} takes the other method, with 1 / {ratio:.0f} of the operations"]


def _shallow(eye: Observer) -> list[str]:
    """A warning if the eye sees all depths of the scene about equally sharp; otherwise none."""
    depths, wavelength = eye.scene.depths, min(eye.scene.settings.wavelengths)
    deep, middle = max(depths) - min(depths), (max(depths) + min(depths)) / 2
    if not 0 < deep < (focus := depth_of_focus(wavelength, eye.detail(middle, wavelength))):
        return []
    return [
        f"the scene is {deep * 1e3:.3g} mm deep and this eye's depth of focus there {focus * 1e3:.3g} mm: focusing "
        "makes no visible difference; use a deeper scene, a smaller distance, a wider hologram or pupil, or finer rays"
    ]


def _scene(eye: Observer) -> str:
    """Where volume, view and hologram come from, in words."""
    scene, own = eye.settings.scene.config, eye.settings.volume
    source = scene if own is None else f"{own.path or own.scene or own.phantom}, with view and hologram of {scene}"
    if changes := eye.settings.scene.change:
        source += f" and scene.change: {', '.join(changes)}"
    given = {} if (view := eye.settings.view) is None else view.model_dump(mode="json", exclude_unset=True)
    words = [f"view.{key}={json.dumps(value)}" for key, value in given.items()]
    words += [] if (scale := eye.settings.scale) is None else [f"scale={scale}"]
    if words:
        source += f"; {', '.join(words)}"
    return source


def plan_text(eye: Observer, values: dict[str, Any]) -> str:
    """The plan in words."""
    settings, depths, grid = eye.settings, values["focus_mm"], eye.scene.grid
    lines = [
        f"Scene      {values['scene']}" + (f" (synthetic: {values['synthetic']})" if values["synthetic"] else ""),
        f"View       {volume_plan.viewpoint(eye.scene)}",
        f"Hologram   {grid.shape[0]} x {grid.shape[1]} px of {grid.pitch[1] * 1e6:.4g} um, {eye.scene.rays.shape[0]} x "
        f"{eye.scene.rays.shape[1]} rays, {len(eye.scene.depths)} planes",
        f"Display    {settings.display.kind}; eyepiece {values['display']['lens_distance_mm']:.4g} mm from the "
        f"hologram, eye {values['display']['eye_distance_mm']:.4g} mm behind it",
        f"Focus      at {', '.join(f'{depth:.4g}' for depth in depths)} mm, which appear at "
        f"{', '.join(f'{distance:.4g}' for distance in values['accommodation_mm'])} mm; the pupil takes light "
        f"of a half angle whose sine is {', '.join(f'{sine:.3g}' for sine in values['aperture'])}",
        *eye_geometry.in_words(values["geometry"]),
    ]
    for method in dict.fromkeys(choice["method"] for choice in values["retina"]):
        plans = [pair for pair in zip(depths, values["retina"], strict=True) if pair[1]["method"] == method]
        depth, worst = max(plans, key=lambda pair: pair[1]["predicted_error"])
        where = f" (largest error, at {depth:.4g} mm)" if len(plans) > 1 else ""
        only = f" (focus {', '.join(f'{depth:.4g}' for depth, _ in plans)} mm)" if len(plans) < len(depths) else ""
        lines.append(f"Retina     {worst['reason']}{where}{only}; alternative: {worst['runner_up']}")
    lines.append(f"Methods    to the retina, by {_METHODS}")
    lines += _cheaper(eye, values["retina"])
    lines += colours_in_words("volume", eye.scene.settings.wavelengths)
    by = "by colour, " if len(eye.scene.settings.wavelengths) > 1 else ""
    light = "; ".join(
        f"{name}: {plain(values['followed'][name])} of {plain(count)} wavelengths simulated"
        for name, count in values["wavelengths"].items()
    )
    directions = f"; from {plain(values['directions'])} directions" if settings.light.extent else ""
    others = "" if eye.separate else "; the others are derived from them"
    if any(settings.eye.position):
        y, x = (1e3 * each for each in settings.eye.position)
        lines.append(f"Eye        beside the axis, at y {y:.3g} mm, x {x:.3g} mm; light below: for an eye on the axis")
    lines += [
        f"Light      with the eye at {max(depths):.4g} mm, {by}{light}{others}{directions}",
        f"Phases     {settings.seeds} realisation(s) of the random phases, compared with the mean of "
        f"{8 * settings.seeds} others",
        eye.budget.text,
        f"Cost       about {duration(values['predicted_seconds'])} for {values['images']} images of one wavelength "
        f"each ({seconds_in_words(values['seconds_of'])}); "
        f"{values['predicted_peak_bytes'] / 1e9:.2g} GB of memory at the peak",
    ]
    if sweep := settings.sweep:
        lines.append(
            f"Sweep      in addition, {sweep.steps} depths of focus, {sweep.realisations} realisation(s) each, all "
            "colours; the cost above excludes it"
        )
    if settings.tradeoff:
        where = ", ".join(f"{distance * 1e3:g}" for distance in settings.tradeoff)
        lines.append(f"Trade-off  in addition, at {where} mm, by the method collapse; the cost above excludes it")
    if note := volume_plan.preset_note(eye.scene):
        lines.append(f"Note       {note}")
    first = len(eye_geometry.warnings(values["geometry"]))  # printed above, with the numbers of the geometry
    return "\n".join([*lines, *(f"WARNING    {warning}" for warning in values["warnings"][first:])])


def too_large(values: dict[str, Any]) -> str | None:
    """Error message if the run does not fit into the free memory, otherwise None."""
    text = shortage(values)
    elements = any(choice["method"] == "elements" for choice in values["retina"])
    return f"{text}, or a larger tolerance" if text and elements else text
