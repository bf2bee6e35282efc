"""Which 8-bit colours may belong to which band: a table of 32 x 32 x 32, looked up without a float frame."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter

_BITS = 5
_TURN = math.radians(32)  # between chromas in linear light
_PURE = 0.35  # of a band's own saturation; gloss and mixed pixels have less
_DARK = 24 / 255  # levels below are noise


class ColourTable:
    """Labels of pixels: 0 for none, c + 1 for the c-th of ``colours``, whatever the light's strength.

    Attributes:
        colours: The distinct colours of the catheter's bands.
        bands: For each band, which of ``colours`` it has.
        table: uint8 [65536], by the upper five bits of red, green and blue, whatever the highest of the sixteen.

    Raises:
        ValueError: Bands that are grey, whose hues cannot be told apart, or whose colours read the same from both ends.
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
            raise ValueError(f"bands must be of saturated colours, got {self.colours[int(saturation.argmin())]}")
        between = wanted @ wanted.T - 2 * torch.eye(len(wanted), dtype=torch.float64)
        if float(between.max()) > math.cos(math.radians(25)):
            raise ValueError(f"hues of the bands must lie 25 degrees apart at least, got {self.colours}")
        self._wanted = wanted
        like, label = (chroma @ wanted.T).max(-1)
        good = (like > math.cos(_TURN)) & (pure > _PURE * saturation[label]) & (cells.amax(-1) > 255 * _DARK)
        self.table = np.tile(torch.where(good, label + 1, 0).to(torch.uint8).numpy(), 2)

    def labels(self, levels: np.ndarray) -> np.ndarray:
        """uint8 [T, U] of levels uint8 [T, U, 3], neither of them nought."""
        # Five bits of each colour side by side, as the table wants them.
        return cv2.LUT(cv2.cvtColor(levels, cv2.COLOR_RGB2BGR555).view(np.uint16)[..., 0], self.table)

    def alike(self, levels: Tensor, margin: float) -> list[list[int]]:
        """Of each of the levels [n, 3]: indices of ``colours`` that it may pass for, -1 for none of them.

        ``margin``: degrees by which its hue may be moved.
        """
        away = (_chroma(self._linear(levels.double()))[0] @ self._wanted.T).clamp(-1, 1).arccos()
        wide, narrow = (_TURN + sign * math.radians(margin) for sign in (1, -1))
        return [[-1] * (min(row) > narrow) + [i for i, each in enumerate(row) if each < wide] for row in away.tolist()]


def _chroma(light: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector [..., 3] away from grey, and saturation [...]: its length over the light's."""
    away = light - light.mean(-1, keepdim=True)
    length = away.norm(dim=-1)
    return away / length.clamp(min=1e-9)[..., None], length / light.norm(dim=-1).clamp(min=1e-9)
