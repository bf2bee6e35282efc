"""The view of an observer: focus and pupil of the eye, light source, and orientation of the volume."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.quantities import PUPIL_RADIUS
from holotorch.experiments.eye.experiment import LIT, PRESETS, RETINA, Observer, observer_budget
from holotorch.experiments.eye.tradeoff import WHITE
from holotorch.experiments.panel.source import run_array
from holotorch.experiments.view.controls import Choice, Slider, span
from holotorch.experiments.view.kinds.turning import turned, turning_controls
from holotorch.experiments.view.viewer import Picture, Shown, Viewer, percent
from holotorch.io.colour_tables import picture_matrix
from holotorch.metrics import speckle_contrast, ssim
from holotorch.optics.picture import equal_power, gamut_map, linear_srgb, tone_map
from holotorch.optics.viewing.imaging import CollapseSampling

_TOLERANCE = 0.5  # of the propagation to the retina, so large that the fast method is used; its error is shown
_ONE = "one"  # one wavelength for each colour
_RENDERING = "Direct volume rendering"
_NAMES = {"laser": "laser, 1.4 nm", "narrow_sled": "narrow SLED, 5 nm", "sled": "SLED, 10 nm", "led": "LED, 20 nm"}


class EyeViewer(Viewer):
    """Pictures on the retina of a run of kind ``eye``; see :class:`Viewer`."""

    def __init__(self, folder: Path, experiment: Observer):
        scene, settings = experiment.scene, experiment.settings
        self.title = "What an observer sees" + (" (synthetic)" if scene.synthetic else "")
        self._experiment, focus = experiment, experiment.focus
        wavelengths = scene.settings.wavelengths
        shape = (len(focus), len(wavelengths), *scene.rays.shape)
        self._reference = run_array(folder / "arrays" / "reference.npy", shape, "(F, C, h, w)", "float32")
        self._matrix = picture_matrix(wavelengths).float()
        # Orientation and realisation, and their hologram.
        self._hologram: tuple[Any, Tensor] = None, self._reference
        self._rendering = lru_cache(2)(self._render)
        self._observer = lru_cache(4)(self._with_pupil)
        self.controls = self._controls()
        start = self._observer(1e3 * settings.eye.pupil_radius).retina(focus[len(focus) // 2]).sampling
        padded = max(start.padded, start.fine) if isinstance(start, CollapseSampling) else scene.grid.shape
        self.transforms = len(wavelengths), *padded
        self.note = (
            "The hologram is computed from the volume when it is first needed, and seen by one wavelength a colour "
            "while a control moves; while the volume turns, its rendering follows. Each colour has the power of the "
            "rendering, as in the report. Without speckle: mean of the run's realisations at the nearest depth."
        )

    def _controls(self) -> list[Slider | Choice]:
        scene, settings, focus = self._experiment.scene, self._experiment.settings, self._experiment.focus
        near, far = 1e3 * min(scene.depths), 1e3 * max(scene.depths)
        at, radius = 1e3 * focus[len(focus) // 2], 1e3 * settings.eye.pupil_radius
        narrowest, widest = max(radius / 3, 1e3 * PUPIL_RADIUS.low), min(2 * radius, 1e3 * PUPIL_RADIUS.high)
        listed = ", ".join(f"{1e3 * depth:.4g}" for depth in focus)
        sources = {_ONE: "one wavelength a colour"} | {name: _NAMES[name] for name in PRESETS}
        controls: list[Slider | Choice] = [
            Slider(
                "focus", "Focus of the eye", "mm", **span(min(near, 0.95 * at), max(far, 1.05 * at), at),
                explanation=f"Depth of the scene that is sharp, from the hologram; the run has {listed} mm.",
            ),
            Slider("pupil", "Radius of the pupil", "mm", **span(narrowest, widest, radius, 40), explanation=""),
            Choice("source", "Light source", sources, settings.light.sources[0],
                   "The width of its spectrum: a wide one averages speckle, and blurs."),
            *turning_controls(scene),
        ]  # fmt: skip
        if settings.seeds > 1:
            draws = {str(k): f"{k + 1} of {settings.seeds}" for k in range(settings.seeds)}
            text = "Another draw of the random phases of the hologram has another speckle."
            controls.append(Choice("seed", "Realisation", draws, "0", text))
        return controls

    def show(self, values: Mapping[str, Any], coarse: bool, proceed: Callable[[], None]) -> Shown:
        """See :class:`Viewer`. While a volume turns, only its rendering follows."""
        depth, angles = 1e-3 * values["focus"], (values["azimuth"], values["elevation"])
        observer, rendering = self._observer(values["pupil"]), self._rendering(*angles)
        numbers = {"focus at the eye": f"{1e3 * observer.accommodation(depth):.4g} mm"}
        key = *angles, int(values.get("seed", "0"))
        if key != self._hologram[0]:
            if coarse:
                peak = self._srgb(rendering).flatten().quantile(WHITE)
                return Shown([self._picture("beside", _RENDERING, rendering, peak)], numbers, coarse=True)
            scene = turned(self._experiment.scene, *angles)
            self._hologram = key, scene.hologram(self._experiment.settings.seed + key[-1], proceed)[0]
        proceed()
        source = None if coarse or values["source"] == _ONE else values["source"]
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the error is among the numbers
            numbers["expected error"] = percent(observer.retina(depth).predicted_error)
            light = equal_power(observer.image(self._hologram[1], source, depth), rendering)
        if source is not None:
            counts = [len(observer.samples(source, each, depth)[0]) for each in observer.scene.settings.wavelengths]
            numbers["wavelengths a colour"] = ", ".join(map(str, counts))
        peak = self._srgb(light).flatten().quantile(WHITE)
        beside, caption, view = rendering, _RENDERING, self._experiment.scene.settings.view
        if angles == (view.azimuth_deg, view.elevation_deg):
            f = min(range(len(observer.focus)), key=lambda k: abs(observer.focus[k] - depth))
            beside = equal_power(self._reference[f], rendering)
            caption = f"Without speckle, focus at {1e3 * observer.focus[f]:.4g} mm"
            if abs(observer.focus[f] - depth) < 1e-3 * depth and values["pupil"] == self.controls[1].value:
                numbers |= _scores(light, beside)
        shown = self._picture("shown", f"Focus at {values['focus']:.4g} mm", light, peak)
        pictures = [shown, self._picture("beside", caption, beside, peak)]
        return Shown(pictures, numbers, coarse=coarse and values["source"] != _ONE)

    def _render(self, azimuth: float, elevation: float) -> Tensor:
        scene = turned(self._experiment.scene, azimuth, elevation)
        return scene.rendering()[0]

    def _with_pupil(self, radius: float) -> Observer:
        """The observer with a pupil of another radius, in millimetres."""
        settings = self._experiment.settings
        looser = max(self._experiment.budget.share(RETINA), _TOLERANCE)
        eye = settings.eye.model_copy(update={"pupil_radius": 1e-3 * radius, "tolerance": looser})
        settings = settings.model_copy(update={"eye": eye})
        budget = observer_budget(settings, self._experiment.scene.settings)
        return replace(self._experiment, settings=settings, budget=budget)

    def _srgb(self, light: Tensor) -> Tensor:
        return gamut_map(linear_srgb(light, self._matrix))

    def _picture(self, name: str, caption: str, light: Tensor, peak: Tensor) -> Picture:
        return Picture.of(name, caption, tone_map(self._srgb(light), peak=peak))


def _scores(light: Tensor, reference: Tensor) -> dict[str, str]:
    """SSIM and contrast of the speckle, mean over the colours, as in the table of the report."""
    peak = reference.amax((-2, -1), keepdim=True)
    quality = ssim((light / peak).clamp(0, 1), reference / peak, data_range=1.0).mean().item()
    contrast = speckle_contrast(light, reference=reference, mask=reference > LIT * peak).mean().item()
    return {"SSIM": f"{quality:.3f}", "contrast of speckle": f"{contrast:.3f}"}
