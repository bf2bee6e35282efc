"""Settings of the hologram of a volume."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import DEPTH, WIDTH
from holotorch.experiments.config.settings import (
    Count,
    Distance,
    ExistingArray,
    ExistingPath,
    GridSettings,
    Length,
    Number,
    Settings,
    Wavelength,
    number,
    plausible,
    several,
)

_MOST_WAVELENGTHS = 32
MOST_SAMPLES = 1024
Scene = Literal["tooth", "teapot", "bonsai", "engine", "c60", "hand"]
Phantom = Literal["shells", "c60", "marschner_lobb", "gaussian_ball"]


def _number_type(value: Any) -> Any:
    try:
        fits = not isinstance(value, str) or np.dtype(value).kind in "buif"
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise PydanticCustomError("dtype", "expected a type of number, such as uint8, float32, or '>i2' if big-endian")
    return value


def _in_front(value: float) -> float:
    if not value > 0:
        raise PydanticCustomError("depth", "expected a distance above zero, from the hologram or array to the scene")
    return value


Depth = Annotated[Distance, AfterValidator(_in_front)]


class VolumeSource(Settings):
    """A file (``path``), a scene of the public catalogue, or a synthetic phantom, in this order of precedence.

    If both a scene and a phantom are given, the phantom is used only if the scene cannot be fetched. ``spacing``
    (z, y, x), ``shape`` (D, H, W), ``dtype`` and ``unit`` supply what a file does not state; see ``load_volume``.
    ``left_handed``: the axes x, y, z of a file that does not say where they point form a left-handed frame, as of a
    stack of slices in the other order.
    ``directory`` is the cache of fetched scenes.
    """

    path: ExistingArray | None = None
    scene: Scene | None = None
    phantom: Phantom | None = None
    samples: Annotated[Count, Field(ge=4, le=512)] = 128  # samples of a phantom per axis; 512 take some seconds
    directory: str | None = None
    spacing: Annotated[tuple[Length, ...], BeforeValidator(several)] | None = None
    shape: tuple[Count, Count, Count] | None = None
    dtype: Annotated[str, BeforeValidator(_number_type)] | None = None
    unit: Literal["m", "relative"] | None = None
    left_handed: bool = False


class TransferSettings(Settings):
    """Colour and opacity: a preset between the values ``low`` and ``high`` of the volume, a JSON file, or ``points``.

    Without ``low`` and ``high``, a preset lies between Otsu's threshold, which divides the histogram into a dark and a
    bright part, and the value that 0.1 % of the voxels exceed. ``visible_from`` takes the place of ``low``, above which
    presets begin: the value from which on something is visible.

    Each point is [value, red, green, blue, opacity]; all but the value are in 0..1. The opacity is that of a path of
    length ``unit_distance``, in units of the longest side of the volume. ``transfer: bone`` is short for
    ``transfer: {preset: bone}``.
    """

    model_config = ConfigDict(json_schema_extra={"type": ["object", "string"]})

    preset: Literal["bone", "soft_tissue", "skin", "vessels", "industrial"] | None = None
    low: Number | None = None
    high: Number | None = None
    visible_from: Number | None = None
    file: ExistingPath | None = None
    points: tuple[tuple[Number, Number, Number, Number, Number], ...] | None = None
    unit_distance: Annotated[Number, Field(gt=0, le=1)] = 1 / 256

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        return {"preset": value} if isinstance(value, str) else value


class ScatteringSettings(Settings):
    """Light that the volume scatters once, see ``holotorch.scene.Scattering``.

    ``towards`` is the direction (z, y, x) to the light, with z away from the observer, y downwards and x to the right.

    ``half_angle_deg``: angle between the middle and the edge of the light. ``samples``: number of random directions.
    """

    towards: tuple[Number, Number, Number] = (-1.0, -0.5, -0.5)
    half_angle_deg: Annotated[Number, Field(ge=0, le=180)] = 20.0
    ambient: Annotated[Number, Field(ge=0, le=100)] = 0.2
    strength: Annotated[Number, Field(ge=0, le=100)] = 0.8
    anisotropy: Annotated[Number, Field(gt=-1, lt=1)] = 0.0
    samples: Annotated[Count, Field(le=4096)] = 16


class ViewSettings(Settings):
    """Orientation and size of the volume.

    ``up`` is the direction of the volume that points up: -y shows its first row on top; z or -z stands a scan in axial
    slices upright. ``head`` stands a patient upright, the face to the observer, if the file says how he lies. The
    volume is then rotated by ``azimuth_deg`` about the vertical axis, and by ``elevation_deg`` about the horizontal
    axis (x). ``width`` is the length of its longest side in metres, by default the longest side of the hologram.
    ``front`` says which end of the volume faces the observer: the one far from the hologram, for a display that forms
    the scene in front of it (by the conjugate field, as eye runs do), or the near one, for a virtual image behind it.
    Runs of kind joint put either end next to their array. Either observer sees the volume as it was scanned, not its
    mirror image.
    ``lighting`` shades points by the gradient of the volume; ``scattering`` in its place gives the volume shadows.
    ``adaptive``: follow all rays only where colours or opacity of every fourth ray differ by more than this.
    ``samples``: samples of the volume along a ray within the slab of each plane, whose light the plane shows; the
    thesis has 1. By default 1, or two for each voxel where 1 puts the rendering more than 0.3 % off that with very
    many.
    """

    up: Literal["-y", "y", "z", "-z", "x", "-x", "head"] = "-y"
    azimuth_deg: Number = 0.0
    elevation_deg: Number = 0.0
    width: Annotated[Length, plausible(WIDTH)] | None = None
    front: Literal["far", "near"] = "far"
    lighting: bool = False
    scattering: ScatteringSettings | None = None
    adaptive: Annotated[Number, Field(ge=0, le=1)] | None = None
    samples: Annotated[Count, Field(le=MOST_SAMPLES)] | None = None


class HologramSettings(GridSettings):
    """Pixels of the hologram, ``distance`` of the volume's middle, and number or distances of the planes (``depths``).

    ``rays`` is the number of rays along each side, by default one per pixel. ``cone`` is the type of the edge of a
    point's cone of light, see ``holotorch.hologram.cone``; by default the cheapest soft edge. ``tolerance``: allowed
    relative L2 error of the field; by default a share of the tolerance of the run, or 1e-3 if the run has none.
    """

    distance: Depth
    depths: Annotated[int, BeforeValidator(number), Field(ge=1, le=100000)] | tuple[Depth, ...] = 64
    rays: Count | None = None
    cone: Literal["full", "box", "disc", "taper", "band"] | None = None
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None


class VolumeReport(Settings):
    """Depths of the refocused pictures, and number of realisations of the random phases to average.

    The default depths are the 10, 50 and 90 % quantiles of the depths of the visible rays.
    """

    refocus: Annotated[tuple[Depth, ...], BeforeValidator(several)] | None = None
    seeds: Annotated[Count, Field(le=256)] = 1


Scale = Annotated[Count, Field(le=64)]


class VolumeSettings(Settings):
    """The hologram of a volume, which is rendered directly into light sources, and its refocused pictures.

    ``phase`` is the phase of the sources: ``point``, random for each source, so that planes do not interfere on
    average; ``ray``, random for each ray, as in the thesis, so that the planes of a colour interfere; ``smooth``, a
    smooth random function of the ray; or ``constant``. ``scale`` divides pixels, rays, distances, the volume's width
    and a given number of planes, which makes a small version of a scene. Three wavelengths show red, green and blue of
    the volume; a single one shows their mean; of two, the longer one shows the mean of red and green, the shorter one
    that of green and blue. More share the colours by their distance from 630, 530 and 450 nm. ``tolerance``: allowed
    relative L2 error of the refocused fields, divided between the hologram and its refocusing; without it, the two may
    err by 1e-3 and 3e-3.
    """

    experiment: Literal["volume"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None
    volume: VolumeSource
    transfer: TransferSettings
    view: ViewSettings = ViewSettings()
    hologram: HologramSettings
    wavelengths: Annotated[tuple[Wavelength, ...], BeforeValidator(several)]
    phase: Literal["point", "ray", "smooth", "constant"] = "point"
    scale: Scale = 1
    report: VolumeReport = VolumeReport()


def contradictions(settings: VolumeSettings) -> list[tuple[tuple[str | int, ...], str]]:
    """Settings that contradict each other: their keys, and what to change."""
    problems: list[tuple[tuple[str | int, ...], str]] = []
    source, transfer, hologram = settings.volume, settings.transfer, settings.hologram
    if not (source.path or source.scene or source.phantom):
        problems.append((("volume",), "expected a path, a scene or a phantom"))
    given = [name for name in ("preset", "file", "points") if getattr(transfer, name) is not None]
    if len(given) != 1:
        got = f"{' and '.join(given)}; 'transfer={{preset: bone}}' replaces the whole section" if given else "none"
        problems.append((("transfer",), f"expected one of preset, file or points, got {got}"))
    if transfer.visible_from is not None:
        if transfer.preset is None or transfer.low is not None:
            got = "no preset" if transfer.preset is None else "both"
            problems.append((("transfer", "visible_from"), f"expected in place of the low of a preset, got {got}"))
        elif transfer.high is not None and transfer.high <= transfer.visible_from:
            text = f"expected less than transfer.high, {transfer.high:g}, got {transfer.visible_from:g}"
            problems.append((("transfer", "visible_from"), text))
    elif (transfer.low is None) != (transfer.high is None):
        problems.append((("transfer",), "expected both low and high, or neither: then they follow from the histogram"))
    if transfer.low is not None and transfer.high is not None and transfer.low >= transfer.high:
        problems.append((("transfer",), "a preset needs low < high, the values of the volume between which it lies"))
    if transfer.points is not None and len(transfer.points) < 2:
        problems.append((("transfer", "points"), "expected at least 2 points"))
    if hologram.depths == ():
        problems.append((("hologram", "depths"), "expected a number of planes, or at least one distance, got none"))
    if isinstance(hologram.depths, tuple) and len(set(hologram.depths)) < len(hologram.depths):
        twice = next(depth for k, depth in enumerate(hologram.depths) if depth in hologram.depths[:k])
        problems.append((("hologram", "depths"), f"expected distances that all differ, got {twice:g} m twice"))
    if not 1 <= (count := len(settings.wavelengths)) <= _MOST_WAVELENGTHS:
        problems.append((("wavelengths",), f"expected 1 (grey) to {_MOST_WAVELENGTHS}, got {count}"))
    if count > 3 and len(set(settings.wavelengths)) < count:
        problems.append((("wavelengths",), "expected wavelengths that all differ"))
    side, rays = hologram.shape, hologram.rays
    if rays is not None and (side[0] % rays or side[1] % rays or side[0] // rays != side[1] // rays):
        message = f"expected a number that divides the hologram's sides {side}, both equally often, got {rays}"
        problems.append((("hologram", "rays"), f"{message}; 'hologram.rays=null' is one ray per pixel"))
    if settings.view.lighting and settings.view.scattering:
        problems.append((("view", "lighting"), "expected false with scattering, which takes its place"))
    if settings.view.scattering and not any(settings.view.scattering.towards):
        problems.append((("view", "scattering"), "expected towards to point to the light, got [0, 0, 0]"))
    width = settings.view.width or max(side[0] * hologram.pitch[0], side[1] * hologram.pitch[1])
    if isinstance(hologram.depths, int) and hologram.distance <= width / 2:
        hint = f"a volume {width:.3g} m wide needs more than {width / 2:.3g} m"
        if settings.view.width and hologram.distance < width / 20:
            hint += f"; view.width={width:g} means {width:g} m: did you mean '{width:g} mm'?"
        problems.append((("hologram", "distance"), f"expected the whole volume in front of the hologram; {hint}"))
    lengths = (hologram.distance, *(hologram.depths if isinstance(hologram.depths, tuple) else ()))
    if min(lengths) / settings.scale < DEPTH.low:
        by = f" divided by the scale {settings.scale}" if settings.scale > 1 else ""
        wanted = f"expected distances of at least {DEPTH.low:g} m, got {min(lengths):g} m{by}"
        problems.append((("hologram", "distance"), wanted))
    least = min(side) // settings.scale
    if least < 8 or any(size % settings.scale for size in side) or (rays is not None and rays % settings.scale):
        problems.append((("scale",), f"expected a divisor of the pixels {side} and the rays that leaves at least 8"))
    return problems
