"""Guard: how long transforms must be that what wraps around stays below a tolerance, measured on one axis.

A transfer function that is sampled in frequency is periodic in space. Light that leaves the array comes back on the
other side, and the rim of the band rings as far as it likes. Two cures: frequencies whose light no pixel can meet are
faded out, and the array is made longer. What is left is measured: the axis' kernel against one on a far longer array,
weighted by how many pairs of source and pixel lie so far apart.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from holotorch.core.fourier import good_length
from holotorch.hologram.cone import Cone, taper
from holotorch.hologram.raster import strided_length

_LONGEST = 1 << 24  # samples of one axis, whose kernel takes 2 GB and seconds


@dataclass(frozen=True)
class Axis:
    """One axis of sources and pixels.

    Attributes:
        sources: Samples that the sources cover, ``stride`` apart.
        pixels: Of the hologram.
        stride: Pixels between sources.
        pitch: Of the pixels in metres.
        wavelength: In metres.
        nearest: Depth of the first plane in metres.
        farthest: Depth of the last.
        cone: "band" or "taper".
    """

    sources: int
    pixels: int
    stride: int
    pitch: float
    wavelength: float
    nearest: float
    farthest: float
    cone: Cone

    @property
    def apart(self) -> int:
        """Farthest displacement of a pair, in samples."""
        return (self.sources + self.pixels) // 2

    @property
    def steepest(self) -> float:
        """Tangent of the band's steepest light."""
        sine = min(0.995, self.wavelength / (2 * self.pitch))
        return sine / math.sqrt(1 - sine**2)

    def fade(self, length: int) -> tuple[float, float]:
        """Tangents between which light is faded out: met by no pixel of the nearest plane, not wrapping from any."""
        begin = self.apart * self.pitch / self.nearest
        end = (length - self.apart) * self.pitch / self.farthest
        # Where the band ends beyond all pairs its sharp edge need not ring.
        return begin, min(end, self.steepest) if self.far else end

    @property
    def far(self) -> bool:
        """Whether the band ends beyond all pairs, at every depth: then all cones agree on what is exact."""
        return self.steepest * self.nearest > 1.02 * self.apart * self.pitch

    def least(self) -> int:
        """Shortest length at which no light of a ray's straight path wraps around into a pair."""
        kept = min(self.steepest * self.farthest / self.pitch, 1.02 * self.apart * self.farthest / self.nearest)
        return strided_length(math.ceil(self.apart + kept) + 1, self.stride)

    def error(self, length: int) -> float:
        """Relative L2 error of the field of noise-like sources, the worse of the nearest and the farthest plane."""
        return max(self._error(length, depth) for depth in {self.nearest, self.farthest})

    def _error(self, length: int, depth: float) -> float:
        spread = self.apart + self.steepest * depth / self.pitch
        # The reference's own tails wrap too: four times the length leaves a quarter of them.
        longer = good_length(math.ceil(4 * max(length, spread)))
        displacement = np.arange(self.apart + 1)
        taps, exact = self._taps(length, depth, True)[displacement % length], _exact_taps(self, longer, depth)
        pairs = np.clip(self.apart - displacement, 0, min(self.sources, self.pixels)) + 1.0
        pairs[1:] *= 2
        return math.sqrt((pairs * np.abs(taps - exact) ** 2).sum() / (pairs * np.abs(exact) ** 2).sum())

    def _taps(self, length: int, depth: float, faded: bool) -> np.ndarray:
        part = 2 * self.pitch * np.fft.fftfreq(length, self.pitch)
        sine = part * self.wavelength / (2 * self.pitch)
        travels = np.abs(sine) < 0.999
        cosine = np.sqrt(np.where(travels, 1 - sine**2, 1))
        turns = -depth / self.wavelength * sine**2 / (1 + cosine)
        kernel = np.where(travels, np.exp(2j * math.pi * (turns - np.rint(turns))), 0)
        if self.cone == "taper":
            kernel = kernel * taper(torch.from_numpy(part)).numpy()
        begin, end = self.fade(length) if faded else (self.apart * self.pitch / depth, self.steepest)
        if faded or self.far:
            kernel = kernel * faded_out(torch.from_numpy(sine / cosine), begin, end).numpy()
        return np.fft.ifft(kernel)


@lru_cache(maxsize=8)  # far away it is the same for every length that is tried, and longer than all of them
def _exact_taps(axis: Axis, length: int, depth: float) -> np.ndarray:
    return axis._taps(length, depth, False)[: axis.apart + 1].copy()


def faded_out(values: Tensor, begin: float, end: float) -> Tensor:
    """1 up to ``begin``, 0 from ``end`` on, of abs(values), with three continuous derivatives, so that little rings."""
    t = ((values.abs() - begin) / max(end - begin, 1e-12)).clamp(0, 1)
    return 1 - t**4 * (35 - 84 * t + 70 * t**2 - 20 * t**3)


def choose_length(axis: Axis, tolerance: float) -> tuple[int, float]:
    """Shortest fast length whose error is within ``tolerance``, with that error; else the best of those tried.

    Tried are lengths up to three windows and twelve times sqrt(wavelength z), how far light spreads around an edge.
    """
    spread = 4 * (axis.apart + axis.steepest * axis.farthest / axis.pitch)
    if spread > _LONGEST:
        raise ValueError(
            f"depth {axis.farthest:g} m is too far for pixels of {axis.pitch:g} m: light spreads over {spread / 4:.2g} "
            "of them; use nearer planes or a larger pitch"
        )
    length, best = axis.least(), None
    around = math.sqrt(axis.wavelength * axis.farthest) / axis.pitch
    most = max(3 * (axis.sources + axis.pixels), length) + 12 * around
    while length <= most:
        error = axis.error(length)
        if best is None or error < best[1]:
            best = length, error
        if error <= tolerance:
            break
        length = strided_length(length + max(axis.stride, length // 24), axis.stride)
    assert best is not None
    return best
