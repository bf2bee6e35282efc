"""What a kernel on a transform of finite length gets wrong, computed on one axis before any field is propagated."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from holotorch.core.fourier import good_length
from holotorch.optics.kernels import turns_phasor
from holotorch.optics.taps import fresnel_taps, remainder_kernel, tap_indices

_TONES = 17


@dataclass(frozen=True)
class AxisContent:
    """Light of one axis: its band, and how the exact kernel and others treat tones of that band.

    All errors are energies relative to what the exact kernel keeps in the window of the result. They are means over
    tones exp(2 pi i f x) of the band, cut by the window of the source or faded out over its rim, which is the
    expectation for noise that fills both; or over measured signals, where there are any.

    Attributes:
        size: Samples n of the source.
        pitch: In metres.
        band: Highest frequency present, in cycles per metre, at most 1 / (2 pitch).
        wavelength: In metres.
        distance: In metres, > 0.
        margin: Width in metres of the rim over which the content fades to nothing at both ends; 0 for a hard edge.
        out: Samples of the result; ``size`` if 0.
        shift: Where sample 0 of the result lies beside sample 0 of the source, in samples, seen along the light.
        tilt: Sines (this axis, the other) of the carrier's direction.
        measured: Signals [K, size] to take instead of tones: random mixtures of the lines of a field.
    """

    size: int
    pitch: float
    band: float
    wavelength: float
    distance: float
    margin: float = 0.0
    out: int = 0
    shift: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    measured: Tensor | None = field(default=None, compare=False)

    @property
    def nyquist(self) -> float:
        """Highest frequency of the grid, 1 / (2 pitch)."""
        return 0.5 / self.pitch

    @property
    def window(self) -> int:
        """Samples of the result."""
        return self.out or self.size

    @property
    def bent(self) -> float:
        """Distance over which untilted light of the same wavelength would get this axis' curvature of phase."""
        own, other = self.tilt
        return self.distance * (1 - other**2) / (1 - own**2 - other**2) ** 1.5

    @cached_property
    def captured(self) -> float:
        """Share of the energy of the content that stays in the window."""
        return max(self._energy(self._taps), 1e-300)

    def moment(self, power: int, limit: float = math.inf) -> float:
        """Mean of min(f, limit)^power over the content, f in cycles per metre.

        Measured content has the window's edges in it, of a band without measurement only :meth:`standing` and
        :meth:`paraxial` know them.
        """
        if self.measured is None:
            top = min(self.band, limit)
            return top**power / (power + 1)
        # Twice the window: on the window alone the field would repeat, and a uniform one would have no edges.
        frequency = torch.fft.fftfreq(2 * self.size, self.pitch, dtype=torch.float64).abs().clamp(max=limit)
        weight = torch.fft.fft(self.measured, 2 * self.size).abs().square().sum(0)
        return ((weight * frequency**power).sum() / weight.sum().clamp(min=1e-300)).item()

    def standing(self) -> float:
        """Error of leaving the field as it is, what its edges diffract included."""
        still = (self._shifts == 0).to(torch.complex128)
        return self._energy(still - self._taps) / self.captured

    def wrapped(self, padded: int) -> float:
        """Error of a transfer function sampled on ``padded`` points.

        It repeats the kernel every ``padded`` samples; the repetitions among the window's displacements are the error.
        Where the rays alone say that more than 5 % of the light wraps, that share is returned as it is.
        """
        if self.measured is None and not self.shift and self.window == self.size:
            share = self._wrapped_rays(padded)
            if share > 0.05:
                return share
        frequency = torch.fft.fftfreq(padded, self.pitch, dtype=torch.float64)
        turns = -self.wavelength * self.bent / 2 * frequency.square() + frequency * self.shift * self.pitch
        repeated = torch.fft.ifft(turns_phasor(turns))
        return self._energy(repeated[self._shifts % padded] - self._taps) / self.captured

    def _wrapped_rays(self, padded: int) -> float:
        """Share of the light that travels sideways past the padding but not past the window behind it."""
        steepest = self.wavelength * self.bent * self.band / self.pitch  # samples
        room = padded - self.size
        if steepest <= room:
            return 0.0
        farthest = min(steepest, room + self.size)
        return (farthest - room) ** 2 / (2 * self.size * steepest) + max(0.0, steepest - farthest) / steepest

    def cropped(self, padded: int, cross: float) -> float:
        """Error of the factor beyond Fresnel on cropped taps, against the same on a much longer transform.

        ``cross`` is the frequency on the other axis, in cycles per metre, which takes part in that factor.
        """
        if self._moved > padded / 4:
            return self._rim()
        longer = max(2 * (self.size + self.window), 2 * padded if any(self.tilt) else 0)
        far = self._beyond_fresnel(good_length(longer, odd=any(self.tilt)), cross)
        return self._energy(self._beyond_fresnel(padded, cross) - far) / self.captured

    def paraxial(self) -> float:
        """Error of leaving out the factor beyond Fresnel, for light that travels along this axis only."""
        if self._moved > (self.size + self.window) / 4:
            return self._rim()
        exact = self._beyond_fresnel(good_length((3 * self.size + 3 * self.window) // 2), 0.0)
        return self._energy(exact - self._taps) / self.captured

    @property
    def _moved(self) -> float:
        """Samples by which the factor beyond Fresnel moves the steepest light of the grid: z s^3 / 2."""
        return self.distance * (self.wavelength * self.nyquist) ** 3 / (2 * self.pitch)

    def _rim(self) -> float:
        """Energy of the kernel's part that comes from the ends of the band, where its phase is not to be trusted.

        So far away the steepest light has long left the window; what remains of it are the two terms
        f(u) ~ 1 / (pi u) of the taps beside the point source's 1 / sqrt(2), in random phase.
        """
        product = self.wavelength * self.bent
        farthest = max(self.window - 1 + self.shift, self.size - 1 - self.shift, 0) * self.pitch
        u = math.sqrt(2 * product) * (self.nyquist - farthest / product)
        return min(1.0, 2 * 2 * 2 / (math.pi * u) ** 2) if u > 1 else 1.0

    @cached_property
    def _shifts(self) -> Tensor:
        return torch.arange(-(self.size - 1), self.window)

    @cached_property
    def _taps(self) -> Tensor:
        return self._fresnel(self._shifts)

    def _fresnel(self, index: Tensor) -> Tensor:
        wavelength, bent = (torch.tensor(value, dtype=torch.float64) for value in (self.wavelength, self.bent))
        return fresnel_taps(index.to(torch.float64) + self.shift, self.pitch, wavelength, bent)

    def _beyond_fresnel(self, padded: int, cross: float) -> Tensor:
        index = tap_indices(padded, self.size, self.window)
        frequency = torch.fft.fftfreq(padded, self.pitch, dtype=torch.float64)
        wavelength, distance, other = (
            torch.tensor(value, dtype=torch.float64) for value in (self.wavelength, self.distance, cross)
        )
        tilt = torch.tensor(self.tilt[::-1], dtype=torch.float64) if any(self.tilt) else None
        factor = remainder_kernel(other, frequency, wavelength, distance, tilt)
        return torch.fft.ifft(torch.fft.fft(self._fresnel(index)) * factor)[self._shifts % padded]

    @cached_property
    def _tones(self) -> Tensor:
        """Spectra of the content, long enough for the samples of the result to be free of wrapping."""
        length = good_length(self.size + self.window - 1)
        if self.measured is not None:
            return torch.fft.fft(self.measured, length)
        n = torch.arange(self.size, dtype=torch.float64)
        frequencies = torch.linspace(-1, 1, _TONES, dtype=torch.float64) * self.band * self.pitch
        tones = self._fade(n) * turns_phasor(frequencies[:, None] * n)
        tones[[0, -1]] *= math.sqrt(0.5)  # trapezoidal rule over the band
        return torch.fft.fft(tones / math.sqrt(_TONES - 1), length)

    def _fade(self, n: Tensor) -> Tensor:
        """1 inside, infinitely smooth to 0 over the margin at both ends."""
        if self.margin == 0:
            return torch.ones_like(n)
        place = (torch.minimum(n, self.size - 1 - n) + 0.5) * self.pitch / self.margin
        t = place.clamp(2e-3, 1 - 2e-3)
        return torch.where(place < 1, 1 / (1 + torch.exp(1 / t - 1 / (1 - t))), 1.0)

    def _energy(self, taps: Tensor) -> float:
        """Energy per sample of the source that a convolution with ``taps`` [n + m - 1] gives of the content."""
        spectrum = self._tones * torch.fft.fft(taps, self._tones.shape[-1])
        kept = torch.fft.ifft(spectrum)[:, self.size - 1 : self.size - 1 + self.window]
        return (kept.abs().square().sum() / self.size).item()


def rms_beyond_fresnel(axes: list[AxisContent]) -> float:
    """Rms over the content of the phase that Fresnel leaves out, pi z s^4 / (4 lambda), for light that lands inside.

    Both axes together, but without what hard edges put beyond the band; :meth:`AxisContent.paraxial` has that.
    """
    moments = []
    for axis in axes:
        reach = (abs(axis.shift) + (axis.size + axis.window) / 2) * axis.pitch
        limit = reach / math.hypot(reach, axis.distance) / axis.wavelength
        moments.append([axis.moment(power, limit) * axis.wavelength**power for power in (8, 6, 4, 2)])
    (y8, y6, y4, y2), (x8, x6, x4, x2) = moments
    mean_s8 = y8 + x8 + 4 * (y6 * x2 + y2 * x6) + 6 * y4 * x4
    return min(math.pi * axes[0].distance / (4 * axes[0].wavelength) * math.sqrt(mean_s8), 2.0)
