"""The proximity-effect experiment: a configuration made into operators, and its solution."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.grid import Grid
from holotorch.correction import APG, PECProblem, ProjectedAdam, Solution, gerchberg_saxton
from holotorch.experiments.config import APGSettings, NearFieldSettings, PECSettings
from holotorch.experiments.errors import ConfigError
from holotorch.io.images import fit_image, frame_image, load_image, with_channels
from holotorch.modulator import PhasedArray, ThermalCrosstalk
from holotorch.optics import AngularSpectrum, CroppedKernel, Fraunhofer, Fresnel

BASELINE_PASSES = 100  # of Gerchberg-Saxton and of basic IPEC, as in the thesis's comparison
Progress = Callable[[Solution], None]


@dataclass(frozen=True)
class PECExperiment:
    """A configuration made into operators. Colours in which the picture is black are left dark and not solved for.

    Attributes:
        settings: The configuration.
        source: The picture as loaded, float64 [C', h, w].
        lit: Which colours are not black, [C].
        array: The phased array, over the lit colours.
        start: Where the solver starts: "hot" or "flat".
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
    def isolated(self) -> bool:
        """Whether light may leave the window, so that only the best scale can be compared."""
        light = self.settings.propagator
        return isinstance(light, NearFieldSettings) and light.boundary == "isolated"

    @cached_property
    def image(self) -> Tensor:
        """The picture on the grid, float64 [C, H, W]; resampled when first used, so that a plan needs no memory."""
        settings = self.settings
        fitted = fit_image(self.source, settings.grid.shape, settings.target.fit)
        return with_channels(fitted, len(settings.wavelengths)).contiguous()

    @property
    def target(self) -> Tensor:
        """The wanted intensity of the lit colours, mean 1 each."""
        image = self.image[self.lit]
        return image / image.mean((-2, -1), keepdim=True)

    @cached_property
    def propagator(self) -> AngularSpectrum | CroppedKernel | Fresnel | Fraunhofer:
        """From the array to the image. Built when first used: its kernel is the first large allocation."""
        return self._build_propagator().to(self.device)

    def _build_propagator(self) -> AngularSpectrum | CroppedKernel | Fresnel | Fraunhofer:
        light = self.settings.propagator
        if not isinstance(light, NearFieldSettings):
            return Fraunhofer(self.grid, self.wavelengths)
        paraxial = light.kind == "fresnel"
        if light.boundary == "isolated":
            return CroppedKernel(self.grid, self.wavelengths, light.distance, paraxial=paraxial)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the plan says the same
            if paraxial:
                return Fresnel(self.grid, self.wavelengths, light.distance, pad=1)
            return AngularSpectrum(self.grid, self.wavelengths, light.distance, pad=1, band_limit=False)

    def problem(self, dtype: torch.dtype = torch.float32) -> PECProblem:
        """The objective over the lit colours."""
        target = self.target.to(self.device, dtype)
        return PECProblem(self.array.crosstalk, self.propagator, target, scale_free=self.isolated)

    def start_phase(self) -> Tensor:
        """Heater phases of the start, float32 [C, H, W] over the lit colours, the same numbers on every device."""
        generator = torch.Generator().manual_seed(self.settings.seed)
        uniform = torch.rand(self.target.shape, generator=generator).to(self.device)
        return uniform * {"hot": 2 * math.pi, "flat": 1.0}[self.start]

    def solve(self, progress: Progress | None = None) -> Solution:
        """Run the configured solver on the lit colours. ConfigError where it cannot start."""
        solver = self.settings.solver
        rule = {"max_steps": solver.max_steps, "tolerance": solver.tolerance, "patience": solver.patience}
        if isinstance(solver, APGSettings):
            method = APG(step=solver.step, shrink=solver.shrink, **rule)
        else:
            method = ProjectedAdam(learning_rate=solver.learning_rate, **rule)
        try:
            return method(self.problem(), self.start_phase(), callback=progress)
        except ValueError as error:
            raise ConfigError([f"the solver cannot start: {error}"]) from error

    def baseline(self, name: str, progress: Progress | None = None) -> Solution:
        """Phases without correction ("none") or from basic IPEC ("basic_ipec"), by Gerchberg-Saxton.

        Both begin with the image that the solver's own start forms, so that they have the same light to work with.
        """
        with torch.no_grad():
            begin = torch.angle(self.propagator(self.array(self.start_phase())))
        return gerchberg_saxton(
            self.propagator,
            self.target.to(self.device, torch.float32),
            begin,
            max_steps=BASELINE_PASSES,
            crosstalk=self.array.crosstalk if name == "basic_ipec" else None,
            callback=progress,
        )


def build(settings: PECSettings) -> PECExperiment:
    """Load the picture and choose what the configuration leaves open. ConfigError for what cannot be shown."""
    try:
        source = load_image(settings.target.image)
        framed = frame_image(source, settings.grid.shape[1] / settings.grid.shape[0], settings.target.fit)
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
