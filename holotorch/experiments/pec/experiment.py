"""PECExperiment: the operators, the target and the solver that a configuration of kind ``pec`` describes."""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor, nn

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
from holotorch.correction.run import Callback, State
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.pec import budget as shares
from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.pec.weight import weight_map
from holotorch.experiments.planning.correction import measured_crosstalk, solver_precision
from holotorch.experiments.planning.tolerance import Budget
from holotorch.experiments.runs.environment import find_device
from holotorch.experiments.runs.processes import SharedIntensity, process_count
from holotorch.io.colour_tables import colour_shares, picture_matrix
from holotorch.io.images import fit_image, frame_image, load_image, with_channels
from holotorch.modulator import PhasedArray, ThermalCrosstalk, quantised
from holotorch.optics import AngularSpectrum, CroppedKernel, DepthStack, Fraunhofer, Fresnel
from holotorch.optics.free_space.propagators import SpectralFilter


@dataclass(frozen=True)
class PECExperiment:
    """The operators, the target and the solver of a configuration.

    Colours in which the picture is black are not lit, and no phases are computed for them. In the shapes below, C is
    the number of lit colours unless stated otherwise.

    Attributes:
        settings: The configuration.
        source: The picture as loaded, float64 [channels of the file, h, w].
        lit: Mask of the colours that are not black, bool [all colours].
        array: The phased array, over the lit colours.
        start: Kind of the start phases, as in ``solver.start``.
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
        return getattr(self.settings.propagator, "distance", ())

    @property
    def isolated(self) -> bool:
        """Whether the model is a single chip with a near-field image; light may then leave the window."""
        return getattr(self.settings.propagator, "boundary", None) == "isolated"

    @property
    def scale_free(self) -> bool:
        """Whether light may leave the picture. The image is then scaled to fit the target best before comparison."""
        return self.isolated or self.settings.target.region is not None

    @property
    def joint(self) -> bool:
        """Whether several frames share one image and one loss."""
        return self.settings.frames > 1 and self.settings.multiplexing == "joint"

    @cached_property
    def budget(self) -> Budget:
        """Tolerances and predicted errors of heat kernel, propagation and stopping rule."""
        return shares.pec_budget(self.settings, self.start)

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the phases in the solver."""
        return solver_precision(shares.stop(self.settings, self.budget))

    @cached_property
    def image(self) -> Tensor:
        """The picture resampled to the grid, or to the region, float64 [all colours, h, w]; computed on first use."""
        settings = self.settings
        fitted = fit_image(self.source, settings.target.region or settings.grid.shape, settings.target.fit)
        return _on_wavelengths(fitted, settings.wavelengths).contiguous()

    @property
    def normalised(self) -> Tensor:
        """Intensity of the lit colours of the picture, each scaled to mean 1, float64 [C, h, w]."""
        image = self.image[self.lit]
        return image / image.mean((-2, -1), keepdim=True)

    @property
    def target(self) -> Tensor:
        """Target intensity [C, *image]; *image is (H, W), or (D, H, W) with the picture at each of D > 1 distances."""
        normalised = self.normalised
        if region := self.settings.target.region:
            whole = normalised.new_zeros(len(normalised), *self.grid.shape)
            whole[self.window] = normalised
            # The factor puts half of the light in the region. Its value is not critical, since the scale is fitted.
            return whole * (math.prod(self.grid.shape) / math.prod(region) / 2)
        return normalised[:, None].repeat(1, len(self.distances), 1, 1) if len(self.distances) > 1 else normalised

    @property
    def window(self) -> tuple[Any, ...]:
        """Slices that cut the picture out of a tensor [..., H, W] on the grid."""
        size = self.settings.target.region or self.grid.shape
        first = [whole // 2 - part // 2 for whole, part in zip(self.grid.shape, size, strict=True)]
        return (..., *(slice(start, start + part) for start, part in zip(first, size, strict=True)))

    @property
    def mask(self) -> Tensor | None:
        """1 where the image is compared with the target, else 0; float64, broadcasts to [C, *image]. None for all 1."""
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
        """Factor on the error before squaring: :attr:`mask` or the square root of ``target.weight``; None for 1."""
        if self.settings.target.weight is None:
            return self.mask
        return weight_map(self.settings.target.weight, self.grid.shape).sqrt()[None]

    @property
    def unweighted(self) -> "PECExperiment":
        """This experiment without ``target.weight``."""
        target = self.settings.target.model_copy(update={"weight": None})
        return replace(self, settings=self.settings.model_copy(update={"target": target}))

    def picture_in(self, formed: Tensor) -> Tensor:
        """Cut the picture [..., C, h, w] out of an image intensity [..., C, *image].

        For several distances, the picture consists of the band at each distance, or is the mean over the distances.
        """
        if len(self.distances) < 2:
            return formed[self.window]
        mask = self.mask
        return formed.mean(-3) if mask is None else (formed * mask.to(formed)).sum(-3)

    @cached_property
    def propagator(self) -> SpectralFilter | Fraunhofer | DepthStack:
        """Propagator from the array to the image; built on first use, because its kernel takes much memory."""
        return self._propagator(self.wavelengths)

    @cached_property
    def _intensities(self) -> SharedIntensity:
        """The same for the solver of a run that several processes share: intensities, each a part of them."""

        def own(colours: Sequence[int]) -> nn.Module:
            return self._propagator([self.wavelengths[colour] for colour in colours])

        return SharedIntensity(own, len(self.wavelengths), self.settings.frames)

    def _propagator(self, wavelengths: Sequence[float]) -> SpectralFilter | Fraunhofer | DepthStack:
        if not self.distances:
            return Fraunhofer(self.grid, wavelengths).to(self.device)
        filters = [self._to_distance(distance, wavelengths).to(self.device) for distance in self.distances]
        return filters[0] if len(filters) == 1 else DepthStack(filters)

    def _to_distance(self, distance: float, wavelengths: Sequence[float]) -> SpectralFilter:
        paraxial = self.settings.propagator.kind == "fresnel"
        if self.isolated:
            return CroppedKernel(self.grid, wavelengths, distance, paraxial=paraxial)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the plan reports it in a note
            if paraxial:
                return Fresnel(self.grid, wavelengths, distance, pad=1)
            return AngularSpectrum(self.grid, wavelengths, distance, pad=1, band_limit=False)

    def problem(self, dtype: torch.dtype | None = None, *, shared: bool = False, **options) -> PECProblem:
        """The objective over the lit colours.

        With ``shared``, the processes of a run compute it together, and all of them must call it. ``options`` of
        :class:`PECProblem` replace those of the configuration.
        """
        weights, dtype = self.weights, dtype or self.dtype
        configured: dict[str, Any] = {
            "mask": None if weights is None else weights.to(self.device, dtype),
            "scale_free": self.scale_free,
            "frames": self.joint,
            "power_weight": self.settings.modulator.power_weight,
        }
        target = self.target.to(self.device, dtype)
        propagator = self._intensities if shared and process_count()[1] > 1 else self.propagator
        return PECProblem(self.array.crosstalk, propagator, target, **configured | options)

    def intensity(self, phase: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Mean intensity [C, *image] of the frames of heater phases [F, C, H, W], by default in their dtype."""
        return self.mean_intensity(lambda frame: self.array(frame.to(dtype or frame.dtype)), phase)

    def mean_intensity(self, emitted: Callable[[Tensor], Tensor], phase: Tensor) -> Tensor:
        """Mean intensity [C, *image] of the fields ``emitted`` for each frame of heater phases [F, C, H, W]."""
        # One frame at a time, since float64 fields at several depths take much memory.
        images = (intensity(self.propagator(emitted(frame))) for frame in phase)
        return sum(images, next(images)) / len(phase)

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
            lens = math.pi * (y.square() / height + x.square() / width)  # slope at the edge: pi rad per pixel
            return (lens / spread + 0.01 * uniform).to(uniform.dtype)
        if self.start == "retrieved":
            if isinstance(self.propagator, DepthStack):
                raise ValueError("a retrieved start needs one distance; use another solver.start")
            image_phase, mask = 2 * math.pi * uniform, None if self.mask is None else self.mask.to(uniform)
            target = self.target.to(uniform)
            retrieved = gerchberg_saxton(self.propagator, target, image_phase, max_steps=30, mask=mask)
            return deconvolve(self.array.crosstalk, retrieved.x, max_steps=100)
        return uniform * {"hot": 2 * math.pi, "cool": 2 * math.pi / spread, "flat": 1.0}[self.start]

    @property
    def limit(self) -> float | None:
        """Upper limit in rad on the phase after spreading, of all colours; None without one.

        A limit on the temperature is that of the colour whose phase is smallest at this temperature.
        """
        chip = self.settings.modulator
        hottest = chip.max_temperature
        return chip.max_phase if hottest is None else hottest * min(self.array.response)

    def heater_phases(self, solution: Tensor) -> Tensor:
        """Heater phases [F, C, H, W]: the solver's result, rounded to the heater levels and scaled below the limit."""
        phase = solution.detach() if self.settings.frames > 1 else solution.detach()[None]
        limit, bits = self.limit, self.settings.modulator.bits
        if bits is not None:
            phase = quantised(phase, bits)
        # Rounded phases may exceed the limit, so they are scaled last, all levels by the same factor.
        return phase if limit is None else limit_peak_phase(limit, phase, self.array.crosstalk)

    def stages(self, *, shared: bool = False) -> list[Stage]:
        """The stages of the configured solver in order; ``shared`` as in :meth:`problem`."""
        problem = partial(self.problem, shared=shared)
        kind, crosstalk = self.settings.solver.kind, self.array.crosstalk
        options = self.settings.solver.model_dump(exclude={"kind", "start", "reruns"})
        options["tolerance"] = shares.stop(self.settings, self.budget)
        if kind == "lbfgs":
            solver = LBFGS(precondition=spread_preconditioner(crosstalk.kernel), **options)
            return penalty_schedule(problem, solver, crosstalk.total, self.limit)
        return [Stage(problem(), APG(**options) if kind == "apg" else ProjectedAdam(**options))]

    def solve(self, progress: Callback | None = None, resume: State | None = None) -> Solution:
        """Run the configured solver on the lit colours, in all processes of a run. ConfigError if it cannot start."""
        try:
            return run_stages(
                self.stages(shared=True), self.start_phase().to(self.dtype), callback=progress, resume=resume
            )
        except ValueError as error:
            raise ConfigError([f"the solver cannot start: {error}"]) from error


def build(settings: PECSettings) -> PECExperiment:
    """Load the picture, and choose the device and start that are not configured. ConfigError for a bad picture."""
    shape = settings.target.region or settings.grid.shape
    try:
        source = load_image(settings.target.image)
        framed = frame_image(source, shape[1] / shape[0], settings.target.fit)
        lit = _on_wavelengths(framed, settings.wavelengths).amax((-2, -1)) > 0
    except ValueError as error:
        raise ConfigError([f"target.image: {error}"]) from error
    if len(settings.wavelengths) not in (1, 3):
        try:
            picture_matrix(settings.wavelengths)  # what pictures are drawn with
        except ValueError as error:
            raise ConfigError([f"wavelengths: {error}; 1 or 3 wavelengths may have any length"]) from error
    if not lit.any():
        raise ConfigError([f"target.image: {settings.target.image} is black inside its crop; use target.fit: pad"])
    wavelengths = [length for length, on in zip(settings.wavelengths, lit.tolist(), strict=True) if on]
    # From a hot start most of the light of an isolated chip misses the window: at 128 px and sigma 0.66 the picture has
    # 4 to 25 % of the light and an SSIM of 0.5 to 0.75. From a flat start it has half of the light and an SSIM of 0.9.
    isolated = getattr(settings.propagator, "boundary", None) == "isolated"
    start = settings.solver.start or ("flat" if isolated else "hot")
    array = PhasedArray(
        wavelengths, _crosstalk(settings, start), reference_response=settings.modulator.reference_response
    )
    return PECExperiment(settings, source, lit, array, start, find_device(settings.device))


def _on_wavelengths(image: Tensor, wavelengths: Sequence[float]) -> Tensor:
    """What each of K wavelengths shows of a picture [1 or 3, H, W], [K, H, W]; of a single one its luminance.

    A picture [K, H, W] has a channel for each wavelength, as where a study solves several grey ones at once.
    """
    if len(wavelengths) in (1, 3, len(image)):
        return with_channels(image, len(wavelengths))
    return torch.einsum("kc,chw->khw", colour_shares(wavelengths).to(image), with_channels(image, 3))


def _crosstalk(settings: PECSettings, start: str) -> ThermalCrosstalk:
    """The spreading of the heat, from the width of a Gaussian or from a measured kernel."""
    chip = settings.modulator
    if chip.kernel is not None:
        return measured_crosstalk(chip.kernel, settings.grid.shape, "modulator.kernel")
    assert chip.sigma_px is not None  # ``contradictions`` asks for one of the two
    with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the plan reports lost heat in a note
        return ThermalCrosstalk(chip.sigma_px, shares.taps(settings, start))
