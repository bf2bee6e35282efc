"""The plan of a volume's run: methods, cost and physics, before anything is computed."""

import math
from collections.abc import Sequence
from typing import Any

import torch

from holotorch.core.grid import Grid
from holotorch.experiments.planning.colours import colours_in_words
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.planning.machine import Machine, machine_speed, seconds_in_words
from holotorch.experiments.volume.experiment import VolumeExperiment
from holotorch.experiments.volume.report import EDGES, METHODS
from holotorch.hologram.plan import EDGE_MATTERS
from holotorch.optics import diffraction_angle
from holotorch.optics.light.coherence import depth_of_focus
from holotorch.scene import DVRSampler

# Times on one core of the reference machine of ``planning.machine``.
FLOP_SECONDS = 5.7e-11  # seconds per operation of a HologramPlan
_RAY_SECONDS = 2.5e-8  # seconds of rendering per ray and sample
_FIELD_SECONDS = 1e-8  # seconds / (n log2 n) to refocus a field of n samples
_CALL_SECONDS = 0.015  # seconds to plan the refocusing of a field
_PICTURE_SECONDS = 2.4e-6  # seconds to score a pixel of a picture, encode it and draw it in a figure
_BASE_BYTES = 410e6  # memory of the libraries
_RAY_BYTES = 120  # memory of the renderer per ray
_FEW_VALUES = 0.01  # share of the range of a volume below which points hardly lie among its values
_FAINT = 0.02  # share of the voxels above the background from which a note says that a preset hides them
_COARSE_SLABS = 0.1  # predicted error of a rendering above which the plan contains a note
_DENSE, _STEEP = 0.5, 0.1  # opacity of a surface, and the part of the range of values within which it rises to that
_SIDES = {"L": "left", "R": "right", "A": "front", "P": "back", "S": "head", "I": "feet"}  # of a patient
_END = {"far": "far from", "near": "near"}
_OPPOSITE = str.maketrans("LRAPSI", "RLPAIS")
_SAME_SIZE = 0.01  # logarithm of a ratio of sizes below which they are the same
_SLAB = 42  # rendered planes held in memory before they are spread onto the nodes of an axial hologram
_COARSE = 64  # rays along each side of the renderings that estimate how much light is cut off, and what is black
_LIT = 0.05  # value above which a ray is not black
_DARK = 0.1  # share of such rays below which a picture counts as mostly black


def plan_values(experiment: VolumeExperiment) -> dict[str, Any]:
    """Choices with their reasons, cost and physics, as plain JSON values."""
    settings, plans, depths = experiment.settings, experiment.plans, experiment.depths
    rays = math.prod(experiment.rays.shape)
    machine = machine_speed(experiment.device)
    seconds = {"holograms": settings.report.seeds * hologram_seconds(experiment, machine)}
    seconds |= _evaluation_seconds(experiment, machine)
    slab_error = experiment.slab_error
    spectra = [experiment.dtype.itemsize * math.prod(plan.size) for plan in plans]  # bytes
    # While planes are added, each colour holds a sum and a summand; at the end, one spectrum is transformed as well.
    slab = 8 * rays * _SLAB * len(plans)
    peak = _BASE_BYTES + 2 * sum(spectra) + 1.5 * max(spectra) + slab + _RAY_BYTES * rays
    peak += experiment.volume.values.nbytes
    return {
        "volume": {
            "shape": list(experiment.volume.shape),
            "unit": experiment.volume.unit,
            "synthetic": experiment.synthetic,
            "width_mm": experiment.width * 1e3,
        },
        "planes": len(depths),
        "samples": experiment.samples,
        "slab_error": round(slab_error, 4),
        "depths_mm": [min(depths) * 1e3, max(depths) * 1e3],
        "rays": list(experiment.rays.shape),
        "holograms": [
            {
                "wavelength_nm": wavelength * 1e9,
                "method": each.method,
                "cone": each.cone,
                "near": each.near,
                "transforms": each.transforms,
                "samples": list(each.size),
                "predicted_error": each.predicted_error,
                "reason": each.reason,
                "runner_up": each.runner_up,
            }
            for wavelength, each in zip(settings.wavelengths, plans, strict=True)
        ],
        **experiment.budget.values(),
        "precision": str(experiment.dtype).removeprefix("torch."),
        "predicted_seconds": round(sum(seconds.values()), 2),
        "seconds_of": {name: round(each, 2) for name, each in seconds.items()},
        "predicted_peak_bytes": round(peak),
        "device": str(experiment.device),
        "physics": _physics(experiment),
        "warnings": [*_beside_the_scene(experiment), *_shallow(experiment), *dark_picture(experiment)],
        "notes": _notes(experiment, slab_error),
    }


def hologram_seconds(experiment: VolumeExperiment, machine: Machine) -> float:
    """Seconds to render and compute the holograms of one realisation."""
    seconds = rendering_seconds(experiment, machine)
    return seconds + sum(FLOP_SECONDS * plan.flops * machine.fft(math.prod(plan.size)) for plan in experiment.plans)


def rendering_seconds(experiment: VolumeExperiment, machine: Machine) -> float:
    """Seconds to render the volume once."""
    steps = len(experiment.depths) * experiment.samples
    return _RAY_SECONDS * math.prod(experiment.rays.shape) * steps * machine.elementwise


def _evaluation_seconds(experiment: VolumeExperiment, machine: Machine) -> dict[str, float]:
    """Seconds of each step after the holograms, by name."""
    depths, pixels = len(experiment.refocus) or 3, math.prod(experiment.grid.shape)
    field = _FIELD_SECONDS * pixels * math.log2(pixels) * machine.fft(pixels) + _CALL_SECONDS * machine.interpreter
    pictures = _PICTURE_SECONDS * math.prod(experiment.rays.shape) * (depths + 2) * machine.interpreter
    return {
        "refocusing": experiment.settings.report.seeds * depths * len(experiment.plans) * field,
        # The volume is rendered and its depth mapped once more for the comparison.
        "pictures": pictures + 2 * rendering_seconds(experiment, machine),
        "start-up and figures": machine.around(figures=2),
    }


def viewpoint(experiment: VolumeExperiment) -> str:
    """Sides of a patient towards the observer, upwards and to the right, in words; else directions of the file."""
    observer = 1.0 if experiment.settings.view.front == "far" else -1.0  # sign of his direction along depths
    # The rows of the scene, (z, y, x), each as a direction (z, y, x) of the file.
    scene = experiment.rotation @ torch.tensor(experiment.volume.orientation, dtype=torch.float64)
    names = []
    for direction in (observer * scene[0], -scene[1], scene[2]):
        k = int(direction.abs().argmax())
        about = "about " if direction[k].abs() < 0.99 else ""
        reverse = bool(direction[k] < 0)
        side = _side(experiment.volume.frame, k, reverse=reverse)
        names.append(about + (f"the {side}" if side else f"{'-' * reverse}{'zyx'[k]}"))
    if _side(experiment.volume.frame, 0, reverse=False):
        return "from {} of a patient, with {} up and {} to the right, as the file names its sides".format(*names)
    text = "from {} in the coordinates of its file, with {} up and {} to the right".format(*names)
    source = experiment.settings.volume
    if source.path and not experiment.volume.frame and not source.left_handed:
        text += "; the file does not say how its axes lie: left and right are a guess (volume.left_handed)"
    return text


def _side(frame: str, axis: int, *, reverse: bool) -> str:
    """The side of a patient that an axis of the file (0 for z, 1 for y, 2 for x) points to; empty if unknown."""
    letter = frame[2 - axis] if frame else ""
    return _SIDES.get(letter.translate(_OPPOSITE) if reverse else letter, "")


def plan_text(experiment: VolumeExperiment, values: dict[str, Any]) -> str:
    """The plan in words."""
    settings, grid = experiment.settings, experiment.grid
    volume, physics = values["volume"], values["physics"]
    source = settings.volume.path or settings.volume.scene or settings.volume.phantom
    if volume["synthetic"]:
        source = f"{settings.volume.phantom} (synthetic: {volume['synthetic']})"
    nearest, farthest = values["depths_mm"]
    lines = [
        f"Volume     {source}, {' x '.join(map(str, volume['shape']))} voxels, {volume['width_mm']:.4g} mm wide"
        f"{_resized(experiment)}",
        f"View       {viewpoint(experiment)}",
        f"Rays       {values['rays'][0]} x {values['rays'][1]}, {settings.phase} phases; {values['planes']} planes "
        f"from {nearest:.4g} to {farthest:.4g} mm, the end {_END[settings.view.front]} the hologram towards the "
        f"observer, {values['samples']} sample(s) of the volume for each; predicted error of the rendering: "
        f"{100 * values['slab_error']:.2g} %",
        f"Hologram   {grid.shape[0]} x {grid.shape[1]} px of {grid.pitch[1] * 1e6:.4g} um; field of view "
        f"{', '.join(f'{angle:.2f}' for angle in physics['field_of_view_deg'])} deg",
    ]
    if settings.scale > 1:
        divided = "pixels, rays, distances, width and a given number of planes"
        lines.append(f"Scale      1 / {settings.scale} of the configuration: {divided} are divided by {settings.scale}")
    if experiment.refocus:
        lines.append(
            f"Pictures   refocused at {_millimetres(experiment.refocus)}, as report.refocus asks{_by(settings.scale)}"
        )
    lines += colours_in_words("volume", settings.wavelengths)
    lines.append(f"Method     {METHODS}")
    for hologram in values["holograms"]:
        method = hologram["method"] + (f"; {EDGES[hologram['cone']]}" if hologram["near"] else "")
        error = f"predicted error {hologram['predicted_error']:.1e}"
        lines.append(f"{hologram['wavelength_nm']:.0f} nm     method: {method} ({error}); {hologram['runner_up']}")
    lines += [
        experiment.budget.text,
        f"Precision  {values['precision']}",
        f"Cost       about {duration(values['predicted_seconds'])} for {settings.report.seeds} realisation(s) of the "
        f"random phases ({seconds_in_words(values['seconds_of'])}); "
        f"{values['predicted_peak_bytes'] / 1e9:.2g} GB of memory at the peak",
    ]
    lines += [f"Note       {note}" for note in values["notes"]]
    lines += [f"WARNING    {warning}" for warning in values["warnings"]]
    return "\n".join(lines)


def _resized(experiment: VolumeExperiment) -> str:
    """How many times smaller or larger than in its file the volume is shown, in words; empty if that is not known."""
    if experiment.volume.unit != "m" or experiment.synthetic:
        return ""
    times = max(experiment.volume.extent) / experiment.width
    if abs(math.log(times)) < _SAME_SIZE:
        return ""
    return f", {max(times, 1 / times):.3g} times {'smaller' if times > 1 else 'larger'} than in the file (view.width)"


def _physics(experiment: VolumeExperiment) -> dict[str, Any]:
    grid, wavelengths = experiment.grid, experiment.settings.wavelengths
    angles = [diffraction_angle(grid, wavelength)[1] for wavelength in wavelengths]
    middle = (min(experiment.depths) + max(experiment.depths)) / 2
    return {
        "field_of_view_deg": [2 * math.degrees(angle) for angle in angles],
        "spot_um": [wavelength * middle / min(grid.extent) * 1e6 for wavelength in wavelengths],
        # The smallest distance at which the light of every source covers the whole hologram (region III of the thesis).
        "whole_cone_from_mm": [
            (experiment.width + min(grid.extent)) / 2 / math.tan(angle) * 1e3 if angle < math.pi / 2 else 0.0
            for angle in angles
        ],
    }


def preset_note(experiment: VolumeExperiment) -> str:
    """Range of a preset that the configuration does not state; empty for any other transfer function."""
    if experiment.preset_range is None:
        return ""
    low, high = experiment.preset_range
    hidden = experiment.transfer.visible_from
    preset, shown, values = experiment.settings.transfer.preset, experiment.background, experiment.counted
    note = (
        f"the preset {preset} lies between {low:.3g} and {high:.3g}, from the histogram, and shows nothing of values "
        f"below {hidden:.3g}: look at it with holotorch check --preview"
    )
    if shown is None or (faint := 1 - (values >= hidden).sum() / (values > shown).sum()) < _FAINT:
        return note
    kind = " (in a patient, soft tissue)" if preset == "bone" else ""
    return (
        f"{note}; that hides {100 * faint:.2g} % of the voxels above {shown:.4g}, where the background ends{kind}; "
        f"'transfer={{preset: {preset}, visible_from: {shown:.4g}}}' shows them"
    )


def _notes(experiment: VolumeExperiment, slab_error: float) -> list[str]:
    notes = list(dict.fromkeys(note for plan in experiment.plans for note in plan.notes))
    if experiment.settings.tolerance is None and experiment.settings.hologram.tolerance is None:
        # Pictures hardly depend on it, and nobody asked for a field of a certain accuracy.
        notes = [note for note in notes if note != EDGE_MATTERS]
    if slab_error > _COARSE_SLABS:
        notes.append(
            f"slabs this thick put the rendering {slab_error:.0%} off the one with thin slabs: without view.samples, "
            "each is sampled twice for each voxel"
        )
    if words := preset_note(experiment):
        notes.append(words)
    notes += _other_values(experiment) + unlit(experiment)
    return notes + cut_off(experiment, "rays")


def unlit(experiment: VolumeExperiment) -> list[str]:
    """A note on opaque surfaces that nothing shades."""
    view, transfer = experiment.settings.view, experiment.transfer
    dense = transfer.positions[transfer.opacities > _DENSE]
    if view.lighting or view.scattering or not len(dense):
        return []
    clear = transfer.positions[(transfer.opacities == 0) & (transfer.positions < dense[0])]
    if not len(clear) or dense[0] - clear[-1] > _STEEP * (transfer.positions[-1] - clear[0]):
        return []
    return ["the transfer function shows opaque surfaces without shading; view.lighting=true shows their shape"]


def _other_values(experiment: VolumeExperiment) -> list[str]:
    """A note if the points of the transfer function hardly lie among the values of the volume."""
    points = experiment.settings.transfer.points
    if points is None:
        return []
    first, last = min(point[0] for point in points), max(point[0] for point in points)
    least, largest = experiment.volume.value_range()
    common = min(last, largest) - max(first, least)
    if 2 * common >= last - first and common >= _FEW_VALUES * (largest - least):
        return []
    return [
        f"the points of the transfer function lie between {first:g} and {last:g}, the values of this volume between "
        f"{least:g} and {largest:g}: are they meant for this file? transfer=bone takes its values from the histogram"
    ]


def _beside_the_scene(experiment: VolumeExperiment) -> list[str]:
    """A warning if no plane lies near a depth at which the hologram is refocused."""
    nearest, farthest = min(experiment.depths), max(experiment.depths)
    margin = max(farthest - nearest, 0.1 * farthest) / 4
    outside = [depth for depth in experiment.refocus if not nearest - margin <= depth <= farthest + margin]
    if not outside:
        return []
    scale = experiment.settings.scale
    meant = [depth * scale for depth in outside]
    typed = ""
    if scale > 1 and all(nearest - margin <= depth <= farthest + margin for depth in meant):
        typed = f"; for {_millimetres(meant)} of this plan give {_millimetres([depth * scale for depth in meant])}"
    return [
        f"report.refocus: {_millimetres(outside)}{_by(scale)} lies beside the scene, which extends "
        f"from {nearest * 1e3:.4g} to {farthest * 1e3:.4g} mm: pictures there are blurred. SSIM takes each ray from "
        "the picture that is refocused nearest to it; leave report.refocus out, and depths within the scene are "
        f"taken{typed}"
    ]


def _millimetres(depths: Sequence[float]) -> str:
    return ", ".join(f"{depth * 1e3:.4g} mm" for depth in depths)


def _by(scale: int) -> str:
    return f" (divided by the scale, {scale})" if scale > 1 else ""


def _shallow(experiment: VolumeExperiment) -> list[str]:
    nearest, depth = min(experiment.depths), max(experiment.depths) - min(experiment.depths)
    half_angle = math.atan(min(experiment.grid.extent) / 2 / nearest)
    wavelength = min(experiment.settings.wavelengths)
    aperture = min(math.sin(half_angle), wavelength / (2 * max(experiment.rays.pitch)))
    if 0 < depth < (focus := depth_of_focus(wavelength, aperture)):
        return [
            f"the scene is {depth * 1e3:.3g} mm deep and the depth of focus {focus * 1e3:.3g} mm: refocusing "
            "makes no visible difference; use a deeper scene, a smaller distance, or a wider hologram with finer rays"
        ]
    return []


def dark_picture(experiment: VolumeExperiment) -> list[str]:
    """A warning if most of a coarse rendering is black; otherwise none."""
    share = (experiment.quick_rendering(_COARSE, lit=False).amax(0) > _LIT).double().mean().item()
    if share >= _DARK:
        return []
    low, highest = experiment.settings.transfer.low, experiment.volume.value_range()[1]
    if low is not None and low >= highest:
        return [
            f"transfer.low {low:g} is not below the largest value of the file, {highest:g}: nothing is visible; leave "
            "low and high out, and the preset takes them from the histogram"
        ]
    return [
        f"{100 * (1 - share):.0f} % of the picture is black: SSIM, which compares black with black there, says little; "
        f"look at holotorch check --preview, and change transfer or view.width"
    ]


def cut_off(experiment: VolumeExperiment, what: str) -> list[str]:
    """A note if over 0.5 % of the volume's light lies outside the area of the rays, which the note calls ``what``."""
    sides = _sides(experiment)
    height, width = experiment.rays.extent
    fits = min(height / sides[1], width / sides[2])
    if fits >= 1 or (lost := _lost_light(experiment, sides)) <= 0.005:
        return []
    fitting = experiment.width * fits * 1e3
    step = 10.0 ** (math.floor(math.log10(fitting)) - 1)
    whole = f"{step * math.floor(fitting / step):.2g} mm"  # rounded down, so that it fits
    return [
        f"{100 * lost:.1f} % of the volume's light lies beside the {what}, {width * 1e3:.3g} mm wide and "
        f"{height * 1e3:.3g} mm high, and is cut off; about 'view.width={whole}' shows all of it"
    ]


def _sides(experiment: VolumeExperiment) -> list[float]:
    """Depth, height and width in metres of the box around the volume, as it is turned."""
    extent = torch.tensor(experiment.volume.extent, dtype=torch.float64)
    return (experiment.rotation.abs() @ extent / extent.max() * experiment.width).tolist()


def _lost_light(experiment: VolumeExperiment, sides: list[float]) -> float:
    """Fraction of the volume's light outside the area of the rays, from a coarse rendering of the whole volume."""
    height, width = experiment.rays.extent
    finest = min(experiment.volume.spacing) / max(experiment.volume.extent) * experiment.width
    middle, half, planes = experiment.distance, sides[0] / 2, max(24, math.ceil(sides[0] / (4 * finest)))
    coarse = Grid(_COARSE, (sides[1] / _COARSE, sides[2] / _COARSE))
    depths = [middle + half * ((j + 0.5) * 2 / planes - 1) for j in range(planes)]
    geometry = {"width": experiment.width, "distance": middle, "rotation": experiment.rotation}
    front_to_back = depths[::-1] if experiment.settings.view.front == "far" else depths
    sampler = DVRSampler(experiment.transfer, coarse, front_to_back, **geometry)
    sampler.checks_slabs = False  # a rough sum of light needs no thin slabs
    with torch.no_grad():
        light = sampler.render(experiment.volume)[0].sum(0)
    total = light.sum().item()
    if total == 0:
        return 0.0
    y, x = coarse.coordinates(light.device)
    inside = (y.abs() <= height / 2) & (x.abs() <= width / 2)
    return 1 - (light * inside).sum().item() / total
