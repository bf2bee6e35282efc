"""Bench: a batch of photographs on one array, for the chart and the studies of proximity effect correction (PEC)."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from holotorch.core.fourier import fft2, ifft2
from holotorch.correction import (
    APG,
    LBFGS,
    Solution,
    gerchberg_saxton,
    iterative_pec,
    limit_peak_phase,
    penalty_schedule,
    run_stages,
    spread_preconditioner,
)
from holotorch.correction.problem import best_scale
from holotorch.correction.run import Callback
from holotorch.experiments.pec.baselines import PASSES
from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.io.images import fit_image, load_image, with_channels
from holotorch.metrics import psnr, ssim
from holotorch.modulator import PhasedArray, ThermalCrosstalk

PHOTOGRAPHS = ("camera", "astronaut", "coffee", "page")
WAVELENGTH, EXTENT, DISTANCE = 530e-9, 2e-3, 0.1  # metres; width of the chip and distance of the image of the thesis
COLOURS = 630e-9, 530e-9, 445e-9  # metres; red, green and blue of the thesis
# Settings of the propagator for each value of ``Bench.kind``.
_PROPAGATORS = {
    "fourier": {"kind": "fraunhofer"},
    "fresnel": {"kind": "fresnel", "boundary": "periodic"},
    "isolated": {"kind": "fresnel", "boundary": "isolated"},
    "exact": {"kind": "angular_spectrum", "boundary": "isolated"},
}


def photograph(name: str, size: tuple[int, int], channels: int = 1) -> Tensor:
    """A photograph cropped and resampled to ``size`` (H, W), float64 [channels, H, W]: luminance, or three colours."""
    return with_channels(fit_image(load_image(name), size, "crop"), channels)


@dataclass(frozen=True)
class Bench:
    """One array, one kind of propagation, and the photographs as its C channels: grey ones, or the colours of each.

    Attributes:
        images: Names of the photographs.
        size: Pixels of the array from left to right; the array is 2 mm wide.
        height: Pixels of the array from top to bottom; None for a square array.
        colour: Whether each photograph has three channels at the wavelengths of the thesis, instead of one at 530 nm.
        sigma_px: Width of the heat kernel exp(-d^2 / sigma^2) in pixels.
        kind: "fourier" (far field), "fresnel" (near field of the array repeated periodically, as in the thesis),
            "isolated" (near field of a single array, paraxial) or "exact" (the same, not paraxial).
        region: Pixels along each axis of a signal region, or 0 for the whole window.
        distances: Distances of the image in metres, except in the far field. Several distances divide the image into as
            many vertical bands.
        lowpass: Cut-off of a Butterworth filter on the targets in cycles per pixel, or 0 for no filter.
        pictures: Targets [C, h, w] in place of the photographs.
    """

    images: Sequence[str] = PHOTOGRAPHS
    size: int = 128
    height: int | None = None
    colour: bool = False
    sigma_px: float = 0.66
    kind: str = "fourier"
    region: int = 0
    distances: tuple[float, ...] = (DISTANCE,)
    lowpass: float = 0.0
    pictures: Tensor | None = field(default=None, compare=False, repr=False)

    @cached_property
    def experiment(self) -> PECExperiment:
        """An experiment of kind ``pec`` whose C colours are the channels of all photographs.

        The heat kernel has seven taps per axis, as in the thesis, or one tap if no heat spreads.
        """
        pictures, shape = self.pictures, (self.region, self.region) if self.region else self.shape
        if pictures is None:
            pictures = torch.cat([photograph(name, shape, self.channels) for name in self.images])
            pictures = butterworth(pictures, self.lowpass) if self.lowpass else pictures
        wavelengths = (COLOURS if self.colour else (WAVELENGTH,)) * (len(pictures) // self.channels)
        propagator = _PROPAGATORS[self.kind] | ({} if self.kind == "fourier" else {"distance": self.distances})
        settings = PECSettings.model_validate(
            {
                "experiment": "pec",
                "grid": {"shape": self.shape, "pitch": EXTENT / self.size},
                "wavelengths": wavelengths,
                "target": {"image": PHOTOGRAPHS[0], "region": self.region or None},  # required, but not loaded
                "modulator": {"sigma_px": self.sigma_px},
                "propagator": propagator,
                "solver": {"kind": "lbfgs"},
            }
        )
        array = PhasedArray(wavelengths, ThermalCrosstalk(self.sigma_px, 7 if self.sigma_px else 1))
        lit = torch.ones(len(pictures), dtype=torch.bool)
        return PECExperiment(settings, pictures, lit, array, "hot", torch.device("cpu"))

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels (H, W) of the array."""
        return self.height or self.size, self.size

    @property
    def channels(self) -> int:
        """Channels of each photograph."""
        return len(COLOURS) if self.colour else 1

    @property
    def crosstalk(self) -> ThermalCrosstalk:
        """Operator that spreads the heat between pixels."""
        return self.experiment.array.crosstalk

    def start(self, kind: str, frames: int = 1, seed: int = 7) -> Tensor:
        """Heater phases at the start, [C, H, W] or [F, C, H, W]; ``kind`` as ``solver.start`` of a configuration."""
        settings = self.experiment.settings.model_copy(update={"frames": frames, "seed": seed})
        phase = replace(self.experiment, settings=settings, start="flat" if kind == "quadratic" else kind).start_phase()
        if kind != "quadratic":
            return phase
        n = torch.arange(self.size) - self.size // 2
        lens = math.pi * n.square() / self.size  # float32, as in the committed charts
        return (lens[:, None] + lens) / self.crosstalk.total + 0.01 * phase

    def lbfgs(
        self,
        start: Tensor,
        *,
        steps: int = 300,
        limit: float | None = None,
        power_weight: float = 0.0,
        callback: Callback | None = None,
    ) -> Solution:
        """L-BFGS in stages, jointly for frames [F, C, H, W]. ``limit`` in rad bounds the phase after spreading."""
        make = partial(self.experiment.problem, frames=start.ndim == 4, power_weight=power_weight)
        solver = LBFGS(precondition=spread_preconditioner(self.crosstalk.kernel), max_steps=steps, tolerance=1e-4)
        solution = run_stages(penalty_schedule(make, solver, self.crosstalk.total, limit), start, callback=callback)
        return solution if limit is None else replace(solution, x=limit_peak_phase(limit, solution.x, self.crosstalk))

    def algorithm2(self, start: Tensor, *, steps: int = 400, callback: Callback | None = None) -> Solution:
        """Thesis Algorithm 2, proximal proximity effect correction (PPEC)."""
        return APG(max_steps=steps)(self.experiment.problem(), start, callback=callback)

    def retrieved(self, kind: str, seed: int = 7) -> Solution:
        """Gerchberg-Saxton; ``kind`` is "none", "basic" (crosstalk in the loop) or "ipec" (deconvolution as well)."""
        problem, propagator = self.experiment.problem(), self.experiment.propagator
        target, mask = problem.target, problem.mask
        start = 2 * math.pi * torch.rand(target.shape, generator=torch.Generator().manual_seed(seed))
        if kind == "ipec":
            return iterative_pec(propagator, self.crosstalk, target, start, max_steps=PASSES, mask=mask)
        spread = self.crosstalk if kind == "basic" else None
        return gerchberg_saxton(propagator, target, start, max_steps=PASSES, crosstalk=spread, mask=mask)

    def formed(self, phase: Tensor) -> Tensor:
        """Intensity of the picture, float64 [C, h, w], that the frames of ``phase`` ([F,] C, H, W) form on average."""
        return self.experiment.picture_in(self.experiment.intensity(phase.double().reshape(-1, *phase.shape[-3:])))

    def scores(self, phase: Tensor, formed: Tensor | None = None) -> dict[str, float]:
        """Scores of heater phases by name.

        ``ssim``, ``psnr`` and ``power_rad`` (heater phase) are means over the photographs, ``ssim_sd`` is the standard
        deviation of the SSIM between them (each the mean of its colours). ``efficiency`` is the fraction of the light
        in the picture, smallest over the channels, and ``peak_rad`` the largest phase after spreading. ``formed``
        replaces the picture that the phases form.
        """
        formed = self.formed(phase) if formed is None else formed
        image, light = self.experiment.image, formed.sum((-2, -1)) / math.prod(self.shape)
        if self.experiment.scale_free:
            formed = formed * best_scale(formed, self.experiment.normalised)[:, None, None]
        picture = (formed * image.mean((-2, -1), keepdim=True)).clamp(0, 1)
        single = ssim(picture, image, data_range=1.0).reshape(-1, self.channels).mean(1)  # of each photograph
        scores = {
            "ssim": single.mean(),
            "ssim_sd": single.std() if len(single) > 1 else single.new_zeros(()),
            "psnr": psnr(picture, image, data_range=1.0).mean(),
            "efficiency": light.min(),
            "peak_rad": self.crosstalk(phase.double()).max(),
            "power_rad": phase.double().mean(),
        }
        return {name: value.item() for name, value in scores.items()}


class Track:
    """Solver callback that scores every few steps; the recorded times exclude the scoring."""

    def __init__(self, bench: Bench, every: int = 5):
        self.bench, self.every, self.started = bench, every, time.perf_counter()
        self.rows: list[tuple[float, int, float, float]] = []  # seconds, evaluations, SSIM, peak_rad

    def __call__(self, solution: Solution) -> None:
        """Score the phases if the step is a multiple of ``every``."""
        entered = time.perf_counter()
        if (len(solution.losses) - 1) % self.every == 0:
            scores = self.bench.scores(solution.x)
            self.rows.append((entered - self.started, solution.evaluations, scores["ssim"], scores["peak_rad"]))
        self.started += time.perf_counter() - entered

    def reached(self, quality: float) -> tuple[float, int, float, float] | None:
        """The first row whose SSIM is at least ``quality``; None if there is none."""
        return next((row for row in self.rows if row[2] >= quality), None)


def butterworth(images: Tensor, cutoff: float) -> Tensor:
    """Images after the low-pass filter 1 / (1 + (f / cutoff)^4), f in cycles per pixel (thesis Eqs. 4.43, 4.44)."""
    fy, fx = (torch.fft.fftfreq(size, dtype=torch.float64) for size in images.shape[-2:])
    square = fy[:, None] ** 2 + fx**2
    spectrum = fft2(images.to(torch.complex128))
    return ifft2(spectrum / (1 + (square / cutoff**2) ** 2)).real.clamp(0, 1)
