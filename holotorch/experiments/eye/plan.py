"""What a run of the observer will do, by which way and at what cost, before it starts."""

import math
from typing import Any

from holotorch.experiments.eye import geometry as eye_geometry
from holotorch.experiments.eye.experiment import Observer
from holotorch.experiments.runs.markup import plain
from holotorch.experiments.runs.memory import shortage
from holotorch.experiments.volume import plan as volume_plan
from holotorch.optics.viewing.imaging import retinal_scale

# Seconds per flop of the plan's own measure on two CPU cores.
_FLOP_SECONDS = {"collapse": 2e-10, "elements": 4e-10}
_NEIGHBOUR = 1e-9  # the same per sample and its logarithm, for a wavelength made from another
_BASE_BYTES = 600e6  # measured: libraries, holograms of 512 px, and pictures of the report
_ROOM, _FIELDS = 1.1, 96.0  # the rim that neighbours need, of a way's own; bytes of theirs per sample


def plan_values(eye: Observer) -> dict[str, Any]:
    """Choices with their reasons, cost and physics, as plain JSON values."""
    settings, scene, display = eye.settings, eye.scene, eye.display
    waves = scene.settings.wavelengths
    rules = {source: [eye.samples(source, wave, max(eye.focus)) for wave in waves] for source in settings.light.sources}
    counts = {source: [len(places) for places, _, _ in rule] for source, rule in rules.items()}
    followed = {source: [many for _, _, many in rule] for source, rule in rules.items()}
    others, own = 8 * settings.seeds, settings.seeds
    directions = [len(eye.points(wave, max(eye.focus))[0]) for wave in waves]

    def pictures(each: dict[str, list[int]]) -> int:
        return own * sum(n * many for count in each.values() for n, many in zip(count, directions, strict=True))

    images = others * len(waves) + pictures(followed)
    made = pictures(counts) - pictures(followed)
    ways = [eye.retina(depth) for depth in eye.focus]
    volume = volume_plan.plan_values(scene)
    seconds = volume["predicted_seconds"] / scene.settings.report.seeds * (others + own)
    seconds += images * sum(way.flops * _FLOP_SECONDS[way.method] for way in ways)
    samples = math.prod(scene.grid.shape)
    seconds += made * len(ways) * _NEIGHBOUR * samples * math.log2(samples)
    return {
        "scene": settings.scene.config,
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
        "tolerance": settings.tolerance,
        "retina": [
            {
                "method": way.method,
                "predicted_error": way.predicted_error,
                "adequate": way.adequate,
                "reason": way.reason,
                "runner_up": way.runner_up,
            }
            for way in ways
        ],
        "wavelengths": counts,
        "followed": followed,
        "directions": directions,
        "images": images * len(eye.focus),
        "predicted_seconds": round(seconds, 1),
        "predicted_peak_bytes": round(
            max(
                volume["predicted_peak_bytes"],
                *(_BASE_BYTES + _ROOM * way.memory_bytes + _FIELDS * samples for way in ways),
            )
        ),
        "geometry": eye_geometry.geometry(eye),
    }


def plan_text(eye: Observer, values: dict[str, Any]) -> str:
    """The plan in words."""
    settings, depths = eye.settings, values["focus_mm"]
    lines = [
        f"Scene      {values['scene']}" + (f" (synthetic: {values['synthetic']})" if values["synthetic"] else ""),
        f"Display    {settings.display.kind}; eyepiece {values['display']['lens_distance_mm']:.4g} mm from the "
        f"hologram, eye {values['display']['eye_distance_mm']:.4g} mm behind it",
        f"Focus      at {', '.join(f'{depth:.4g}' for depth in depths)} mm, seen at "
        f"{', '.join(f'{far:.4g}' for far in values['accommodation_mm'])} mm; aperture "
        f"{', '.join(f'{sine:.3g}' for sine in values['aperture'])}",
        *eye_geometry.in_words(values["geometry"]),
    ]
    for method in dict.fromkeys(way["method"] for way in values["retina"]):
        own = [(depth, way) for depth, way in zip(depths, values["retina"], strict=True) if way["method"] == method]
        depth, worst = max(own, key=lambda pair: pair[1]["predicted_error"])
        where = f" at {depth:.4g} mm, where it is worst" if len(own) > 1 else ""
        only = f" (focus {', '.join(f'{depth:.4g}' for depth, _ in own)} mm)" if len(own) < len(depths) else ""
        lines.append(f"Retina     {worst['reason']}{where}{only}; next: {worst['runner_up']}")
    lines += [
        "Light      "
        + "; ".join(
            f"{name}: {plain(values['followed'][name])} of {plain(count)} wavelengths followed"
            for name, count in values["wavelengths"].items()
        )
        + (f", each from {plain(values['directions'])} directions" if settings.light.extent else ""),
        f"Phases     {settings.seeds} realisation(s), compared with the mean of {8 * settings.seeds} others",
        f"Cost       about {values['predicted_seconds']:.2g} s on two idle cores for {values['images']} images, "
        f"{values['predicted_peak_bytes'] / 1e9:.2g} GB of memory at the peak",
    ]
    if sweep := settings.sweep:
        lines.append(
            f"Sweep      {sweep.steps} depths of focus besides, {sweep.realisations} realisation(s) each, all three "
            "colours; its cost is not in the above"
        )
    if settings.tradeoff:
        where = ", ".join(f"{distance * 1e3:g}" for distance in settings.tradeoff)
        lines.append(f"Trade-off  at {where} mm besides, all of it by the collapse; its cost is not in the above")
    return "\n".join(lines)


def too_large(values: dict[str, Any]) -> str | None:
    """A line that says that the run does not fit into the memory that is free, or None."""
    text = shortage(values)
    elements = any(way["method"] == "elements" for way in values["retina"])
    return f"{text}, or a larger tolerance" if text and elements else text
