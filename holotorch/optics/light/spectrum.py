"""Spectrum: distribution of the power of a light source over wavelength."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import BANDWIDTH
from holotorch.optics.light.quadrature import SpeckleIntegral, gauss_rule

CUTOFF = 0.1  # fraction of the peak below which the thesis drops the power (Sec. 5.5.2.2)
_NODES = 256  # number of quadrature nodes over the band; exact to rounding for phases that vary by up to 200 rad
_legendre_rule = lru_cache(maxsize=8)(np.polynomial.legendre.leggauss)  # takes longer than what uses it


@dataclass(frozen=True)
class _Line:
    """A Lorentzian or, with ``gaussian``, a Gaussian line; all wavelengths in metres."""

    centre: float
    half_width: float
    gaussian: bool = False

    def __call__(self, wavelengths: Tensor) -> Tensor:
        """Power relative to the peak."""
        squares = ((wavelengths - self.centre) / self.half_width).square()
        return torch.exp2(-squares) if self.gaussian else 1 / (1 + squares)

    def band(self, level: float) -> tuple[float, float]:
        """Outermost wavelengths with at least ``level`` of the peak."""
        half = self.half_width * math.sqrt(-math.log2(level) if self.gaussian else 1 / level - 1)
        return self.centre - half, self.centre + half

    @property
    def joints(self) -> list[float]:
        """Ends of the quadrature intervals: 4, 16, ... half widths from the centre, so that the peak is resolved."""
        offset, joints = 4 * self.half_width, []
        while offset < self.centre:
            joints = [self.centre - offset, *joints, self.centre + offset]
            offset *= 4
        return joints


@dataclass(frozen=True)
class _Table:
    """Measured power at increasing wavelengths, linearly interpolated."""

    wavelengths: tuple[float, ...]
    powers: tuple[float, ...]

    def __call__(self, wavelengths: Tensor) -> Tensor:
        """Power relative to the peak; ValueError for wavelengths outside the table."""
        first, last = self.wavelengths[0], self.wavelengths[-1]
        outside = (wavelengths < first) | (wavelengths > last)
        if outside.any():
            wrong = wavelengths[outside].flatten()[0].item()
            raise ValueError(f"wavelength {wrong:g} m lies outside the table, which covers {first:g} to {last:g} m")
        power = np.interp(wavelengths.cpu().numpy(), self.wavelengths, self.powers) / max(self.powers)
        return torch.as_tensor(power, device=wavelengths.device)

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

    @property
    def joints(self) -> list[float]:
        """Ends of the quadrature intervals: the wavelengths at which the power has a kink."""
        return list(self.wavelengths)


@dataclass(frozen=True)
class Spectrum:
    """Power of a source against wavelength, from :meth:`Spectrum.lorentzian`, ``gaussian``, ``table`` or a preset.

    Power below ``cutoff`` times the peak is dropped, and the remaining band is normalised to unit power, so that images
    under different sources are compared at equal power (text below Eq. 5.16).

    The presets, such as ``Spectrum.laser(636e-9)``, are Lorentzian with the full widths at half maximum of Table 5.1.
    Eq. 5.15 as printed uses these numbers as half widths, which :meth:`Spectrum.lorentzian_as_printed` reproduces.

    Attributes:
        centre: Wavelength of the peak, in metres.
        fwhm: Full width at half maximum in metres.
        cutoff: Lowest power kept, as a fraction of the peak, above 0 and below 1.
        profile: Power relative to the peak as a function of wavelength.

    Raises ValueError for a width, wavelength or cutoff outside its range, or a band that would extend to wavelength 0.
    """

    centre: float
    fwhm: float
    profile: _Line | _Table
    cutoff: float = CUTOFF

    def __post_init__(self):
        checks.wavelengths(self.centre)
        checks.quantity(BANDWIDTH, self.fwhm)
        if self.band()[0] <= 0:
            raise ValueError(
                f"a width of {self.fwhm:g} m at {self.centre:g} m, cut off at {self.cutoff:g} of the peak, reaches "
                "wavelength 0; widths are in metres (5 nm is 5e-9), and a higher cutoff narrows the band"
            )

    @classmethod
    def lorentzian(cls, centre: float, fwhm: float, *, cutoff: float = CUTOFF) -> "Spectrum":
        """1 / (1 + (2 (lambda - centre) / fwhm)^2): Eq. 5.15 with gamma = fwhm / 2, the half width."""
        return cls(centre, fwhm, _Line(centre, checks.quantity(BANDWIDTH, fwhm) / 2), cutoff)

    @classmethod
    def lorentzian_as_printed(cls, centre: float, gamma: float, *, cutoff: float = CUTOFF) -> "Spectrum":
        """Eq. 5.15 as printed. The thesis calls ``gamma`` the full width, but in the equation it is half of it."""
        return cls.lorentzian(centre, 2 * checks.quantity(BANDWIDTH, gamma, "gamma"), cutoff=cutoff)

    @classmethod
    def gaussian(cls, centre: float, fwhm: float, *, cutoff: float = CUTOFF) -> "Spectrum":
        """2^(-(2 (lambda - centre) / fwhm)^2)."""
        return cls(centre, fwhm, _Line(centre, checks.quantity(BANDWIDTH, fwhm) / 2, gaussian=True), cutoff)

    @classmethod
    def table(cls, wavelengths: Sequence[float], power: Sequence[float], *, cutoff: float = CUTOFF) -> "Spectrum":
        """Measured ``power``, in any unit, at increasing ``wavelengths`` in metres; linearly interpolated.

        Where the power at an end of the table exceeds the cutoff or half the maximum, the band or the full width at
        half maximum ends with the table.

        Raises:
            ValueError: Fewer than two rows, unequal lengths, wavelengths that do not increase, a power below 0, or no
                power.
        """
        rows = checks.wavelengths(list(wavelengths))
        powers = tuple(checks.finite("power", value) for value in power)
        if len(rows) != len(powers) or len(rows) < 2:
            raise ValueError(
                f"a table needs two or more wavelengths and as many powers, got {len(rows)}, {len(powers)}"
            )
        for i, (one, two) in enumerate(itertools.pairwise(rows), 1):
            if two <= one:
                raise ValueError(f"wavelengths must increase, but number {i} is {two:g} after {one:g}; sort the rows")
        least, peak = min(powers), max(powers)
        if least < 0 or peak == 0:
            raise ValueError(f"power must be nonnegative, and positive somewhere, got {least:g} to {peak:g}")
        profile = _Table(rows, powers)
        low, high = profile.band(0.5)
        return cls(rows[powers.index(peak)], high - low, profile, cutoff)

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
        """Outermost wavelengths in metres with at least ``cutoff`` of the peak, by default ``self.cutoff``."""
        level = self.cutoff if cutoff is None else cutoff
        if not 0 < checks.finite("cutoff", level) < 1:
            raise ValueError(f"cutoff must lie between 0 and 1, a part of the peak, got {level!r}")
        return self.profile.band(level)

    def power(self, wavelengths: float | Sequence[float] | np.ndarray | Tensor) -> Tensor:
        """Power per metre of wavelength, float64 of the same shape: 0 outside the band, with an integral of 1.

        Raises ValueError for wavelengths outside the table of a measured spectrum.
        """
        points = torch.as_tensor(wavelengths, dtype=torch.float64)
        checks.all_finite("wavelengths", points)
        nodes, steps = self._steps()
        total = (self.profile(nodes) * steps).sum()
        low, high = self.band()
        return torch.where((points >= low) & (points <= high), self.profile(points) / total, 0.0)

    def every(self, step: float = 1e-9) -> tuple[Tensor, Tensor]:
        """Wavelengths [K] in the band ``step`` metres apart, including the centre, and weights [K] with a sum of 1.

        The weights are proportional to the power. This is the thesis's sampling with a step of 1 nm (Sec. 5.5.2.2);
        :meth:`samples` is more accurate with fewer wavelengths.
        """
        low, high = self.band()
        step, slack = checks.quantity(BANDWIDTH, step, "step"), 1e-9  # keeps the outermost steps despite rounding
        first, last = math.ceil((low - self.centre) / step - slack), math.floor((high - self.centre) / step + slack)
        wavelengths = self.centre + step * torch.arange(first, last + 1, dtype=torch.float64)
        power = self.profile(wavelengths.clamp(low, high))
        return wavelengths, power / power.sum()

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
        polynomials of the wavelength up to degree 2 K - 1. With ``path_difference``, wavelengths and weights minimise
        the expected error; where many wavelengths are needed, this takes a third fewer than Gauss's rule.

        Args:
            count: Number of wavelengths, at least 1.
            tolerance: Accepted rms error of an image relative to its rms brightness, above 0. It replaces ``count`` by
                the smallest sufficient number of wavelengths and needs ``path_difference``.
            path_difference: Greatest path difference in metres of the light that interferes
                (``coherence.path_difference``), above 0.
            iris: Whether the light passes a sharp pupil of fixed size. A hologram diffracts longer wavelengths to
                larger angles, so such a pupil cuts off more of their light. The intensity is then a rough function of
                wavelength, and errors below 2 % need many wavelengths. Pass False if a soft pupil or the highest
                frequency or the window of the hologram limits the light.
            step: Approximate the sum of :meth:`every` with this step in metres instead of the integral.

        Raises:
            ValueError: Neither or both of count and tolerance, a tolerance without a path difference, or a count above
                the number of wavelengths of :meth:`every`, or above 256 without ``step``.
        """
        if (count is None) == (tolerance is None):
            raise ValueError(f"give either count or tolerance, got {count!r} and {tolerance!r}")
        wavelengths, weights = self.measure() if step is None else self.every(step)
        middle = sum(self.band()) / 2
        offsets = wavelengths - middle
        if path_difference is None:
            if count is None:
                raise ValueError("a tolerance needs path_difference, in metres, of the light that interferes")
            nodes, weights = gauss_rule(offsets, weights, checks.whole("count", count, 1))
            return middle + nodes, weights
        beat = checks.positive("path_difference", path_difference, "metres") / middle**2
        integral = SpeckleIntegral(offsets, weights, beat, iris / middle)
        if count is not None:
            nodes, weights = integral.rule(checks.whole("count", count, 1))
        else:
            nodes, weights = integral.least_rule(checks.positive("tolerance", tolerance))  # type: ignore[arg-type]
        return middle + nodes, weights

    def measure(self) -> tuple[Tensor, Tensor]:
        """Many wavelengths [M] and weights [M] with a sum of 1, which integrate over the band almost exactly."""
        nodes, steps = self._steps()
        weights = self.profile(nodes) * steps
        return nodes, weights / weights.sum()

    def _steps(self) -> tuple[Tensor, Tensor]:
        """Nodes and weights of a composite Gauss-Legendre rule for the band, with one rule between adjacent joints."""
        low, high = self.band()
        ends = np.array([low, *(joint for joint in self.profile.joints if low < joint < high), high])
        count = max(2, math.ceil(_NODES / (len(ends) - 1)))
        t, weight = _legendre_rule(count)
        half = np.diff(ends)[:, None] / 2
        nodes = ends[:-1, None] + half * (1 + t)
        return torch.from_numpy(nodes.ravel()), torch.from_numpy((half * weight).ravel())
