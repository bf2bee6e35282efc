"""Size over eccentricity of patterns that are perceived as quickly as a given target pattern."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.perception import angles
from holotorch.perception.table import TABLE_2_2
from holotorch.perception.time import PerceptionTime

TESTED_DEG = (5.0, 26.0)  # smallest and largest pattern that the study of thesis chapter 2 showed in the far periphery
FITTED_DEG = (40.0, 70.0)  # eccentricities over which that study fitted its lines


@dataclass(frozen=True, eq=False)
class EqualEfficiencyScale:
    """Line S(E) = alpha E + beta: the size in degrees that gives equal perception time at each eccentricity E.

    Attributes:
        alpha: Slope in degrees of size per degree of eccentricity, a number or a scalar tensor.
        beta: Intercept in degrees, a number or a scalar tensor.
        low_deg: Smallest eccentricity at which the line is valid.
        high_deg: Greatest such eccentricity.
        covariance: Covariance of (alpha, beta), [2, 2]; None for the lines of Table 2.2, which does not print it.

    Source: thesis Sec. 2.4.3.
    """

    alpha: float | Tensor
    beta: float | Tensor
    low_deg: float = FITTED_DEG[0]
    high_deg: float = FITTED_DEG[1]
    covariance: Tensor | None = None

    def __post_init__(self):
        for name in ("alpha", "beta"):
            value = angles.as_tensor(name, getattr(self, name))
            if value.ndim:
                raise ValueError(f"{name} must be one number, got a tensor of shape {tuple(value.shape)}")
        low, high = checks.finite("low_deg", self.low_deg), checks.finite("high_deg", self.high_deg)
        if not 0 <= low < high <= 180:
            raise ValueError(f"expected 0 <= low_deg < high_deg <= 180, got {low:g} and {high:g}")

    @classmethod
    def from_table(cls, size_deg: float, eccentricity_deg: float) -> "EqualEfficiencyScale":
        """The line of Table 2.2 whose target pattern has this size at this eccentricity, both in degrees.

        Rows are not interpolated: ValueError for a target that is not in the table.
        """
        for row in TABLE_2_2:
            if (row.size_deg, row.eccentricity_deg) == (size_deg, eccentricity_deg):
                return cls(row.alpha, row.beta)
        rows = ", ".join(f"{row.size_deg:g} at {row.eccentricity_deg:g}" for row in TABLE_2_2)
        raise ValueError(f"Table 2.2 has no target of {size_deg} deg at {eccentricity_deg} deg; it has {rows}")

    @classmethod
    def fit(cls, eccentricity_deg: Any, size_deg: Any) -> "EqualEfficiencyScale":
        """Fit a line by least squares to the sizes [N] that have equal perception time at eccentricities [N].

        Points outside 40 .. 70 deg are ignored. The fit is differentiable in the sizes and uses float64. The
        covariance is NaN for a fit to two points.

        Raises:
            ValueError: There are fewer than two different eccentricities within 40 .. 70 deg, or a size at one of them
                is not finite, not above zero or above 360 deg.
        """
        sizes = size_deg if isinstance(size_deg, Tensor) else torch.as_tensor(size_deg, dtype=torch.float64)
        eccentricity, inside = _fitted(eccentricity_deg, sizes.shape, "size")
        x, y = eccentricity[inside], angles.size(sizes[inside]).double()
        spread = (x - x.mean()).square().sum()
        alpha = ((x - x.mean()) * y).sum() / spread
        beta = y.mean() - alpha * x.mean()
        freedom = len(x) - 2
        variance = (y - alpha * x - beta).square().sum() / freedom if freedom else y.new_tensor(torch.nan)
        rows = [1 / spread, -x.mean() / spread, -x.mean() / spread, 1 / len(x) + x.mean().square() / spread]
        return cls(alpha, beta, covariance=variance * torch.stack(rows).unflatten(0, (2, 2)))

    @classmethod
    def from_time(cls, seconds: float | Tensor, times: PerceptionTime, eccentricity_deg: Any) -> "EqualEfficiencyScale":
        """Fit the line of sizes with perception time ``seconds``, given the laws ``times`` [N] at N eccentricities.

        As in the thesis, only laws within 40 .. 70 deg are used. ValueError if one of them has a slope >= 0.
        """
        eccentricity, inside = _fitted(eccentricity_deg, times.slope.shape, "law")
        return cls.fit(eccentricity[inside], times[inside].size(seconds))

    @classmethod
    def from_surface(
        cls, size_deg: float, target_deg: float, times: PerceptionTime, eccentricity_deg: Any
    ) -> "EqualEfficiencyScale":
        """As :meth:`from_time`, with the perception time of a target of ``size_deg`` at eccentricity ``target_deg``.

        ValueError unless exactly one of the eccentricities equals ``target_deg``.
        """
        eccentricity = angles.eccentricity(eccentricity_deg).double()
        at = (eccentricity == target_deg).nonzero()
        if eccentricity.ndim != 1 or len(at) != 1:
            raise ValueError(f"expected one law at {target_deg} degrees among the eccentricities, got {len(at)}")
        return cls.from_time(times[int(at[0])].seconds(size_deg), times, eccentricity)

    def __call__(self, eccentricity_deg: Any, *, extrapolate: bool = False) -> Tensor:
        """S(E) in degrees, in the shape, dtype and device of the eccentricities; float64 for numbers.

        Args:
            eccentricity_deg: Angles from the fixation point, >= 0, any shape.
            extrapolate: Allow eccentricities outside ``low_deg`` .. ``high_deg``.

        Raises:
            ValueError: An eccentricity is outside ``low_deg`` .. ``high_deg`` and ``extrapolate`` is False, or S(E) is
                not above zero.
        """
        eccentricity = angles.eccentricity(eccentricity_deg)
        if not extrapolate:
            limits = f"{self.low_deg:g} .. {self.high_deg:g} degrees, where the line was fitted"
            rule = f"eccentricity_deg must be within {limits}"
            angles.require(self.inside(eccentricity), rule, eccentricity, "; or pass extrapolate=True")
        sizes = self._line(eccentricity)
        if (bad := sizes <= 0).any():
            got = f"{angles.first(sizes, bad):.3g} degrees at {angles.first(eccentricity, bad):g}"
            raise ValueError(f"the line holds in the far periphery only: its size is {got} degrees of eccentricity")
        return sizes

    def inverse(self, size_deg: Any, *, extrapolate: bool = False) -> Tensor:
        """Eccentricity E in degrees where S(E) = ``size_deg``. ValueError if alpha is 0 or E is not allowed in S(E)."""
        if not torch.as_tensor(self.alpha).detach().any():
            raise ValueError("alpha is 0: the size is the same at every eccentricity, so that there is no inverse")
        sizes = angles.size(size_deg)
        alpha, beta = self._coefficients(sizes)
        eccentricity = (sizes - beta) / alpha
        if extrapolate:
            return angles.eccentricity(eccentricity, "the eccentricity of size_deg")
        low, high = self._line(torch.tensor([self.low_deg, self.high_deg], dtype=torch.float64)).detach().sort().values
        rule = f"size_deg must be within {low:.4g} .. {high:.4g} degrees, the sizes of the line"
        angles.require(self._covers(eccentricity), rule, sizes, "; or pass extrapolate=True")
        return eccentricity.clamp(self.low_deg, self.high_deg)

    def inside(self, eccentricity_deg: Any) -> Tensor:
        """Whether each eccentricity is within ``low_deg`` .. ``high_deg``, up to rounding errors; bool, same shape."""
        return self._covers(angles.eccentricity(eccentricity_deg))

    def tested(self, eccentricity_deg: Any) -> Tensor:
        """Whether S(E) is within 5 .. 26 deg, the sizes tested in the study; bool. E may be any eccentricity.

        The lines of Table 2.2 range from 4.0 deg at E = 40 deg to 29.0 deg at E = 70 deg, so that some are not tested.
        """
        return angles.within(self._line(angles.eccentricity(eccentricity_deg)), *TESTED_DEG)

    def _covers(self, eccentricity: Tensor) -> Tensor:
        """As :meth:`inside`, without a check of the range of the eccentricities."""
        tolerance = 1e-9 if eccentricity.dtype == torch.float64 else 1e-4  # degrees
        return angles.within(eccentricity, self.low_deg, self.high_deg, tolerance)

    def _line(self, eccentricity: Tensor) -> Tensor:
        alpha, beta = self._coefficients(eccentricity)
        return alpha * eccentricity + beta

    def _coefficients(self, like: Tensor) -> list[Tensor]:
        return [torch.as_tensor(value, dtype=torch.float64).to(like) for value in (self.alpha, self.beta)]


def _fitted(eccentricity_deg: Any, shape: torch.Size, what: str) -> tuple[Tensor, Tensor]:
    """Eccentricities [N] in float64, and mask of those in ``FITTED_DEG``; ValueError unless two of these differ."""
    eccentricity = angles.eccentricity(eccentricity_deg).double()
    if eccentricity.ndim != 1 or shape != eccentricity.shape:
        shapes = f"{tuple(shape)} and {tuple(eccentricity.shape)}"
        raise ValueError(f"expected one {what} per eccentricity [N], got {shapes}")
    inside = angles.within(eccentricity, *FITTED_DEG)
    if len(eccentricity[inside].unique()) < 2:
        raise ValueError("a line needs two or more eccentricities within 40 .. 70 degrees")
    return eccentricity, inside
