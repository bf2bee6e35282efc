"""Size of content over eccentricity, from cortical magnification and from empirical laws.

A law is a function of the eccentricity E in degrees, within 0 .. 180. Some laws return the size S in degrees; others
return 1 / M in deg/mm, to which the size is proportional. The cortical magnification M is the length of cortex per
degree of visual angle; M0 (``m0``, in mm/deg) is its value in the fovea.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.perception import angles


@dataclass(frozen=True)
class _Law:
    """Base class of the laws. ValueError for a parameter that is not above zero."""

    def __post_init__(self):
        for parameter in fields(self):
            checks.positive(parameter.name, getattr(self, parameter.name))


@dataclass(frozen=True)
class LinearMagnification(_Law):
    """1 / M = (1 + E / E2) / M0, thesis Eqs. 2.1 and 2.2 with a = 1 / E2; at E2, 1 / M is twice its foveal value."""

    m0: float
    e2_deg: float

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        return (1 + angles.eccentricity(eccentricity_deg) / self.e2_deg) / self.m0


# Cowey and Rolls (1974). The thesis prints 1 / M = (E / E2) / M0, which would give a size of 0 at the fovea.
COWEY_ROLLS = LinearMagnification(8.55, 1.746)
HORTON_HOYT = LinearMagnification(17.3 / 0.75, 0.75)  # thesis: M = 17.3 / (E + 0.75)
DOUGHERTY = LinearMagnification(29.2 / 3.67, 3.67)  # thesis: M = 29.2 / (E + 3.67)


@dataclass(frozen=True)
class RovamoVirsu(_Law):
    """1 / M = (1 + a E + b E^3) / M0 with a in 1/deg and b in 1/deg^3; Rovamo and Virsu (1979)."""

    a: float
    b: float
    m0: float = 7.99

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        eccentricity = angles.eccentricity(eccentricity_deg)
        return (1 + self.a * eccentricity + self.b * eccentricity**3) / self.m0


# Commonly quoted coefficients for the halves of the visual field; the thesis gives none.
NASAL, TEMPORAL = RovamoVirsu(0.33, 7e-5), RovamoVirsu(0.29, 1.2e-5)
SUPERIOR, INFERIOR = RovamoVirsu(0.42, 1.2e-4), RovamoVirsu(0.42, 5.5e-5)  # the upper and the lower half


@dataclass(frozen=True)
class TolhurstLing(_Law):
    """1 / M = (1 + a E)^1.1 / M0 with a in 1/deg; Tolhurst and Ling (1988). The thesis gives no value for a."""

    a: float
    m0: float = 24.88

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        return (1 + self.a * angles.eccentricity(eccentricity_deg)) ** 1.1 / self.m0


@dataclass(frozen=True)
class StrasburgerLetters(_Law):
    """S = 0.022 E + 0.25 / (log10 C + 2.07 - 0.0345 E), the size in degrees at which a letter is recognised.

    ``contrast`` is the letter's Michelson contrast C, above 10^-2.07 = 0.0085 and at most 1. The law is valid below the
    eccentricity ``pole_deg``, at which its denominator is zero; this pole is at 60 deg for a contrast of 1.

    Source: Strasburger et al. (2011), in thesis Sec. 2.2.1.
    """

    contrast: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        if not (self.pole_deg > 0 and self.contrast <= 1):
            raise ValueError(f"contrast must be above 10^-2.07 = 0.0085 and at most 1, got {self.contrast:g}")

    @property
    def pole_deg(self) -> float:
        """Eccentricity in degrees at which the denominator of S is zero."""
        return (math.log10(self.contrast) + 2.07) / 0.0345

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """S in degrees. ValueError for eccentricities of ``pole_deg`` or more."""
        eccentricity = angles.eccentricity(eccentricity_deg)
        pole = f"{self.pole_deg:.4g} degrees, its pole at a contrast of {self.contrast:g}"
        rule = f"eccentricity_deg must be below {pole}"
        angles.require(eccentricity < self.pole_deg, rule, eccentricity, "; use another law")
        return 0.022 * eccentricity + 0.25 / (0.0345 * (self.pole_deg - eccentricity))


@dataclass(frozen=True)
class LinearSize(_Law):
    """S = slope E + foveal_deg for E <= ``high_deg``, after Grogorick et al.; the thesis gives no coefficients."""

    slope: float
    foveal_deg: float
    high_deg: float = 40.0

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """S in degrees. ValueError beyond ``high_deg``."""
        eccentricity = angles.eccentricity(eccentricity_deg)
        rule = f"eccentricity_deg must be at most {self.high_deg:g} degrees, as far as it was tested"
        angles.require(eccentricity <= self.high_deg, rule, eccentricity)
        return self.slope * eccentricity + self.foveal_deg


Law = Callable[[Any], Tensor]


def cortical_scale(eccentricity_deg: Any, law: Law, size_deg: float = 1.0) -> Tensor:
    """Size in degrees at each eccentricity E, for content of size ``size_deg`` at the fixation point.

    Args:
        eccentricity_deg: Angles from the fixation point, >= 0, any shape; numbers give float64.
        law: A law of this module, such as ``COWEY_ROLLS``, or another function of the eccentricity to which the size is
            proportional. The result is ``size_deg * law(E) / law(0)``.
        size_deg: Size at the fixation point in degrees; 1 gives the ratio law(E) / law(0).

    Raises:
        ValueError: An eccentricity is outside 0 .. 180 deg or outside the range of the law.
    """
    eccentricity, foveal = angles.eccentricity(eccentricity_deg), angles.size(size_deg)
    return foveal.to(eccentricity) * law(eccentricity) / law(torch.zeros_like(eccentricity))


def peripheral_weight(eccentricity_deg: Any, law: Law, *, least: float = 0.0) -> Tensor:
    """Weights for the squared error of image samples, lower where the eye resolves less detail; their mean is 1.

    To be equally visible at eccentricity E, a detail must be law(E) / law(0) times as wide as at the fixation point.
    The eye thus sees a fraction (law(0) / law(E))^2 of an error with a white 2-D spectrum; this fraction is the weight.

    Args:
        eccentricity_deg: Eccentricities of the samples, [..., H, W], e.g. from ``Display.eccentricity_map``.
        law: As in :func:`cortical_scale`.
        least: Lower limit of the weight as a fraction of the weight at the fixation point, within 0 .. 1. Errors in
            the far periphery then keep at least this weight.

    Returns:
        Weights [..., H, W] with mean 1 over (H, W), in the dtype and on the device of the eccentricities.

    Raises:
        ValueError: As :func:`cortical_scale`; the eccentricities have fewer than two axes; ``least`` is outside 0 .. 1.
    """
    least = checks.finite("least", least)
    if not 0 <= least <= 1:
        raise ValueError(f"least must be within 0 .. 1, got {least:g}")
    eccentricity = angles.eccentricity(eccentricity_deg)
    if eccentricity.ndim < 2:
        raise ValueError(f"eccentricity_deg must end in (H, W), got {tuple(eccentricity.shape)}")
    weight = cortical_scale(eccentricity, law).pow(-2).clamp(min=least)
    return weight / weight.mean((-2, -1), keepdim=True)
