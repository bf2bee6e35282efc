"""Bench: grey photographs as a batch on one array, the common work of the charts and studies of PEC."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity, phasor
from holotorch.core.fourier import fft2, ifft2
from holotorch.core.grid import Grid
from holotorch.correction import (
    APG,
    LBFGS,
    PECProblem,
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
from holotorch.io.images import fit_image, load_image
from holotorch.metrics import PerceptualSimilarity, psnr, ssim
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import CroppedKernel, DepthStack, Fraunhofer, Fresnel

PHOTOGRAPHS = ("camera", "astronaut", "coffee", "page")
WAVELENGTH, EXTENT, DISTANCE = 530e-9, 2e-3, 0.1  # metres: the thesis's chip of 2 mm and its image at 100 mm
# Weights of linear red, green and blue in the luminance: ITU-R BT.709.
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)[:, None, None]


def grey(name: str, size: tuple[int, int]) -> Tensor:
    """A photograph as luminance, float64 [1, H, W]."""
    image = fit_image(load_image(name), size, "crop").double()
    return (image * LUMINANCE).sum(0, keepdim=True) if len(image) == 3 else image


@dataclass(frozen=True)
class Bench:
    """One array, one kind of propagation, and C photographs as its channels.

    Attributes:
        images: Names of the photographs.
        size: Pixels of the array along each axis.
        sigma_px: Width of the heat kernel, exp(-d^2 / sigma^2).
        kind: "fourier", "fresnel" (the thesis's periodic model) or "isolated".
        region: Pixels along each axis of a signal region, or 0 for the whole window.
        distances: Distances of the image in metres for "fresnel" and "isolated"; several divide it into as many bands.
        lowpass: Cut-off of a Butterworth filter on the targets in cycles per pixel, or 0 for none.
        perceptual: Learned similarity that scores the pictures too, if it is installed.
        pictures: Luminances [C, h, w] instead of those of the photographs.
    """

    images: Sequence[str] = PHOTOGRAPHS
    size: int = 128
    sigma_px: float = 0.66
    kind: str = "fourier"
    region: int = 0
    distances: tuple[float, ...] = (DISTANCE,)
    lowpass: float = 0.0
    perceptual: PerceptualSimilarity | None = None
    pictures: Tensor | None = field(default=None, compare=False, repr=False)

    @cached_property
    def image(self) -> Tensor:
        """Luminances, float64 [C, h, w]."""
        if self.pictures is not None:
            return self.pictures
        size = self.region or self.size
        pictures = torch.cat([grey(name, (size, size)) for name in self.images])
        return butterworth(pictures, self.lowpass) if self.lowpass else pictures

    @cached_property
    def wanted(self) -> Tensor:
        """Luminances scaled to mean 1."""
        return self.image / self.image.mean((-2, -1), keepdim=True)

    @property
    def grid(self) -> Grid:
        """Sampling of the array."""
        return Grid(self.size, EXTENT / self.size)

    @cached_property
    def crosstalk(self) -> ThermalCrosstalk:
        """Crosstalk with seven taps, as in the thesis, or with one tap where no heat spreads."""
        return ThermalCrosstalk(self.sigma_px, 7 if self.sigma_px else 1)

    @cached_property
    def propagator(self) -> Fraunhofer | DepthStack | Fresnel | CroppedKernel:
        """Propagator of all channels to the image."""
        wavelengths = [WAVELENGTH] * len(self.images)
        if self.kind == "fourier":
            return Fraunhofer(self.grid, wavelengths)
        if self.kind == "isolated":
            return CroppedKernel(self.grid, wavelengths, self.distances[0], paraxial=True)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the thesis's model is periodic
            filters = [Fresnel(self.grid, wavelengths, z, pad=1) for z in self.distances]
        return filters[0] if len(filters) == 1 else DepthStack(filters)

    @property
    def mask(self) -> Tensor | None:
        """1 where the image is compared with the target: in the region, or in the band in focus at each distance."""
        if self.region:
            begin = (self.size - self.region) // 2
            mask = torch.zeros(1, self.size, self.size)
            mask[:, begin : begin + self.region, begin : begin + self.region] = 1
            return mask
        count = len(self.distances)
        if count == 1:
            return None
        mask = torch.zeros(1, count, 1, self.size)
        for i in range(count):
            mask[:, i, :, i * self.size // count : (i + 1) * self.size // count] = 1
        return mask

    @property
    def target(self) -> Tensor:
        """Wanted intensity, float32 [C, *image]."""
        if self.region:
            begin, part = (self.size - self.region) // 2, self.size**2 / self.region**2 / 2
            around = (begin, self.size - self.region - begin)
            return torch.nn.functional.pad(self.wanted * part, (*around, *around)).float()
        if len(self.distances) > 1:
            return self.wanted[:, None].repeat(1, len(self.distances), 1, 1).float()
        return self.wanted.float()

    @property
    def scale_free(self) -> bool:
        """Whether light may leave the picture."""
        return self.kind == "isolated" or self.region > 0

    def problem(self, **options) -> PECProblem:
        """The objective in float32."""
        options = {"mask": self.mask, "scale_free": self.scale_free, **options}
        return PECProblem(self.crosstalk, self.propagator, self.target, **options)

    def start(self, kind: str, frames: int = 1, seed: int = 7) -> Tensor:
        """Heater phases at the start, [C, H, W] or [F, C, H, W], of a kind as in the configurations ``pec``."""
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(len(self.images), frames, self.size, self.size, generator=generator)
        uniform = uniform.movedim(1, 0).contiguous() if frames > 1 else uniform[:, 0]
        if kind == "quadratic":
            n = torch.arange(self.size) - self.size // 2
            lens = math.pi * n.square() / self.size
            return (lens[:, None] + lens) / self.crosstalk.total + 0.01 * uniform
        return uniform * {"hot": 2 * math.pi, "cool": 2 * math.pi / self.crosstalk.total, "flat": 1.0}[kind]

    def lbfgs(
        self,
        start: Tensor,
        *,
        steps: int = 300,
        limit: float | None = None,
        tolerance: float = 1e-4,
        power_weight: float = 0.0,
        callback: Callback | None = None,
    ) -> Solution:
        """L-BFGS in stages; frames [F, C, H, W] share the image."""
        frames = start.ndim == 4
        solver = LBFGS(precondition=spread_preconditioner(self.crosstalk.kernel), max_steps=steps, tolerance=tolerance)

        def make(**options) -> PECProblem:
            return self.problem(frames=frames, power_weight=power_weight, **options)

        stages = penalty_schedule(make, solver, self.crosstalk.total, limit)
        solution = run_stages(stages, start, callback=callback)
        return solution if limit is None else replace(solution, x=limit_peak_phase(limit, solution.x, self.crosstalk))

    def algorithm2(self, start: Tensor, *, steps: int = 400, callback: Callback | None = None) -> Solution:
        """Algorithm 2 of the thesis, proximal proximity effect correction (PPEC)."""
        return APG(max_steps=steps)(self.problem(), start, callback=callback)

    def retrieved(self, kind: str, *, passes: int = 100, inner: int = 30, seed: int = 7) -> Solution:
        """Gerchberg-Saxton: "none" (plain), "basic" (with the crosstalk in the loop) or "ipec" (deconvolution too)."""
        generator = torch.Generator().manual_seed(seed)
        begin = 2 * math.pi * torch.rand(self.target.shape, generator=generator)
        assert not isinstance(self.propagator, DepthStack)
        if kind == "ipec":
            return iterative_pec(
                self.propagator, self.crosstalk, self.target, begin, max_steps=passes, inner_steps=inner, mask=self.mask
            )
        spread = self.crosstalk if kind == "basic" else None
        return gerchberg_saxton(self.propagator, self.target, begin, max_steps=passes, crosstalk=spread, mask=self.mask)

    @property
    def exact(self) -> CroppedKernel:
        """Exact propagator of a single chip, neither paraxial nor periodic, for its scores."""
        return CroppedKernel(self.grid, [WAVELENGTH] * len(self.images), self.distances[0])

    def formed(
        self,
        phase: Tensor,
        crosstalk: Callable[[Tensor], Tensor] | None = None,
        propagator: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """Picture [C, h, w] in the mean intensity of the frames of ``phase`` [C, H, W] or [F, C, H, W], float64."""
        frames = phase.double().reshape(-1, *phase.shape[-3:])
        spread, propagate = crosstalk or self.crosstalk, propagator or self.propagator
        formed = intensity(propagate(phasor(spread(frames[0]))))
        for frame in frames[1:]:
            formed = formed + intensity(propagate(phasor(spread(frame))))
        formed = formed / len(frames)
        if len(self.distances) > 1:
            mask = self.mask
            assert mask is not None
            return (formed * mask).sum(-3)
        begin, size = (self.size - (self.region or self.size)) // 2, self.region or self.size
        return formed[:, begin : begin + size, begin : begin + size]

    def scores(self, phase: Tensor, formed: Tensor | None = None) -> dict[str, float]:
        """Mean SSIM and PSNR over the photographs, light in the picture, and the largest phase after spreading."""
        formed = self.formed(phase) if formed is None else formed
        light = formed.sum((-2, -1)) / self.size**2
        if self.scale_free:
            formed = formed * best_scale(formed, self.wanted)[:, None, None]
        picture = (formed * self.image.mean((-2, -1), keepdim=True)).clamp(0, 1)
        learned = {}
        if self.perceptual is not None:
            learned = {"perceptual": self.perceptual(picture[:, None], self.image[:, None]).mean().item()}
        return learned | {
            "ssim": ssim(picture, self.image, data_range=1.0).mean().item(),
            "psnr": psnr(picture, self.image, data_range=1.0).mean().item(),
            "efficiency": light.min().item(),
            "peak_rad": self.crosstalk(phase.double()).max().item(),
            "power_rad": phase.double().mean().item(),
        }


class Track:
    """Callback that scores the intermediate phases of a solver; the recorded times exclude the scoring."""

    def __init__(self, bench: Bench, every: int = 5):
        self.bench, self.every = bench, every
        self.rows: list[tuple[float, int, float, float]] = []  # seconds, evaluations, SSIM, largest phase in rad
        self.spent, self.started = 0.0, time.perf_counter()

    def __call__(self, solution: Solution) -> None:
        """Score every few steps."""
        entered = time.perf_counter()
        if (len(solution.losses) - 1) % self.every == 0:
            scores = self.bench.scores(solution.x)
            seconds = entered - self.started - self.spent
            self.rows.append((seconds, solution.evaluations, scores["ssim"], scores["peak_rad"]))
        self.spent += time.perf_counter() - entered

    def reached(self, quality: float) -> tuple[float, int, float, float] | None:
        """The first row whose SSIM is at least ``quality``; None if there is none."""
        return next((row for row in self.rows if row[2] >= quality), None)


def butterworth(images: Tensor, cutoff: float) -> Tensor:
    """Low-pass of thesis Eqs. 4.43, 4.44, H = 1 / (1 + (f / cutoff)^4), f in cycles per pixel, counted from zero."""
    fy, fx = (torch.fft.fftfreq(size, dtype=torch.float64) for size in images.shape[-2:])
    square = fy[:, None] ** 2 + fx**2
    spectrum = fft2(images.to(torch.complex128))
    return ifft2(spectrum / (1 + (square / cutoff**2) ** 2)).real.clamp(0, 1)
