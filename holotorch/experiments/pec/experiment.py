"""PECExperiment: the operators, the target and the solver that a configuration of kind ``pec`` describes."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.correction import (
    APG,
    LBFGS,
    PECProblem,
    ProjectedAdam,
    Solution,
    Stage,
    deconvolve,
    gerchberg_saxton,
    limit_peak_phase,
    penalty_schedule,
    run_stages,
    spread_preconditioner,
)
from holotorch.correction.run import State
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.pec.config import APGSettings, LBFGSSettings, NearFieldSettings, PECSettings
from holotorch.experiments.pec.weight import weight_map
from holotorch.experiments.runs.environment import find_device
from holotorch.io.images import fit_image, frame_image, load_image, with_channels
from holotorch.modulator import PhasedArray, ThermalCrosstalk, quantised
from holotorch.optics import AngularSpectrum, CroppedKernel, DepthStack, Fraunhofer, Fresnel
from holotorch.optics.free_space.propagators import SpectralFilter

Progress = Callable[[Solution], None]


@dataclass(frozen=True)
class PECExperiment:
    """The operators, the target and the solver of a configuration.

    Colours in which the picture is black are not lit, and no phases are computed for them. In the shapes below, C is
    the number of lit colours unless stated otherwise.

    Attributes:
        settings: The configuration.
        source: The picture as loaded, float64 [C', h, w].
        lit: Mask of the colours that are not black, bool [all colours].
        array: The phased array, over the lit colours.
        start: Kind of the phases at the start, as in ``solver.start``.
        device: Device of the solver.
    """

    settings: PECSettings
    source: Tensor
    lit: Tensor
    array: PhasedArray
    start: str
    device: torch.device

    @property
    def grid(self) -> Grid:
        """Sampling of the array."""
        return Grid(self.settings.grid.shape, self.settings.grid.pitch)

    @property
    def wavelengths(self) -> tuple[float, ...]:
        """Wavelengths of the lit colours in metres."""
        return self.array.wavelengths

    @property
    def distances(self) -> tuple[float, ...]:
        """Distances of the image in metres; none in the far field."""
        light = self.settings.propagator
        return light.distance if isinstance(light, NearFieldSettings) else ()

    @property
    def isolated(self) -> bool:
        """Whether the model is a single chip with an image at a distance, where light may leave the window."""
        light = self.settings.propagator
        return isinstance(light, NearFieldSettings) and light.boundary == "isolated"

    @property
    def scale_free(self) -> bool:
        """Whether light may leave the picture, so that the image is compared at its best scale."""
        return self.isolated or self.settings.target.region is not None

    @property
    def joint(self) -> bool:
        """Whether several frames share one image and one loss."""
        return self.settings.frames > 1 and self.settings.multiplexing == "joint"

    @cached_property
    def image(self) -> Tensor:
        """The picture resampled to its pixels, float64 [all colours, H, W]; computed on first use, not for a plan."""
        settings = self.settings
        fitted = fit_image(self.source, settings.target.region or settings.grid.shape, settings.target.fit)
        return with_channels(fitted, len(settings.wavelengths)).contiguous()

    @property
    def wanted(self) -> Tensor:
        """Intensity of the lit colours of the picture, scaled to mean 1 each, float64 [C, H, W]."""
        image = self.image[self.lit]
        return image / image.mean((-2, -1), keepdim=True)

    @property
    def target(self) -> Tensor:
        """Wanted intensity [C, *image]: the picture in the middle of the grid, or at each of several distances."""
        wanted = self.wanted
        if region := self.settings.target.region:
            whole = wanted.new_zeros(len(wanted), *self.grid.shape)
            whole[self.window] = wanted
            # A region holds about half of the light of such holograms. The scale of the image is free.
            return whole * (math.prod(self.grid.shape) / math.prod(region) / 2)
        return wanted[:, None].repeat(1, len(self.distances), 1, 1) if len(self.distances) > 1 else wanted

    @property
    def window(self) -> tuple[Any, ...]:
        """Index of the picture in a tensor [..., H, W] on the grid."""
        size = self.settings.target.region or self.grid.shape
        begin = [whole // 2 - part // 2 for whole, part in zip(self.grid.shape, size, strict=True)]
        return (..., slice(begin[0], begin[0] + size[0]), slice(begin[1], begin[1] + size[1]))

    @property
    def mask(self) -> Tensor | None:
        """1 where the image is compared with the target, else 0, float64, broadcasts to the target; None for all 1."""
        depths, width = len(self.distances), self.grid.shape[1]
        if self.settings.target.region:
            mask = torch.zeros(1, *self.grid.shape, dtype=torch.float64)
            mask[self.window] = 1
            return mask
        if depths < 2 or self.settings.target.depths == "full":
            return None
        mask = torch.zeros(1, depths, 1, width, dtype=torch.float64)
        for depth in range(depths):
            mask[:, depth, :, depth * width // depths : (depth + 1) * width // depths] = 1
        return mask

    @property
    def weights(self) -> Tensor | None:
        """Factor on the error: the mask, or the square root of ``target.weight``. None for 1 everywhere."""
        if self.settings.target.weight is None:
            return self.mask
        return weight_map(self.settings.target.weight, self.grid.shape).sqrt()[None]

    @property
    def unweighted(self) -> "PECExperiment":
        """This experiment without ``target.weight``."""
        target = self.settings.target.model_copy(update={"weight": None})
        return replace(self, settings=self.settings.model_copy(update={"target": target}))

    def picture_in(self, formed: Tensor) -> Tensor:
        """The picture [..., C, h, w] in an intensity [..., C, *image]: its region, or the bands that are in focus."""
        if len(self.distances) < 2:
            return formed[self.window]
        mask = self.mask
        return formed.mean(-3) if mask is None else (formed * mask.to(formed)).sum(-3)

    @cached_property
    def propagator(self) -> SpectralFilter | Fraunhofer | DepthStack:
        """Propagator from the array to the image; built on first use, as its kernel is the first large allocation."""
        if not self.distances:
            return Fraunhofer(self.grid, self.wavelengths).to(self.device)
        filters = [self._to_distance(distance).to(self.device) for distance in self.distances]
        return filters[0] if len(filters) == 1 else DepthStack(filters)

    def _to_distance(self, distance: float) -> SpectralFilter:
        paraxial = self.settings.propagator.kind == "fresnel"
        if self.isolated:
            return CroppedKernel(self.grid, self.wavelengths, distance, paraxial=paraxial)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the plan's notes contain it
            if paraxial:
                return Fresnel(self.grid, self.wavelengths, distance, pad=1)
            return AngularSpectrum(self.grid, self.wavelengths, distance, pad=1, band_limit=False)

    def problem(self, dtype: torch.dtype = torch.float32, **options) -> PECProblem:
        """The objective over the lit colours."""
        target, mask = (None if part is None else part.to(self.device, dtype) for part in (self.target, self.weights))
        assert target is not None
        return PECProblem(
            self.array.crosstalk,
            self.propagator,
            target,
            mask=mask,
            scale_free=self.scale_free,
            frames=self.joint,
            power_weight=self.settings.modulator.power_weight,
            **options,
        )

    def intensity(self, phase: Tensor) -> Tensor:
        """Mean intensity [C, *image] of the frames of heater phases [F, C, H, W]."""
        # One frame at a time, since float64 fields at several depths take much memory.
        return torch.stack([intensity(self.propagator(self.array(each))) for each in phase]).mean(0)

    def start_phase(self) -> Tensor:
        """Heater phases at the start, float32 [C, H, W], or [F, C, H, W] for several frames; the same on every device.

        The random numbers of joint frames are drawn colour by colour, those of independent frames frame by frame.
        """
        generator = torch.Generator().manual_seed(self.settings.seed)
        colours, frames, side = len(self.wavelengths), self.settings.frames, self.grid.shape
        if self.joint:
            uniform = torch.rand(colours, frames, *side, generator=generator).movedim(1, 0).contiguous()
        else:
            uniform = torch.rand(*[frames] * (frames > 1), colours, *side, generator=generator)
        uniform = uniform.to(self.device)
        spread = self.array.crosstalk.total
        if self.start == "quadratic":
            (y, x), (height, width) = self.grid.coordinates(self.device), self.grid.shape
            y, x = y / self.grid.pitch[0], x / self.grid.pitch[1]
            lens = math.pi * (y.square() / height + x.square() / width)  # with a slope of pi per pixel at the edge
            return (lens / spread + 0.01 * uniform).to(uniform.dtype)
        if self.start == "retrieved":
            return self._retrieved(2 * math.pi * uniform)
        return uniform * {"hot": 2 * math.pi, "cool": 2 * math.pi / spread, "flat": 1.0}[self.start]

    def _retrieved(self, begin: Tensor) -> Tensor:
        """Phases of 30 passes of Gerchberg-Saxton from the image phases ``begin``, deconvolved."""
        propagator = self.propagator
        if isinstance(propagator, DepthStack):
            raise ValueError("a retrieved start needs one distance; use another solver.start")
        mask = None if self.mask is None else self.mask.to(begin)
        retrieved = gerchberg_saxton(propagator, self.target.to(begin), begin, max_steps=30, mask=mask).x
        return deconvolve(self.array.crosstalk, retrieved, max_steps=100)

    def heater_phases(self, solution: Tensor) -> Tensor:
        """Phases [F, C, H, W] for the heaters: the solver's result on their levels and scaled to keep the limit."""
        phase = solution.detach() if self.settings.frames > 1 else solution.detach()[None]
        limit, bits = self.settings.modulator.max_phase, self.settings.modulator.bits
        if bits is not None:
            phase = quantised(phase, bits)
        # The limit is applied after rounding to levels, which may exceed it. A common scale keeps the number of levels.
        return phase if limit is None else limit_peak_phase(limit, phase, self.array.crosstalk)

    def stages(self) -> list[Stage]:
        """The runs of the configured solver, one after another."""
        solver = self.settings.solver
        rule = {"max_steps": solver.max_steps, "tolerance": solver.tolerance, "patience": solver.patience}
        if isinstance(solver, APGSettings):
            return [Stage(self.problem(), APG(solver.step, solver.shrink, solver.grow, solver.restart, **rule))]
        if not isinstance(solver, LBFGSSettings):
            return [Stage(self.problem(), ProjectedAdam(solver.learning_rate, **rule))]
        crosstalk = self.array.crosstalk
        method = LBFGS(solver.memory, spread_preconditioner(crosstalk.kernel), **rule)
        return penalty_schedule(self.problem, method, crosstalk.total, self.settings.modulator.max_phase)

    def solve(self, progress: Progress | None = None, resume: State | None = None) -> Solution:
        """Run the configured solver on the lit colours. ConfigError if it cannot start."""
        try:
            return run_stages(self.stages(), self.start_phase(), callback=progress, resume=resume)
        except ValueError as error:
            raise ConfigError([f"the solver cannot start: {error}"]) from error


def build(settings: PECSettings) -> PECExperiment:
    """Load the picture, and choose the settings that the configuration leaves open. ConfigError for a bad picture."""
    shape = settings.target.region or settings.grid.shape
    try:
        source = load_image(settings.target.image)
        framed = frame_image(source, shape[1] / shape[0], settings.target.fit)
        lit = with_channels(framed, len(settings.wavelengths)).amax((-2, -1)) > 0
    except ValueError as error:
        raise ConfigError([f"target.image: {error}"]) from error
    if not lit.any():
        raise ConfigError([f"target.image: {settings.target.image} is black inside its crop; use target.fit: pad"])
    wavelengths = [length for length, on in zip(settings.wavelengths, lit.tolist(), strict=True) if on]
    array = PhasedArray(wavelengths, ThermalCrosstalk(settings.modulator.sigma_px, settings.modulator.kernel_size))
    start = settings.solver.start or _start_for(settings)
    return PECExperiment(settings, source, lit, array, start, find_device(settings.device))


def _start_for(settings: PECSettings) -> str:
    # From a hot start most of the light of an isolated chip misses the window: at 128 px and sigma 0.66 the result has
    # 4 to 25 % of the light and an SSIM of 0.5 to 0.75. From a flat start it has half of the light and an SSIM of 0.9.
    light = settings.propagator
    return "flat" if isinstance(light, NearFieldSettings) and light.boundary == "isolated" else "hot"
