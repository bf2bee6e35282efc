"""Observer: the hologram of a volume under light of a real spectrum, seen by a focused eye through a display."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from holotorch.core.grid import Pair
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye.config import ObserverSettings, PlanarSettings, SphericalSettings
from holotorch.experiments.eye.speckle import grains, relative_speckle
from holotorch.experiments.planning.tolerance import Budget, Part
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.evaluation import pooled
from holotorch.experiments.volume.experiment import HOLOGRAM, VolumeExperiment, build
from holotorch.io.colour_tables import picture_matrix
from holotorch.metrics import sharpness, speckle_contrast, ssim
from holotorch.modulator import phase_scale
from holotorch.optics.light.coherence import optimum_fwhm, path_difference, predicted_contrast
from holotorch.optics.light.displaced import displaced_eye, displacement
from holotorch.optics.light.incoherent import disc_source, tilted_wave
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.light.wavelength_sampling import least_count, pupil_illumination
from holotorch.optics.picture import equal_power
from holotorch.optics.viewing.display import Display
from holotorch.optics.viewing.display_geometry import eyepiece_distance, image_distance
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.retina import RetinaPlan, plan_retina

PRESETS: dict[str, Callable[[float], Spectrum]] = {  # functions of the central wavelength in metres
    "laser": Spectrum.laser,
    "narrow_sled": Spectrum.narrow_sled,
    "sled": Spectrum.sled,
    "led": Spectrum.led,
}
_MAX_RINGS = 16  # largest number of rings of directions of an extended source; 16 rings have 1024 directions
WAVELENGTHS, RETINA = "wavelengths", "retina"  # parts that share the tolerance of a run, with the hologram
LIT = 0.05  # speckle is measured on pixels brighter than this fraction of the brightest pixel of the reference


@dataclass(frozen=True)
class Observer:
    """A scene, a display and an eye, as a configuration describes them.

    The hologram is computed for light that diverges from a scene behind it (exp(+ikr)/r). The display shows the
    complex conjugate of the hologram, whose light converges to a scene between hologram and observer. All wavelengths
    of a source are modulated with the same amplitude and phase, as in the thesis, unless ``light.dispersion`` is set.

    Attributes:
        settings: The configuration.
        scene: The volume and its holograms.
        focus: Depths at which the eye is focused in turn, in metres from the hologram.
        budget: Tolerances of hologram, wavelengths and propagation to the retina.
    """

    settings: ObserverSettings
    scene: VolumeExperiment
    focus: tuple[float, ...]
    budget: Budget = field(compare=False)
    _samples: dict[tuple[str, float, float], tuple[Tensor, Tensor, int]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _retina_plans: dict[float, RetinaPlan] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def display(self) -> Display:
        """Positions of the hologram, the eyepiece and the eye."""
        settings = self.settings.display
        if isinstance(settings, PlanarSettings):
            return Display.planar(settings.distance)
        if isinstance(settings, SphericalSettings):
            return Display.spherical(settings.focal_length)
        lengths = settings.focal_length, settings.eye_distance
        lens = settings.lens_distance or eyepiece_distance(self.scene.distance, settings.focus_distance, *lengths)
        return Display(lens, *lengths)

    def accommodation(self, depth: float) -> float:
        """Distance in metres in front of the eye at which a depth of the scene appears. ValueError if there is none."""
        settings, to_lens = self.settings.display, float(self.display.lens_distance) - depth
        if isinstance(settings, PlanarSettings):
            return to_lens
        if isinstance(settings, SphericalSettings):
            return settings.focal_length**2 / (settings.focal_length + depth)
        return image_distance(to_lens, settings.focal_length) + settings.eye_distance

    def eye(self, depth: float) -> Eye:
        """The eye, focused at a depth of the scene in metres."""
        pupil, length = self.settings.eye.pupil_radius, self.settings.eye.axial_length
        reference = self.reference_wavelength if self.settings.eye.chromatic else None
        return Eye(pupil, length, self.accommodation(depth), chromatic_reference=reference)

    @property
    def reference_wavelength(self) -> float:
        """The middle one of the wavelengths in metres, for which an eye with chromatic aberration is in focus."""
        wavelengths = sorted(self.scene.settings.wavelengths)
        return wavelengths[len(wavelengths) // 2]

    def aperture(self, depth: float) -> float:
        """Sine of the half angle of the light cone from a point at a depth to the eye, limited by pupil or hologram."""
        pupil = self.settings.eye.pupil_radius / abs(float(self.display.matrix(depth)[1]))
        return min(pupil, math.sin(math.atan(min(self.scene.grid.extent) / 2 / depth)))

    def detail(self, depth: float, wavelength: float) -> float:
        """The smaller of :meth:`aperture` and the sine wavelength / (2 ray pitch) of the finest detail of the scene."""
        return min(self.aperture(depth), wavelength / (2 * max(self.scene.rays.pitch)))

    def samples(self, source: str, wavelength: float, depth: float) -> tuple[Tensor, Tensor, int]:
        """Wavelengths [K] in metres and weights [K] that represent a source, and the number N <= K to propagate.

        Pictures at the other wavelengths are derived. Results are cached. ConfigError if no light reaches the pupil.
        """
        key = (source, wavelength, depth)
        if key not in self._samples:
            # The error of the sum and that of deriving pictures are independent; each may be tolerance / sqrt(2).
            eye, tolerance = self.eye(depth), self.budget.share(WAVELENGTHS) / math.sqrt(2)
            half_width = self.scene.width / 2
            light = pupil_illumination(self.scene.grid, wavelength, self.display, eye, reach=half_width)
            if not light.path_difference:
                problem = f"no light of {wavelength * 1e9:.4g} nm of the scene reaches the pupil when the eye looks at"
                hint = "change the distances of display, or the pupil"
                raise ConfigError([f"display: {problem} {depth * 1e3:.4g} mm from the hologram; {hint}"])
            spectrum = PRESETS[source](wavelength)
            samples = spectrum.samples(tolerance=tolerance, path_difference=light.path_difference, iris=False)
            count = (
                len(samples[0])
                if self.separate
                else least_count(*samples, tolerance, self.scene.grid, self.display, eye, reach=half_width)
            )
            self._samples[key] = *samples, count
        return self._samples[key]

    def points(self, wavelength: float, depth: float) -> tuple[list[tuple[float, float]], list[float]]:
        """Directions (sines y, x) and weights of the points that represent an extended source.

        A tilt of the light by an angle shifts the picture by the depth times the sine of the angle. From one ring of
        directions to the next, the shift is at most half a diffraction spot, wavelength / (2 aperture).

        Raises:
            ConfigError: More than 16 rings (1024 directions) are needed.
        """
        extent = self.settings.light.extent
        if not extent:
            return [(0.0, 0.0)], [1.0]
        rings = max(1, math.ceil(2 * depth * extent * self.aperture(depth) / wavelength))
        if rings > _MAX_RINGS:
            most = f"at most {extent * _MAX_RINGS / rings:.2g} is taken"
            raise ConfigError([f"light.extent: {extent:g} needs {4 * rings**2} directions; {most}"])
        tilts, weights = disc_source(extent, rings)
        return tilts, weights.tolist()

    @property
    def separate(self) -> bool:
        """Whether the field of the hologram depends on the wavelength, so that each one must be propagated."""
        return self.settings.light.dispersion or any(self.settings.eye.position)

    def retina(self, depth: float) -> RetinaPlan:
        """Choose the method of propagation to the retina of an eye that is focused at a depth.

        All sources use the same method, since their pictures are compared. The plan is made for the shortest and the
        longest wavelength of all sources; wavelengths between them have smaller errors and need fewer samples.

        Raises:
            ConfigError: No method can be used.
        """
        if depth not in self._retina_plans:
            sources, wavelengths = self.settings.light.sources, self.scene.settings.wavelengths
            ends = [end for source in sources for each in wavelengths for end in PRESETS[source](each).band()]
            setup = self.scene.grid, (min(ends), max(ends)), self.display, self.eye(depth)
            tolerance, half_width = self.budget.share(RETINA), self.scene.width / 2
            try:
                self._retina_plans[depth] = plan_retina(
                    *setup, tolerance=tolerance, plane=depth, reach=half_width, registered=True
                )
            except ValueError as error:
                raise ConfigError([f"display: {error}"]) from error
        return self._retina_plans[depth]

    def image(
        self, hologram: Tensor, source: str | None, depth: float, colours: Collection[int] | None = None
    ) -> Tensor:
        """Intensity on the retina of an eye focused at a depth (metres), averaged around each scene ray, [C, h, w].

        ``hologram`` is complex [C, H, W]. Without a source, each colour has a single wavelength. Colours that are not
        in ``colours`` are not computed, and are zero.
        """
        eye, grid, pictures = self.eye(depth), self.scene.grid, []
        elements = self.retina(depth).method == "elements"
        for c, (light, wavelength) in enumerate(zip(hologram.conj(), self.scene.settings.wavelengths, strict=True)):
            if colours is not None and c not in colours:
                pictures.append(torch.zeros(self.scene.rays.shape))
                continue
            samples, points = ([wavelength], [1.0], 1), ([(0.0, 0.0)], [1.0])
            if source is not None:
                samples, points = self.samples(source, wavelength, depth), self.points(wavelength, depth)
            lengths, weights, count = samples
            total = torch.zeros(grid.shape, dtype=light.real.dtype, device=light.device)
            for tilt, share in zip(*points, strict=True):
                if self.separate:
                    for length, weight in zip(map(float, lengths), map(float, weights), strict=True):
                        total += share * weight * self._at_wavelength(light, wavelength, length, tilt, depth)
                    continue
                tilted = light * tilted_wave(grid, wavelength, tilt).to(light) if any(tilt) else light
                setup = tilted, grid, lengths, weights, self.display, eye
                total += share * spectral_image(*setup, count=count, elements=elements)
            pictures.append(pooled(total, self.scene.stride).cpu())
        return torch.stack(pictures)

    def _at_wavelength(self, light: Tensor, design: float, wavelength: float, tilt: Pair, depth: float) -> Tensor:
        """Picture [H, W] at one wavelength, with the phases of the panel there and the perspective of the eye."""
        grid, eye, elements = self.scene.grid, self.eye(depth), self.retina(depth).method == "elements"
        if self.settings.light.dispersion:
            phase = (light.angle() % (2 * math.pi)) * phase_scale(wavelength, design).item()
            light = torch.polar(light.abs(), phase)
        if any(tilt):
            light = light * tilted_wave(grid, wavelength, tilt).to(light)
        light, wide = displaced_eye(light, grid, wavelength, self.display, depth, self.settings.eye.position)
        picture = spectral_image(light, wide, [wavelength], [1.0], self.display, eye, count=1, elements=elements)
        (height, width), (y, x) = grid.shape, ((n - m) // 2 for n, m in zip(wide.shape, grid.shape, strict=True))
        return picture[y : y + height, x : x + width]

    def row(self, source: str, depth: float, pictures: Tensor, reference: Tensor) -> dict[str, Any]:
        """Measurements of a source with the eye focused at a depth (metres): for each quantity, a value per colour.

        The values are means over the S realisations in ``pictures`` [S, C, h, w]; ``reference`` [C, h, w] is free of
        speckle.
        """
        peak = reference.amax((-2, -1), keepdim=True)
        shown = equal_power(pictures, reference.expand_as(pictures))
        wavelengths = self.scene.settings.wavelengths
        samples = [self.samples(source, wavelength, depth) for wavelength in wavelengths]
        difference = path_difference(depth, self.aperture(depth))
        best = [optimum_fwhm(wavelength, self.detail(depth, wavelength), depth) for wavelength in wavelengths]
        quality = ssim((shown / peak).clamp(0, 1), (reference / peak).expand_as(shown), data_range=1.0)
        return {
            "source": source,
            "focus_mm": depth * 1e3,
            "wavelengths": [len(each) for each, _, _ in samples],
            "followed": [count for _, _, count in samples],
            "contrast": speckle_contrast(shown, reference=reference, mask=reference > LIT * peak).mean(0).tolist(),
            "contrast_predicted": [predicted_contrast(PRESETS[source](each), difference) for each in wavelengths],
            "ssim": quality.mean(0).tolist(),
            "sharpness": sharpness(shown, reference).mean(0).tolist(),
            **grains(relative_speckle(shown, reference, LIT * peak)),
            "best_fwhm_nm_by_formula": [fwhm * 1e9 for fwhm in best],
        }


def observer(settings: ObserverSettings, scene_settings: VolumeSettings) -> Observer:
    """Build the scene and resolve the depths of focus.

    ConfigError for a pitch below half a wavelength, if nothing is visible, or if the eye cannot focus.
    """
    pitch, longest = min(scene_settings.hologram.pitch), max(scene_settings.wavelengths)
    if pitch <= longest / 2:
        problem = f"expected more than {longest / 2:.4g} m, half the longest wavelength, got {pitch:g} m"
        raise ConfigError([f"hologram.pitch: {problem}"])
    budget = observer_budget(settings, scene_settings)
    # The scene is not refocused, so that its tolerance is that of its hologram alone.
    hologram = scene_settings.hologram.model_copy(update={"tolerance": budget.share(HOLOGRAM)})
    scene = build(scene_settings.model_copy(update={"hologram": hologram, "tolerance": None}))
    budget.predict(HOLOGRAM, max(plan.predicted_error for plan in scene.plans))
    try:
        picture_matrix(scene_settings.wavelengths)
    except ValueError as error:
        raise ConfigError([f"wavelengths: {error}"]) from error
    focus = settings.focus
    if focus is None:
        depth = scene.depth_map()
        visible = depth[depth > 0].sort().values
        if not len(visible):
            raise ConfigError(["scene: nothing of the volume is visible; change its transfer function"])
        focus = tuple(visible[round(share * (len(visible) - 1))].item() for share in (0.1, 0.5, 0.9))
    result = Observer(settings, scene, focus, budget)
    for depth in focus:
        try:
            result.eye(depth)
        except ValueError as error:
            raise ConfigError([f"display: {error}; the eye cannot focus at a depth of {depth * 1e3:.4g} mm"]) from error
        for wavelength in scene_settings.wavelengths if any(settings.eye.position) else ():
            shortest = min(PRESETS[source](wavelength).band()[0] for source in settings.light.sources)
            try:
                displacement(scene.grid, shortest, result.display, depth, settings.eye.position)
            except ValueError as error:
                raise ConfigError([f"eye.position: {error}"]) from error
    return result


def observer_budget(settings: ObserverSettings, scene: VolumeSettings) -> Budget:
    """The tolerances of hologram, wavelengths and propagation to the retina."""
    given = scene.hologram.tolerance or scene.tolerance
    parts = [
        Part(HOLOGRAM, 1e-3, "the scene's tolerance", given),
        Part(WAVELENGTHS, 0.02, "light.tolerance", settings.light.tolerance),
        Part(RETINA, 0.03, "eye.tolerance", settings.eye.tolerance),
    ]
    return Budget(settings.tolerance, parts)
