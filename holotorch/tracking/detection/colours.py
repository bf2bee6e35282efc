"""Table of 32 x 32 x 32 colours that classifies 8-bit pixels without conversion to floating point."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import NO_GAPS, Catheter

_BITS = 5  # bits of each channel in the index of the table
_TURN = math.radians(32)  # largest angle between the chroma vectors of a pixel and of its band, in linear light
_PURE = 0.35  # least saturation of a pixel relative to that of its band; gloss and mixed pixels are less saturated
ALIKE = 14.0  # largest difference of equal colours in each channel, in levels; several times the noise
_DARK = 24 / 255  # least value of the brightest channel; darker pixels are noise


class ColourTable:
    """Labels of pixels by hue, at any brightness: c + 1 for ``colours[c]``, 0 for any other colour.

    Attributes:
        colours: The distinct colours of the catheter's bands.
        bands: For each band, the index of its colour in ``colours``.
        table: uint8 [65536] labels. The index has 16 bits: five of each channel, and a highest bit without effect.

    Raises:
        ValueError: Bands are grey, their hues are too similar, or their sequence is the same from both ends.
    """

    def __init__(self, camera: Camera, catheter: Catheter):
        self.colours = tuple(dict.fromkeys(catheter.colours))
        self.bands = tuple(self.colours.index(colour) for colour in catheter.colours)
        if self.bands == self.bands[::-1]:
            raise ValueError(
                "bands must not read the same from both ends, or the tip cannot be told from the rear; "
                f"got colours {catheter.colours}: change one"
            )
        levels = torch.arange(1 << _BITS, dtype=torch.float64) * 8 + 3.5
        cells = torch.cartesian_prod(levels, levels, levels)
        self._linear = camera.linear
        chroma, pure = _chroma(camera.linear(cells))
        wanted, saturation = _chroma(camera.linear(torch.tensor(self.colours, dtype=torch.float64)))
        if float(saturation.min()) < 0.2:
            least = int(saturation.argmin())
            hint = f"; {NO_GAPS}" if least in self.bands[1:-1] else ""
            raise ValueError(f"bands must be of saturated colours, got {self.colours[least]}{hint}")
        between = wanted @ wanted.T - 2 * torch.eye(len(wanted), dtype=torch.float64)
        if float(between.max()) > math.cos(math.radians(25)):
            raise ValueError(f"hues of the bands must lie 25 degrees apart at least, got {self.colours}")
        self._wanted = wanted
        like, label = (chroma @ wanted.T).max(-1)
        good = (like > math.cos(_TURN)) & (pure > _PURE * saturation[label]) & (cells.amax(-1) > 255 * _DARK)
        self.table = np.tile(torch.where(good, label + 1, 0).to(torch.uint8).numpy(), 2)

    def labels(self, levels: np.ndarray) -> np.ndarray:
        """Labels uint8 [T, U] of the levels uint8 [T, U, 3], T > 0 and U > 0."""
        # The upper five bits of all channels, concatenated, are the index into the table.
        return cv2.LUT(cv2.cvtColor(levels, cv2.COLOR_RGB2BGR555).view(np.uint16)[..., 0], self.table)

    def alike(self, levels: Tensor, margin: float) -> list[list[int]]:
        """For each of the levels [n, 3], the indices into ``colours`` that it may be classified as; -1 means none.

        ``margin`` is the largest error of the hue in degrees.
        """
        away = (_chroma(self._linear(levels.double()))[0] @ self._wanted.T).clamp(-1, 1).arccos()
        wide, narrow = (_TURN + sign * math.radians(margin) for sign in (1, -1))
        return [[-1] * (min(row) > narrow) + [i for i, each in enumerate(row) if each < wide] for row in away.tolist()]


def _chroma(light: Tensor) -> tuple[Tensor, Tensor]:
    """Chroma [..., 3], the unit vector of light minus its mean; saturation [...], that difference's relative length."""
    away = light - light.mean(-1, keepdim=True)
    length = away.norm(dim=-1)
    return away / length.clamp(min=1e-9)[..., None], length / light.norm(dim=-1).clamp(min=1e-9)
