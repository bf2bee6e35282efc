"""The computations whose times on each device are charted."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.experiments.joint.experiment import JointExperiment, Views
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.registry import find_kind, load_config
from holotorch.experiments.tracking_benchmark.methods import as_camera
from holotorch.experiments.volume.chart import PITCH, TABLE, WAVELENGTHS, WHOLE, Scene, ThesisConvolution
from holotorch.hologram import AxialHologram
from holotorch.optics import Display, Eye, Propagator, PupilViews, Retina, View
from holotorch.optics.viewing.display_geometry import eyepiece_distance
from holotorch.tracking import CatheterTracker, ChannelOrder, PhotometricFit, ThesisTracker
from holotorch.tracking.simulation.trials import conditions
from holotorch.tracking.simulation.world import Case, World

THESIS, OURS = "thesis's convolutions (Algorithm 5)", "axial nodes, 3e-3"
_PLANES = 3  # of the thesis's method, whose time is scaled to all planes and colours
# The thesis's display: a scene 30 mm from the hologram appears 120 mm in front of an eye 50 mm behind the eyepiece.
_SCENE, _SEEN, _FOCAL_LENGTH, _BEHIND = 30e-3, 120e-3, 20e-3, 50e-3  # metres


@dataclass(frozen=True)
class Amount:
    """Sizes of the tasks; ``steps`` of a solver, ``frames`` of a camera, ``rounds`` on the processor and on a GPU."""

    side: int = WHOLE  # of holograms, retina and array, in pixels
    scenes: tuple[str, ...] = tuple(TABLE)
    pec: int = 256
    steps: int = 50
    frames: int = 32
    rounds: tuple[int, int] = (3, 7)


FULL = Amount()
QUICK = Amount(128, ("Tooth",), 32, 3, 2, (1, 1))


@dataclass(frozen=True)
class Task:
    """A computation.

    Attributes:
        name: What is computed, with its size.
        method: How, where there are several methods.
        unit: What the seconds are of.
        build: Prepares it on a device, and returns a call that computes it there.
        times: Factor from the seconds of a call to those of a unit.
        thesis: Seconds of the unit on the thesis's GPU; None where it states none.
    """

    name: str
    method: str
    unit: str
    build: Callable[[torch.device], Callable[[], Tensor]]
    times: float = 1.0
    thesis: float | None = None


def tasks(amount: Amount) -> Iterator[Task]:
    """All computations, one after another."""
    part = WHOLE // amount.side
    for name in amount.scenes:
        millimetres, planes, thesis = TABLE[name]
        scene = Scene(amount.side, millimetres / 1e3 / part, planes // part)
        about = f"{name}, {scene.planes} planes, {amount.side} px", "hologram, three colours"
        own = thesis if part == 1 else None
        factor = scene.planes / _PLANES * len(WAVELENGTHS)
        yield Task(about[0], THESIS, about[1], partial(_convolutions, scene), factor, own)
        yield Task(about[0], OURS, about[1], partial(_axial, scene), 1.0, own)
    side = amount.side
    yield Task(f"PEC, {amount.pec} px, three colours", "APG", "step", partial(_pec, amount), 1 / amount.steps)
    yield Task(f"Propagator, {side} px, three colours", "", "forward and backward", partial(_propagator, side))
    yield Task(f"Retina, {side} px, three colours", "", "forward and backward", partial(_retina, side))
    yield Task(f"joint correction, {side} px, three colours, five foci", "", "step of a frame", partial(_joint, side))
    each = 1 / amount.frames
    for method, tracker in (("thesis, kornia", ThesisTracker), ("ours, cold", CatheterTracker)):
        build = partial(_tracked, amount.frames, tracker)
        yield Task(f"catheter, batch of {amount.frames} frames, 1080p", method, "frame", build, each)
    fitted = partial(_fitted, amount.frames)
    yield Task(f"catheter, batch of {amount.frames} frames, 1080p", "PhotometricFit", "frame", fitted, each)


def _convolutions(scene: Scene, device: torch.device) -> Callable[[], Tensor]:
    return partial(ThesisConvolution(replace(scene, device=device), WAVELENGTHS[0]), _PLANES)


def _axial(scene: Scene, device: torch.device) -> Callable[[], Tensor]:
    planes, phase = torch.stack([*scene.amplitudes()]).to(device), scene.phase.to(device)
    colours = [AxialHologram(scene.grid, each, scene.depths, stride=2, tolerance=3e-3) for each in WAVELENGTHS]
    colours = [operator.to(device) for operator in colours]
    for operator in colours:
        operator.design((planes.shape[-2], planes.shape[-1]))
    return lambda: torch.stack([operator.accumulate(planes, phase) for operator in colours])


def _pec(amount: Amount, device: torch.device) -> Callable[[], Tensor]:
    solver = f"solver={{kind: apg, step: 1.0, max_steps: {amount.steps}, patience: 1000000}}"
    settings = load_config("configs/pec/fourier.yaml", [f"grid.shape=[{amount.pec},{amount.pec}]", solver])
    experiment = find_kind(settings.experiment).build(settings)
    assert isinstance(experiment, PECExperiment)
    experiment = replace(experiment, device=device)
    return lambda: experiment.intensity(experiment.heater_phases(experiment.solve().x))


def _propagator(side: int, device: torch.device) -> Callable[[], Tensor]:
    return _backward(Propagator(Grid(side, PITCH), WAVELENGTHS, _SCENE).to(device), side, device)


def _retina(side: int, device: torch.device) -> Callable[[], Tensor]:
    lens = eyepiece_distance(_SCENE, _SEEN, _FOCAL_LENGTH, _BEHIND)
    setup = Display(lens, _FOCAL_LENGTH, _BEHIND), Eye(1.5e-3, accommodation=_SEEN)
    return _backward(Retina(Grid(side, PITCH), WAVELENGTHS, *setup, plane=_SCENE).to(device), side, device)


def _backward(module: Callable[[Tensor], Tensor], side: int, device: torch.device) -> Callable[[], Tensor]:
    """Gradient of the squared light that a module forms of a random phase."""
    generator = torch.Generator().manual_seed(3)
    phase = (2 * torch.pi * torch.rand(len(WAVELENGTHS), side, side, generator=generator)).to(device).requires_grad_()

    def step() -> Tensor:
        formed = module(torch.polar(torch.ones_like(phase), phase))
        light = intensity(formed) if formed.is_complex() else formed
        return torch.autograd.grad(light.square().sum(), phase)[0]

    return step


def _joint(side: int, device: torch.device) -> Callable[[], Tensor]:
    length = 10.0 * side / 128  # mm: the rays of the configuration's 128 px, over an array as many times as large
    changes = [
        "volume={phantom: shells, samples: 64}",
        f"view.width={0.092 * length} mm",
        f"display={{shape: [{side},{side}], pitch: 9 um, distance: {length} mm, depth: {0.8 * length} mm, planes: 5, "
        "sigma_px: 0.66, max_phase: 12.566}",
        "frames=1",
        "report.baselines=[]",
        f"device={device.type}",
    ]
    settings = load_config("configs/joint/teapot.yaml", changes)
    experiment = find_kind(settings.experiment).build(settings)
    assert isinstance(experiment, JointExperiment)
    pupils = [View(focus, experiment.radius) for focus in experiment.foci]
    views = PupilViews(experiment.grid, WAVELENGTHS, pupils, longest=experiment.padding * max(experiment.foci))
    generator = torch.Generator().manual_seed(4)
    images = torch.rand(
        len(WAVELENGTHS), len(pupils), side, side, generator=generator
    )  # the time is that of any images
    problem = experiment.problem(experiment.heat, Views(views.to(device), images.to(device)), None)
    phase = 2 * torch.pi * torch.rand(1, len(WAVELENGTHS), side, side, generator=generator)
    phase = phase.to(device).requires_grad_()
    return lambda: torch.autograd.grad(problem(phase).sum(), phase)[0]


def _tracked(
    count: int, tracker: type[ThesisTracker] | type[CatheterTracker], device: torch.device
) -> Callable[[], Tensor]:
    world, _, frames = _plain(count)
    track = tracker(world.camera, world.catheter, channels=ChannelOrder.RGB)
    frames = frames.to(device)
    return lambda: torch.stack([pose.tip.detach().cpu() for pose in track(frames)])


def _fitted(count: int, device: torch.device) -> Callable[[], Tensor]:
    """The fit alone, from poses that are 2 mm off; tips [count, 3]."""
    world, cases, frames = _plain(count)
    fit = PhotometricFit(world.camera, world.catheter).to(device)
    tips, directions = (torch.stack([getattr(case, name) for case in cases]) for name in ("tip", "direction"))
    start = tips + torch.tensor([1e-3, -1e-3, 1.4e-3], dtype=torch.float64)
    frames, start, directions = (each.to(device) for each in (frames, start, directions))
    return lambda: fit(frames, start, directions).tip


def _plain(count: int) -> tuple[World, list[Case], Tensor]:
    """A world, ``count`` of its frames of a plain desk, four of them different, and their light [count, 3, H, W]."""
    world = World()
    seeds = [replace(world, seed=world.seed + seed) for seed in range(min(4, count))]
    plain = [next(case for case in conditions(each) if case.name == "plain") for each in seeds]
    frames = torch.stack([as_camera(case.frame()) for case in plain])
    return world, (plain * count)[:count], frames.repeat(-(-count // len(frames)), 1, 1, 1)[:count]
