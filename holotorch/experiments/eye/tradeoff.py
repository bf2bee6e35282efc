"""Speckle against sharpness: which spectral width shows a volume best, per colour and depth (thesis Sec. 6.4.2)."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.core.complex import intensity
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.eye.experiment import PRESETS, Observer, observer
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.judge import pooled
from holotorch.metrics import seed_statistics, sharpness, speckle_contrast, ssim
from holotorch.optics.light.coherence import optimum_fwhm, path_difference, predicted_contrast
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.picture import equal_power, tone_map
from holotorch.optics.viewing.imaging import propagate_collapsed

WIDTHS = tuple(1e-9 * width for width in (1.4, 2.5, 4, 6, 9, 13, 19, 28, 40, 56))
_AWAY = 1e-9 * np.concatenate([np.arange(0, 10, 0.5), np.arange(10, 85.0)])  # half a beat of a scene's corner
_FOLLOWED = 16  # of all of these; 1 in 60 errs by 0.4 % (``holotorch chart eye``)
_OTHERS = 1000  # seeds of the reference


@dataclass(frozen=True)
class Case:
    """One colour at one distance.

    Attributes:
        distance: Of the scene from the hologram, in metres.
        wavelength: In metres.
        aperture: Sine up to which detail is carried: by the eye, the hologram, or the rays' own pitch.
        ssim: Of each of ``WIDTHS``, against the mean of other realisations.
        contrast: Of each.
        sharpness: Of each.
        best: FWHM of the highest SSIM, by a parabola through its neighbours, in metres.
        inside: Whether it lies inside the range of widths.
    """

    distance: float
    wavelength: float
    aperture: float
    ssim: tuple[float, ...]
    contrast: tuple[float, ...]
    sharpness: tuple[float, ...]
    best: float
    inside: bool

    def formula(self, prefactor: float) -> float:
        """The closed form's FWHM in metres."""
        return optimum_fwhm(self.wavelength, self.aperture, self.distance, defocus=prefactor)

    def row(self, prefactor: float) -> dict[str, Any]:
        """A line of a table; ``prefactor`` is that of the closed form."""
        return {
            "distance_mm": self.distance * 1e3,
            "wavelength_nm": round(self.wavelength * 1e9),
            "aperture": round(self.aperture, 4),
            "best_fwhm_nm": round(self.best * 1e9, 2),
            "inside": self.inside,
            "formula_nm": round(self.formula(prefactor) * 1e9, 2),
            **{f"ssim_{width * 1e9:g}": round(value, 4) for width, value in zip(WIDTHS, self.ssim, strict=True)},
            **{
                f"contrast_{width * 1e9:g}": round(value, 3) for width, value in zip(WIDTHS, self.contrast, strict=True)
            },
            **{f"predicted_{width * 1e9:g}": round(self.predicted(width), 3) for width in WIDTHS},
        }

    @property
    def source(self) -> str:
        """Preset whose FWHM is nearest to the best."""
        return min(PRESETS, key=lambda name: abs(math.log(PRESETS[name](self.wavelength).fwhm / self.best)))

    def predicted(self, width: float) -> float:
        """Contrast in closed form at a FWHM."""
        spectrum = Spectrum.lorentzian(self.wavelength, width)
        return predicted_contrast(spectrum, path_difference(self.distance, self.aperture))


def tradeoff(
    settings: ObserverSettings, scene: VolumeSettings, distances: tuple[float, ...], *, seeds: int = 2, others: int = 12
) -> list[Case]:
    """Cases for every distance and colour; the eye is focused on the middle of the scene.

    By the collapse throughout, as every hologram is looked at in 189 wavelengths of each colour.
    """
    cases = []
    for distance in tqdm(distances, desc="speckle against sharpness", unit="distance"):
        moved = scene.model_copy(update={"hologram": scene.hologram.model_copy(update={"distance": distance})})
        found = observer(settings.model_copy(update={"focus": (distance,)}), moved)
        found = replace(found, focus=(distance,))
        own = [found.scene.hologram(seed)[0] for seed in range(seeds)]
        rest = [found.scene.hologram(_OTHERS + seed)[0] for seed in range(others)]
        for colour, wave in enumerate(moved.wavelengths):
            reference = seed_statistics(torch.stack([_seen(found, h[colour], wave) for h in rest])).mean
            cases.append(_case(found, colour, wave, own, reference))
    return cases


def _seen(eye: Observer, field: Tensor, wave: float) -> Tensor:
    depth = eye.focus[0]
    image = propagate_collapsed(field.conj()[None], eye.scene.grid, [wave], eye.display, eye.eye(depth), plane=depth)
    return pooled(intensity(image[0]), eye.scene.stride)


def _case(eye: Observer, colour: int, wave: float, holograms: list[Tensor], reference: Tensor) -> Case:
    depth = eye.focus[0]
    places = wave + np.concatenate([-_AWAY[:0:-1], _AWAY])
    weights = np.stack([_weights(places, Spectrum.lorentzian(wave, width)) for width in WIDTHS])
    shown = []
    for hologram in holograms:
        seen = spectral_image(
            hologram[colour].conj(),
            eye.scene.grid,
            torch.from_numpy(places),
            torch.from_numpy(weights),
            eye.display,
            eye.eye(depth),
            count=min(_FOLLOWED, len(places)),
        )
        shown.append(torch.stack([pooled(picture, eye.scene.stride) for picture in seen]))
    pictures = equal_power(torch.stack(shown), reference.expand(len(holograms), len(WIDTHS), *reference.shape))
    peak = reference.flatten().quantile(0.995)
    tone = tone_map(pictures[..., None, :, :], peak=peak), tone_map(reference[None], peak=peak)
    quality = ssim(tone[0], tone[1].expand_as(tone[0]).contiguous(), data_range=1.0)[..., 0].mean(0)
    mask = reference > 0.05 * reference.max()
    contrast = speckle_contrast(pictures, reference=reference, mask=mask).mean(0)
    best, inside = _peak(np.log(np.array(WIDTHS)), quality.numpy())
    return Case(
        depth,
        wave,
        eye.detail(depth, wave),
        tuple(quality.tolist()),
        tuple(contrast.tolist()),
        tuple(sharpness(pictures, reference).mean(0).tolist()),
        float(np.exp(best)),
        inside,
    )


def _weights(places: np.ndarray, spectrum: Spectrum) -> np.ndarray:
    """Of the trapezoidal rule over wavelengths within the spectrum's band, pictures linear between ``places``."""
    low, high = (float(np.clip(end, places[0], places[-1])) for end in spectrum.band())
    nodes = np.concatenate([[low], places[(places > low + 1e-13) & (places < high - 1e-13)], [high]])
    gaps = np.diff(nodes)
    power = spectrum.power(torch.from_numpy(nodes)).numpy() * (np.append(gaps, 0) + np.insert(gaps, 0, 0)) / 2
    after = np.searchsorted(places, nodes).clip(1, len(places) - 1)
    share = (nodes - places[after - 1]) / (places[after] - places[after - 1])
    weights = np.bincount(after - 1, power * (1 - share), len(places)) + np.bincount(after, power * share, len(places))
    return weights / weights.sum()


def _peak(places: np.ndarray, values: np.ndarray) -> tuple[float, bool]:
    i = int(values.argmax())
    if not 0 < i < len(places) - 1:
        return float(places[i]), False
    a, b, _ = np.polyfit(places[i - 1 : i + 2], values[i - 1 : i + 2], 2)
    return float(-b / (2 * a)), True


def fitted_prefactor(cases: list[Case]) -> float:
    """Prefactor of the closed form that fits the measured optima best, in the mean of their logarithms."""
    ratios = [np.log(case.best / case.formula(1.0)) for case in cases if case.inside]
    return float(np.exp(np.mean(ratios))) if ratios else float("nan")


def in_words(cases: list[Case]) -> list[str]:
    """What the cases say: the closed form that fits them, how far off it is, and the best source of each."""
    lines = []
    prefactor = fitted_prefactor(cases)
    inside = [case for case in cases if case.inside]
    off = [case.best / case.formula(prefactor) - 1 for case in inside]
    lines.append(
        f"best FWHM = 2 x {prefactor:.2f} wavelength^2 / (aperture^2 distance): {len(inside)} of {len(cases)} optima "
        f"lie inside the widths tried, off by {min(off, default=0):+.0%} to {max(off, default=0):+.0%}"
    )
    for case in cases:
        lines.append(
            f"{case.distance * 1e3:g} mm, {case.wavelength * 1e9:.0f} nm, aperture {case.aperture:.3f}: best "
            f"{case.best * 1e9:.1f} nm (formula {case.formula(prefactor) * 1e9:.1f}), nearest to a "
            f"{case.source.replace('_', ' ')}"
        )
    return lines
