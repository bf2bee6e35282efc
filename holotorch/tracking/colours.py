"""Which 8-bit colours may belong to which band: a table of 32 x 32 x 32, looked up without a float frame."""

import math

import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import Catheter

_BITS = 5
_TURN = math.radians(32)  # between chromas in linear light
_PURE = 0.35  # of a band's own saturation; gloss and mixed pixels have less
_DARK = 24 / 255  # levels below are noise


class ColourTable:
    """Labels of pixels: 0 for none, c + 1 for the c-th of ``colours``, whatever the light's strength.

    Attributes:
        colours: The distinct colours of the catheter's bands.
        bands: For each band, which of ``colours`` it has.
        table: uint8 [32768], by the upper five bits of red, green and blue.
        of_packed: The same as OpenCV's look-up tables want it, [1, 65536].

    Raises:
        ValueError: Bands that are grey, or whose hues cannot be told apart.
    """

    def __init__(self, camera: Camera, catheter: Catheter):
        self.colours = tuple(dict.fromkeys(catheter.colours))
        self.bands = tuple(self.colours.index(colour) for colour in catheter.colours)
        levels = torch.arange(1 << _BITS, dtype=torch.float64) * 8 + 3.5
        cells = torch.cartesian_prod(levels, levels, levels)
        chroma, pure = _chroma(camera.linear(cells))
        wanted, saturation = _chroma(camera.linear(torch.tensor(self.colours, dtype=torch.float64)))
        if float(saturation.min()) < 0.2:
            raise ValueError(f"bands must be of saturated colours, got {self.colours[int(saturation.argmin())]}")
        between = wanted @ wanted.T - 2 * torch.eye(len(wanted), dtype=torch.float64)
        if float(between.max()) > math.cos(math.radians(25)):
            raise ValueError(f"hues of the bands must lie 25 degrees apart at least, got {self.colours}")
        like, label = (chroma @ wanted.T).max(-1)
        good = (like > math.cos(_TURN)) & (pure > _PURE * saturation[label]) & (cells.amax(-1) > 255 * _DARK)
        self.table = torch.where(good, label + 1, 0).to(torch.uint8).numpy()
        self.of_packed = np.tile(self.table, 2)[None]  # the sixteenth bit says nothing

    def labels(self, levels: np.ndarray) -> np.ndarray:
        """uint8 [...] of levels uint8 [3, ...]."""
        red, green, blue = levels >> (8 - _BITS)
        index = (red.astype(np.intp) << 2 * _BITS) + (green.astype(np.intp) << _BITS) + blue
        return self.table.take(index)


def _chroma(light: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector [..., 3] away from grey, and saturation [...]: its length over the light's."""
    away = light - light.mean(-1, keepdim=True)
    length = away.norm(dim=-1)
    return away / length.clamp(min=1e-9)[..., None], length / light.norm(dim=-1).clamp(min=1e-9)
