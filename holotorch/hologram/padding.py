"""Transform lengths at which the wrap-around of an ``AxialHologram`` stays below a tolerance, estimated per axis.

A transfer function that is sampled in frequency has a periodic kernel in space: light that leaves the array at one side
enters at the opposite side. So does the ringing due to the finite bandwidth. Two remedies are combined: frequencies
whose light reaches no pixel are attenuated, and the array is padded. The remaining error is computed for each axis
alone, as the difference between the periodic kernel and the wave that ``cone`` defines. The difference at each
displacement is weighted by the number of pairs of a source and a pixel with this displacement.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import hankel1e

from holotorch.core.fourier import good_length
from holotorch.hologram.cone import Cone, Samples, taper
from holotorch.hologram.raster import strided_length

_LONGEST = 1 << 24  # longest kernel of one axis in samples, which takes 2 GB and several seconds to compute


@dataclass(frozen=True)
class Axis:
    """One axis of sources and pixels."""

    sources: int  # extent of the sources in samples at the pixel pitch
    pixels: int  # number of pixels of the hologram
    stride: int  # distance between neighbouring sources in pixels
    pitch: float  # pixel pitch in metres
    wavelength: float  # in metres
    nearest: float  # smallest depth of a plane in metres
    farthest: float  # largest depth of a plane in metres
    cone: Cone  # "full", "taper" or "band", see ``holotorch.hologram.cone``

    @property
    def displacement(self) -> int:
        """Upper bound of the displacement between a source and a pixel, in samples."""
        return (self.sources + self.pixels) // 2

    @property
    def steepest(self) -> float:
        """Tangent of the largest angle to the axis that the pitch samples."""
        sine = min(0.995, self.wavelength / (2 * self.pitch))  # below 1, so that the tangent is finite
        return sine / math.sqrt(1 - sine**2)

    def fade(self, length: int) -> tuple[float, float]:
        """Tangents of two angles to the axis: attenuation begins at the first and is complete at the second.

        Light from any plane at more than the first angle reaches no pixel. In FFTs of ``length`` samples, light wraps
        onto a pixel only at more than the second angle.
        """
        start = self.displacement * self.pitch / self.nearest
        end = (length - self.displacement) * self.pitch / self.farthest
        # For "full" the spectrum falls to 0 at the highest frequency at the latest, since a sharp end causes ringing.
        return start, min(end, self.steepest) if self.cone == "full" else end

    @property
    def within_band(self) -> bool:
        """Whether the pitch samples the direction from every source to every pixel, at every depth."""
        return self.steepest * self.nearest > self.displacement * self.pitch

    def least(self) -> int:
        """Shortest length, in samples, at which all light that wraps onto a pixel is attenuated."""
        extent = min(
            self.steepest * self.farthest / self.pitch, 1.02 * self.displacement * self.farthest / self.nearest
        )
        return strided_length(math.ceil(self.displacement + extent) + 1, self.stride)

    def error(self, length: int) -> float:
        """Relative L2 error of the field of random sources, the larger one of the nearest and the farthest depth."""
        return max(self._error(length, depth) for depth in {self.nearest, self.farthest})

    def _error(self, length: int, depth: float) -> float:
        offsets = np.arange(self.displacement + 1)
        sine = np.clip(np.fft.fftfreq(length, self.pitch) * self.wavelength, -0.999, 0.999)
        weights = faded_out(sine / np.sqrt(1 - sine**2), *self.fade(length))
        kernel = np.fft.ifft(self._spectrum(length, depth) * weights)[offsets % length]
        # The reference is computed on an array at least four times as long, on which much less light wraps around.
        exact_length = good_length(math.ceil(4 * max(length, self.displacement + self.steepest * depth / self.pitch)))
        exact = _exact_kernel(self, exact_length, depth)
        # Number of pairs of a source and a pixel at each offset and, except for offset 0, at its negative.
        pairs = np.clip(self.displacement - offsets, 0, min(self.sources, self.pixels)) + 1.0
        pairs[1:] *= 2
        return math.sqrt((pairs * np.abs(kernel - exact) ** 2).sum() / (pairs * np.abs(exact) ** 2).sum())

    def _spectrum(self, length: int, depth: float) -> np.ndarray:
        """Spectrum of the wave from ``depth`` at ``length`` frequencies, without the factor exp(i k z)."""
        sine = np.fft.fftfreq(length, self.pitch) * self.wavelength
        propagates = np.abs(sine) < 0.999
        cosine = np.sqrt(np.where(propagates, 1 - sine**2, 1))
        cycles = -depth / self.wavelength * sine**2 / (1 + cosine)
        kernel = np.where(propagates, np.exp(2j * math.pi * (cycles - np.rint(cycles))), 0)
        if self.cone == "taper":
            kernel = kernel * taper(sine * (2 * self.pitch / self.wavelength))
        return kernel


@lru_cache(maxsize=8)  # several of the lengths that ``choose_length`` tries may need the same kernel
def _exact_kernel(axis: Axis, length: int, depth: float) -> np.ndarray:
    """Kernel at offsets of 0, 1, ... samples without the factor exp(i k z), in closed form or by FFT of ``length``."""
    if axis.cone != "full":
        return np.fft.ifft(axis._spectrum(length, depth))[: axis.displacement + 1].copy()
    # Closed form of the integral of exp(2 pi i (f x + z w)) over f, with w = sqrt(1 / wavelength^2 - f^2).
    x, k = np.arange(axis.displacement + 1) * axis.pitch, 2 * math.pi / axis.wavelength
    distance = np.hypot(x, depth)
    wave = 0.5j * k * depth / distance * hankel1e(1, k * distance)
    return axis.pitch * wave * np.exp(1j * k * (x**2 / (distance + depth)))


def faded_out(values: Samples, start: float, end: float) -> Samples:
    """Smooth step from 1 at abs(values) = ``begin`` to 0 at ``end``, with three continuous derivatives."""
    t: Any = ((abs(values) - start) / max(end - start, 1e-12)).clip(0, 1)
    return 1 - t**4 * (35 - 84 * t + 70 * t**2 - 20 * t**3)


def choose_length(axis: Axis, tolerance: float) -> tuple[int, float]:
    """Shortest length in samples with an error within ``tolerance``, else the most accurate length, and its error.

    Only lengths with a fast FFT are tried, up to 3 (sources + pixels) + 12 sqrt(wavelength z) / pitch samples, where
    z is the farthest depth. The square root is the width of the diffraction at an edge.
    """
    spread = 4 * (axis.displacement + axis.steepest * axis.farthest / axis.pitch)
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
