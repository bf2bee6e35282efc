"""Errors of kernels on transforms of finite length, predicted on one axis before any field is propagated.

The factor beyond Fresnel is the exact transfer function divided by Fresnel's. The taps of a kernel are the n + m - 1
samples of its impulse response at the displacements between n samples of the source and m of the result. A slice of a
kernel that does not factor into one kernel per axis is its restriction to one frequency of the other axis. K counts
slices, tones or measured signals.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from holotorch.core.fourier import good_length
from holotorch.optics.free_space.impulse_response import (
    fresnel_taps,
    levelling_shift,
    remainder_kernel,
    tap_indices,
    tilted_cycles,
)
from holotorch.optics.free_space.kernels import cycles_phasor

_TONES = 17  # tones that represent the band of one axis
_SLICES = 9  # evenly spaced slices
_QUANTILES = (0.02, 0.1, 0.25, 0.4, 0.6, 0.75, 0.9, 0.98)  # quantiles of measured energy at which slices are added
_LONGER = 4  # length of the reference transform, in units of source plus window; the wrapping is then negligible
_LONGEST = 1 << 18  # samples of the longest reference transform; light that needs a longer one counts as lost


@dataclass(frozen=True)
class AxisContent:
    """Light of one axis, and the errors of approximate kernels for this light.

    All errors are energies relative to the energy that the exact kernel keeps in the window of the result. They are
    means over tones exp(2 pi i f x) of the band, cut off by the window of the source or faded out over its margin.
    These means are the expectation for noise that fills band and window. Measured signals, if given, replace the tones.
    Arguments ``padded`` are samples of a transform, and ``other`` is the content of the other axis.

    Attributes:
        size: Samples n of the source.
        pitch: Pitch in metres of source and result.
        band: Highest frequency of the content, in cycles per metre, at most 1 / (2 pitch).
        wavelength: In metres.
        distance: In metres, > 0.
        margin: Width in metres over which the content fades to zero at both ends; 0 for a hard edge.
        window: Samples m of the result.
        shift: Position, in samples, of sample 0 of the result relative to sample 0 of the source projected along the
            carrier.
        tilt: Sines (this axis, the other) of the carrier's direction.
        measured: Signals [K, size] that replace the tones, or None: random mixtures of the lines of a field.
    """

    size: int
    pitch: float
    band: float
    wavelength: float
    distance: float
    margin: float
    window: int
    shift: float
    tilt: tuple[float, float]
    measured: Tensor | None = field(compare=False)
    _exact: list[Tensor | None] = field(default_factory=list, init=False, repr=False, compare=False)

    @property
    def nyquist(self) -> float:
        """Highest frequency of the grid, 1 / (2 pitch)."""
        return 0.5 / self.pitch

    @property
    def curving_distance(self) -> float:
        """Distance in metres over which light without tilt acquires the phase curvature of this axis."""
        along, other = self.tilt
        return self.distance * (1 - other**2) / (1 - along**2 - other**2) ** 1.5

    @cached_property
    def captured(self) -> float:
        """Mean energy of the content that arrives in the window; for tones without margin, the arriving fraction."""
        return max(self._energy(self._taps), 1e-300)

    def moment(self, power: int, limit: float = math.inf) -> float:
        """Mean of f^power over described content with f up to ``limit``, or of min(f, limit)^power if measured.

        Frequencies f are in cycles per metre. Only measured content includes the edges of the window.
        """
        if self.measured is None:
            top = min(self.band, limit)
            return top**power / (power + 1)
        frequency, weight = self._power
        frequency = frequency.abs().clamp(max=limit)
        return ((weight * frequency**power).sum() / weight.sum().clamp(min=1e-300)).item()

    def unchanged(self) -> float:
        """Error of returning the field unchanged, including the neglected diffraction at its edges."""
        identity = (self._shifts == 0).to(torch.complex128)
        return self._energy(identity - self._taps) / self.captured

    def wrapped(self, padded: int) -> float:
        """Error of a transfer function sampled at ``padded`` frequencies.

        The sampling repeats the taps every ``padded`` samples; the repetitions within the window are the error. If more
        than 5 % of the light wraps according to geometrical optics, that fraction is returned.
        """
        if self.measured is None and not self.shift and self.window == self.size:
            fraction = self._wrapped_rays(padded)
            if fraction > 0.05:
                return fraction
        frequency = torch.fft.fftfreq(padded, self.pitch, dtype=torch.float64)
        cycles = -self.wavelength * self.curving_distance / 2 * frequency.square() + frequency * self.shift * self.pitch
        repeated = torch.fft.ifft(cycles_phasor(cycles))
        return self._energy(repeated[self._shifts % padded] - self._taps) / self.captured

    def wrapped_slices(self, padded: int, other: "AxisContent", *, limited: bool) -> float:
        """:meth:`wrapped` for steep light, whose exact kernel does not factor into axes and is represented by slices.

        If ``limited``, the frequencies that :func:`angular_spectrum_kernel` drops on ``padded`` samples are dropped.
        """
        if any(self.tilt) and self._spread(other) > 2 * padded:
            return 1.0  # as much light wraps as arrives
        return self._from_exact(self._slices(padded, other, padded * self.pitch if limited else math.inf), other)

    def tilted_taps(self, padded: int, other: "AxisContent", *, paraxial: bool) -> float:
        """Error of cropped taps about a tilted carrier, with or, if ``paraxial``, without the factor beyond Fresnel."""
        if paraxial:
            return self._from_exact(self._taps * self._across(other), other)
        wavelength, distance, tilt = self._scene
        shift = levelling_shift((self.nyquist, other.nyquist), wavelength, distance, tilt, 0)
        return self._from_exact(self._levelled(padded, other, shift.expand(len(other.slices), 1)), other)

    def _from_exact(self, approximate: Tensor, other: "AxisContent") -> float:
        """Error of the taps ``approximate`` [K, n + m - 1] of the slices, weighted with the energy of each slice."""
        exact = self._exact_slices(other)
        if exact is None:
            return 1.0
        lost, total = (
            sum(weight * self._energy(each) for weight, each in zip(other.slice_weights, taps, strict=True))
            for taps in (approximate - exact, exact)
        )
        return lost / max(total, 1e-300)

    def _exact_slices(self, other: "AxisContent") -> Tensor | None:
        """Taps [K, n + m - 1] of the slices without wrapping, cached; None if the transform would be too long."""
        if self._exact:
            return self._exact[0]
        padded, exact = _LONGER * (self.size + self.window), None
        if not any(self.tilt):
            # 4 times longer, because the transfer function is singular where waves become evanescent.
            exact = self._slices(4 * padded, other, math.inf)
        elif (padded := good_length(max(padded, 2 * self._spread(other)), odd=True)) <= _LONGEST:
            # Each slice is shifted so that its phase is equal at both ends of the band, which adjoin in the DFT.
            wavelength, distance, tilt = self._scene
            ends = torch.tensor((self.nyquist, -self.nyquist), dtype=torch.float64)
            cycles = tilted_cycles(ends, other.slices, wavelength, distance, tilt, squares=False)
            exact = self._levelled(padded, other, (cycles[:, :1] - cycles[:, 1:]) / (2 * self.nyquist))
        self._exact.append(exact)
        return exact

    def _levelled(self, padded: int, other: "AxisContent", shift: Tensor) -> Tensor:
        """Taps [K, n + m - 1]: Fresnel taps moved by ``shift`` [K, 1] metres, times the factor beyond Fresnel."""
        index = tap_indices(padded, self.size, self.window)
        taps = torch.stack([self._fresnel(index + offset / self.pitch) for offset in shift[:, 0]])
        factor = self._levelled_factor(padded, other, shift)
        return torch.fft.ifft(torch.fft.fft(taps) * factor)[:, self._shifts % padded]

    def _levelled_factor(self, padded: int, other: "AxisContent", shift: Tensor) -> Tensor:
        """Factor beyond Fresnel [K, padded] of the slices, without the phase of a displacement by ``shift`` [K, 1]."""
        wavelength, distance, tilt = self._scene
        frequency = torch.fft.fftfreq(padded, self.pitch, dtype=torch.float64)
        cycles = tilted_cycles(frequency, other.slices, wavelength, distance, tilt, squares=False)
        return cycles_phasor(cycles - frequency * shift) * self._across(other)

    def _across(self, other: "AxisContent") -> Tensor:
        """Paraxial phase factor [K, 1] of the slices, which depends on the frequency of the other axis only."""
        return cycles_phasor(-self.wavelength * other.curving_distance / 2 * other.slices.square())

    @property
    def _scene(self) -> tuple[Tensor, Tensor, Tensor]:
        """Wavelength, distance and tilt [2] as float64 tensors."""
        wavelength, distance, *tilt = torch.tensor((self.wavelength, self.distance, *self.tilt), dtype=torch.float64)
        return wavelength, distance, torch.stack(tilt)

    @cached_property
    def slices(self) -> Tensor:
        """Frequencies [K, 1] of this axis, in cycles per metre, at which slices of the kernel represent this axis.

        They cover the band evenly; for measured content, quantiles of its energy are added.
        """
        even = torch.linspace(-1, 1, _SLICES, dtype=torch.float64) * self.band
        if self.measured is None:
            return even[:, None]
        frequency, energy = self._power
        order = frequency.argsort()
        fractions = energy[order].cumsum(0) / energy.sum().clamp(min=1e-300)
        quantiles = torch.searchsorted(fractions, torch.tensor(_QUANTILES, dtype=torch.float64))
        return torch.cat([even, frequency[order][quantiles.clamp(max=len(order) - 1)]]).unique()[:, None]

    @property
    def _power(self) -> tuple[Tensor, Tensor]:
        """Frequencies [2 size] and the energy of measured content at them.

        The transform has twice the length of the source, so that the spectrum includes the edges of the source.
        """
        assert self.measured is not None
        frequency = torch.fft.fftfreq(2 * self.size, self.pitch, dtype=torch.float64)
        return frequency, torch.fft.fft(self.measured, 2 * self.size).abs().square().sum(0)

    def _spread(self, other: "AxisContent") -> int:
        """Samples over which tilted light spreads from source and window, at all frequencies of both axes."""
        along, across = (
            self.wavelength * torch.tensor((-axis.nyquist, 0.0, axis.nyquist), dtype=torch.float64) + sine
            for axis, sine in zip((self, other), self.tilt, strict=True)
        )
        tangents = along[:, None] / torch.sqrt((1 - along[:, None].square() - across.square()).clamp(min=1e-3))
        positions = self.distance * tangents / self.pitch
        return math.ceil((positions.max() - positions.min()).item()) + self.size + self.window

    @cached_property
    def slice_weights(self) -> list[float]:
        """Fraction of the energy of the content that each of :attr:`slices` represents."""
        if self.measured is None:
            weights = torch.ones(_SLICES, dtype=torch.float64)
            weights[[0, -1]] = 0.5
        else:
            frequency, energy = self._power
            nearest = (frequency[:, None] - self.slices[:, 0]).abs().argmin(1)
            weights = torch.zeros(len(self.slices), dtype=torch.float64).index_add(0, nearest, energy)
        return (weights / weights.sum().clamp(min=1e-300)).tolist()

    def _slices(self, padded: int, other: "AxisContent", extent: float) -> Tensor:
        """Taps [K, n + m - 1] of the slices of the exact kernel, sampled at ``padded`` frequencies.

        Without tilt, frequencies whose light moves sideways by more than ``extent`` / 2 metres are dropped.
        """
        wavelength, distance, tilt = self._scene
        frequency = torch.fft.fftfreq(padded, self.pitch, dtype=torch.float64)
        cycles = frequency * self.shift * self.pitch
        if any(self.tilt):
            kernel = cycles_phasor(tilted_cycles(frequency, other.slices, wavelength, distance, tilt) + cycles)
        else:
            root = torch.sqrt(1 - (wavelength * frequency).square() - (wavelength * other.slices).square() + 0j)
            kernel = cycles_phasor(distance / wavelength * (root.real - 1) + cycles)
            kernel = kernel * torch.exp(-2 * math.pi * distance / wavelength * root.imag)
            steep = 2 * distance * wavelength * frequency.abs() > extent * root.abs()
            kernel = torch.where(steep, 0.0, kernel)
        return torch.fft.ifft(kernel)[:, self._shifts % padded]

    def _wrapped_rays(self, padded: int) -> float:
        """Fraction of the light that moves sideways beyond the padding, into the repetition of the window."""
        steepest = self.wavelength * self.curving_distance * self.band / self.pitch  # sideways travel in samples
        padding = padded - self.size
        if steepest <= padding:
            return 0.0
        farthest = min(steepest, padded)
        return (farthest - padding) ** 2 / (2 * self.size * steepest) + max(0.0, steepest - farthest) / steepest

    def cropped(self, padded: int, cross: float) -> float:
        """Error of applying the factor beyond Fresnel to cropped taps, with a longer transform as the reference.

        The factor depends on both axes; ``cross`` is the frequency of the other axis, in cycles per metre.
        """
        if self._moved > padded / 4:
            return self._band_edge_energy()
        longer = self._beyond_fresnel(good_length(2 * (self.size + self.window)), cross)
        return self._energy(self._beyond_fresnel(padded, cross) - longer) / self.captured

    def resampled(self, padded: int, cross: float) -> float:
        """Error of applying the factor beyond Fresnel to the padded source, before the Fresnel taps.

        ``cross`` as in :meth:`cropped`.
        """
        if self._moved > padded / 4:
            return self._band_edge_energy()
        approximate = self._filtered_first(self._remainder(padded, cross), self._fresnel)
        longer = self._beyond_fresnel(good_length(max(2 * (self.size + self.window), 4 * padded)), cross)
        return ((approximate - self._arriving(longer)).abs().square().sum() / self.size).item() / self.captured

    def resampled_slices(self, padded: int, other: "AxisContent") -> float:
        """:meth:`resampled` about a tilted carrier, computed on slices."""
        exact = self._exact_slices(other)
        if exact is None:
            return 1.0
        wavelength, distance, tilt = self._scene
        shift = levelling_shift((self.nyquist, other.nyquist), wavelength, distance, tilt, 0)
        factors, lost, total = self._levelled_factor(padded, other, shift), 0.0, 0.0
        for factor, taps, weight in zip(factors, exact, other.slice_weights, strict=True):
            approximate = self._filtered_first(factor, lambda index: self._fresnel(index + shift / self.pitch))
            reference = self._arriving(taps)
            lost += weight * (approximate - reference).abs().square().sum().item()
            total += weight * reference.abs().square().sum().item()
        return lost / max(total, 1e-300)

    def _filtered_first(self, factor: Tensor, taps: Callable[[Tensor], Tensor]) -> Tensor:
        """The content filtered with ``factor`` [P], then convolved with the result of ``taps`` for displacements."""
        padded = len(factor)
        margin = (padded - self.size) // 2
        kept = self.size + 2 * margin
        filtered = torch.fft.ifft(torch.fft.fft(self._signals, padded) * factor)
        filtered = filtered[:, torch.arange(-margin, self.size + margin) % padded]
        weights = taps(torch.arange(-(self.size + margin - 1), self.window + margin))
        length = good_length(kept + len(weights) - 1)
        arriving = torch.fft.ifft(torch.fft.fft(filtered, length) * torch.fft.fft(weights, length))
        return arriving[:, kept - 1 : kept - 1 + self.window]

    def paraxial(self) -> float:
        """Error of neglecting the factor beyond Fresnel, for light of frequency 0 on the other axis."""
        if self._moved > (self.size + self.window) / 4:
            return self._band_edge_energy()
        exact = self._beyond_fresnel(good_length((3 * self.size + 3 * self.window) // 2), 0.0)
        return self._energy(exact - self._taps) / self.captured

    @property
    def _moved(self) -> float:
        """Samples by which the factor beyond Fresnel moves the steepest light of the grid, z s^3 / 2 for the sine s."""
        return self.distance * (self.wavelength * self.nyquist) ** 3 / (2 * self.pitch)

    def _band_edge_energy(self) -> float:
        """Error where the factor beyond Fresnel gives the ends of the band an unreliable phase.

        At such distances the steepest light has left the window. The ends of the band contribute terms ~ 1 / (pi u) to
        the taps, where u is an argument of :func:`fresnel_taps`; their energy is estimated as 8 / (pi u)^2, at most 1,
        with the u of the largest displacement.
        """
        product = self.wavelength * self.curving_distance
        largest = max(self.window - 1 + self.shift, self.size - 1 - self.shift, 0) * self.pitch
        u = math.sqrt(2 * product) * (self.nyquist - largest / product)
        return min(1.0, 2 * 2 * 2 / (math.pi * u) ** 2) if u > 1 else 1.0

    @cached_property
    def _shifts(self) -> Tensor:
        """Displacements [n + m - 1] in samples, without :attr:`shift`."""
        return torch.arange(-(self.size - 1), self.window)

    @cached_property
    def _taps(self) -> Tensor:
        """Fresnel's taps [n + m - 1]."""
        return self._fresnel(self._shifts)

    def _fresnel(self, index: Tensor) -> Tensor:
        wavelength, distance = torch.tensor((self.wavelength, self.curving_distance), dtype=torch.float64)
        return fresnel_taps(index.to(torch.float64) + self.shift, self.pitch, wavelength, distance)

    def _beyond_fresnel(self, padded: int, cross: float) -> Tensor:
        """Fresnel's taps [n + m - 1] times the factor beyond Fresnel, applied on ``padded`` samples."""
        taps = self._fresnel(tap_indices(padded, self.size, self.window))
        return torch.fft.ifft(torch.fft.fft(taps) * self._remainder(padded, cross))[self._shifts % padded]

    def _remainder(self, padded: int, cross: float) -> Tensor:
        """Factor beyond Fresnel [padded] at the frequency ``cross`` of the other axis."""
        frequency = torch.fft.fftfreq(padded, self.pitch, dtype=torch.float64)
        wavelength, distance, _ = self._scene
        return remainder_kernel(torch.tensor(cross, dtype=torch.float64), frequency, wavelength, distance)

    @cached_property
    def _signals(self) -> Tensor:
        """Measured signals or tones of the content [K, size]."""
        if self.measured is not None:
            return self.measured
        n = torch.arange(self.size, dtype=torch.float64)
        frequencies = torch.linspace(-1, 1, _TONES, dtype=torch.float64) * self.band * self.pitch
        tones = self._fade(n) * cycles_phasor(frequencies[:, None] * n)
        tones[[0, -1]] *= math.sqrt(0.5)  # trapezoidal rule over the band
        return tones / math.sqrt(_TONES - 1)

    @cached_property
    def _spectra(self) -> Tensor:
        """Spectra [K, length] of the content, padded so that nothing wraps into the samples of the result."""
        return torch.fft.fft(self._signals, good_length(self.size + self.window - 1))

    def _fade(self, n: Tensor) -> Tensor:
        """Weights at the samples ``n``: 1 inside, falling to 0 over the margin, infinitely differentiable."""
        if self.margin == 0:
            return torch.ones_like(n)
        position = (torch.minimum(n, self.size - 1 - n) + 0.5) * self.pitch / self.margin
        t = position.clamp(2e-3, 1 - 2e-3)
        return torch.where(position < 1, 1 / (1 + torch.exp(1 / t - 1 / (1 - t))), 1.0)

    def _energy(self, taps: Tensor) -> float:
        """Energy of the content after convolution with ``taps`` [n + m - 1], divided by the samples of the source."""
        return (self._arriving(taps).abs().square().sum() / self.size).item()

    def _arriving(self, taps: Tensor) -> Tensor:
        """The content convolved with ``taps`` [n + m - 1], in the window of the result."""
        spectrum = self._spectra * torch.fft.fft(taps, self._spectra.shape[-1])
        return torch.fft.ifft(spectrum)[:, self.size - 1 : self.size - 1 + self.window]


def rms_beyond_fresnel(axes: tuple[AxisContent, AxisContent]) -> float:
    """Rms, at most 2 rad, of the phase pi z s^4 / (4 lambda) that Fresnel's model neglects, over the arriving light.

    z is the distance and s the sine of the angle to the axis. Both axes are included, but not the light that hard edges
    diffract beyond the band; :meth:`AxisContent.paraxial` includes that light.
    """
    moments = []
    for axis in axes:
        lateral = (abs(axis.shift) + (axis.size + axis.window) / 2) * axis.pitch
        limit = lateral / math.hypot(lateral, axis.distance) / axis.wavelength
        moments.append([axis.moment(power, limit) * axis.wavelength**power for power in (8, 6, 4, 2)])
    (y8, y6, y4, y2), (x8, x6, x4, x2) = moments
    mean_s8 = y8 + x8 + 4 * (y6 * x2 + y2 * x6) + 6 * y4 * x4
    return min(math.pi * axes[0].distance / (4 * axes[0].wavelength) * math.sqrt(mean_s8), 2.0)
