"""Laws of how content must grow towards the periphery to stimulate equally much cortex, and empirical ones."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.perception import angles


def _positive(law: Any, *names: str) -> None:
    for name in names:
        checks.positive(name, getattr(law, name))


@dataclass(frozen=True)
class LinearMagnification:
    """1 / M = (1 + E / E2) / M0, thesis Eqs. 2.1 and 2.2 with a = 1 / E2.

    Attributes:
        m0: Cortex per visual angle in the fovea, mm/deg.
        e2_deg: Eccentricity at which a size has doubled.
    """

    m0: float
    e2_deg: float

    def __post_init__(self):
        _positive(self, "m0", "e2_deg")

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        return (1 + angles.eccentricity(eccentricity_deg) / self.e2_deg) / self.m0


# The thesis prints E / E2 for Cowey and Rolls (1974), which would shrink the fovea's content to nothing.
COWEY_ROLLS = LinearMagnification(8.55, 1.746)
HORTON_HOYT = LinearMagnification(17.3 / 0.75, 0.75)  # printed as M = 17.3 / (E + 0.75)
DOUGHERTY = LinearMagnification(29.2 / 3.67, 3.67)  # printed as M = 29.2 / (E + 3.67)


@dataclass(frozen=True)
class RovamoVirsu:
    """1 / M = (1 + a E + b E^3) / M0; Rovamo and Virsu (1979), one pair (a, b) for each half-meridian.

    Attributes:
        a: Per degree.
        b: Per cubic degree.
        m0: In mm/deg.
    """

    a: float
    b: float
    m0: float = 7.99

    def __post_init__(self):
        _positive(self, "a", "b", "m0")

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        where = angles.eccentricity(eccentricity_deg)
        return (1 + self.a * where + self.b * where**3) / self.m0


# The thesis gives no coefficients; these are those commonly quoted, by half of the visual field.
NASAL, TEMPORAL = RovamoVirsu(0.33, 7e-5), RovamoVirsu(0.29, 1.2e-5)
SUPERIOR, INFERIOR = RovamoVirsu(0.42, 1.2e-4), RovamoVirsu(0.42, 5.5e-5)


@dataclass(frozen=True)
class TolhurstLing:
    """1 / M = (1 + a E)^1.1 / M0; Tolhurst and Ling (1988). The thesis gives M0 and not a, which must be chosen.

    Attributes:
        a: Per degree.
        m0: In mm/deg.
    """

    a: float
    m0: float = 24.88

    def __post_init__(self):
        _positive(self, "a", "m0")

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """1 / M in deg/mm."""
        return (1 + self.a * angles.eccentricity(eccentricity_deg)) ** 1.1 / self.m0


@dataclass(frozen=True)
class StrasburgerLetters:
    """S = 0.022 E + 0.25 / (log10 C + 2.07 - 0.0345 E), the size in degrees at which a letter is recognised.

    Its pole, where the denominator is zero, lies at E = (log10 C + 2.07) / 0.0345: 60 deg at full contrast, and at the
    fovea for C = 0.0085. From there on the formula means nothing (negative sizes), and is refused.

    Attributes:
        contrast: Michelson contrast C of the letter, above 0.0085 and at most 1.

    Source: Strasburger et al. (2011), in thesis Sec. 2.2.1.
    """

    contrast: float = 1.0

    def __post_init__(self):
        _positive(self, "contrast")
        if not (self.pole_deg > 0 and self.contrast <= 1):
            raise ValueError(f"contrast must be above 10^-2.07 = 0.0085 and at most 1, got {self.contrast:g}")

    @property
    def pole_deg(self) -> float:
        """Eccentricity in degrees that the formula cannot reach."""
        return (math.log10(self.contrast) + 2.07) / 0.0345

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """S in degrees. ValueError from the pole on."""
        where = angles.eccentricity(eccentricity_deg)
        if (bad := where >= self.pole_deg).any():
            limit = f"below {self.pole_deg:.4g} degrees, its pole at a contrast of {self.contrast:g}"
            raise ValueError(f"eccentricity_deg must be {limit}, got {angles.first(where, bad):g}; use another law")
        return 0.022 * where + 0.25 / (0.0345 * (self.pole_deg - where))


@dataclass(frozen=True)
class LinearSize:
    """S = slope E + foveal_deg within 0 .. 40 deg, the form Grogorick et al. found; the thesis gives no numbers.

    Attributes:
        slope: Degrees of size per degree of eccentricity.
        foveal_deg: Size at the fixation point.
        high_deg: Greatest eccentricity, beyond which it is refused.
    """

    slope: float
    foveal_deg: float
    high_deg: float = 40.0

    def __post_init__(self):
        _positive(self, "slope", "foveal_deg", "high_deg")

    def __call__(self, eccentricity_deg: Any) -> Tensor:
        """S in degrees. ValueError beyond ``high_deg``."""
        where = angles.eccentricity(eccentricity_deg)
        if (bad := where > self.high_deg).any():
            limit = f"at most {self.high_deg:g} degrees, as far as it was tested"
            raise ValueError(f"eccentricity_deg must be {limit}, got {angles.first(where, bad):g}")
        return self.slope * where + self.foveal_deg


Law = Callable[[Any], Tensor]


def cortical_scale(eccentricity_deg: Any, law: Law, size_deg: float = 1.0) -> Tensor:
    """The size in degrees at an eccentricity of content that is ``size_deg`` wide at the fixation point.

    Args:
        eccentricity_deg: Angles from the fixation point, >= 0, any shape; numbers give float64.
        law: One of this module's, such as ``COWEY_ROLLS``, or any function of the eccentricity that is proportional to
            the size: ``size_deg * law(E) / law(0)`` is returned.
        size_deg: At the fixation point; 1 gives the magnification itself.

    Raises:
        ValueError: Eccentricities below 0, above 180, or where the law does not hold.
    """
    where, foveal = angles.eccentricity(eccentricity_deg), angles.size(size_deg)
    return foveal.to(where) * law(where) / law(torch.zeros_like(where))


def peripheral_weight(eccentricity_deg: Any, law: Law, *, least: float = 0.0) -> Tensor:
    """Weights for the squared error of each sample of an image, by what the eye can use of it; mean 1.

    A detail must be law(E) / law(0) times as wide as at the fixation point to be seen as well; of an error whose energy
    lies evenly over the frequencies of both axes, the share (law(0) / law(E))^2 is coarse enough. That is the weight.

    Args:
        eccentricity_deg: Of the samples, [..., H, W]; see ``Display.eccentricity_map``.
        law: As in :func:`cortical_scale`.
        least: Lower limit of the weight relative to that at the fixation point, within 0 .. 1, so that the far
            periphery is not given up entirely.

    Returns:
        Real [..., H, W] with mean 1 over the last two axes, dtype and device of the eccentricities.

    Raises:
        ValueError: As :func:`cortical_scale`; eccentricities without two axes; ``least`` outside 0 .. 1.
    """
    least = checks.finite("least", least)
    if not 0 <= least <= 1:
        raise ValueError(f"least must be within 0 .. 1, got {least:g}")
    where = angles.eccentricity(eccentricity_deg)
    if where.ndim < 2:
        raise ValueError(f"eccentricity_deg must end in (H, W), got {tuple(where.shape)}")
    weight = cortical_scale(where, law).pow(-2).clamp(min=least)
    return weight / weight.mean((-2, -1), keepdim=True)
