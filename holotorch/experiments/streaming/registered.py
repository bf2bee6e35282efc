"""A volume whose place is known: the page shows its slice at the tip of the catheter."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import interpolate

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.settings import Number, Settings
from holotorch.experiments.config.source import read_source
from holotorch.experiments.tracking.devices import Row, rigid_matrix
from holotorch.experiments.volume.config import VolumeSource
from holotorch.scene.volume import Volume

_MOST = 256  # samples along an axis that the page gets; a longer axis is averaged


class RegistrationSettings(Settings):
    """A volume and its place in the frame of the poses.

    ``frame_from_volume``: rows of the rigid 4 x 4 matrix from the coordinates (x, y, z) of the volume's file, in
    metres, to the frame of the poses. ``level``, ``window``: middle and width of the values that are shown from black
    to white, by default those of the whole volume; the page can change both.
    """

    volume: VolumeSource
    frame_from_volume: tuple[Row, Row, Row, Row]
    level: Number | None = None
    window: Number | None = Field(None, gt=0)


@dataclass(frozen=True, eq=False)
class RegisteredVolume:
    """The samples that the page gets, and the map to them.

    Attributes:
        samples: float16 [D, H, W] from 0 for ``low`` to 1 for ``high``; at most 256 along an axis.
        texture_from_frame: float64 [4, 4] from points (x, y, z) in metres in the frame of the poses to coordinates
            (x, y, z) of the samples, from 0 to 1 between the faces of the volume.
        low, high: Smallest and largest value of the volume.
        level, window: Middle and width of the values that are shown at first.
    """

    samples: Tensor
    texture_from_frame: Tensor
    low: float
    high: float
    level: float
    window: float

    def setup(self) -> dict[str, Any]:
        """Description of the volume for the page, without the samples."""
        values = {name: getattr(self, name) for name in ("low", "high", "level", "window")}
        return values | {"shape": list(self.samples.shape), "matrix": self.texture_from_frame.mT.flatten().tolist()}


def load_registered(path: Path) -> RegisteredVolume:
    """Read a file of ``RegistrationSettings`` and its volume. ConfigError for mistakes in either."""
    from holotorch.experiments.volume.experiment import open_volume

    needed = "a registered volume: volume, frame_from_volume"
    source = read_source(path, [], needed)
    settings = validated(source, RegistrationSettings)
    try:
        frame_from_volume = rigid_matrix("frame_from_volume", settings.frame_from_volume)
    except ValueError as error:
        text = str(error).removeprefix("frame_from_volume ")
        raise ConfigError([source.mistake(("frame_from_volume",), text)]) from None
    volume, _ = open_volume(settings.volume)
    try:
        return register(volume, frame_from_volume, settings.level, settings.window)
    except ValueError as error:
        raise ConfigError([source.mistake(("volume",), str(error))]) from None


def register(
    volume: Volume, frame_from_volume: Tensor, level: float | None = None, window: float | None = None
) -> RegisteredVolume:
    """Prepare a volume for the page. ``frame_from_volume``: as in ``RegistrationSettings``, float64 [4, 4].

    ValueError for a volume whose size in metres is unknown, or with values that are not finite.
    """
    if volume.unit != "m":
        raise ValueError("its size in metres is unknown: state its spacing in metres, such as spacing: 5.0e-4")
    low, high = volume.value_range()
    spread = max(high - low, 1e-12)
    shape = [min(count, _MOST) for count in volume.shape]
    values = ((volume.values.to(torch.float32) - low) / spread)[None, None]
    samples = interpolate(values, shape, mode="area")[0, 0].to(torch.float16)
    # Index of a point along an axis: (its place - origin) . direction / spacing; the faces are half a voxel out.
    axes = torch.tensor(volume.orientation, dtype=torch.float64).flip(0, 1)  # rows and components in the order x, y, z
    spacing, origin = (torch.tensor(triple, dtype=torch.float64).flip(0) for triple in (volume.spacing, volume.origin))
    count = torch.tensor(volume.shape, dtype=torch.float64).flip(0)
    texture_from_volume = torch.eye(4, dtype=torch.float64)
    texture_from_volume[:3, :3] = axes / (spacing * count)[:, None]
    texture_from_volume[:3, 3] = 0.5 / count - texture_from_volume[:3, :3] @ origin
    matrix = texture_from_volume @ torch.linalg.inv(frame_from_volume)
    middle = (low + high) / 2 if level is None else level
    return RegisteredVolume(samples, matrix, low, low + spread, middle, spread if window is None else window)
