"""Guard: how long transforms must be that what wraps around stays below a tolerance, measured on one axis.

A transfer function that is sampled in frequency is periodic in space. Light that leaves the array comes back on the
other side, and the rim of the band rings as far as it likes. Two cures: frequencies whose light no pixel can meet are
faded out, and the array is made longer. What is left, of both, is measured on one axis: its kernel against the wave
that ``cone`` defines, weighted by how many pairs of source and pixel lie so far apart.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.special import hankel1e
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
        cone: "full", "taper" or "band", see ``holotorch.hologram.cone``.
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
        # The plain wave has no end: that of the band need not ring.
        return begin, min(end, self.steepest) if self.cone == "full" else end

    @property
    def within_band(self) -> bool:
        """Whether the band holds the light of every pair, at every depth."""
        return self.steepest * self.nearest > self.apart * self.pitch

    def least(self) -> int:
        """Shortest length at which no light of a ray's straight path wraps around into a pair."""
        kept = min(self.steepest * self.farthest / self.pitch, 1.02 * self.apart * self.farthest / self.nearest)
        return strided_length(math.ceil(self.apart + kept) + 1, self.stride)

    def error(self, length: int) -> float:
        """Relative L2 error of the field of noise-like sources, the worse of the nearest and the farthest plane."""
        return max(self._error(length, depth) for depth in {self.nearest, self.farthest})

    def _error(self, length: int, depth: float) -> float:
        displacement = np.arange(self.apart + 1)
        faded = self._spectrum(length, depth) * self._fading(length)
        taps, exact = np.fft.ifft(faded)[displacement % length], _exact_taps(self, self._longer(length, depth), depth)
        pairs = np.clip(self.apart - displacement, 0, min(self.sources, self.pixels)) + 1.0
        pairs[1:] *= 2
        return math.sqrt((pairs * np.abs(taps - exact) ** 2).sum() / (pairs * np.abs(exact) ** 2).sum())

    def _longer(self, length: int, depth: float) -> int:
        """Length of the array that stands for an endless one: what wraps around there is a quarter of it or less."""
        return good_length(math.ceil(4 * max(length, self.apart + self.steepest * depth / self.pitch)))

    def _sines(self, length: int) -> np.ndarray:
        return np.fft.fftfreq(length, self.pitch) * self.wavelength

    def _spectrum(self, length: int, depth: float) -> np.ndarray:
        """Of the wave in samples of frequency, without carrier."""
        sine = self._sines(length)
        travels = np.abs(sine) < 0.999
        cosine = np.sqrt(np.where(travels, 1 - sine**2, 1))
        turns = -depth / self.wavelength * sine**2 / (1 + cosine)
        kernel = np.where(travels, np.exp(2j * math.pi * (turns - np.rint(turns))), 0)
        if self.cone == "taper":
            kernel = kernel * taper(torch.from_numpy(sine * (2 * self.pitch / self.wavelength))).numpy()
        return kernel

    def _fading(self, length: int) -> np.ndarray:
        sine = np.clip(self._sines(length), -0.999, 0.999)
        return faded_out(torch.from_numpy(sine / np.sqrt(1 - sine**2)), *self.fade(length)).numpy()

    def _plain(self, depth: float) -> np.ndarray:
        """The wave that no cone limits, integral of exp(2 pi i (f x + z w)) over f, at displacements from 0 on."""
        aside, k = np.arange(self.apart + 1) * self.pitch, 2 * math.pi / self.wavelength
        distance = np.hypot(aside, depth)
        wave = 0.5j * k * depth / distance * hankel1e(1, k * distance)
        return self.pitch * wave * np.exp(1j * k * (aside**2 / (distance + depth)))


@lru_cache(maxsize=8)  # far away it is the same for every length that is tried, and longer than all of them
def _exact_taps(axis: Axis, length: int, depth: float) -> np.ndarray:
    if axis.cone == "full":
        return axis._plain(depth)
    return np.fft.ifft(axis._spectrum(length, depth))[: axis.apart + 1].copy()


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
