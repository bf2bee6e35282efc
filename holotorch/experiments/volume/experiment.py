"""The volume experiment: the volume of a configuration, its renderer and a hologram for each colour."""

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.planning.tolerance import Budget
from holotorch.experiments.planning.tolerance import Part as ErringPart
from holotorch.experiments.runs.environment import find_device
from holotorch.experiments.volume.config import MOST_SAMPLES, TransferSettings, VolumeSettings, VolumeSource
from holotorch.hologram import AxialHologram, ConvolutionHologram, HologramPlan, plan_hologram
from holotorch.io.catalogue import PUBLISHED, fetch_volume
from holotorch.io.colour_tables import colour_shares, picture_matrix
from holotorch.io.files import read_bytes
from holotorch.io.volumes import load_volume
from holotorch.optics import plan_propagation
from holotorch.scene import phantoms, transfer_presets
from holotorch.scene.adaptive import sample_adaptively
from holotorch.scene.layers import SourceLayers
from holotorch.scene.lighting import Lighting, Scattering
from holotorch.scene.phases import PointPhases, point_phases, random_phase, smooth_phase
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Triple, Volume

_CATALOGUE = {"teapot": "boston_teapot"}  # names of the thesis that differ from those of the catalogue
_COUNTED = 1_000_000  # largest number of voxels in the histogram
_APART = 5.0  # Gaussian noise that is divided has means 2.7 deviations apart, noise cut off at 0 up to 4.9
HOLOGRAM, REFOCUSING = "hologram", "refocusing"  # parts that share the tolerance of a run
_SINGLE = 5e-6  # tolerance below which fields are complex128: 10 times the rounding of a sum in complex64
_SMOOTH = 8  # correlation length of smooth phases, in rays
_CLOSE = 0.003  # predicted error above which slabs are sampled more than once; at 1 %, surfaces have rings
_QUICK_PLANES = 1000  # planes of a preview at most; as many slabs as voxels along the depth are thin enough

# Arguments in the messages of ``load_volume``, and the settings that stand for them; those named in full come first.
_SETTINGS = (
    (r"spacing=\(z, y, x\) in metres, such as \(1e-3, 5e-4, 5e-4\)", "spacing=[1e-3,5e-4,5e-4] (z, y, x in metres)"),
    (r"spacing=1, unit='relative'", "spacing=[1,1,1] unit=relative"),
    (r"unit='relative'", "unit=relative"),
    (r"shape=\(D, H, W\) and dtype=(, such as 'uint8')?", "shape=[D,H,W] dtype=uint8"),
    (r"shape=\(([\w, ]+)\)", r"shape=[\1]"),
    (r"(?<![\w.])(spacing|shape|dtype|unit)=", r"volume.\1="),
)


# Rotations, for vectors (z, y, x), that make a direction of the volume point up, which is -y: about the horizontal axis
# for z, and about the axis of sight for x and y.
_STANDING = {
    "-y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "-z": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "x": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-x": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


@dataclass(frozen=True)
class VolumeExperiment:
    """The volume, geometry and operators that a configuration describes."""

    settings: VolumeSettings
    volume: Volume
    synthetic: str  # the reason why the volume is a phantom; empty for real data
    device: torch.device

    @property
    def grid(self) -> Grid:
        """Pixels of the hologram."""
        height, width = self.settings.hologram.shape
        return Grid((height // self.settings.scale, width // self.settings.scale), self.settings.hologram.pitch)

    @property
    def distance(self) -> float:
        """Distance of the volume's middle from the hologram, in metres."""
        return self.settings.hologram.distance / self.settings.scale

    @property
    def stride(self) -> int:
        """Pitch of the rays in pixels."""
        rays = self.settings.hologram.rays
        return 1 if rays is None else self.settings.hologram.shape[0] // rays

    @property
    def rays(self) -> Grid:
        """Grid of the rays, which is the same on all planes."""
        (height, width), (py, px) = self.grid.shape, self.grid.pitch
        return Grid((height // self.stride, width // self.stride), (py * self.stride, px * self.stride))

    @property
    def width(self) -> float:
        """Length of the volume's longest side, in metres."""
        width = self.settings.view.width
        return width / self.settings.scale if width else max(self.grid.extent)

    @cached_property
    def rotation(self) -> Tensor:
        """Rotation matrix of the volume about its middle, for vectors (z, y, x)."""
        view = self.settings.view
        a, e = math.radians(view.azimuth_deg), math.radians(view.elevation_deg) * (1 if view.front == "far" else -1)
        about_y = ((math.cos(a), 0, math.sin(a)), (0, 1, 0), (-math.sin(a), 0, math.cos(a)))
        about_x = ((math.cos(e), -math.sin(e), 0), (math.sin(e), math.cos(e), 0), (0, 0, 1))
        x, y = (torch.tensor(rows, dtype=torch.float64) for rows in (about_x, about_y))
        mirror = torch.tensor([1.0, 1.0, 1.0 if view.front == "near" else -1.0], dtype=torch.float64)  # see _unmirrored
        if view.up == "head":
            standing = _facing(self.volume, view.front)
        else:
            standing = mirror[:, None] * torch.tensor(_STANDING[view.up], dtype=torch.float64) * mirror
        return (mirror[:, None] * (x @ y) * mirror @ standing).round(decimals=15)

    @cached_property
    def depths(self) -> tuple[float, ...]:
        """Depths of the planes in metres, in the order in which rays meet them."""
        depths, scale = self.settings.hologram.depths, self.settings.scale
        if isinstance(depths, int):  # planes in the middle of slabs of equal thickness
            count, middle = max(1, depths // scale), self.distance
            extent = torch.tensor(self.volume.extent, dtype=torch.float64)
            half = (self.rotation.abs()[0] @ (extent / extent.max() * self.width)).item() / 2
            step = 2 * half / count
            depths = tuple(scale * (middle - half + (j + 0.5) * step) for j in range(count))
        return tuple(sorted((depth / scale for depth in depths), reverse=self.settings.view.front == "far"))

    @cached_property
    def plans(self) -> list[HologramPlan]:
        """The plan of each colour's hologram."""
        try:
            plans = [self._plan(wavelength) for wavelength in self.settings.wavelengths]
        except ValueError as error:
            raise ConfigError([f"hologram: {error}"]) from error
        self._budget.predict(HOLOGRAM, max(plan.predicted_error for plan in plans))
        return plans

    def _plan(self, wavelength: float) -> HologramPlan:
        scene = self.grid, wavelength, self.depths, self.rays.shape
        options = {
            "stride": self.stride,
            "tolerance": self._budget.share(HOLOGRAM),
            "cone": self.settings.hologram.cone,
        }
        return plan_hologram(*scene, **options, dtype=self.dtype)

    @cached_property
    def _budget(self) -> Budget:
        given = self.settings.hologram.tolerance
        parts = [ErringPart(HOLOGRAM, 1e-3, "hologram.tolerance", given), ErringPart(REFOCUSING, 3e-3)]
        return Budget(self.settings.tolerance, parts)

    @cached_property
    def budget(self) -> Budget:
        """Tolerances and predicted errors of hologram and refocusing; the latter at the ends of the scene."""
        _ = self.plans
        tolerance, ends = self._budget.share(REFOCUSING), {-min(self.depths), -max(self.depths)}
        options = {"tolerance": tolerance, "dtype": self.dtype}
        plans = [plan_propagation(self.grid, self.settings.wavelengths, end, **options) for end in ends]
        self._budget.predict(REFOCUSING, max(plan.predicted_error for plan in plans))
        return self._budget

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the fields: complex128 if a tolerance is below 10 times the rounding error of complex64."""
        asked = self.settings.tolerance, self.settings.hologram.tolerance
        least = min((error for error in asked if error is not None), default=1.0)
        return torch.complex128 if least < _SINGLE else torch.complex64

    @cached_property
    def transfer(self) -> TransferFunction:
        """Transfer function from a value of the volume to opacity and the colours that the wavelengths show."""
        settings = self.settings.transfer
        if settings.preset is None:
            transfer = _transfer(settings)
        else:
            make = getattr(transfer_presets, settings.preset)
            transfer = make(*self._range(make(0.0, 1.0).visible_from))
        return _shared(transfer, self.settings.wavelengths).to(self.device)

    def _range(self, share: float) -> tuple[float, float]:
        """Values between which a preset lies that shows nothing within this share of them."""
        stated = self.settings.transfer
        if stated.low is not None and stated.high is not None:
            return stated.low, stated.high
        if (begin := stated.visible_from) is None:
            return self.histogram_range
        high = self.histogram_range[1] if stated.high is None else stated.high
        if begin >= high:
            raise ValueError(f"transfer.visible_from must be below {high:g}, got {begin:g}; give transfer.high, too")
        return (begin - share * high) / (1 - share), high

    @cached_property
    def preset_range(self) -> tuple[float, float] | None:
        """Range of a preset, from the histogram, if the configuration does not state it; None otherwise."""
        transfer = self.settings.transfer
        stated = transfer.low is not None or transfer.visible_from is not None
        return None if transfer.preset is None or stated else self.histogram_range

    @cached_property
    def histogram_range(self) -> tuple[float, float]:
        """Range of a preset that the histogram proposes. ValueError if all voxels have the same value."""
        from skimage.filters import threshold_otsu

        values = self.counted
        if values.min() == values.max():
            raise ValueError(f"all voxels have the value {values.min():g}; give transfer.low and transfer.high")
        low, high = float(threshold_otsu(values)), float(np.quantile(values, 0.999))
        return (low, high) if low < high else (low, float(values.max()))

    @cached_property
    def counted(self) -> np.ndarray:
        """Values of evenly spaced voxels, at most two million, float64 [n]: those of histogram and percentiles."""
        values = self.volume.values.detach().flatten()
        return values[:: max(1, len(values) // _COUNTED)].double().cpu().numpy()

    @cached_property
    def background(self) -> float | None:
        """Value up to which voxels are background; None where the histogram does not show it.

        It is the lower threshold of Otsu's method with three parts: dark, faint and bright. One threshold leaves faint
        tissue in the dark part. Where the dark and the faint part are nearer to each other than ``_APART`` deviations
        of the dark one, the method has only divided its noise.
        """
        from skimage.filters import threshold_multiotsu

        values = self.counted
        try:
            first, second = threshold_multiotsu(values)
        except ValueError:  # fewer than three values
            return None
        dark, faint = values[values <= first], values[(values > first) & (values <= second)]
        deviation = max(dark.std(), (values.max() - values.min()) / 256)  # the histogram has 256 bins
        return float(first) if faint.mean() - dark.mean() > _APART * deviation else None

    @cached_property
    def samples(self) -> int:
        """Samples of the volume along a ray within each slab."""
        if (given := self.settings.view.samples) is not None:
            return given
        if self.single_error <= _CLOSE:
            return 1
        return min(MOST_SAMPLES, 2 * max(self.volume.shape) // len(self.depths) + 1)  # two for each voxel

    @cached_property
    def single_error(self) -> float:
        """Predicted relative L2 error of the rendering with one sample for each slab."""
        return self._slab_error(1)

    @cached_property
    def slab_error(self) -> float:
        """Predicted relative L2 error of the rendering."""
        return self.single_error if self.samples == 1 else self._slab_error(self.samples)

    def _slab_error(self, samples: int) -> float:
        return self.sampler(samples=samples).slab_error(self.volume)

    def sampler(self, seed: int = 0, samples: int | None = None, depths: Sequence[float] | None = None) -> DVRSampler:
        """The renderer with the random phases of a realisation, by default with the samples and depths of the run."""
        generator = torch.Generator().manual_seed(self.settings.seed + seed)
        phases: dict[str, Callable[[Grid], Tensor | PointPhases] | None] = {
            "ray": lambda grid: random_phase(grid, generator=generator),
            "point": lambda grid: point_phases(grid, generator=generator),
            "smooth": lambda grid: smooth_phase(grid, _SMOOTH * grid.pitch[0], generator=generator),
            "constant": None,
        }
        sampler = DVRSampler(
            self.transfer,
            self.rays,
            depths or self.depths,
            width=self.width,
            distance=self.distance,
            rotation=self.rotation,
            lighting=self._lighting(),
            phase=phases[self.settings.phase],
            samples=samples or self.samples,
        )
        sampler.checks_slabs = False  # the plan states the error
        return sampler

    def rendering(self) -> tuple[Tensor, Tensor]:
        """Direct volume rendering [C, h, w], a channel for each wavelength, and the opacity of the rays [h, w]."""
        with torch.no_grad():
            picture, opacity = self.sampler().render(self.volume)
        return picture[: len(self.settings.wavelengths)].cpu(), opacity.cpu()

    def depth_map(self) -> Tensor:
        """Mean depth in metres of what each ray shows, [h, w]; 0 where all is transparent.

        Of more than a thousand planes, neighbours are joined as by :meth:`quick_rendering`.
        """
        with torch.no_grad():
            return self.sampler(depths=_joined(self.depths, _QUICK_PLANES)).depth_map(self.volume).cpu()

    def quick_rendering(self, side: int, *, lit: bool = True) -> Tensor:
        """The same picture on at most ``side`` rays along each side, without lighting and scattering unless ``lit``.

        Of more than a thousand planes, neighbours are joined to one in their middle, whose slab is as thick as theirs.
        """
        rays = self.rays
        step = max(1, -(-max(rays.shape) // side))
        height, width = (max(1, n // step) for n in rays.shape)
        sampler = DVRSampler(
            self.transfer,
            Grid((height, width), (rays.pitch[0] * step, rays.pitch[1] * step)),
            _joined(self.depths, _QUICK_PLANES),
            width=self.width,
            distance=self.distance,
            rotation=self.rotation,
            lighting=self._lighting() if lit else None,
            samples=self.samples,
        )
        sampler.checks_slabs = False  # the plan states the error
        with torch.no_grad():
            return sampler.render(self.volume)[0][: len(self.settings.wavelengths)].cpu()

    def _lighting(self) -> Lighting | Scattering | None:
        view = self.settings.view
        if (light := view.scattering) is not None:
            strengths = {name: getattr(light, name) for name in ("ambient", "strength", "anisotropy", "samples")}
            towards, half_angle = self._in_scene(light.towards), math.radians(light.half_angle_deg)
            return Scattering(towards, half_angle, seed=self.settings.seed, **strengths)
        return Lighting(self._in_scene(Lighting.towards)) if view.lighting else None

    def _in_scene(self, towards: Triple) -> Triple:
        """A direction (z, y, x) with z away from the observer, as one with z away from the hologram."""
        z, y, x = towards
        return (-z if self.settings.view.front == "far" else z), y, x

    def layers(self, seed: int = 0) -> SourceLayers:
        """The light sources of the planes with the random phases of a realisation."""
        sampler, contrast = self.sampler(seed), self.settings.view.adaptive
        return (
            sampler(self.volume) if contrast is None else sample_adaptively(sampler, self.volume, contrast=contrast)[0]
        )

    def hologram(
        self, seed: int = 0, advance: Callable[[], object] = lambda: None, part: "Part | None" = None
    ) -> tuple[Tensor, float]:
        """Fields [C, H, W] of the holograms of one realisation, and the seconds spent on rendering.

        Each plane is rendered once and added to all colours. ``seed`` is the number of the realisation of the phases;
        ``advance`` is called after every plane; ``part`` selects planes and colours, all by default.
        """
        layers = self.layers(seed)
        sums = []
        for plan in self.plans:
            assert isinstance(plan.operator, AxialHologram | ConvolutionHologram)
            sums.append(plan.operator.accumulator(self.rays.shape, layers.phase))
        rendering_seconds, started = 0.0, time.perf_counter()
        with torch.no_grad():
            for j, plane in enumerate(layers.amplitudes()):
                rendering_seconds += time.perf_counter() - started
                for colour, total in enumerate(sums):
                    if part is None or part.takes(colour, j):
                        total.add(j, self.precise(plane[colour]))
                advance()
                started = time.perf_counter()
        fields = []
        while sums:  # one by one, so that the memory of each spectrum is freed before the next is transformed
            fields.append(sums.pop(0).finish().to(self.device))
        return torch.stack(fields), rendering_seconds

    def precise(self, plane: Tensor) -> Tensor:
        """A plane of sources, in complex128 if that is the precision of the fields."""
        return plane.to(self.dtype) if self.dtype == torch.complex128 else plane

    @property
    def refocus(self) -> list[float]:
        """Configured depths of the refocused pictures, in metres; empty if there are none."""
        return [depth / self.settings.scale for depth in self.settings.report.refocus or ()]


def _joined(depths: Sequence[float], limit: int) -> Sequence[float]:
    """``depths`` if they are at most ``limit``; otherwise the means of that many groups of neighbours."""
    count = len(depths)
    if count <= limit:
        return depths
    groups = (depths[count * k // limit : count * (k + 1) // limit] for k in range(limit))
    return [sum(group) / len(group) for group in groups]


@dataclass(frozen=True)
class Part:
    """The share of one of several processes: the processes divide the colours, then the planes of a colour."""

    rank: int  # index of this process
    count: int  # number of processes
    planes: int  # number of planes in the scene
    colours: int = 3  # number of wavelengths

    def takes(self, colour: int, plane: int) -> bool:
        """Whether this process adds ``plane`` of ``colour``."""
        every = self.colours
        if self.count <= every:
            return colour % self.count == self.rank
        blocks = (self.count - colour + every - 1) // every  # number of processes whose rank modulo C is this colour
        return self.rank % every == colour and plane * blocks // self.planes == self.rank // every


def build(settings: VolumeSettings) -> VolumeExperiment:
    """Load the inputs. ConfigError for a volume or transfer function that cannot be read or used."""
    volume, synthetic = open_volume(settings.volume)
    try:
        volume.check_finite()
        volume = _unmirrored(volume, settings.view.front)
        device = find_device(settings.device)
        volume = replace(volume, values=volume.values.to(device))
        experiment = VolumeExperiment(settings, volume, synthetic, device)
        _ = experiment.transfer, experiment.rotation  # computed now, so that errors are reported
    except ValueError as error:
        raise ConfigError([f"volume: {error}"]) from error
    except OSError as error:
        raise ConfigError([f"transfer.file: {error.filename}: {error.strerror}"]) from error
    try:
        if len(settings.wavelengths) == 2 or len(settings.wavelengths) > 3:
            picture_matrix(settings.wavelengths)
    except ValueError as error:
        hint = "; two wavelengths are shown in their own colours" if len(settings.wavelengths) == 2 else ""
        raise ConfigError([f"wavelengths: {error}{hint}"]) from error
    if (nearest := min(experiment.depths)) <= 0:
        raise ConfigError([f"hologram.distance: the volume extends behind the hologram, to {nearest:g} m"])
    return experiment


def _facing(volume: Volume, front: str) -> Tensor:
    """Rotation matrix [3, 3], for vectors (z, y, x), by which a patient stands upright and faces the observer.

    It takes axes of the voxels to axes of the scene, so that a scan that was tilted stays so. ConfigError if the volume
    does not say how a patient lies.
    """
    sides = [volume.frame[::-1].find(letter) for letter in "SIAP"]  # axes z, y, x of the file
    if max(sides[:2]) < 0 or max(sides[2:]) < 0:
        raise ConfigError(
            [
                "view.up: head is known for files that say how a patient lies (DICOM, NIfTI, MetaImage, NRRD), and "
                "this volume does not; give the direction of the voxels that points up: -y, y, z, -z, x or -x"
            ]
        )
    free, axes = torch.ones(3, dtype=torch.float64), []
    for positive, negative in (sides[:2], sides[2:]):
        along = torch.tensor(volume.orientation, dtype=torch.float64)[:, max(positive, negative)]
        along, axis = along if negative < 0 else -along, int((along.abs() * free).argmax())
        free[axis] = 0
        axes.append(torch.eye(3, dtype=torch.float64)[axis] * along[axis].sign())
    head, face = axes
    depth = face if front == "far" else -face
    return torch.stack([depth, -head, torch.linalg.cross(depth, -head)])


def _unmirrored(volume: Volume, front: str) -> Volume:
    """The volume, mirrored along x where its observer would see the mirror image of what was scanned.

    The columns of every picture go to the right and its rows downwards. From the hologram's side, depths go away from
    the observer: these three form a right-handed frame, and from the far side a left-handed one. The voxels of a file
    may have either.
    """
    return volume if volume.left_handed == (front == "far") else volume.mirrored()


def open_volume(source: VolumeSource) -> tuple[Volume, str]:
    """The volume, and the reason why it is a phantom, "" for real data. ConfigError if it cannot be read."""
    spacing = source.spacing[0] if source.spacing and len(source.spacing) == 1 else source.spacing
    try:
        if source.path:
            options = {"spacing": spacing, "shape": source.shape, "dtype": source.dtype, "unit": source.unit}
            volume = load_volume(source.path, **options)
            z, y, (a, b, c) = volume.orientation
            return replace(volume, orientation=(z, y, (-a, -b, -c))) if source.left_handed else volume, ""
    except ValueError as error:
        raise ConfigError([f"volume: {_as_settings(str(error))}"]) from error
    except ImportError as error:
        raise ConfigError([f"volume.path: {source.path}: {error}"]) from error
    except OSError as error:
        raise ConfigError([f"volume.path: {source.path}: {error.strerror or error}"]) from error
    reason = "a phantom was asked for"
    if source.scene:
        name = _CATALOGUE.get(source.scene, source.scene)
        reason = f"no checksum of {source.scene} is published; give its file as volume.path=FILE"
        if name in PUBLISHED:
            try:
                return fetch_volume(name, source.directory), ""
            except (OSError, ValueError) as error:
                cause = " ".join(str(error).split())
                reason = f"{source.scene} could not be fetched ({cause}); give its file as volume.path=FILE"
        if not source.phantom:
            raise ConfigError([f"volume.scene: {reason}, or volume.phantom to stand in for it"])
    assert source.phantom is not None
    return getattr(phantoms, source.phantom)(source.samples, dtype=torch.uint8), reason


def _as_settings(message: str) -> str:
    """A message of ``load_volume`` with its arguments written as settings, which a command can take as they are."""
    for argument, setting in _SETTINGS:
        message = re.sub(argument, setting, message)
    return message


def _shared(transfer: TransferFunction, wavelengths: Sequence[float]) -> TransferFunction:
    """The transfer function with a channel for each wavelength in place of red, green and blue.

    Compositing is linear in the colours, so they are mixed before the rendering instead of after it. With fewer than
    three wavelengths, the last channel is repeated.
    """
    if len(wavelengths) == 3:
        return transfer
    rows = colour_shares(wavelengths).tolist()
    rows += rows[-1:] * (3 - len(rows))
    colours = transfer.colours.detach()
    mixed = (colours @ torch.tensor(rows, dtype=colours.dtype).T).clamp(0, 1)
    opacities = transfer.opacities.detach()
    return TransferFunction(transfer.positions, mixed, opacities, unit_distance=transfer.unit_distance)


def _transfer(settings: TransferSettings) -> TransferFunction:
    """Transfer function of a file or of points."""
    if settings.file:
        return transfer_presets.transfer_from_json(read_bytes(Path(settings.file)).decode("utf-8"))
    assert settings.points is not None
    table = torch.tensor(settings.points)
    return TransferFunction(table[:, 0], table[:, 1:4], table[:, 4], unit_distance=settings.unit_distance)
