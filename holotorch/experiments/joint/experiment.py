"""The joint experiment: the light of a volume, the display, the views of an eye, and what they are to show."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.correction import (
    LBFGS,
    PECProblem,
    Solution,
    deconvolve,
    limit_peak_phase,
    spread_preconditioner,
)
from holotorch.correction.run import Callback, State
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.joint import budget as shares
from holotorch.experiments.joint.config import FOCI_PER_STEP, JointSettings, volume_settings
from holotorch.experiments.joint.views import pupils
from holotorch.experiments.joint.views.sampled import Group, SampledViews, adam
from holotorch.experiments.planning.correction import PROPAGATION, measured_crosstalk
from holotorch.experiments.planning.tolerance import Budget
from holotorch.experiments.runs.processes import SharedIntensity, process_count
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.experiment import VolumeExperiment
from holotorch.experiments.volume.experiment import build as build_volume
from holotorch.hologram import incoherent_views
from holotorch.modulator import HeatCycle, ThermalCrosstalk
from holotorch.optics import PupilViews, View, disc_source, propagate
from holotorch.optics.light.coherence import depth_of_focus
from holotorch.optics.viewing.pupil_views import view_padding
from holotorch.scene.layers import SlabLayers, SourceLayers

_PENALTY_FROM = 0.985  # fraction of the limit above which phases are penalised, so that little is left to scale down
_TOLERANCE = 3e-3  # relative L2 error of the fields that the start is made of
# Distance of the corrected foci in depths of focus. 40 planes of a head (one colour, 60 steps) then have 51.3 dB over
# all of them and 49.4 at worst; with a focus on each, 50.2 and 42.9, in nine times the time; at 0.78, 50.3 and 47.4.
_APART = 0.5
_RINGS = 2  # rings of directions within a pupil, for the occlusion between planes
_VIEWS_SEED = 1 << 40  # added to the seed for the random pupils, so that they are independent of the start


@dataclass(frozen=True)
class Views:
    """Views with the images that an eye is to see in them.

    Attributes:
        operator: The fields of the views from the field of the display.
        images: Wanted intensities [C, V, H, W], relative to the mean of each colour over the trained foci.
    """

    operator: PupilViews
    images: Tensor

    def select(self, indices: Sequence[int]) -> "Views":
        """Some of the views, by their indices."""
        return Views(self.operator.select(indices), self.images[:, list(indices)])


@dataclass(frozen=True)
class JointExperiment:
    """The scene, display and eye that a configuration describes."""

    settings: JointSettings
    scene: VolumeExperiment

    @property
    def grid(self) -> Grid:
        """Pixels of the array."""
        return self.scene.grid

    @property
    def device(self) -> torch.device:
        """Device of the computation."""
        return self.scene.device

    @cached_property
    def depths(self) -> tuple[float, ...]:
        """Depths of the planes behind the array in metres, stretched along the axis, in the order of an eye's rays.

        The array forms the volume behind itself, so that the end that faces the observer (``view.front``) is nearest.
        """
        middle, towards = self.settings.display.distance, -1 if self.settings.view.front == "far" else 1
        return tuple(middle + towards * self.stretched * (depth - middle) for depth in self.scene.depths)

    @property
    def stretched(self) -> float:
        """Factor by which the volume is stretched along the axis."""
        depth, planes = self.settings.display.depth, self.scene.depths
        if depth is None or len(planes) == 1:
            return 1.0
        return depth / (abs(planes[-1] - planes[0]) * len(planes) / (len(planes) - 1))

    @cached_property
    def budget(self) -> Budget:
        """Tolerances and predicted errors of heat kernel, planes, propagation and stopping rule."""
        return shares.joint_budget(self.settings, self.scene.slab_error, self.padded)

    def padded(self, factor: int) -> Grid:
        """Padded grid of a view for light that travels up to ``factor`` times as far as to the farthest focus."""
        pupil, farthest = View(max(self.foci), self.radius), factor * max(self.foci)
        return view_padding(self.grid, self.settings.wavelengths, [pupil], farthest)

    @cached_property
    def padding(self) -> int:
        """Factor of :meth:`padded` that the tolerance requires."""
        errors = {factor: shares.edge_error(self.settings, self.padded(factor)) for factor in shares.PADDINGS}
        return shares.padding(self.settings, self.budget.share(PROPAGATION), errors)

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the phases in the solver."""
        return shares.solver_dtype(self.settings, self.budget)

    @cached_property
    def slabs(self) -> SlabLayers:
        """Colours and opacities of the planes, at their stretched depths."""
        with torch.no_grad():
            layers = self.scene.sampler().slab_layers(self.scene.volume)
        count = len(self.settings.wavelengths)
        emission = layers.emission.mean(1, keepdim=True) if count == 1 else layers.emission[:, :count]
        return replace(layers, depths=self.depths, emission=emission)

    @cached_property
    def light(self) -> Tensor:
        """Light of the planes along the axis, |amplitude|^2, [D, C, h, w]."""
        return self.slabs.towards((0.0, 0.0))

    def _light_into(self, pupil: View) -> Tensor:
        """Light of the planes that gets into a pupil past the planes in front, mean over its directions."""
        if self.settings.eye.occlusion == "axis":
            return self.light
        points, weights = disc_source(pupil.radius, _RINGS)
        (y, x), (down, right) = pupil.centre, pupil.covered
        open_ = [dy * down + dx * right <= 0 for dy, dx in points]
        shares = weights[open_] / weights[open_].sum()
        total = torch.zeros_like(self.light)
        for (dy, dx), share in zip(
            (point for point, each in zip(points, open_, strict=True) if each), shares, strict=True
        ):
            total += share.item() * self.slabs.towards((y + dy, x + dx))
        return total

    @property
    def radius(self) -> float:
        """Sine of the half-angle of the pupil."""
        return self.settings.eye.pupil * min(self.settings.wavelengths) / (2 * max(self.grid.pitch))

    @cached_property
    def foci(self) -> list[float]:
        """Focal distances that are corrected, nearest first: the depths of the planes, or fewer of the same extent.

        Where planes are closer than ``_APART`` depths of focus, their pictures hardly differ; foci at that distance
        take less time and correct all of them as well (see ``scripts/docs/joint.md``).
        """
        planes = sorted(self.depths)
        apart = _APART * depth_of_focus(min(self.settings.wavelengths), self.radius)
        count = math.ceil((planes[-1] - planes[0]) / apart) + 1
        if count >= len(planes):
            return planes
        step = (planes[-1] - planes[0]) / max(count - 1, 1)
        return [planes[0] + step * i for i in range(count)]

    @cached_property
    def stack(self) -> Views:
        """The whole pupil at every corrected focus."""
        return self.at_foci(self.foci)

    @cached_property
    def held_back(self) -> Views | None:
        """The whole pupil at foci half-way between the corrected ones, which no method is given; None for one plane."""
        between = [(one + other) / 2 for one, other in zip(self.foci, self.foci[1:], strict=False)]
        return self.at_foci(between) if between else None

    @cached_property
    def halves(self) -> Views:
        """The left and the right half of the pupil at every corrected focus, which no method is given."""
        return self.views(pupils.halves(self.foci, self.radius))

    @cached_property
    def held_parts(self) -> Views:
        """Circles within the pupil at every corrected focus, which no method is given."""
        return self.views(pupils.held_parts(self.foci, self.radius))

    @cached_property
    def trained(self) -> Views:
        """The views that are corrected: the stack, and parts of the pupil for the parallax."""
        count = self.settings.eye.parallax
        return self.with_parts(self.parts(count)) if count else self.stack

    def parts(self, count: int) -> list[View]:
        """Parts of the pupil with random foci, in turn circles and pupils that an edge cuts."""
        return pupils.corrected_parts(self.foci, self.radius, count, self.settings.seed + _VIEWS_SEED)

    def with_parts(self, parts: list[View]) -> Views:
        """The whole pupil at every corrected focus, and parts of it."""
        return self.views([View(focus, self.radius) for focus in self.foci] + parts)

    def at_foci(self, foci: list[float]) -> Views:
        """The whole pupil at focal distances in metres."""
        return self.views([View(focus, self.radius) for focus in foci])

    def plane(self, index: int) -> Views:
        """The light of one plane alone, in focus."""
        return self.views([View(self.depths[index], self.radius)], slice(index, index + 1))

    def views(self, views: list[View], planes: slice = slice(None)) -> Views:
        """Any views, of the light of the chosen planes."""
        operator = PupilViews(self.grid, self.settings.wavelengths, views, longest=self.padding * max(self.foci))
        return Views(operator.to(self.device), self._images(views, planes).to(self.device) / self._mean)

    def _images(self, views: list[View], planes: slice = slice(None)) -> Tensor:
        """Incoherent images [C, V, H, W]; views that share a pupil receive the same light."""
        pupils = [replace(view, focus=0.0) for view in views]
        images: list[Tensor] = [torch.empty(0)] * len(views)
        for pupil in dict.fromkeys(pupils):
            chosen = [v for v, each in enumerate(pupils) if each == pupil]
            light = self._light_into(pupil)[planes]
            layers = SourceLayers(
                self.grid, self.depths[planes], light.shape[1], lambda light=light: iter(light.sqrt())
            )
            observed = incoherent_views(layers, self.settings.wavelengths, [views[v] for v in chosen])
            for v, image in zip(chosen, observed.unbind(1), strict=True):
                images[v] = image
        return torch.stack(images, 1)

    @property
    def colours(self) -> Tensor:
        """Mean light of each colour in the volume, [C, 1, 1, 1], which white light gives the pictures."""
        return self.light.sum(0).mean((-2, -1))[:, None, None, None].to(self.device)

    @cached_property
    def _mean(self) -> Tensor:
        """Mean image of each colour over the corrected foci, [C, 1, 1, 1]. ConfigError for a black colour."""
        views = [View(focus, self.radius) for focus in self.foci]
        mean = self._images(views).mean((1, 2, 3), keepdim=True)
        if not bool((mean > 0).all()):
            dark = [f"{w * 1e9:.0f} nm" for w, each in zip(self.settings.wavelengths, mean, strict=True) if each <= 0]
            raise ConfigError([f"transfer: the volume has no light at {', '.join(dark)}; change colours or opacity"])
        return mean.to(self.device)

    @cached_property
    def crosstalk(self) -> ThermalCrosstalk:
        """The spreading of the heat in the steady state."""
        display = self.settings.display
        if display.kernel is not None:
            return measured_crosstalk(display.kernel, display.shape, "display.kernel").to(self.device)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the plan states the error
            return ThermalCrosstalk(display.sigma_px, shares.taps(self.settings)).to(self.device)

    @cached_property
    def heat(self) -> ThermalCrosstalk | HeatCycle:
        """Operator from heater phases to the phases that the frames show, with heat left from earlier frames."""
        return self.heat_after(self.crosstalk)

    def heat_after(self, crosstalk: ThermalCrosstalk) -> ThermalCrosstalk | HeatCycle:
        """The same for another spreading of the heat."""
        heat = self.settings.heat
        if heat is None:
            return crosstalk
        return HeatCycle(crosstalk, heat.frame_us * 1e-6, heat.time_constant_us * 1e-6).to(self.device)

    def problem(
        self, heat: ThermalCrosstalk | HeatCycle, views: Views, limit: float | None, *, shared: bool = False
    ) -> PECProblem:
        """The loss of F frames: squared differences of the amplitudes in all views, with one scale for each colour.

        With ``shared``, the processes of a run compute it together, and all of them must call it.
        """
        return PECProblem(
            heat,
            self._intensities(views.operator) if shared and process_count()[1] > 1 else views.operator,
            views.images,
            frames=True,
            amplitude=True,
            scale_free=True,
            # Views through small pupils are darker, and count as if they were as bright as the others.
            mask=self._weights(views),
            limit=None if limit is None else _PENALTY_FROM * limit,
            light_weight=self.settings.light_weight,
        )

    def _intensities(self, whole: PupilViews) -> SharedIntensity:
        """The images of all views, of which this process computes those of some frames and colours."""

        def own(colours: Sequence[int]) -> PupilViews:
            if len(colours) == len(whole.wavelengths):
                return whole
            return whole.select(range(len(whole.views)), colours)

        return SharedIntensity(own, len(whole.wavelengths), self.settings.frames)

    def _weights(self, views: Views) -> Tensor:
        radii = torch.tensor([view.radius for view in views.operator.views])
        return (self.radius / radii).sqrt()[:, None, None].to(self.device)

    def random_fields(self, planes: slice = slice(None)) -> Tensor:
        """Fields [F, C, H, W] at the array of all sources of the chosen planes, with random phases in each frame."""
        settings = self.settings
        generator = torch.Generator().manual_seed(settings.seed)
        shape = settings.frames, len(settings.wavelengths), *self.grid.shape
        wavelengths = torch.tensor(settings.wavelengths, dtype=torch.float64)
        total = torch.zeros(shape, dtype=torch.complex64)
        for depth, light in zip(self.depths[planes], self.light[planes], strict=True):
            phases = 2 * math.pi * torch.rand(shape, generator=generator)
            sources = light.cpu().sqrt() * phasor(phases)
            total += propagate(sources, self.grid, wavelengths, depth, tolerance=_TOLERANCE)
        return total.to(self.device)

    def kinoform(self, fields: Tensor, crosstalk: ThermalCrosstalk) -> Tensor:
        """Heater phases >= 0 for the phases of ``fields``, deconvolved; pi is added, so that few need cooling."""
        return deconvolved(crosstalk, fields.angle())

    def solver(self, crosstalk: ThermalCrosstalk) -> LBFGS:
        """L-BFGS with the preconditioner of the heat kernel, for views that are the same in each step."""
        rule = {"tolerance": shares.stop(self.settings, self.budget), "patience": shares.PATIENCE}
        return LBFGS(max_steps=self.settings.steps, precondition=spread_preconditioner(crosstalk.kernel), **rule)

    def optimise(
        self,
        heat: ThermalCrosstalk | HeatCycle,
        crosstalk: ThermalCrosstalk,
        limit: float | None,
        progress: Callback | None = None,
        resume: State | None = None,
    ) -> Solution:
        """Heater phases for the trained views and a model of the heat, from the kinoforms of random fields.

        All processes of a run must call this.
        """
        start = self.kinoform(self.random_fields(), crosstalk).to(self.dtype)
        per_step = self.settings.eye.per_step
        if per_step is None:
            problem = self.problem(heat, self.trained, limit, shared=True)
            return self.solver(crosstalk)(problem, start, callback=progress, resume=resume)
        whole, parts = range(len(self.foci)), range(len(self.foci), len(self.trained.operator.views))
        groups = [Group(whole, min(FOCI_PER_STEP, len(whole))), Group(parts, per_step)]
        loss = self.sampled(heat, self.trained, groups, limit)
        return adam(self.settings.steps)(loss, start, callback=progress, resume=resume)

    def sampled(
        self, heat: ThermalCrosstalk | HeatCycle, views: Views, groups: Sequence[Group], limit: float | None
    ) -> SampledViews:
        """The loss of views of which each step takes some of each group at random, computed by all processes."""

        def problem(drawn: list[int]) -> PECProblem:
            return self.problem(heat, views.select(drawn), limit, shared=True)

        return SampledViews(problem, groups, self.settings.seed + _VIEWS_SEED)

    def solve(self, progress: Callback | None = None, resume: State | None = None) -> Solution:
        """Heater phases [F, C, H, W] that form all views at once, from the kinoforms of random fields.

        All processes of a run must call this.
        """
        return self.optimise(self.heat, self.crosstalk, self.settings.limit, progress, resume)

    def within_limit(self, phase: Tensor) -> Tensor:
        """Heater phases scaled down where a phase after spreading exceeds the limit."""
        return limit_peak_phase(self.settings.limit, phase, self.heat)

    def emitted(self, phase: Tensor) -> Tensor:
        """Fields [F, C, H, W] that heater phases of F frames emit."""
        return phasor(self.heat(phase.to(self.device)))


def deconvolved(crosstalk: ThermalCrosstalk, phase: Tensor) -> Tensor:
    """Heater phases >= 0, [..., H, W] in rad, after whose spread the array shows ``phase``, wrapped, plus pi.

    With pi added, few heaters would have to cool, which they cannot.
    """
    return deconvolve(crosstalk, phase % (2 * math.pi) + math.pi)


def with_planes(scene: VolumeExperiment, settings: JointSettings, count: int) -> VolumeExperiment:
    """The scene of a run on ``count`` planes."""
    return replace(scene, settings=VolumeSettings.model_validate(volume_settings(settings, count)))


def build(settings: JointSettings) -> JointExperiment:
    """Load the inputs. ConfigError for a volume, transfer function or heat kernel that cannot be read or used."""
    scene = build_volume(VolumeSettings.model_validate(volume_settings(settings)))

    def slab_error(count: int) -> float:
        return with_planes(scene, settings, count).single_error

    experiment = JointExperiment(settings, with_planes(scene, settings, shares.choose_planes(settings, slab_error)))
    _ = experiment.crosstalk  # read now, so that its errors are reported
    return experiment
