"""What the configuration of a volume's hologram may say."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from holotorch.experiments.config.settings import (
    Count,
    Distance,
    ExistingArray,
    ExistingPath,
    GridSettings,
    Number,
    Settings,
    Wavelength,
    number,
    several,
)

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


def _ahead(value: float) -> float:
    if not value > 0:
        raise PydanticCustomError("depth", "expected a distance above zero: the scene lies before the hologram")
    return value


Depth = Annotated[Distance, AfterValidator(_ahead)]


class VolumeSource(Settings):
    """A file, a scene of the public catalogue, or a synthetic phantom: the first of them that is given.

    A phantom beside a scene stands in for it where it cannot be fetched.

    ``spacing`` (z, y, x), ``shape`` (D, H, W), ``dtype`` and ``unit`` say what a file does not: see ``load_volume``.
    ``directory``: where scenes are kept once fetched.
    """

    path: ExistingArray | None = None
    scene: Scene | None = None
    phantom: Phantom | None = None
    samples: Annotated[Count, Field(ge=4, le=512)] = 128  # of a phantom, per axis; 512 take some seconds
    directory: str | None = None
    spacing: Annotated[tuple[Number, ...], BeforeValidator(several)] | None = None
    shape: tuple[Count, Count, Count] | None = None
    dtype: Annotated[str, BeforeValidator(_number_type)] | None = None
    unit: Literal["m", "relative"] | None = None


class TransferSettings(Settings):
    """Colour and opacity: a preset between two values of the volume, a JSON file, or points of one's own.

    ``points``: [value, red, green, blue, opacity] each, in 0..1 but for the value; ``unit_distance`` is the part of the
    volume's longest side along which the opacity holds.
    """

    preset: Literal["bone", "soft_tissue", "vessels", "industrial"] | None = None
    low: Number | None = None
    high: Number | None = None
    file: ExistingPath | None = None
    points: tuple[tuple[Number, Number, Number, Number, Number], ...] | None = None
    unit_distance: Annotated[Number, Field(gt=0, le=1)] = 1 / 256


class ViewSettings(Settings):
    """How the volume stands: degrees about the vertical (y) and then about the horizontal axis (x); its width.

    ``width``: metres of its longest side; that of the hologram by default. ``front``: which end of the volume the
    observer sees first. ``lighting``: shade by the gradient instead of letting all points glow evenly.
    """

    azimuth_deg: Number = 0.0
    elevation_deg: Number = 0.0
    width: Depth | None = None
    front: Literal["far", "near"] = "far"
    lighting: bool = False


class HologramSettings(GridSettings):
    """Pixels, the distance of the volume's middle, the number of planes (or where they lie), and rays per side.

    ``cone``: which definition of a wave's limits, see ``holotorch.hologram.cone``; the cheapest soft one by default.
    """

    distance: Depth
    depths: Annotated[int, BeforeValidator(number), Field(ge=1, le=100000)] | tuple[Depth, ...] = 64
    rays: Count | None = None
    cone: Literal["full", "box", "disc", "taper", "band"] | None = None


class VolumeReport(Settings):
    """Depths of the refocused pictures, and random phases that are averaged in them.

    By default a tenth, half and nine tenths of the rays see something nearer than the depths.
    """

    refocus: Annotated[tuple[Depth, ...], BeforeValidator(several)] | None = None
    seeds: Annotated[Count, Field(le=256)] = 1


class VolumeSettings(Settings):
    """The hologram of a volume, rendered directly into light sources, and what it shows.

    ``phase``: of the sources. ``point``: random, each its own, so that planes add without interference; ``ray``: one
    for each ray, as in the thesis, whose planes interfere colour by colour; ``smooth``; ``constant``. ``scale`` divides
    pixels, rays, distances, the volume's width and a given number of planes, for a small version of a scene.
    """

    experiment: Literal["volume"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    tolerance: Annotated[Number, Field(gt=0, lt=1)] = 1e-3
    volume: VolumeSource
    transfer: TransferSettings
    view: ViewSettings = ViewSettings()
    hologram: HologramSettings
    wavelengths: Annotated[tuple[Wavelength, ...], BeforeValidator(several)]
    phase: Literal["point", "ray", "smooth", "constant"] = "point"
    scale: Annotated[Count, Field(le=64)] = 1
    report: VolumeReport = VolumeReport()


def contradictions(settings: VolumeSettings) -> list[tuple[tuple[str | int, ...], str]]:
    """Settings that are fine one by one and not together."""
    found: list[tuple[tuple[str | int, ...], str]] = []
    source, transfer, hologram = settings.volume, settings.transfer, settings.hologram
    if not (source.path or source.scene or source.phantom):
        found.append((("volume",), "expected a path, a scene or a phantom"))
    if sum(item is not None for item in (transfer.preset, transfer.file, transfer.points)) != 1:
        found.append((("transfer",), "expected one of preset, file or points"))
    if transfer.preset and (transfer.low is None or transfer.high is None or transfer.low >= transfer.high):
        found.append((("transfer",), "a preset needs low and high, the values between which it lies, low < high"))
    if transfer.points is not None and len(transfer.points) < 2:
        found.append((("transfer", "points"), "expected at least 2 points"))
    if hologram.depths == ():
        found.append((("hologram", "depths"), "expected a number of planes, or one distance at least, got none"))
    if isinstance(hologram.depths, tuple) and len(set(hologram.depths)) < len(hologram.depths):
        twice = next(depth for k, depth in enumerate(hologram.depths) if depth in hologram.depths[:k])
        found.append((("hologram", "depths"), f"expected distances that all differ, got {twice:g} m twice"))
    if len(settings.wavelengths) != 3:
        found.append((("wavelengths",), f"expected 3 (red, green, blue), got {len(settings.wavelengths)}"))
    side, rays = hologram.shape, hologram.rays
    if rays is not None and (side[0] % rays or side[1] % rays or side[0] // rays != side[1] // rays):
        found.append((("hologram", "rays"), f"expected a number that divides the hologram's sides {side}, got {rays}"))
    width = settings.view.width or max(side[0] * hologram.pitch[0], side[1] * hologram.pitch[1])
    if isinstance(hologram.depths, int) and hologram.distance <= width / 2:
        hint = f"a volume {width:.3g} m wide needs more than {width / 2:.3g} m"
        found.append((("hologram", "distance"), f"expected the whole volume before the hologram; {hint}"))
    least = min(side) // settings.scale
    if least < 8 or any(size % settings.scale for size in side) or (rays is not None and rays % settings.scale):
        found.append((("scale",), f"expected a divisor of the pixels {side} and rays that leaves 8 at least"))
    return found
