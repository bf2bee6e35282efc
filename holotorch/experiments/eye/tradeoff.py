"""Speckle against sharpness: the spectral width with the best picture, per colour and distance (thesis Sec. 6.4.2)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.integrate import trapezoid
from torch import Tensor
from tqdm import tqdm

from holotorch.core.complex import intensity
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.eye.experiment import LIT, PRESETS, Observer, observer
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.evaluation import pooled
from holotorch.metrics import seed_statistics, speckle_contrast, ssim
from holotorch.optics.light.coherence import optimum_fwhm, path_difference, predicted_contrast
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.picture import equal_power, tone_map
from holotorch.optics.viewing.imaging import propagate_collapsed

WIDTHS = tuple(1e-9 * width for width in (1.4, 2.5, 4, 6, 9, 13, 19, 28, 40, 56))  # FWHM in metres, to be compared
# Offsets in metres from the central wavelength at which pictures are computed, on both sides. Up to 10 nm the step is
# 0.5 nm, since the picture at the corner of a scene oscillates with a period of 1 nm; beyond, it is 1 nm.
_OFFSETS = 1e-9 * np.concatenate([np.arange(0, 10, 0.5), np.arange(10, 85.0)])
# Number of wavelengths of a colour that are propagated; the pictures at the others are derived from theirs. For an LED,
# even a single propagated wavelength of 61 has an error of only 0.4 % (``holotorch chart eye``).
_PROPAGATED = 16
_REFERENCE_SEED = 1000  # first seed of the realisations of the reference
WHITE = 0.995  # quantile of the brightness of the reference that is shown as white


@dataclass(frozen=True)
class Case:
    """Measurements of one colour at one distance.

    Attributes:
        distance: Distance of the scene from the hologram in metres.
        wavelength: Central wavelength in metres.
        aperture: Sine of the half angle of the light cone, from ``Observer.detail``.
        ssim: SSIM against the mean picture of other realisations, for each of ``WIDTHS``.
        contrast: Speckle contrast for each of ``WIDTHS``.
        best: FWHM in metres with the highest SSIM, see :func:`parabola_peak`.
        inside: Whether ``best`` lies inside the range of ``WIDTHS``.
        lpips: Perceptual similarity to the same mean picture for each of ``WIDTHS``; None without its weights.
    """

    distance: float
    wavelength: float
    aperture: float
    ssim: tuple[float, ...]
    contrast: tuple[float, ...]
    best: float
    inside: bool
    lpips: tuple[float, ...] | None = None

    def formula(self, prefactor: float) -> float:
        """Best FWHM in metres by the closed form ``optimum_fwhm``; NaN for a prefactor of NaN."""
        defined = not math.isnan(prefactor)
        return optimum_fwhm(self.wavelength, self.aperture, self.distance, defocus=prefactor) if defined else math.nan

    def row(self, prefactor: float) -> dict[str, Any]:
        """A row of the table; ``prefactor`` is the argument of :meth:`formula`."""
        difference = path_difference(self.distance, self.aperture)
        spectra = (Spectrum.lorentzian(self.wavelength, width) for width in WIDTHS)
        predicted = [predicted_contrast(spectrum, difference) for spectrum in spectra]
        by_width = [("ssim", self.ssim, 4), ("contrast", self.contrast, 3), ("predicted", predicted, 3)]
        if self.lpips is not None:
            by_width.append(("lpips", self.lpips, 4))
        return {
            "distance_mm": self.distance * 1e3,
            "wavelength_nm": round(self.wavelength * 1e9),
            "aperture": round(self.aperture, 4),
            "best_fwhm_nm": round(self.best * 1e9, 2),
            "inside": self.inside,
            "formula_nm": round(self.formula(prefactor) * 1e9, 2),
        } | {
            f"{name}_{width * 1e9:g}": round(value, digits)
            for name, values, digits in by_width
            for width, value in zip(WIDTHS, values, strict=True)
        }

    @property
    def source(self) -> str:
        """Name of the preset source whose FWHM is nearest to ``best`` on a logarithmic scale."""
        return min(PRESETS, key=lambda name: abs(math.log(PRESETS[name](self.wavelength).fwhm / self.best)))


def tradeoff(
    settings: ObserverSettings,
    scene: VolumeSettings,
    distances: tuple[float, ...],
    *,
    seeds: int = 2,
    others: int = 12,
    similarity: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> list[Case]:
    """Compute a case for every distance (metres) and colour, with the eye focused on the middle of the scene.

    ``seeds`` realisations of the random phases are compared with the mean picture of ``others`` further realisations.
    Propagation is always collapsed, because each hologram needs many propagations per colour. ``similarity``, such as
    ``PerceptualSimilarity()``, compares pictures [..., 1, h, w] in addition to SSIM.
    """
    cases = []
    for distance in tqdm(distances, desc="speckle against sharpness", unit="distance"):
        moved = scene.model_copy(update={"hologram": scene.hologram.model_copy(update={"distance": distance})})
        eye = observer(settings.model_copy(update={"focus": (distance,)}), moved)
        holograms = [eye.scene.hologram(seed)[0] for seed in range(seeds)]
        reference_holograms = [eye.scene.hologram(_REFERENCE_SEED + seed)[0] for seed in range(others)]
        for colour, wavelength in enumerate(moved.wavelengths):
            images = torch.stack([_image(eye, field[colour], wavelength) for field in reference_holograms])
            reference = seed_statistics(images).mean
            cases.append(_case(eye, colour, wavelength, holograms, reference, similarity))
    return cases


def _image(eye: Observer, field: Tensor, wavelength: float) -> Tensor:
    depth, grid = eye.focus[0], eye.scene.grid
    image = propagate_collapsed(field.conj()[None], grid, [wavelength], eye.display, eye.eye(depth), plane=depth)
    return pooled(intensity(image[0]), eye.scene.stride)


def _case(
    eye: Observer,
    colour: int,
    wavelength: float,
    holograms: list[Tensor],
    reference: Tensor,
    similarity: Callable[[Tensor, Tensor], Tensor] | None,
) -> Case:
    """Measurements of holograms [C, H, W] against a reference [h, w]."""
    depth = eye.focus[0]
    wavelengths = wavelength + np.concatenate([-_OFFSETS[:0:-1], _OFFSETS])
    weights = np.stack([_weights(wavelengths, Spectrum.lorentzian(wavelength, width)) for width in WIDTHS])
    spectra, count = (torch.from_numpy(wavelengths), torch.from_numpy(weights)), min(_PROPAGATED, len(wavelengths))
    shown = []
    for hologram in holograms:
        field = hologram[colour].conj()
        images = spectral_image(field, eye.scene.grid, *spectra, eye.display, eye.eye(depth), count=count)
        shown.append(torch.stack([pooled(image, eye.scene.stride) for image in images]))
    pictures = equal_power(torch.stack(shown), reference.expand(len(holograms), len(WIDTHS), *reference.shape))
    peak = reference.flatten().quantile(WHITE)
    tone = tone_map(pictures[..., None, :, :], peak=peak), tone_map(reference[None], peak=peak)
    quality = ssim(tone[0], tone[1].expand_as(tone[0]).contiguous(), data_range=1.0)[..., 0].mean(0)
    contrast = speckle_contrast(pictures, reference=reference, mask=reference > LIT * reference.max()).mean(0)
    perceived = None
    if similarity is not None:
        perceived = tuple(similarity(tone[0], tone[1].expand_as(tone[0]).contiguous()).mean(0).tolist())
    best, inside = parabola_peak(np.log(WIDTHS).tolist(), quality.tolist())
    return Case(
        depth,
        wavelength,
        eye.detail(depth, wavelength),
        tuple(quality.tolist()),
        tuple(contrast.tolist()),
        float(np.exp(best)),
        inside,
        perceived,
    )


def _weights(wavelengths: np.ndarray, spectrum: Spectrum) -> np.ndarray:
    """Weights of ``wavelengths`` by the trapezoidal rule over the band of a spectrum; their sum is 1."""
    low, high = (float(np.clip(end, wavelengths[0], wavelengths[-1])) for end in spectrum.band())
    inside = (wavelengths > low + 1e-13) & (wavelengths < high - 1e-13)
    nodes = np.concatenate([[low], wavelengths[inside], [high]])
    basis = np.stack([np.interp(nodes, wavelengths, unit) for unit in np.eye(len(wavelengths))])
    weights = trapezoid(spectrum.power(torch.from_numpy(nodes)).numpy() * basis, nodes)
    return weights / weights.sum()


def parabola_peak(positions: Sequence[float], values: Sequence[float]) -> tuple[float, bool]:
    """Position of the maximum of a parabola through the largest value and its neighbours.

    Returns:
        The position and True, or the position of the largest value and False if it has only one neighbour.
    """
    i = int(np.argmax(values))
    if not 0 < i < len(positions) - 1:
        return positions[i], False
    left, right = positions[i] - positions[i - 1], positions[i + 1] - positions[i]
    rise, fall = values[i] - values[i - 1], values[i] - values[i + 1]
    return positions[i] + 0.5 * (right**2 * rise - left**2 * fall) / (right * rise + left * fall), True


def fitted_prefactor(cases: list[Case]) -> float:
    """Prefactor of ``Case.formula`` fitted to the best widths (mean of logarithms); NaN if no case is ``inside``."""
    ratios = [np.log(case.best / case.formula(1.0)) for case in cases if case.inside]
    return float(np.exp(np.mean(ratios))) if ratios else math.nan


def in_words(cases: list[Case]) -> list[str]:
    """Lines of text: the fitted formula, how well it predicts the other distances, and the best source of each case.

    Each optimum is compared with the formula whose prefactor was fitted to the cases at the other distances.
    """
    inside = [case for case in cases if case.inside]
    expected = {case: case.formula(fitted_prefactor([other for other in inside if other.distance != case.distance]))
                for case in cases}  # fmt: skip
    off = [case.best / expected[case] - 1 for case in inside if not math.isnan(expected[case])]
    judged = f"off by {min(off):+.0%} to {max(off):+.0%}" if off else "which only several distances could test"
    return [
        f"best FWHM = 2 x {fitted_prefactor(cases):.2f} wavelength^2 / (aperture^2 distance) in this scene: "
        f"{len(inside)} of {len(cases)} optima lie inside the widths tried; with a prefactor from the other distances, "
        f"{judged}",
        *(
            f"{case.distance * 1e3:g} mm, {case.wavelength * 1e9:.0f} nm, aperture {case.aperture:.3f}: best "
            f"{case.best * 1e9:.1f} nm (from the other distances {expected[case] * 1e9:.1f}), nearest to a "
            f"{case.source.replace('_', ' ')}{_perceived(case)}"
            for case in cases
        ),
    ]


def _perceived(case: Case) -> str:
    if case.lpips is None:
        return ""
    best, inside = parabola_peak(np.log(WIDTHS).tolist(), case.lpips)
    return f"; by LPIPS {'' if inside else 'beyond '}{1e9 * math.exp(best):.1f} nm"
