"""Transform lengths at which the wrap-around of an ``AxialHologram`` stays below a tolerance, estimated per axis.

A transfer function that is sampled in frequency is periodic in space: light that leaves the array re-enters on the
opposite side, as does the ringing of the band edge. Two remedies are combined: frequencies whose light reaches no pixel
are attenuated, and the array is padded. The remaining error is computed on one axis, as the difference between the
periodic kernel and the wave that ``cone`` defines, weighted by the number of pairs of a source and a pixel at each
displacement.
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

_LONGEST = 1 << 24  # samples; the kernel of one axis of that length takes 2 GB and several seconds


@dataclass(frozen=True)
class Axis:
    """One axis of sources and pixels.

    Attributes:
        sources: Extent of the sources in samples.
        pixels: Number of pixels of the hologram.
        stride: Distance between neighbouring sources in pixels.
        pitch: Pixel pitch in metres.
        wavelength: In metres.
        nearest: Smallest depth of a plane in metres.
        farthest: Largest depth of a plane in metres.
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
        """Largest displacement between a source and a pixel, in samples."""
        return (self.sources + self.pixels) // 2

    @property
    def steepest(self) -> float:
        """Tangent of the steepest direction in the band."""
        sine = min(0.995, self.wavelength / (2 * self.pitch))
        return sine / math.sqrt(1 - sine**2)

    def fade(self, length: int) -> tuple[float, float]:
        """Tangents of direction between which the attenuation rises from none to complete, for FFTs of ``length``.

        Light less steep than the first can reach a pixel from the nearest plane. Light steeper than the second can wrap
        onto a pixel from the farthest plane.
        """
        begin = self.apart * self.pitch / self.nearest
        end = (length - self.apart) * self.pitch / self.farthest
        # For the unlimited wave the attenuation is complete at the band edge, which then does not ring.
        return begin, min(end, self.steepest) if self.cone == "full" else end

    @property
    def within_band(self) -> bool:
        """Whether the band contains the direction from every source to every pixel, at every depth."""
        return self.steepest * self.nearest > self.apart * self.pitch

    def least(self) -> int:
        """Shortest length at which no straight ray that is not attenuated wraps onto a pixel."""
        extent = min(self.steepest * self.farthest / self.pitch, 1.02 * self.apart * self.farthest / self.nearest)
        return strided_length(math.ceil(self.apart + extent) + 1, self.stride)

    def error(self, length: int) -> float:
        """Relative L2 error of the field of random sources: the larger error of the nearest and the farthest depth."""
        return max(self._error(length, depth) for depth in {self.nearest, self.farthest})

    def _error(self, length: int, depth: float) -> float:
        displacement = np.arange(self.apart + 1)
        spectrum = self._spectrum(length, depth) * self._attenuation(length)
        taps = np.fft.ifft(spectrum)[displacement % length]
        exact = _exact_taps(self, self._reference_length(length, depth), depth)
        pairs = np.clip(self.apart - displacement, 0, min(self.sources, self.pixels)) + 1.0
        pairs[1:] *= 2
        return math.sqrt((pairs * np.abs(taps - exact) ** 2).sum() / (pairs * np.abs(exact) ** 2).sum())

    def _reference_length(self, length: int, depth: float) -> int:
        """Length of the array for the reference kernel, on which at most a quarter as much light wraps around."""
        return good_length(math.ceil(4 * max(length, self.apart + self.steepest * depth / self.pitch)))

    def _sines(self, length: int) -> np.ndarray:
        return np.fft.fftfreq(length, self.pitch) * self.wavelength

    def _spectrum(self, length: int, depth: float) -> np.ndarray:
        """Sampled spectrum of the wave at ``depth``, without the carrier."""
        sine = self._sines(length)
        propagates = np.abs(sine) < 0.999
        cosine = np.sqrt(np.where(propagates, 1 - sine**2, 1))
        cycles = -depth / self.wavelength * sine**2 / (1 + cosine)
        kernel = np.where(propagates, np.exp(2j * math.pi * (cycles - np.rint(cycles))), 0)
        if self.cone == "taper":
            kernel = kernel * taper(torch.from_numpy(sine * (2 * self.pitch / self.wavelength))).numpy()
        return kernel

    def _attenuation(self, length: int) -> np.ndarray:
        sine = np.clip(self._sines(length), -0.999, 0.999)
        return faded_out(torch.from_numpy(sine / np.sqrt(1 - sine**2)), *self.fade(length)).numpy()

    def _plain(self, depth: float) -> np.ndarray:
        """The unlimited wave, the integral of exp(2 pi i (f x + z w)) over f, at displacements 0, 1, ... samples."""
        offset, k = np.arange(self.apart + 1) * self.pitch, 2 * math.pi / self.wavelength
        distance = np.hypot(offset, depth)
        wave = 0.5j * k * depth / distance * hankel1e(1, k * distance)
        return self.pitch * wave * np.exp(1j * k * (offset**2 / (distance + depth)))


@lru_cache(maxsize=8)  # for distant planes the length of the reference is the same for every length that is tried
def _exact_taps(axis: Axis, length: int, depth: float) -> np.ndarray:
    if axis.cone == "full":
        return axis._plain(depth)
    return np.fft.ifft(axis._spectrum(length, depth))[: axis.apart + 1].copy()


def faded_out(values: Tensor, begin: float, end: float) -> Tensor:
    """Smooth step from 1 at abs(values) = ``begin`` to 0 at ``end``; three continuous derivatives limit its ringing."""
    t = ((values.abs() - begin) / max(end - begin, 1e-12)).clamp(0, 1)
    return 1 - t**4 * (35 - 84 * t + 70 * t**2 - 20 * t**3)


def choose_length(axis: Axis, tolerance: float) -> tuple[int, float]:
    """Shortest fast FFT length whose error is within ``tolerance``, and its error; else the best length tried.

    Lengths are tried up to three times the sum of sources and pixels, plus twelve times the width sqrt(wavelength z) of
    edge diffraction.
    """
    spread = 4 * (axis.apart + axis.steepest * axis.farthest / axis.pitch)
    if spread > _LONGEST:
        raise ValueError(
            f"depth {axis.farthest:g} m is too far for pixels of {axis.pitch:g} m: light spreads over {spread / 4:.2g} "
            "of them; use nearer planes or a larger pitch"
        )
    length, best = axis.least(), None
    edge_width = math.sqrt(axis.wavelength * axis.farthest) / axis.pitch
    most = max(3 * (axis.sources + axis.pixels), length) + 12 * edge_width
    while length <= most:
        error = axis.error(length)
        if best is None or error < best[1]:
            best = length, error
        if error <= tolerance:
            break
        length = strided_length(length + max(axis.stride, length // 24), axis.stride)
    assert best is not None
    return best
