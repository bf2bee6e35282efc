"""What an observer sees: a volume's hologram under real light sources, through a display and a focused eye."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye.config import ObserverSettings, PlanarSettings
from holotorch.experiments.volume.experiment import VolumeExperiment, build
from holotorch.experiments.volume.judge import pooled
from holotorch.metrics import sharpness, speckle_contrast, ssim
from holotorch.optics.light.coherence import optimum_fwhm, path_difference, predicted_contrast
from holotorch.optics.light.incoherent import disc_source, tilted_wave
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.light.wavelength_sampling import least_followed, seen_light
from holotorch.optics.picture import equal_power
from holotorch.optics.viewing.display import Display
from holotorch.optics.viewing.display_geometry import eyepiece_distance, image_distance
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.retina import RetinaPlan, plan_retina

PRESETS: dict[str, Callable[[float], Spectrum]] = {
    "laser": Spectrum.laser,
    "narrow_sled": Spectrum.narrow_sled,
    "sled": Spectrum.sled,
    "led": Spectrum.led,
}
BEST = 0.46  # prefactor of the best FWHM for the CT of a teapot; smooth scenes want more, C60 0.8
_OTHERS = 100_000  # seeds of the realisations that only make the reference
_RINGS = 16  # of an extended source: what takes a thousand times a point's time
_LIT = 0.05  # of the brightest of the reference: where speckle is measured


@dataclass(frozen=True)
class Observer:
    """A configuration made into a scene, a display and an eye.

    The hologram's waves come from behind it (exp(+ikr)/r); a display shows its conjugate, whose light converges to the
    scene in front, towards the observer. Every wavelength of a source meets the same amplitude and phase, as in the
    thesis; dispersion of a panel is left out.

    Attributes:
        settings: The configuration.
        scene: The volume and its holograms.
        focus: Depths of the scene, from the hologram, at which the eye is focused in turn.
    """

    settings: ObserverSettings
    scene: VolumeExperiment
    focus: tuple[float, ...]

    @cached_property
    def display(self) -> Display:
        """Where everything stands."""
        given = self.settings.display
        if isinstance(given, PlanarSettings):
            return Display.planar(given.distance)
        far = given.lens_distance
        if far is None:
            far = eyepiece_distance(self.scene.distance, given.focus_distance, given.focal_length, given.eye_distance)
        return Display(far, given.focal_length, given.eye_distance)

    def accommodation(self, depth: float) -> float:
        """Distance in front of the eye at which the depth appears, in metres."""
        given, before = self.settings.display, float(self.display.lens_distance) - depth
        if isinstance(given, PlanarSettings):
            return before
        return image_distance(before, given.focal_length) + given.eye_distance

    def eye(self, depth: float) -> Eye:
        """Focused at a depth of the scene."""
        given = self.settings.eye
        reference = self.reference_wavelength if given.chromatic else None
        return Eye(given.pupil_radius, given.axial_length, self.accommodation(depth), chromatic_reference=reference)

    @property
    def reference_wavelength(self) -> float:
        """The wavelength that is in focus in an eye with colour error: the middle one."""
        return sorted(self.scene.settings.wavelengths)[1]

    def aperture(self, depth: float) -> float:
        """Sine of the half angle of light from the depth that reaches the retina: the pupil's, or the hologram's."""
        seen = self.settings.eye.pupil_radius / abs(float(self.display.matrix(depth)[1]))
        return min(seen, math.sin(math.atan(min(self.scene.grid.extent) / 2 / depth)))

    def detail(self, depth: float, wave: float) -> float:
        """Sine of the half angle of light that carries detail: :meth:`aperture`, or that of the rays' own pitch."""
        return min(self.aperture(depth), wave / (2 * max(self.scene.rays.pitch)))

    def samples(self, source: str, wave: float, depth: float) -> tuple[Tensor, Tensor, int]:
        """Wavelengths and weights that stand for a source within the tolerance, and how many of them to follow."""
        key = (source, wave, depth)
        if key not in self._rules:
            # Two errors that know nothing of each other: of the sum, and of making most of it from few wavelengths.
            eye, tolerance, reach = self.eye(depth), self.settings.light.tolerance / math.sqrt(2), self.scene.width / 2
            away = seen_light(self.scene.grid, wave, self.display, eye, reach=reach).path_difference
            if not away:
                words = f"no light of {wave * 1e9:.4g} nm of the scene reaches the pupil when the eye looks at"
                cure = "change the distances of display, or the pupil"
                raise ConfigError([f"display: {words} {depth * 1e3:.4g} mm from the hologram; {cure}"])
            places, weights = PRESETS[source](wave).samples(tolerance=tolerance, path_difference=away, iris=False)
            count = least_followed(places, weights, tolerance, self.scene.grid, self.display, eye, reach=reach)
            self._rules[key] = places, weights, count
        return self._rules[key]

    @cached_property
    def _rules(self) -> dict[tuple[str, float, float], tuple[Tensor, Tensor, int]]:
        return {}  # choosing wavelengths may take a second

    def points(self, wave: float, depth: float) -> tuple[list[tuple[float, float]], list[float]]:
        """Sines (y, x) of directions, and weights, that stand for the extent of the sources.

        A tilt moves the picture by the depth times its sine: rings are half a spot apart there at most. ConfigError for
        more than 16 of them, 1024 directions.
        """
        extent = self.settings.light.extent
        if not extent:
            return [(0.0, 0.0)], [1.0]
        rings = max(1, math.ceil(2 * depth * extent * self.aperture(depth) / wave))
        if rings > _RINGS:
            most = extent * _RINGS / rings
            raise ConfigError(
                [f"light.extent: {extent:g} needs {4 * rings**2} directions; at most {most:.2g} is taken"]
            )
        tilts, shares = disc_source(extent, rings)
        return tilts, shares.tolist()

    def retina(self, depth: float) -> RetinaPlan:
        """The way to the retina of an eye that is focused at the depth: one for all sources, which are compared.

        Planned for the ends of all their bands, between which the error and the sampling are less. ConfigError where
        there is none.
        """
        if depth not in self._ways:
            waves = self.scene.settings.wavelengths
            bands = [
                end for source in self.settings.light.sources for wave in waves for end in PRESETS[source](wave).band()
            ]
            try:
                self._ways[depth] = plan_retina(
                    self.scene.grid,
                    (min(bands), max(bands)),
                    self.display,
                    self.eye(depth),
                    tolerance=self.settings.tolerance,
                    plane=depth,
                    reach=self.scene.width / 2,
                    registered=True,
                )
            except ValueError as error:
                raise ConfigError([f"display: {error}"]) from error
        return self._ways[depth]

    @cached_property
    def _ways(self) -> dict[float, RetinaPlan]:
        return {}

    def seen(self, hologram: Tensor, source: str | None, depth: float) -> Tensor:
        """Picture on the retina, referred back to the scene, real [3, h, w] on the rays; None: one wavelength each.

        Goes the way of :meth:`retina`, every wavelength followed with the least sampling that it needs there.
        """
        eye, grid, pictures = self.eye(depth), self.scene.grid, []
        elements = self.retina(depth).method == "elements"
        for field, wave in zip(hologram.conj(), self.scene.settings.wavelengths, strict=True):
            places, weights, count = ([wave], [1.0], 1) if source is None else self.samples(source, wave, depth)
            tilts, shares = ([(0.0, 0.0)], [1.0]) if source is None else self.points(wave, depth)
            total = torch.zeros(grid.shape, dtype=field.real.dtype, device=field.device)
            for tilt, share in zip(tilts, shares, strict=True):
                lit = field * tilted_wave(grid, wave, tilt).to(field) if any(tilt) else field
                total += share * spectral_image(
                    lit, grid, places, weights, self.display, eye, count=count, elements=elements
                )
            pictures.append(pooled(total, self.scene.stride))
        return torch.stack(pictures).cpu()

    def row(self, source: str, depth: float, pictures: Tensor, reference: Tensor) -> dict[str, Any]:
        """Numbers of a source at a focus: per colour, mean over realisations [S, 3, h, w], against [3, h, w]."""
        mask = reference > _LIT * reference.amax((-2, -1), keepdim=True)
        shown = equal_power(pictures, reference.expand_as(pictures))
        scale = reference.amax((-2, -1), keepdim=True)
        waves = self.scene.settings.wavelengths
        spectra = [PRESETS[source](wave) for wave in waves]
        away = path_difference(depth, self.aperture(depth))
        return {
            "source": source,
            "focus_mm": depth * 1e3,
            "wavelengths": [len(self.samples(source, wave, depth)[0]) for wave in waves],
            "followed": [self.samples(source, wave, depth)[2] for wave in waves],
            "contrast": speckle_contrast(shown, reference=reference, mask=mask).mean(0).tolist(),
            "contrast_predicted": [predicted_contrast(spectrum, away) for spectrum in spectra],
            "ssim": ssim((shown / scale).clamp(0, 1), (reference / scale).expand_as(shown), data_range=1.0)
            .mean(0)
            .tolist(),
            "sharpness": sharpness(shown, reference).mean(0).tolist(),
            "best_fwhm_nm_by_formula": [
                optimum_fwhm(wave, self.detail(depth, wave), depth, defocus=BEST) * 1e9 for wave in waves
            ],
        }


def observer(settings: ObserverSettings, scene_settings) -> Observer:
    """Build the scene and choose the depths. ConfigError for a scene that the display cannot show."""
    scene = build(scene_settings)
    if settings.focus is not None:
        focus = settings.focus
    else:
        depth = scene.sampler().depth_map(scene.volume)
        inside = depth[depth > 0].sort().values
        if not len(inside):
            raise ConfigError(["scene: nothing of the volume can be seen; change its transfer function"])
        focus = tuple(inside[round(part * (len(inside) - 1))].item() for part in (0.1, 0.5, 0.9))
    found = Observer(settings, scene, focus)
    for depth in found.focus:
        try:
            found.eye(depth)
        except ValueError as error:
            raise ConfigError([f"display: {error}; a depth of {depth * 1e3:.4g} mm cannot be looked at"]) from error
    return found


def realisations(count: int, *, reference: bool) -> list[int]:
    """Seeds of ``count`` holograms, those of the reference disjoint from the others."""
    return [(_OTHERS if reference else 0) + k for k in range(count)]
