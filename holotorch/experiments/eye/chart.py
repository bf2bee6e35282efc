"""The way to the retina: error against time, wavelengths against error, and speckle against sharpness."""

import io
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.fourier import good_length
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.eye.experiment import PRESETS, Observer, observer
from holotorch.experiments.eye.tradeoff import WIDTHS, Case, fitted_prefactor, in_words, tradeoff
from holotorch.experiments.registry import load_config
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.io.bundled import find_config
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.wavelength_sampling import followed, neighbour_error, seen_light
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling, propagate_elements
from holotorch.optics.viewing.imaging import propagate_collapsed
from holotorch.optics.viewing.retina import plan_retina

SIDE, DISTANCES = 512, (10e-3, 20e-3, 30e-3)
SCENE = "hologram={{shape: [{0}, {0}], pitch: 3.74 um, distance: 30 mm, depths: 58, rays: {1}}}"
FACTORS = (1.0, 2.0, 4.0)


def eye() -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Rows of ways and of sources, rows of the trade-off, pictures by name, and the verdict."""
    looking, shown = find_config("configs/eye/teapot.yaml"), find_config("configs/volume/c60.yaml")
    assert looking is not None and shown is not None
    settings, scene = load_config(looking), load_config(shown, [_scene()])
    assert isinstance(settings, ObserverSettings) and isinstance(scene, VolumeSettings)
    found = observer(settings.model_copy(update={"focus": (30e-3,)}), scene)
    ways = _ways(_quarter(settings, scene))
    counts = _counts(found)
    cases = tradeoff(settings, scene, DISTANCES)
    rows = [case.row(fitted_prefactor(cases)) for case in cases]
    return ways + counts, rows, {"chart": _draw(ways, counts, cases)}, _verdict(ways, counts, cases)


def _quarter(settings: ObserverSettings, scene: VolumeSettings) -> Observer:
    """Display, eye and distances a quarter as large: element by element the whole one needs 11 GB for 512 px."""
    display, eye = settings.display, settings.eye
    lengths = {name: value / 4 for name, value in display.model_dump().items() if isinstance(value, float)}
    smaller = {
        "display": display.model_copy(update=lengths),
        "eye": eye.model_copy(update={"pupil_radius": eye.pupil_radius / 4, "axial_length": eye.axial_length / 4}),
        "focus": (7.5e-3,),
    }
    near = scene.hologram.model_copy(update={"distance": 7.5e-3})
    return observer(settings.model_copy(update=smaller), scene.model_copy(update={"hologram": near}))


def _scene() -> str:
    return SCENE.format(SIDE, SIDE // 2)


def _ways(eye: Observer) -> list[dict]:
    """Collapse and elements for green light, paraxial: error of the retina's intensity against finer elements."""
    grid, depth, wave = eye.scene.grid, eye.focus[0], eye.scene.settings.wavelengths[1]
    hologram, _ = eye.scene.hologram(0)
    field, looking, display = hologram[1].conj()[None], eye.eye(depth), eye.display
    least = least_oversampling(grid, [wave], display, looking, plane=depth)
    wanted = intensity(
        propagate_elements(
            field, grid, [wave], display, looking, plane=depth, sampling=_finer(least, 1.3), paraxial=True
        )
    )
    plan = plan_retina(grid, [wave], display, looking, plane=depth, paraxial=True)
    needed = max(least.oversampling)
    calls: dict[str, Any] = {
        "collapse": lambda: propagate_collapsed(field, grid, [wave], display, looking, plane=depth, paraxial=True)
    }
    for factor in (*(f for f in FACTORS if f < 0.95 * needed), needed):
        sampling = _finer(least, factor / needed)
        name = f"elements, {factor:.2g} x" + (", the thesis's sampling" if factor == 1 else "")
        calls[name] = lambda sampling=sampling: propagate_elements(
            field, grid, [wave], display, looking, plane=depth, sampling=sampling, paraxial=True
        )
    rows = []
    for name, call in calls.items():
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the coarse ones alias: that is shown
            call()
            started = time.perf_counter()
            seen = intensity(call())
            seconds = time.perf_counter() - started
        error = ((seen - wanted).square().sum() / wanted.square().sum()).sqrt().item()
        predicted = f"{plan.predicted_error:.1e}" if name == "collapse" else ""
        rows.append(_row("way", name, seconds=f"{seconds:.3f}", error=f"{error:.1e}", predicted=predicted))
    return rows


def _finer(least: ElementSampling, factor: float) -> ElementSampling:
    """``least`` with so many times its samples."""
    fine = tuple(good_length(math.ceil(size * factor / 2) * 2) for size in least.fine)
    times = tuple(m * now / size for m, now, size in zip(least.oversampling, fine, least.fine, strict=True))
    return replace(least, oversampling=times, fine=fine)  # type: ignore[arg-type]


def _counts(eye: Observer) -> list[dict]:
    """Error of a picture in green light by the number of wavelengths, against one every nanometre.

    Followed: all are in the sum, but only so many go through the optics. Alone: only so many are in the sum.
    """
    depth, wave, grid = eye.focus[0], eye.scene.settings.wavelengths[1], eye.scene.grid
    hologram, _ = eye.scene.hologram(0)
    field, looking = hologram[1].conj(), eye.eye(depth)
    light = seen_light(grid, wave, eye.display, looking, reach=eye.scene.width / 2)
    rows = []
    for source, make in PRESETS.items():
        spectrum = make(wave)
        places, weights = spectrum.every(1e-9)
        wanted, slow = _timed(lambda p=places, w=weights: _sum(eye, field, p, w, len(p)))
        rows.append(_row(source, f"{len(places)} of {len(places)} nm steps", seconds=f"{slow:.3f}", error="0"))
        # Where the power is in few wavelengths, no more than these are followed.
        for count in sorted({len(followed(places, weights, many)[0]) for many in (1, 2, 3, 7, 15, len(places) // 4)
                             if many <= max(3, len(places) // 4)}):  # fmt: skip
            seen, seconds = _timed(lambda p=places, w=weights, n=count: _sum(eye, field, p, w, n))
            rows.append(
                _row(source, f"{count} of {len(places)} followed", seconds=f"{seconds:.3f}", error=_error(seen, wanted),
                     predicted=f"{neighbour_error(places, weights, count, light):.1e}")
            )  # fmt: skip
        for count in sorted({1, 2, 3, 4, 6, 9, 14, 20}):
            if count < len(places):
                few = spectrum.samples(count, path_difference=light.path_difference, iris=False, step=1e-9)
                seen, seconds = _timed(lambda few=few: _sum(eye, field, *few, len(few[0])))
                rows.append(
                    _row(
                        source, f"{count} of {len(places)} alone", seconds=f"{seconds:.3f}", error=_error(seen, wanted)
                    )
                )
    return rows


def _sum(eye: Observer, field: Tensor, places: Tensor, weights: Tensor, count: int) -> Tensor:
    looking = eye.eye(eye.focus[0])
    return spectral_image(field, eye.scene.grid, places, weights, eye.display, looking, count=count)


def _timed(make: Callable[[], Tensor]) -> tuple[Tensor, float]:
    started = time.perf_counter()
    return make(), time.perf_counter() - started


def _error(seen: Tensor, wanted: Tensor) -> str:
    return f"{((seen - wanted).square().mean() / wanted.square().mean()).sqrt().item():.1e}"


def _row(subject: str, what: str, **numbers: str) -> dict:
    return {"subject": subject, "what": what, "seconds": "", "error": "", "predicted": ""} | numbers


def _verdict(ways: list[dict], counts: list[dict], cases: list[Case]) -> list[str]:
    lines = [f"torch {torch.__version__}, {torch.get_num_threads()} threads; {SIDE} px, synthetic C60, 520 nm"]
    for row in ways:
        predicted = f" (predicted {row['predicted']})" if row["predicted"] else ""
        lines.append(f"{row['what']}: error {row['error']}{predicted}, {row['seconds']} s")
    for source in PRESETS:
        own = [row for row in counts if row["subject"] == source]
        full = float(own[0]["seconds"])
        through = [
            f"{row['what']} {row['error']} (predicted {row['predicted']}), {full / float(row['seconds']):.1f} x as fast"
            for row in own
            if "followed" in row["what"]
        ]
        alone = [f"{row['what']} {row['error']}" for row in own if "alone" in row["what"]]
        lines += [f"{source}: " + "; ".join(through), f"{source}: " + "; ".join(alone)]
    lines += in_words(cases)
    return lines


def _draw(ways: list[dict], counts: list[dict], cases: list[Case]) -> bytes:
    figure = Figure(figsize=(16, 5), layout="constrained")
    first, second, third = (figure.add_subplot(1, 3, k + 1) for k in range(3))
    for k, row in enumerate(ways):
        first.loglog(float(row["seconds"]), max(float(row["error"]), 1e-6), "os^vDP"[k % 6], label=row["what"])
    first.set_xlabel("seconds")
    first.set_ylabel("relative L2 error of the retina's intensity")
    for k, source in enumerate(PRESETS):
        for how, line in (("followed", "o-"), ("alone", "x:")):
            own = [row for row in counts if row["subject"] == source and how in row["what"]]
            numbers, errors = [int(row["what"].split()[0]) for row in own], [float(row["error"]) for row in own]
            second.loglog(numbers, errors, line, color=f"C{k}", label=f"{source}, {how}")
    second.set_xlabel("wavelengths through the optics")
    second.set_ylabel("relative L2 error against one every nm")
    for k, case in enumerate(cases):
        label = f"{case.distance * 1e3:g} mm, {case.wavelength * 1e9:.0f} nm"
        widths = [width * 1e9 for width in WIDTHS]
        third.semilogx(
            widths, case.ssim, color=("C3", "C2", "C0")[k % 3], linestyle=("-", "--", ":")[k // 3 % 3], label=label
        )
    third.set_xticks([1.4, 3, 6, 12, 25, 50], ["1.4", "3", "6", "12", "25", "50"], minor=False)
    third.minorticks_off()
    third.set_xlabel("FWHM (nm)")
    third.set_ylabel("SSIM to the speckle-free mean")
    for axes in (first, second, third):
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=7)
    second.set_ylim(bottom=1e-4)
    second.legend(fontsize=7, ncols=2, loc="lower left")
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()
