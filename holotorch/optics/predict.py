"""What a kernel on a transform of finite length gets wrong, computed on one axis before any field is propagated."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from holotorch.core.fourier import good_length
from holotorch.optics.kernels import turns_phasor
from holotorch.optics.taps import fft_indices, fresnel_taps, remainder_kernel

_TONES = 17


@dataclass(frozen=True)
class AxisContent:
    """Light of one axis: its band, and how the exact kernel and others treat tones of that band.

    All errors are energies relative to what the exact kernel keeps in the window. They are means over tones
    exp(2 pi i f x) of the band, cut by the window or faded out over its rim, which is the expectation for noise that
    fills both.

    Attributes:
        size: Samples n.
        pitch: In metres.
        band: Highest frequency present, in cycles per metre, at most 1 / (2 pitch).
        wavelength: In metres.
        distance: In metres, > 0.
        margin: Width in metres of the rim over which the content fades to nothing at both ends; 0 for a hard edge.
    """

    size: int
    pitch: float
    band: float
    wavelength: float
    distance: float
    margin: float = 0.0

    @property
    def nyquist(self) -> float:
        """Highest frequency of the grid, 1 / (2 pitch)."""
        return 0.5 / self.pitch

    @cached_property
    def captured(self) -> float:
        """Share of the energy of the band's tones that stays in the window."""
        return max(self._energy(self._taps), 1e-300)

    def wrapped(self, padded: int) -> float:
        """Error of a transfer function sampled on ``padded`` points.

        It repeats the kernel every ``padded`` samples; the repetitions among the window's displacements are the error.
        Where the rays alone say that more than 5 % of the light wraps, that share is returned as it is.
        """
        share = self._wrapped_rays(padded)
        if share > 0.05:
            return share
        frequency = fft_indices(padded).to(torch.float64) / (padded * self.pitch)
        product = self.wavelength * self.distance
        repeated = torch.fft.ifft(turns_phasor(-product / 2 * frequency.square()))
        return self._energy(repeated[self._shifts % padded] - self._taps) / self.captured

    def _wrapped_rays(self, padded: int) -> float:
        """Share of the light that travels sideways past the padding but not past the window behind it."""
        steepest = self.wavelength * self.distance * self.band / self.pitch  # samples
        room = padded - self.size
        if steepest <= room:
            return 0.0
        farthest = min(steepest, room + self.size)
        return (farthest - room) ** 2 / (2 * self.size * steepest) + max(0.0, steepest - farthest) / steepest

    def cropped(self, padded: int, cross: float) -> float:
        """Error of the factor beyond Fresnel on cropped taps, against the same on a much longer transform.

        ``cross`` is the frequency on the other axis, in cycles per metre, which takes part in that factor.
        """
        if self._shift > padded / 4:
            return self._rim()
        far = self._beyond_fresnel(good_length(4 * self.size), cross)
        return self._energy(self._beyond_fresnel(padded, cross) - far) / self.captured

    def paraxial(self) -> float:
        """Error of leaving out the factor beyond Fresnel, for light that travels along this axis only."""
        if self._shift > self.size / 2:
            return self._rim()
        exact = self._beyond_fresnel(good_length(3 * self.size), 0.0)
        return self._energy(exact - self._taps) / self.captured

    @property
    def _shift(self) -> float:
        """Samples by which the factor beyond Fresnel moves the steepest light of the grid: z s^3 / 2."""
        return self.distance * (self.wavelength * self.nyquist) ** 3 / (2 * self.pitch)

    def _rim(self) -> float:
        """Energy of the kernel's part that comes from the ends of the band, where its phase is not to be trusted.

        So far away the steepest light has long left the window; what remains of it are the two terms
        f(u) ~ 1 / (pi u) of the taps beside the point source's 1 / sqrt(2), in random phase.
        """
        product = self.wavelength * self.distance
        u = math.sqrt(2 * product) * (self.nyquist - self.size * self.pitch / product)
        return min(1.0, 2 * 2 * 2 / (math.pi * u) ** 2) if u > 1 else 1.0

    @cached_property
    def _shifts(self) -> Tensor:
        return torch.arange(-(self.size - 1), self.size)

    @cached_property
    def _taps(self) -> Tensor:
        return self._fresnel(self._shifts)

    def _fresnel(self, index: Tensor) -> Tensor:
        wavelength, distance = (torch.tensor(value, dtype=torch.float64) for value in (self.wavelength, self.distance))
        return fresnel_taps(index, self.pitch, wavelength, distance)

    def _beyond_fresnel(self, padded: int, cross: float) -> Tensor:
        index = fft_indices(padded)
        frequency = index.to(torch.float64) / (padded * self.pitch)
        wavelength, distance, other = (
            torch.tensor(value, dtype=torch.float64) for value in (self.wavelength, self.distance, cross)
        )
        factor = remainder_kernel(other, frequency, wavelength, distance)
        return torch.fft.ifft(torch.fft.fft(self._fresnel(index)) * factor)[self._shifts % padded]

    @cached_property
    def _tones(self) -> Tensor:
        n = torch.arange(self.size, dtype=torch.float64)
        frequencies = torch.linspace(-1, 1, _TONES, dtype=torch.float64) * self.band * self.pitch
        return torch.fft.fft(self._fade(n) * turns_phasor(frequencies[:, None] * n), good_length(3 * self.size))

    def _fade(self, n: Tensor) -> Tensor:
        """1 inside, infinitely smooth to 0 over the margin at both ends."""
        if self.margin == 0:
            return torch.ones_like(n)
        place = (torch.minimum(n, self.size - 1 - n) + 0.5) * self.pitch / self.margin
        t = place.clamp(2e-3, 1 - 2e-3)
        return torch.where(place < 1, 1 / (1 + torch.exp(1 / t - 1 / (1 - t))), 1.0)

    def _energy(self, taps: Tensor) -> float:
        """Mean energy per sample that a convolution with ``taps`` [2n - 1] gives for unit tones of the band."""
        spectrum = self._tones * torch.fft.fft(taps, self._tones.shape[-1])
        kept = torch.fft.ifft(spectrum)[:, self.size - 1 : 2 * self.size - 1]
        per_tone = kept.abs().square().mean(1)
        inner, rim = per_tone[1:-1].sum(), per_tone[0] + per_tone[-1]  # trapezoidal rule over the band
        return ((inner + rim / 2) / (_TONES - 1)).item()


def rms_beyond_fresnel(axes: list[AxisContent]) -> float:
    """Rms over the band of the phase that Fresnel leaves out, pi z s^4 / (4 lambda), for light that lands inside.

    Both axes together, but without what hard edges put beyond the band; :meth:`AxisContent.paraxial` has that.
    """
    sines = []
    for axis in axes:
        reach = axis.size * axis.pitch
        sines.append(min(axis.wavelength * axis.band, reach / math.hypot(reach, axis.distance)))
    y, x = sines
    mean_s8 = y**8 / 9 + x**8 / 9 + 4 * (y**6 * x**2 + y**2 * x**6) / 21 + 6 * y**4 * x**4 / 25
    return min(math.pi * axes[0].distance / (4 * axes[0].wavelength) * math.sqrt(mean_s8), 2.0)
