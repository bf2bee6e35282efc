"""Grey photographs on one array, as a batch: what charts and studies of PEC compare methods on."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
    below,
    gerchberg_saxton,
    iterative_pec,
    limited,
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
WAVELENGTH, EXTENT, DISTANCE = 530e-9, 2e-3, 0.1  # the thesis's chip of 2 mm and its image at 100 mm
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)[:, None, None]


def grey(name: str, size: tuple[int, int]) -> Tensor:
    """A photograph as luminance, float64 [1, H, W]."""
    image = fit_image(load_image(name), size, "crop").double()
    return (image * LUMINANCE).sum(0, keepdim=True) if len(image) == 3 else image


@dataclass(frozen=True)
class Bench:
    """One array, one kind of propagation, and photographs as its channels.

    Attributes:
        images: Names.
        size: Pixels of the array along each axis.
        sigma_px: Width of the heat.
        kind: "fourier", "fresnel" (the thesis's periodic model) or "isolated".
        region: Pixels of a signal region, or 0 for the whole window.
        distances: Of the image, for the two kinds that have any; several make a scene of as many bands.
        lowpass: Cut-off of a Butterworth filter on the targets in cycles per pixel, or 0 for none.
        perceptual: Scores the pictures too, where it can be had.
    """

    images: Sequence[str] = PHOTOGRAPHS
    size: int = 128
    sigma_px: float = 0.66
    kind: str = "fourier"
    region: int = 0
    distances: tuple[float, ...] = (DISTANCE,)
    lowpass: float = 0.0
    perceptual: PerceptualSimilarity | None = None

    @cached_property
    def image(self) -> Tensor:
        """Luminances, float64 [C, h, w]."""
        size = self.region or self.size
        pictures = torch.cat([grey(name, (size, size)) for name in self.images])
        return butterworth(pictures, self.lowpass) if self.lowpass else pictures

    @cached_property
    def wanted(self) -> Tensor:
        """With mean 1."""
        return self.image / self.image.mean((-2, -1), keepdim=True)

    @property
    def grid(self) -> Grid:
        """Sampling of the array."""
        return Grid(self.size, EXTENT / self.size)

    @cached_property
    def crosstalk(self) -> ThermalCrosstalk:
        """Seven taps, as in the thesis, or one for no heat at all."""
        return ThermalCrosstalk(self.sigma_px, 7 if self.sigma_px else 1)

    @cached_property
    def propagator(self) -> Fraunhofer | DepthStack | Fresnel | CroppedKernel:
        """Of all channels."""
        waves = [WAVELENGTH] * len(self.images)
        if self.kind == "fourier":
            return Fraunhofer(self.grid, waves)
        if self.kind == "isolated":
            return CroppedKernel(self.grid, waves, self.distances[0], paraxial=True)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # it is the thesis's model
            filters = [Fresnel(self.grid, waves, z, pad=1) for z in self.distances]
        return filters[0] if len(filters) == 1 else DepthStack(filters)

    @property
    def mask(self) -> Tensor | None:
        """Where the target is to be met: the region, or the band in focus at each distance."""
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
        """float32 [C, *image]."""
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
        """The unknown at the start, [C, H, W] or [C, F, H, W], as in ``experiments.pec``."""
        generator = torch.Generator().manual_seed(seed)
        frame = (frames,) if frames > 1 else ()
        uniform = torch.rand(len(self.images), *frame, self.size, self.size, generator=generator)
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
        """Our staged solver, joint where the start has frames."""
        frames = start.ndim == 4
        solver = LBFGS(precondition=spread_preconditioner(self.crosstalk.kernel), max_steps=steps, tolerance=tolerance)

        def make(**options) -> PECProblem:
            return self.problem(frames=frames, power_weight=power_weight, **options)

        found = run_stages(limited(make, solver, self.crosstalk.total, limit), start, callback=callback)
        return found if limit is None else replace(found, x=below(limit, found.x, self.crosstalk))

    def algorithm2(self, start: Tensor, *, steps: int = 400, callback: Callback | None = None) -> Solution:
        """The thesis's solver."""
        return APG(max_steps=steps)(self.problem(), start, callback=callback)

    def retrieved(self, kind: str, *, passes: int = 100, inner: int = 30, seed: int = 7) -> Solution:
        """Gerchberg-Saxton: "none" (plain), "basic" (crosstalk in its loop) or "ipec" (deconvolution too)."""
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
        """What judges a chip that stands alone: nothing paraxial, nothing periodic."""
        return CroppedKernel(self.grid, [WAVELENGTH] * len(self.images), self.distances[0])

    def formed(
        self,
        phase: Tensor,
        crosstalk: Callable[[Tensor], Tensor] | None = None,
        propagator: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """Mean intensity of the frames of ``phase`` [C, H, W] or [C, F, H, W] in float64, of the picture [C, h, w]."""
        frames = phase.double()[:, None] if phase.ndim == 3 else phase.double()
        spread = crosstalk or self.crosstalk
        total = 0
        for frame in frames.unbind(1):
            total = total + intensity((propagator or self.propagator)(phasor(spread(frame))))
        formed = total / frames.shape[1]
        if len(self.distances) > 1:
            mask = self.mask
            assert mask is not None and isinstance(formed, Tensor)
            return (formed * mask).sum(-3)
        assert isinstance(formed, Tensor)
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
    """Callback that scores the way of a solver; the scoring is left out of its seconds."""

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
        """The row in which a quality was reached first."""
        return next((row for row in self.rows if row[2] >= quality), None)


def butterworth(images: Tensor, cutoff: float) -> Tensor:
    """Low-pass of thesis Eqs. 4.43, 4.44, H = 1 / (1 + (f / cutoff)^4), f in cycles per pixel, counted from zero."""
    fy, fx = (torch.fft.fftfreq(size, dtype=torch.float64) for size in images.shape[-2:])
    square = fy[:, None] ** 2 + fx**2
    spectrum = fft2(images.to(torch.complex128))
    return ifft2(spectrum / (1 + (square / cutoff**2) ** 2)).real.clamp(0, 1)
