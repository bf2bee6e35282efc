"""Spectrum: distribution of the power of a light source over wavelength."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import BANDWIDTH
from holotorch.optics.light.quadrature import gauss_rule, least_rule, speckle_rule

CUTOFF = 0.1  # fraction of the peak below which the thesis drops the power (Sec. 5.5.2.2)
# Nodes of the integral over the band from which rules are derived; accurate to rounding for up to 200 rad of phase.
_NODES = 256


@dataclass(frozen=True)
class _Lorentzian:
    half_width: float

    def __call__(self, offsets: Tensor) -> Tensor:
        return 1 / (1 + (offsets / self.half_width).square())

    def reach(self, level: float) -> float:
        return self.half_width * math.sqrt(1 / level - 1)


@dataclass(frozen=True)
class _Gaussian:
    half_width: float

    def __call__(self, offsets: Tensor) -> Tensor:
        return torch.exp2(-(offsets / self.half_width).square())

    def reach(self, level: float) -> float:
        return self.half_width * math.sqrt(-math.log2(level))


@dataclass(frozen=True)
class Spectrum:
    """Power of a source against wavelength, from :meth:`lorentzian`, :meth:`gaussian`, :meth:`table` or a preset.

    Power below ``cutoff`` times the peak is dropped, and the remaining band is normalized to unit power, so that
    pictures under different sources are compared at equal power (text below Eq. 5.16).

    The presets, such as ``Spectrum.laser(636e-9)``, have the widths of Table 5.1 as true full widths at half maximum.
    Eq. 5.15 as printed uses them as half widths; :meth:`lorentzian_as_printed` reproduces the results printed with it.

    Attributes:
        centre: Wavelength of the peak, in metres.
        fwhm: Full width at half maximum in metres.
        cutoff: Lowest power kept, as a fraction of the peak, above 0 and below 1.
        profile: Shape of the spectrum; for a table its wavelengths and powers.

    Raises:
        ValueError: A width, wavelength or cutoff outside its range, or a band that would extend to wavelength 0.
    """

    centre: float
    fwhm: float
    profile: "_Lorentzian | _Gaussian | _Table"
    cutoff: float = CUTOFF

    def __post_init__(self):
        checks.wavelengths(self.centre)
        checks.quantity(BANDWIDTH, self.fwhm)
        if not 0 < checks.finite("cutoff", self.cutoff) < 1:
            raise ValueError(f"cutoff must lie between 0 and 1, a part of the peak, got {self.cutoff!r}")
        if self.band()[0] <= 0:
            raise ValueError(
                f"a width of {self.fwhm:g} m at {self.centre:g} m, cut off at {self.cutoff:g} of the peak, reaches "
                "wavelength 0; widths are in metres (5 nm is 5e-9), and a higher cutoff narrows the band"
            )

    @classmethod
    def lorentzian(cls, centre: float, fwhm: float, *, cutoff: float = CUTOFF) -> "Spectrum":
        """1 / (1 + (2 (lambda - centre) / fwhm)^2): Eq. 5.15, whose gamma, the half width, is fwhm / 2."""
        return cls(centre, fwhm, _Lorentzian(checks.quantity(BANDWIDTH, fwhm) / 2), cutoff)

    @classmethod
    def lorentzian_as_printed(cls, centre: float, gamma: float, *, cutoff: float = CUTOFF) -> "Spectrum":
        """Eq. 5.15 as printed. The thesis calls ``gamma`` the FWHM, but it is half of the FWHM of this source."""
        return cls.lorentzian(centre, 2 * checks.quantity(BANDWIDTH, gamma, "gamma"), cutoff=cutoff)

    @classmethod
    def gaussian(cls, centre: float, fwhm: float, *, cutoff: float = CUTOFF) -> "Spectrum":
        """2^(-(2 (lambda - centre) / fwhm)^2)."""
        return cls(centre, fwhm, _Gaussian(checks.quantity(BANDWIDTH, fwhm) / 2), cutoff)

    @classmethod
    def table(cls, wavelengths: Sequence[float], power: Sequence[float], *, cutoff: float = CUTOFF) -> "Spectrum":
        """Measured ``power``, in any unit, at increasing ``wavelengths`` in metres; linearly interpolated.

        If the power at an end of the table exceeds the cutoff, the band ends there. Likewise the width at half maximum
        is limited by the table.

        Raises:
            ValueError: Fewer than two rows, unequal lengths, wavelengths that do not increase, negative or no power.
        """
        places = checks.wavelengths(list(wavelengths))
        values = tuple(checks.finite("power", value) for value in power)
        if len(places) != len(values) or len(places) < 2:
            raise ValueError(
                f"a table needs two or more wavelengths and as many powers, got {len(places)}, {len(values)}"
            )
        for i, (here, there) in enumerate(zip(places, places[1:], strict=False)):
            if there <= here:
                raise ValueError(
                    f"wavelengths must increase, but number {i + 1} is {there:g} after {here:g}; sort the rows"
                )
        if min(values) < 0 or max(values) == 0:
            raise ValueError(
                f"power must be nonnegative, and positive somewhere, got {min(values):g} to {max(values):g}"
            )
        profile = _Table(places, values)
        low, high = profile.band(0.5)
        return cls(places[values.index(max(values))], high - low, profile, cutoff)

    @classmethod
    def laser(cls, centre: float) -> "Spectrum":
        """Laser diode of Table 5.1, 1.4 nm wide."""
        return cls.lorentzian(centre, 1.4e-9)

    @classmethod
    def narrow_sled(cls, centre: float) -> "Spectrum":
        """Narrow superluminescent diode of Table 5.1, 5 nm wide."""
        return cls.lorentzian(centre, 5e-9)

    @classmethod
    def sled(cls, centre: float) -> "Spectrum":
        """Superluminescent diode of Table 5.1, 10 nm wide."""
        return cls.lorentzian(centre, 10e-9)

    @classmethod
    def led(cls, centre: float) -> "Spectrum":
        """LED of Table 5.1, 20 nm wide."""
        return cls.lorentzian(centre, 20e-9)

    def band(self, cutoff: float | None = None) -> tuple[float, float]:
        """Least and greatest wavelength in metres with at least ``cutoff`` of the peak, by default the spectrum's."""
        level = self.cutoff if cutoff is None else cutoff
        if not 0 < checks.finite("cutoff", level) < 1:
            raise ValueError(f"cutoff must lie between 0 and 1, a part of the peak, got {level!r}")
        if isinstance(self.profile, _Table):
            return self.profile.band(level)
        reach = self.profile.reach(level)
        return self.centre - reach, self.centre + reach

    def power(self, wavelengths: float | Sequence[float] | np.ndarray | Tensor) -> Tensor:
        """Power per metre of wavelength, float64 of the same shape: 0 outside the band, with an integral of 1.

        Raises ValueError for wavelengths outside a table.
        """
        places = torch.as_tensor(wavelengths, dtype=torch.float64)
        checks.all_finite("wavelengths", places)
        nodes, steps = self._steps()
        total = (self._shape(nodes) * steps).sum()
        low, high = self.band()
        return torch.where((places >= low) & (places <= high), self._shape(places) / total, 0.0)

    def every(self, step: float = 1e-9) -> tuple[Tensor, Tensor]:
        """Wavelengths [K] ``step`` metres apart, one at the centre, and weights [K] in proportion to the power.

        This is the thesis's sampling at 1 nm (Sec. 5.5.2.2). The sum covers whole steps within the band only;
        :meth:`samples` is more accurate with fewer wavelengths.
        """
        low, high = self.band()
        step, slack = checks.quantity(BANDWIDTH, step, "step"), 1e-9  # rounding must not drop the last one
        first, last = math.ceil((low - self.centre) / step - slack), math.floor((high - self.centre) / step + slack)
        places = self.centre + step * torch.arange(first, last + 1, dtype=torch.float64)
        shape = self._shape(places.clamp(low, high))
        return places, shape / shape.sum()

    def samples(
        self,
        count: int | None = None,
        *,
        tolerance: float | None = None,
        path_difference: float | None = None,
        step: float | None = None,
        iris: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """Few wavelengths [K] in metres and weights [K], float64, whose weighted sum approximates the integral.

        With ``count`` alone the result is Gauss's rule for the power over the band, exact for intensities that are
        polynomials of the wavelength up to degree 2 K - 1. With ``path_difference``, nodes and weights minimize the
        expected error; where many wavelengths are needed, this takes a third fewer. Then ``tolerance`` may replace
        ``count``, and the smallest sufficient number of wavelengths is used.

        Args:
            count: Number of wavelengths, at least 1.
            tolerance: Accepted rms error of a picture relative to its rms brightness, above 0.
            path_difference: Greatest path difference in metres of the light that interferes
                (``coherence.path_difference``), above 0.
            iris: True if the light passes a sharp pupil of fixed size. A hologram diffracts longer wavelengths more, so
                the pupil cuts off more of their light. This makes intensity a rough function of wavelength, and errors
                below 2 % need many wavelengths. False if the hologram's band, its window or a soft pupil is the limit.
            step: Approximate the sum over :meth:`every` ``step`` instead of the integral; the thesis's step is 1e-9.

        Raises:
            ValueError: Neither or both of count and tolerance, a tolerance without a path difference, or a count above
                the 256 wavelengths of the integral, or those of the sum.
        """
        if (count is None) == (tolerance is None):
            raise ValueError(f"give either count or tolerance, got {count!r} and {tolerance!r}")
        places, weights = self.measure() if step is None else self.every(step)
        low, high = self.band()
        middle = (low + high) / 2
        offsets = places - middle
        if path_difference is None:
            if count is None:
                raise ValueError("a tolerance needs path_difference, in metres, of the light that interferes")
            nodes, weights = gauss_rule(offsets, weights, checks.whole("count", count, 1))
            return middle + nodes, weights
        beat, rim = checks.positive("path_difference", path_difference, "metres") / middle**2, iris / middle
        if tolerance is not None:
            nodes, weights = least_rule(offsets, weights, beat, checks.positive("tolerance", tolerance), rim)
        else:
            nodes, weights = speckle_rule(offsets, weights, beat, checks.whole("count", count or 0, 1), rim)
        return middle + nodes, weights

    def measure(self) -> tuple[Tensor, Tensor]:
        """Many wavelengths [M] in the band and weights [M] with sum 1; they integrate nearly to rounding error."""
        nodes, steps = self._steps()
        weights = self._shape(nodes) * steps
        return nodes, weights / weights.sum()

    def _steps(self) -> tuple[Tensor, Tensor]:
        """Gauss-Legendre nodes and weights of the band, composed of a rule for each piece between joints."""
        low, high = self.band()
        ends = np.array([low, *(place for place in self._joints() if low < place < high), high])
        count = max(2, math.ceil(_NODES / (len(ends) - 1)))
        t, weight = np.polynomial.legendre.leggauss(count)
        half = np.diff(ends)[:, None] / 2
        nodes = ends[:-1, None] + half * (1 + t)
        return torch.from_numpy(nodes.ravel()), torch.from_numpy((half * weight).ravel())

    def _joints(self) -> list[float]:
        """Wavelengths that divide the band into pieces: the rows of a table, or distances of 4, 16, ... half widths.

        Separate pieces keep the peak well sampled if a low cutoff includes wide wings.
        """
        if isinstance(self.profile, _Table):
            return list(self.profile.wavelengths)
        offsets, joints = 4 * self.profile.half_width, []
        while offsets < self.centre:
            joints = [self.centre - offsets, *joints, self.centre + offsets]
            offsets *= 4
        return joints

    def _shape(self, places: Tensor) -> Tensor:
        return self.profile(places if isinstance(self.profile, _Table) else places - self.centre)


@dataclass(frozen=True)
class _Table:
    wavelengths: tuple[float, ...]
    powers: tuple[float, ...]

    def __call__(self, places: Tensor) -> Tensor:
        first, last = self.wavelengths[0], self.wavelengths[-1]
        outside = (places < first) | (places > last)
        if outside.any():
            wrong = places[outside].flatten()[0].item()
            raise ValueError(f"wavelength {wrong:g} m lies outside the table, which covers {first:g} to {last:g} m")
        power = np.interp(places.cpu().numpy(), self.wavelengths, self.powers) / max(self.powers)
        return torch.as_tensor(power, device=places.device)

    def band(self, level: float) -> tuple[float, float]:
        """Outermost wavelengths with at least ``level`` of the peak."""
        power = np.array(self.powers) / max(self.powers)
        strong = np.flatnonzero(power >= level)
        first, last = int(strong[0]), int(strong[-1])
        low, high = self.wavelengths[first], self.wavelengths[last]
        if first > 0:
            low = float(np.interp(level, power[first - 1 : first + 1], self.wavelengths[first - 1 : first + 1]))
        if last < len(power) - 1:
            high = float(np.interp(level, power[last : last + 2][::-1], self.wavelengths[last : last + 2][::-1]))
        return low, high
