"""The proximity-effect experiment: a configuration made into operators, and its solution."""

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
    below,
    deconvolve,
    gerchberg_saxton,
    limited,
    run_stages,
    spread_preconditioner,
)
from holotorch.correction.run import State
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.pec.config import APGSettings, LBFGSSettings, NearFieldSettings, PECSettings
from holotorch.experiments.pec.weight import weight_map
from holotorch.io.images import fit_image, frame_image, load_image, with_channels
from holotorch.modulator import PhasedArray, ThermalCrosstalk, quantised
from holotorch.optics import AngularSpectrum, CroppedKernel, DepthStack, Fraunhofer, Fresnel
from holotorch.optics.free_space.propagators import SpectralFilter

Progress = Callable[[Solution], None]


@dataclass(frozen=True)
class PECExperiment:
    """A configuration made into operators. Colours in which the picture is black are left dark and not solved for.

    Attributes:
        settings: The configuration.
        source: The picture as loaded, float64 [C', h, w].
        lit: Which colours are not black, [C].
        array: The phased array, over the lit colours.
        start: Where the solver starts.
        device: Where it runs.
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
        """Of the colours that are lit, in metres."""
        return self.array.wavelengths

    @property
    def distances(self) -> tuple[float, ...]:
        """Of the image, in metres; none in the far field."""
        light = self.settings.propagator
        return light.distance if isinstance(light, NearFieldSettings) else ()

    @property
    def isolated(self) -> bool:
        """Whether the array stands alone at a distance, and light may leave the window."""
        light = self.settings.propagator
        return isinstance(light, NearFieldSettings) and light.boundary == "isolated"

    @property
    def scale_free(self) -> bool:
        """Whether light may leave the picture, so that only the best scale can be compared."""
        return self.isolated or self.settings.target.region is not None

    @property
    def joint(self) -> bool:
        """Whether several frames share one image and are solved for together."""
        return self.settings.frames > 1 and self.settings.multiplexing == "joint"

    @cached_property
    def image(self) -> Tensor:
        """The picture on its samples, float64 [C, H, W]; resampled when first used, so that a plan needs no memory."""
        settings = self.settings
        fitted = fit_image(self.source, settings.target.region or settings.grid.shape, settings.target.fit)
        return with_channels(fitted, len(settings.wavelengths)).contiguous()

    @property
    def wanted(self) -> Tensor:
        """The intensity of the lit colours in the picture, mean 1 each, float64 [C, H, W]."""
        image = self.image[self.lit]
        return image / image.mean((-2, -1), keepdim=True)

    @property
    def target(self) -> Tensor:
        """The same where the propagator puts it: in the middle of the grid, or at each distance, [C, *image]."""
        wanted = self.wanted
        if region := self.settings.target.region:
            whole = wanted.new_zeros(len(wanted), *self.grid.shape)
            whole[self.window] = wanted
            # Half of the light in the region is what such holograms reach; the scale is free.
            return whole * (math.prod(self.grid.shape) / math.prod(region) / 2)
        return wanted[:, None].repeat(1, len(self.distances), 1, 1) if len(self.distances) > 1 else wanted

    @property
    def window(self) -> tuple[Any, ...]:
        """Where the picture lies in [..., H, W]."""
        size = self.settings.target.region or self.grid.shape
        begin = [whole // 2 - part // 2 for whole, part in zip(self.grid.shape, size, strict=True)]
        return (..., slice(begin[0], begin[0] + size[0]), slice(begin[1], begin[1] + size[1]))

    @property
    def mask(self) -> Tensor | None:
        """1 where the target is to be met, float64, broadcasting to it; None for everywhere."""
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
        """What multiplies the error: the mask, and the root of the weight of its square. None for 1 everywhere."""
        if self.settings.target.weight is None:
            return self.mask
        return weight_map(self.settings.target.weight, self.grid.shape).sqrt()[None]

    @property
    def unweighted(self) -> "PECExperiment":
        """The same work with all errors alike."""
        target = self.settings.target.model_copy(update={"weight": None})
        return replace(self, settings=self.settings.model_copy(update={"target": target}))

    def seen(self, formed: Tensor) -> Tensor:
        """The picture in an intensity [..., C, *image]: its region, or what is in focus, [..., C, h, w]."""
        if len(self.distances) < 2:
            return formed[self.window]
        mask = self.mask
        return formed.mean(-3) if mask is None else (formed * mask.to(formed)).sum(-3)

    @cached_property
    def propagator(self) -> SpectralFilter | Fraunhofer | DepthStack:
        """From the array to the image. Built when first used: its kernel is the first large allocation."""
        if not self.distances:
            return Fraunhofer(self.grid, self.wavelengths).to(self.device)
        filters = [self._to_distance(distance).to(self.device) for distance in self.distances]
        return filters[0] if len(filters) == 1 else DepthStack(filters)

    def _to_distance(self, distance: float) -> SpectralFilter:
        paraxial = self.settings.propagator.kind == "fresnel"
        if self.isolated:
            return CroppedKernel(self.grid, self.wavelengths, distance, paraxial=paraxial)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the plan says the same
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

    def formed(self, phase: Tensor) -> Tensor:
        """Mean intensity of frames of heater phases [F, C, H, W] of the lit colours, [C, *image]."""
        # One frame at a time: a stack of float64 fields at several depths is large.
        return torch.stack([intensity(self.propagator(self.array(each))) for each in phase]).mean(0)

    def start_phase(self) -> Tensor:
        """The unknown at the start, float32 over the lit colours, the same numbers on every device.

        [C, H, W]; [C, F, H, W] for joint frames, [F, C, H, W] for independent ones.
        """
        generator = torch.Generator().manual_seed(self.settings.seed)
        shape, frames = [len(self.wavelengths), *self.grid.shape], self.settings.frames
        if frames > 1:
            shape.insert(1 if self.joint else 0, frames)
        uniform = torch.rand(shape, generator=generator).to(self.device)
        spread = self.array.crosstalk.total
        if self.start == "quadratic":
            (y, x), (height, width) = self.grid.coordinates(self.device), self.grid.shape
            y, x = y / self.grid.pitch[0], x / self.grid.pitch[1]
            lens = math.pi * (y.square() / height + x.square() / width)  # its slope at the edge is pi per pixel
            return (lens / spread + 0.01 * uniform).to(uniform.dtype)
        if self.start == "retrieved":
            return self._retrieved(2 * math.pi * uniform)
        return uniform * {"hot": 2 * math.pi, "cool": 2 * math.pi / spread, "flat": 1.0}[self.start]

    def _retrieved(self, begin: Tensor) -> Tensor:
        """Phases of 30 passes of Gerchberg-Saxton from random image phases, deconvolved, shaped as ``begin``."""
        propagator = self.propagator
        if isinstance(propagator, DepthStack):
            raise ValueError("a retrieved start needs one distance; use another solver.start")
        frames = begin.movedim(1, 0) if self.joint else begin
        mask = None if self.mask is None else self.mask.to(begin)
        found = gerchberg_saxton(propagator, self.target.to(begin), frames, max_steps=30, mask=mask)
        phase = deconvolve(self.array.crosstalk, found.x, max_steps=100)
        return phase.movedim(0, 1).contiguous() if self.joint else phase

    def frames_of(self, unknown: Tensor) -> Tensor:
        """Heater phases [F, C, H, W] of the solver's unknown, within the limit and in the heaters' steps."""
        phase = unknown.detach()
        if self.joint:
            phase = phase.movedim(-3, 0)
        elif self.settings.frames == 1:
            phase = phase[None]
        limit, bits = self.settings.modulator.max_phase, self.settings.modulator.bits
        if bits is not None:
            phase = quantised(phase, bits)
        # Last: rounding to the heaters' steps may pass the limit, scaling them all keeps their number.
        return phase if limit is None else below(limit, phase, self.array.crosstalk)

    def stages(self) -> list[Stage]:
        """What the configured solver does, one run after another."""
        solver = self.settings.solver
        rule = {"max_steps": solver.max_steps, "tolerance": solver.tolerance, "patience": solver.patience}
        if isinstance(solver, APGSettings):
            return [Stage(self.problem(), APG(solver.step, solver.shrink, solver.grow, solver.restart, **rule))]
        if not isinstance(solver, LBFGSSettings):
            return [Stage(self.problem(), ProjectedAdam(solver.learning_rate, **rule))]
        crosstalk = self.array.crosstalk
        method = LBFGS(solver.memory, spread_preconditioner(crosstalk.kernel), **rule)
        return limited(self.problem, method, crosstalk.total, self.settings.modulator.max_phase)

    def solve(self, progress: Progress | None = None, resume: State | None = None) -> Solution:
        """Run the configured solver on the lit colours. ConfigError where it cannot start."""
        try:
            return run_stages(self.stages(), self.start_phase(), callback=progress, resume=resume)
        except ValueError as error:
            raise ConfigError([f"the solver cannot start: {error}"]) from error


def build(settings: PECSettings) -> PECExperiment:
    """Load the picture and choose what the configuration leaves open. ConfigError for what cannot be shown."""
    shape = settings.target.region or settings.grid.shape
    try:
        source = load_image(settings.target.image)
        framed = frame_image(source, shape[1] / shape[0], settings.target.fit)
        lit = with_channels(framed, len(settings.wavelengths)).amax((-2, -1)) > 0
    except ValueError as error:
        raise ConfigError([f"target.image: {error}"]) from error
    if not lit.any():
        raise ConfigError([f"target.image: {settings.target.image} is black inside its crop; use target.fit: pad"])
    waves = [wave for wave, on in zip(settings.wavelengths, lit.tolist(), strict=True) if on]
    array = PhasedArray(waves, ThermalCrosstalk(settings.modulator.sigma_px, settings.modulator.kernel_size))
    start = settings.solver.start or _start_for(settings)
    return PECExperiment(settings, source, lit, array, start, _device(settings.device))


def _start_for(settings: PECSettings) -> str:
    # From hot phases the isolated chip sends most of the light past the window: at 128 px and sigma 0.66 it ends at 4
    # to 25 % of the light and SSIM 0.5 to 0.75, from nearly flat ones at half of it and 0.9.
    light = settings.propagator
    return "flat" if isinstance(light, NearFieldSettings) and light.boundary == "isolated" else "hot"


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(["device: cuda was asked for, but torch finds no CUDA device; use device: auto or cpu"])
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")
