"""Size of content over eccentricity, from cortical magnification and from empirical laws.

A law is a function of the eccentricity E in degrees, within 0 .. 180. It returns the size S in degrees, or 1 / M in
deg/mm, to which sizes are proportional. M is the cortical magnification, the length of cortex per visual angle; M0
(``m0``, in mm/deg) is its value in the fovea.
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
    """Base class of the laws: every parameter must be above zero."""

    def __post_init__(self):
        for parameter in fields(self):
            checks.positive(parameter.name, getattr(self, parameter.name))


@dataclass(frozen=True)
class LinearMagnification(_Law):
    """1 / M = (1 + E / E2) / M0, thesis Eqs. 2.1 and 2.2 with a = 1 / E2; at E2, sizes are twice the foveal ones."""

    m0: float
    e2_deg: float

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        return (1 + angles.eccentricity(eccentricity_deg) / self.e2_deg) / self.m0


# The thesis prints E / E2 for Cowey and Rolls (1974), without the 1, which would give the size 0 at the fovea.
COWEY_ROLLS = LinearMagnification(8.55, 1.746)
HORTON_HOYT = LinearMagnification(17.3 / 0.75, 0.75)  # printed as M = 17.3 / (E + 0.75)
DOUGHERTY = LinearMagnification(29.2 / 3.67, 3.67)  # printed as M = 29.2 / (E + 3.67)


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


# The thesis gives no coefficients; these are the commonly quoted ones for each half of the visual field.
NASAL, TEMPORAL = RovamoVirsu(0.33, 7e-5), RovamoVirsu(0.29, 1.2e-5)
SUPERIOR, INFERIOR = RovamoVirsu(0.42, 1.2e-4), RovamoVirsu(0.42, 5.5e-5)


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
    """S = 0.022 E + 0.25 / (log10 C + 2.07 - 0.0345 E), the size at which a letter of contrast C is recognised.

    ``contrast`` is the Michelson contrast C, above 10^-2.07 = 0.0085 and at most 1. The denominator is zero at
    ``pole_deg``, which is 60 deg at full contrast; beyond this pole, S would be negative.

    Source: Strasburger et al. (2011), in thesis Sec. 2.2.1.
    """

    contrast: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        if not (self.pole_deg > 0 and self.contrast <= 1):
            raise ValueError(f"contrast must be above 10^-2.07 = 0.0085 and at most 1, got {self.contrast:g}")

    @property
    def pole_deg(self) -> float:
        """Eccentricity of the pole in degrees."""
        return (math.log10(self.contrast) + 2.07) / 0.0345

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """S in degrees. ValueError at the pole and beyond."""
        eccentricity = angles.eccentricity(eccentricity_deg)
        pole = f"{self.pole_deg:.4g} degrees, its pole at a contrast of {self.contrast:g}"
        rule = f"eccentricity_deg must be below {pole}"
        angles.require(eccentricity < self.pole_deg, rule, eccentricity, "; use another law")
        return 0.022 * eccentricity + 0.25 / (0.0345 * (self.pole_deg - eccentricity))


@dataclass(frozen=True)
class LinearSize(_Law):
    """S = slope E + foveal_deg for E up to ``high_deg``, as in Grogorick et al.; the thesis gives no coefficients."""

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
    """Size in degrees, at an eccentricity, of content that has the size ``size_deg`` at the fixation point.

    Args:
        eccentricity_deg: Angles from the fixation point, >= 0, any shape; numbers give float64.
        law: A law of this module, such as ``COWEY_ROLLS``, or any function of the eccentricity that is proportional to
            the size. The result is ``size_deg * law(E) / law(0)``.
        size_deg: Size at the fixation point; 1 gives the ratio law(E) / law(0).

    Raises:
        ValueError: An eccentricity is below 0, above 180, or outside the validity of the law.
    """
    eccentricity, foveal = angles.eccentricity(eccentricity_deg), angles.size(size_deg)
    return foveal.to(eccentricity) * law(eccentricity) / law(torch.zeros_like(eccentricity))


def peripheral_weight(eccentricity_deg: Any, law: Law, *, least: float = 0.0) -> Tensor:
    """Weights of the squared error of each image sample by the eye's resolution at its eccentricity; mean 1.

    To be equally visible, a detail must be law(E) / law(0) times as wide as at the fixation point. If the energy of an
    error is uniform over the frequencies of both axes, the visible share is (law(0) / law(E))^2, which is the weight.

    Args:
        eccentricity_deg: Eccentricities of the samples, [..., H, W]; see ``Display.eccentricity_map``.
        law: As in :func:`cortical_scale`.
        least: Lower limit of the weight, relative to the weight at the fixation point, within 0 .. 1. It keeps errors
            in the far periphery from being ignored.

    Returns:
        Real [..., H, W] with mean 1 over the last two axes, dtype and device of the eccentricities.

    Raises:
        ValueError: As :func:`cortical_scale`; eccentricities with fewer than two axes; ``least`` outside 0 .. 1.
    """
    least = checks.finite("least", least)
    if not 0 <= least <= 1:
        raise ValueError(f"least must be within 0 .. 1, got {least:g}")
    eccentricity = angles.eccentricity(eccentricity_deg)
    if eccentricity.ndim < 2:
        raise ValueError(f"eccentricity_deg must end in (H, W), got {tuple(eccentricity.shape)}")
    weight = cortical_scale(eccentricity, law).pow(-2).clamp(min=least)
    return weight / weight.mean((-2, -1), keepdim=True)
