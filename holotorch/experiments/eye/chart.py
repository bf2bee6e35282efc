"""Chart of an observer's view: image error by method and by number of wavelengths, and speckle against sharpness."""

import math
import warnings
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.fourier import good_length
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.eye.experiment import PRESETS, Observer, observer
from holotorch.experiments.eye.run import scene_settings
from holotorch.experiments.eye.tradeoff import WIDTHS, Case, fitted_prefactor, in_words, tradeoff
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.figures import draw_front, figure_png, mark_choice
from holotorch.experiments.timing import timed
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.io.bundled import find_config
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.wavelength_sampling import neighbour_error, pupil_illumination, select_wavelengths
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling, propagate_elements
from holotorch.optics.viewing.imaging import propagate_collapsed
from holotorch.optics.viewing.retina import plan_retina

FOCUS = 30e-3  # distance from hologram to the depth in focus, in metres
FACTORS = (1.0, 2.0, 4.0)  # oversampling by elements: pitch of the hologram / pitch on eyepiece and eye
COLLAPSE = "collapse"  # the method that ``Retina`` uses


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    side: int = 512  # pixels along each side of the hologram
    depths: int = 58  # planes of the scene
    distances: tuple[float, ...] = (10e-3, 20e-3, 30e-3)  # distances from hologram to scene, in metres
    sources: tuple[str, ...] = tuple(PRESETS)
    others: int = 12  # realisations of the reference of the trade-off


FULL = Amount()
QUICK = Amount(96, 8, (30e-3,), ("laser",), others=2)


def eye(quick: bool = False) -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Table rows of methods and sources, table rows of the trade-off, PNG pictures by name, and lines of text."""
    amount = QUICK if quick else FULL
    path = find_config("configs/eye/teapot.yaml")
    assert path is not None  # bundled with the package
    shape = f"shape: [{amount.side}, {amount.side}], depths: {amount.depths}, rays: {amount.side // 2}"
    hologram = f"hologram={{{shape}, pitch: 3.74 um, distance: 30 mm}}"
    settings = load_config(path, [f"scene={{config: configs/volume/c60.yaml, change: ['{hologram}', view.samples=1]}}"])
    assert isinstance(settings, ObserverSettings)
    scene = scene_settings(settings)
    methods = _methods(_quarter_size(settings, scene))
    counts = _counts(observer(settings.model_copy(update={"focus": (FOCUS,)}), scene), amount)
    cases = tradeoff(settings, scene, amount.distances, others=amount.others)
    rows = [case.row(fitted_prefactor(cases)) for case in cases]
    pictures = {"chart": _draw(methods, counts, cases, amount)}
    return methods + counts, rows, pictures, _verdict(methods, counts, cases, amount)


def _quarter_size(settings: ObserverSettings, scene: VolumeSettings) -> Observer:
    """Observer with a quarter of the distances; at full size, element-by-element propagation needs 11 GB."""
    display, eye = settings.display, settings.eye
    lengths = {name: value / 4 for name, value in display.model_dump().items() if isinstance(value, float)}
    smaller = {
        "display": display.model_copy(update=lengths),
        "eye": eye.model_copy(update={"pupil_radius": eye.pupil_radius / 4, "axial_length": eye.axial_length / 4}),
        "focus": (FOCUS / 4,),
    }
    near = scene.hologram.model_copy(update={"distance": FOCUS / 4})
    return observer(settings.model_copy(update=smaller), scene.model_copy(update={"hologram": near}))


def _methods(observer: Observer) -> list[dict]:
    """Table rows with time and error of collapsed and element-by-element propagation of green light, both paraxial.

    The reference is element-by-element propagation with 1.3 times the least oversampling that avoids aliasing.
    """
    grid, depth, wavelength = observer.scene.grid, observer.focus[0], observer.scene.settings.wavelengths[1]
    hologram, _ = observer.scene.hologram(0)
    field, eye, display = hologram[1].conj()[None], observer.eye(depth), observer.display
    least = least_oversampling(grid, [wavelength], display, eye, plane=depth)
    setup: dict[str, Any] = {"plane": depth, "paraxial": True}

    def by_elements(factor: float) -> Tensor:
        return propagate_elements(field, grid, [wavelength], display, eye, sampling=_scaled(least, factor), **setup)

    reference = intensity(by_elements(1.3))
    plan = plan_retina(grid, [wavelength], display, eye, example=field, **setup)
    needed = max(least.oversampling)
    calls: dict[str, Any] = {COLLAPSE: partial(propagate_collapsed, field, grid, [wavelength], display, eye, **setup)}
    for factor in (*(f for f in FACTORS if f < 0.95 * needed), needed):
        name = f"elements, {factor:.2g} x" + (", the thesis's sampling" if factor == 1 else "")
        calls[name] = partial(by_elements, factor / needed)
    rows = []
    for name, call in calls.items():
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the chart shows this aliasing
            call()  # warms up
            image, seconds = timed(call)
        predicted = f"{plan.predicted_error:.1e}" if name == COLLAPSE else ""
        rows.append(_row("way", name, seconds, _error(intensity(image), reference), predicted))
    return rows


def _scaled(sampling: ElementSampling, factor: float) -> ElementSampling:
    """``sampling`` with ``factor`` times as many samples along each axis."""
    fine = tuple(good_length(math.ceil(size * factor / 2) * 2) for size in sampling.fine)
    times = tuple(m * now / size for m, now, size in zip(sampling.oversampling, fine, sampling.fine, strict=True))
    return replace(sampling, oversampling=times, fine=fine)  # type: ignore[arg-type]


def _counts(observer: Observer, amount: Amount) -> list[dict]:
    """Table rows with the error of a green picture by number of wavelengths; the reference has one every nanometre.

    "followed": the picture is the sum over all wavelengths, but only this number of them is propagated; the pictures at
    the other wavelengths are derived from the propagated ones. "alone": the sum is over this number of wavelengths.
    """
    depth, wavelength, grid = observer.focus[0], observer.scene.settings.wavelengths[1], observer.scene.grid
    hologram, _ = observer.scene.hologram(0)
    field, eye = hologram[1].conj(), observer.eye(depth)
    light = pupil_illumination(grid, wavelength, observer.display, eye, reach=observer.scene.width / 2)

    def image(wavelengths: Tensor, weights: Tensor, count: int) -> Tensor:
        return spectral_image(field, grid, wavelengths, weights, observer.display, eye, count=count)

    rows = []
    for source in amount.sources:
        spectrum = PRESETS[source](wavelength)
        wavelengths, weights = spectrum.every(1e-9)
        total = len(wavelengths)
        reference, seconds = timed(partial(image, wavelengths, weights, total))
        rows.append(_row(source, f"{total} of {total} nm steps", seconds, "0"))
        most = total // 4
        # Fewer wavelengths than requested are propagated if few of them carry most of the power.
        asked = [count for count in (1, 2, 3, 7, 15, most) if count <= max(3, most)]
        for count in sorted({len(select_wavelengths(wavelengths, weights, count)[0]) for count in asked}):
            picture, seconds = timed(partial(image, wavelengths, weights, count))
            predicted = f"{neighbour_error(wavelengths, weights, count, light):.1e}"
            rows.append(_row(source, f"{count} of {total} followed", seconds, _error(picture, reference), predicted))
        for count in (1, 2, 3, 4, 6, 9, 14, 20):
            if count < total:
                few = spectrum.samples(count, path_difference=light.path_difference, iris=False, step=1e-9)
                picture, seconds = timed(partial(image, *few, len(few[0])))
                rows.append(_row(source, f"{count} of {total} alone", seconds, _error(picture, reference)))
    return rows


def _error(picture: Tensor, reference: Tensor) -> str:
    """Relative L2 error of a picture, as text."""
    return f"{((picture - reference).square().mean() / reference.square().mean()).sqrt().item():.1e}"


def _row(subject: str, what: str, seconds: float, error: str, predicted: str = "") -> dict:
    return {"subject": subject, "what": what, "seconds": f"{seconds:.3f}", "error": error, "predicted": predicted}


def _verdict(methods: list[dict], counts: list[dict], cases: list[Case], amount: Amount) -> list[str]:
    lines = []
    for row in methods:
        predicted = f" (predicted {row['predicted']})" if row["predicted"] else ""
        lines.append(f"{row['what']}: error {row['error']}{predicted}, {row['seconds']} s")
    setup = f"torch {torch.__version__}, {torch.get_num_threads()} threads; {amount.side} px, synthetic C60, 520 nm"
    lines.insert(1, setup)
    for source in amount.sources:
        selected = [row for row in counts if row["subject"] == source]
        full = float(selected[0]["seconds"])
        derived = [
            f"{row['what']} {row['error']} (predicted {row['predicted']}), {full / float(row['seconds']):.1f} x as fast"
            for row in selected
            if "followed" in row["what"]
        ]
        alone = [f"{row['what']} {row['error']}" for row in selected if "alone" in row["what"]]
        lines += [f"{source}: " + "; ".join(derived), f"{source}: " + "; ".join(alone)]
    # Without an optimum inside the widths tried, the formula cannot be tested.
    return lines + (in_words(cases) if any(case.inside for case in cases) else [])


def _draw(methods: list[dict], counts: list[dict], cases: list[Case], amount: Amount) -> bytes:
    figure = Figure(figsize=(16, 5), layout="constrained")
    first, second, third = (figure.add_subplot(1, 3, k + 1) for k in range(3))
    points = {row["what"]: (float(row["seconds"]), max(float(row["error"]), 1e-6)) for row in methods}
    for k, (name, point) in enumerate(points.items()):
        first.loglog(*point, "os^vDP"[k % 6], label=name)
    draw_front(first, points.values())
    mark_choice(first, [points[COLLAPSE]])
    first.set(xlabel="seconds", ylabel="relative L2 error of the retina's intensity")
    for k, source in enumerate(amount.sources):
        for how, line in (("followed", "o-"), ("alone", "x:")):
            selected = [row for row in counts if row["subject"] == source and how in row["what"]]
            points = [(int(row["what"].split()[0]), float(row["error"])) for row in selected]
            second.loglog(*zip(*points, strict=True), line, color=f"C{k}", label=f"{source}, {how}")
    second.set(xlabel="wavelengths through the optics", ylabel="relative L2 error against one every nm")
    for k, case in enumerate(cases):
        label = f"{case.distance * 1e3:g} mm, {case.wavelength * 1e9:.0f} nm"
        widths, colour, line = [width * 1e9 for width in WIDTHS], f"C{(3, 2, 0)[k % 3]}", ("-", "--", ":")[k // 3 % 3]
        third.semilogx(widths, case.ssim, color=colour, linestyle=line, label=label)
    third.set_xticks([1.4, 3, 6, 12, 25, 50], ["1.4", "3", "6", "12", "25", "50"], minor=False)
    third.minorticks_off()
    third.set(xlabel="FWHM (nm)", ylabel="SSIM to the speckle-free mean")
    for axes in (first, second, third):
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=7)
    second.set_ylim(bottom=1e-4)
    second.legend(fontsize=7, ncols=2, loc="lower left")
    return figure_png(figure)
