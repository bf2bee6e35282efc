"""The proximity-effect experiment: plan it, solve it, judge it."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.correction import APG, PECProblem, ProjectedAdam, Solution, gerchberg_saxton
from holotorch.correction.problem import best_scale
from holotorch.experiments.config import APGSettings, NearFieldSettings, PECSettings
from holotorch.io.images import fit_image, frame_image, load_image, with_channels
from holotorch.metrics import psnr, ssim
from holotorch.modulator import PhasedArray, ThermalCrosstalk
from holotorch.optics import AngularSpectrum, Fraunhofer, Fresnel, least_padding

BASELINE_PASSES = 100  # of Gerchberg-Saxton and of basic IPEC, as in the thesis's comparison
Progress = Callable[[Solution], None]


@dataclass(frozen=True)
class Result:
    """One method's outcome: heater phases in rad, intensity on the picture's scale, both [C, H, W], and its numbers."""

    phase: Tensor
    picture: Tensor
    numbers: dict[str, Any]


@dataclass(frozen=True)
class PECExperiment:
    """A configuration made into operators. Colours in which the picture is black are left dark and not solved for."""

    settings: PECSettings
    source: Tensor
    lit: Tensor
    array: PhasedArray
    pad: float
    start: str
    device: torch.device

    @property
    def crosstalk(self) -> ThermalCrosstalk:
        """Spreads heater phases."""
        return self.array.crosstalk

    @cached_property
    def image(self) -> Tensor:
        """The picture on the grid, float64 [C, H, W]; resampled when first used, so that a plan needs no memory."""
        settings = self.settings
        fitted = fit_image(self.source, settings.grid.shape, settings.target.fit)
        return with_channels(fitted, len(settings.wavelengths)).contiguous()

    @cached_property
    def propagator(self) -> AngularSpectrum | Fresnel | Fraunhofer:
        """From the array to the image. Built when first used: its kernel is the first large allocation."""
        light = self.settings.propagator
        if not isinstance(light, NearFieldSettings):
            return Fraunhofer(self.grid, self.wavelengths)
        kind = Fresnel if light.kind == "fresnel" else AngularSpectrum
        with _without_warning():
            return kind(self.grid, self.wavelengths, light.distance, pad=self.pad).to(self.device)

    @property
    def isolated(self) -> bool:
        """Whether light may leave the window, so that only the best scale can be compared."""
        light = self.settings.propagator
        return isinstance(light, NearFieldSettings) and light.boundary == "isolated"

    @property
    def grid(self) -> Grid:
        """Sampling of the array."""
        return Grid(self.settings.grid.shape, self.settings.grid.pitch)

    @property
    def wavelengths(self) -> list[float]:
        """Of the colours that are lit, in metres."""
        return [wave for wave, on in zip(self.settings.wavelengths, self.lit.tolist(), strict=True) if on]

    @property
    def target(self) -> Tensor:
        """The wanted intensity of the lit colours, mean 1 each."""
        image = self.image[self.lit]
        return image / image.mean((-2, -1), keepdim=True)

    def problem(self, dtype: torch.dtype = torch.float32) -> PECProblem:
        """The objective over the lit colours."""
        target = self.target.to(self.device, dtype)
        return PECProblem(self.crosstalk, self.propagator, target, scale_free=self.isolated)

    def solve(self, progress: Progress | None = None) -> Solution:
        """Run the configured solver on the lit colours."""
        problem, solver = self.problem(), self.settings.solver
        rule = {"max_steps": solver.max_steps, "tolerance": solver.tolerance, "patience": solver.patience}
        if isinstance(solver, APGSettings):
            method = APG(step=solver.step, shrink=solver.shrink, **rule)
        else:
            method = ProjectedAdam(learning_rate=solver.learning_rate, **rule)
        return method(problem, self.random_phase() * self._start_range(), callback=progress)

    def baseline(self, name: str) -> Solution:
        """Phases without correction ("none") or from basic IPEC ("basic_ipec"), both by Gerchberg-Saxton."""
        return gerchberg_saxton(
            self.propagator,
            self.target.to(self.device, torch.float32),
            self.random_phase() * 2 * math.pi,
            max_steps=BASELINE_PASSES,
            crosstalk=self.crosstalk if name == "basic_ipec" else None,
        )

    def random_phase(self) -> Tensor:
        """Uniform numbers in [0, 1), float32 [C, H, W] over the lit colours, the same on every device."""
        generator = torch.Generator().manual_seed(self.settings.seed)
        return torch.rand(self.target.shape, generator=generator).to(self.device)

    def judge(self, phase: Tensor) -> Result:
        """Score heater phases of the lit colours [C, H, W] by a float64 simulation of what they form."""
        phase = phase.detach()
        formed = self.problem(torch.float64).intensity(phase.double()).cpu()
        picture = self._as_picture(formed)
        warm = self.array.temperature(self.crosstalk(phase.double()))
        driven = self.array.temperature(phase.double())
        numbers = self._quality(picture)
        numbers |= {
            "efficiency": self._per_colour(formed.mean((-2, -1))),
            "peak_temperature_rise_K": self._per_colour(warm.amax((-2, -1))),
            "mean_temperature_rise_K": self._per_colour(warm.mean((-2, -1))),
            "heating_power_K_per_pixel": self._per_colour(driven.mean((-2, -1))),
        }
        return Result(self._all_colours(phase.cpu()), picture, numbers)

    def judge_isolated(self, phase: Tensor) -> dict[str, Any]:
        """Score on a chip that stands alone: a second, exact propagator with half as much padding again."""
        light = self.settings.propagator
        assert isinstance(light, NearFieldSettings)
        formed = torch.empty(self.target.shape, dtype=torch.float64)
        emitted = self.array(phase.detach().double())
        for i, wave in enumerate(self.wavelengths):  # one colour at a time: the padded grid is large
            with _without_warning():
                exact = AngularSpectrum(self.grid, wave, light.distance, pad=self._judge_pad(wave)).to(self.device)
            formed[i] = intensity(exact(emitted[i : i + 1]))[0].cpu()
        scale = best_scale(formed, self.target)[:, None, None]
        numbers = self._quality(self._as_picture(formed * scale))
        return numbers | {"efficiency": self._per_colour(formed.mean((-2, -1)))}

    def judge_samples(self) -> int:
        """Samples of the largest padded grid of :meth:`judge_isolated`, to foresee its memory."""
        return max(math.prod(self.grid.padded(self._judge_pad(wave)).shape) for wave in self.wavelengths)

    def _judge_pad(self, wave: float) -> float:
        light = self.settings.propagator
        assert isinstance(light, NearFieldSettings)
        needed = max(least_padding(self.grid, wave, light.distance))
        return 1.5 * needed if math.isfinite(needed) else 2 * max(self.pad, 2)

    def _quality(self, picture: Tensor) -> dict[str, Any]:
        numbers: dict[str, Any] = {}
        for name in self.settings.report.metrics:
            values = {"ssim": ssim, "psnr": psnr}[name](picture.clamp(0, 1), self.image, data_range=1.0)
            finite = [value if math.isfinite(value) else None for value in values.tolist()]
            numbers[name] = finite
            numbers[f"{name}_mean"] = values[self.lit].mean().item()
        return numbers

    def _as_picture(self, formed: Tensor) -> Tensor:
        """Relative intensity [C, H, W] to the picture's own scale, dark colours black."""
        if self.isolated:
            formed = formed * best_scale(formed, self.target)[:, None, None]
        mean = self.image[self.lit].mean((-2, -1), keepdim=True)
        return self._all_colours(formed * mean)

    def _all_colours(self, lit: Tensor) -> Tensor:
        whole = lit.new_zeros(self.image.shape)
        whole[self.lit] = lit
        return whole

    def _per_colour(self, values: Tensor) -> list[float]:
        whole = torch.zeros(len(self.lit), dtype=torch.float64)
        whole[self.lit] = values.double().cpu()
        return whole.tolist()

    def _start_range(self) -> float:
        return {"hot": 2 * math.pi, "cool": 2 * math.pi / self.crosstalk.total, "flat": 1.0}[self.start]


def build(settings: PECSettings) -> PECExperiment:
    """Load the picture and make the operators. ValueError for a picture that cannot be shown."""
    device = _device(settings.device)
    source = load_image(settings.target.image)
    framed = frame_image(source, settings.grid.shape[1] / settings.grid.shape[0], settings.target.fit)
    lit = with_channels(framed, len(settings.wavelengths)).amax((-2, -1)) > 0
    if not lit.any():
        raise ValueError(f"picture {settings.target.image} is black inside its crop; use target.fit: pad")
    waves = [wave for wave, on in zip(settings.wavelengths, lit.tolist(), strict=True) if on]
    crosstalk = ThermalCrosstalk(settings.modulator.sigma_px, settings.modulator.kernel_size)
    grid, light = Grid(settings.grid.shape, settings.grid.pitch), settings.propagator
    near = isinstance(light, NearFieldSettings)
    pad = _padding(grid, waves, light) if near else 1.0
    start = settings.solver.start or (_start_for(light) if near else "hot")
    return PECExperiment(settings, source, lit, PhasedArray(waves, crosstalk), pad, start, device)


def _without_warning() -> warnings.catch_warnings:
    """The plan says what SamplingWarning would, once and in the report."""
    return warnings.catch_warnings(action="ignore", category=SamplingWarning)


def _padding(grid: Grid, waves: list[float], light: NearFieldSettings) -> float:
    if light.boundary == "periodic":
        return 1.0
    if light.pad is not None:
        return light.pad
    needed = max(max(least_padding(grid, wave, light.distance, paraxial=light.kind == "fresnel")) for wave in waves)
    if not math.isfinite(needed):
        raise ValueError(
            f"grid pitch {min(grid.pitch):g} m is at most half of the longest wavelength, {max(waves):g} m, so light "
            "leaves at every angle and no padding can hold it; set propagator.pad or use a coarser pitch"
        )
    return needed


def _start_for(light: NearFieldSettings) -> str:
    # Measured at 128 px, sigma 0.66: from hot phases the isolated chip ends at 0.2 of the light in the window and
    # SSIM 0.5-0.7; from nearly flat ones at 0.5 and 0.9.
    return "flat" if light.boundary == "isolated" else "hot"


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: cuda was asked for, but torch finds no CUDA device; use device: auto or cpu")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")
