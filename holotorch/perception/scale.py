"""How large a pattern must be at an eccentricity to be perceived as soon as a target pattern nearer the centre."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.perception import angles
from holotorch.perception.table import TABLE_2_2
from holotorch.perception.time import PerceptionTime

TESTED_DEG = (5.0, 26.0)  # sizes that the study showed in the far periphery
FITTED_DEG = (40.0, 70.0)  # eccentricities over which it fitted its lines


@dataclass(frozen=True, eq=False)
class EqualEfficiencyScale:
    """S(E) = alpha E + beta, the size in degrees at eccentricity E, for ``low_deg`` <= E <= ``high_deg``.

    Attributes:
        alpha: Slope, degrees of size per degree of eccentricity; a number or a tensor of one value.
        beta: Intercept in degrees.
        low_deg: Least eccentricity for which the line was fitted.
        high_deg: Greatest.
        covariance: Of (alpha, beta), [2, 2]; None for the table's lines, of which the thesis prints none.

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
        """The line of Table 2.2 whose target is a pattern of this size at this eccentricity, both in degrees.

        ValueError for a target that is not in the table; nothing is interpolated between its rows.
        """
        for row in TABLE_2_2:
            if (row.size_deg, row.eccentricity_deg) == (size_deg, eccentricity_deg):
                return cls(row.alpha, row.beta)
        rows = ", ".join(f"{row.size_deg:g} at {row.eccentricity_deg:g}" for row in TABLE_2_2)
        raise ValueError(f"Table 2.2 has no target of {size_deg} deg at {eccentricity_deg} deg; it has {rows}")

    @classmethod
    def fit(cls, eccentricity_deg: Any, size_deg: Any) -> "EqualEfficiencyScale":
        """Least squares through sizes of equal time [N] at eccentricities [N], of which those in 40 .. 70 deg count.

        Differentiable in the sizes, float64. The covariance is NaN for two points, which any line meets.

        Raises:
            ValueError: Fewer than two different eccentricities within 40 .. 70 deg, or a size there that is not finite.
        """
        where = angles.eccentricity(eccentricity_deg).double()
        sizes = size_deg if isinstance(size_deg, Tensor) else torch.as_tensor(size_deg, dtype=torch.float64)
        if where.ndim != 1 or sizes.shape != where.shape:
            shapes = f"{tuple(where.shape)} and {tuple(sizes.shape)}"
            raise ValueError(f"eccentricities and sizes must both be [N], got {shapes}")
        inside = (where >= FITTED_DEG[0]) & (where <= FITTED_DEG[1])
        if len(where[inside].unique()) < 2:
            raise ValueError("a line needs two or more eccentricities within 40 .. 70 degrees")
        x, y = where[inside], angles.size(sizes[inside]).double()
        spread = (x - x.mean()).square().sum()
        alpha = ((x - x.mean()) * y).sum() / spread
        beta = y.mean() - alpha * x.mean()
        freedom = len(x) - 2
        variance = (y - alpha * x - beta).square().sum() / freedom if freedom else y.new_tensor(torch.nan)
        rows = [1 / spread, -x.mean() / spread, -x.mean() / spread, 1 / len(x) + x.mean().square() / spread]
        return cls(alpha, beta, covariance=variance * torch.stack(rows).unflatten(0, (2, 2)))

    @classmethod
    def from_time(cls, seconds: float | Tensor, times: PerceptionTime, eccentricity_deg: Any) -> "EqualEfficiencyScale":
        """The line of the sizes that take ``seconds``, from laws ``times`` [N] at eccentricities [N] in degrees.

        Only laws within 40 .. 70 deg are asked, as in the thesis. ValueError where one of them has a >= 0.
        """
        where = angles.eccentricity(eccentricity_deg).double()
        if where.ndim != 1 or times.slope.shape != where.shape:
            raise ValueError(
                f"expected one law per eccentricity, got {tuple(times.slope.shape)} and {tuple(where.shape)}"
            )
        inside = (where >= FITTED_DEG[0]) & (where <= FITTED_DEG[1])
        if not inside.any():
            raise ValueError("a line needs two or more eccentricities within 40 .. 70 degrees")
        return cls.fit(where[inside], times[inside].size(seconds))

    @classmethod
    def from_surface(
        cls, size_deg: float, target_deg: float, times: PerceptionTime, eccentricity_deg: Any
    ) -> "EqualEfficiencyScale":
        """The same for the time of a pattern of ``size_deg`` at ``target_deg``, one of the eccentricities.

        ValueError where there is no law at ``target_deg``.
        """
        where = angles.eccentricity(eccentricity_deg).double()
        at = (where == target_deg).nonzero()
        if where.ndim != 1 or len(at) != 1:
            raise ValueError(f"expected one law at {target_deg} degrees among the eccentricities, got {len(at)}")
        return cls.from_time(times[int(at[0])].seconds(size_deg), times, where)

    def __call__(self, eccentricity_deg: Any, *, extrapolate: bool = False) -> Tensor:
        """S(E) in degrees; a tensor of the input's dtype and device, float64 for numbers.

        Args:
            eccentricity_deg: Angles from the fixation point, >= 0, any shape.
            extrapolate: Follow the line beyond the eccentricities it was fitted to.

        Raises:
            ValueError: An eccentricity outside ``low_deg`` .. ``high_deg`` without ``extrapolate``; one at which the
                extrapolated line is not above zero.
        """
        where = angles.eccentricity(eccentricity_deg)
        if not extrapolate and not (inside := self.inside(where)).all():
            limits = f"{self.low_deg:g} .. {self.high_deg:g} degrees, where the line was fitted"
            got = angles.first(where, ~inside)
            raise ValueError(f"eccentricity_deg must be within {limits}, got {got:g}; or say extrapolate=True")
        sizes = self._line(where)
        if (bad := sizes <= 0).any():
            got = f"{angles.first(sizes, bad):.3g} degrees at {angles.first(where, bad):g}"
            raise ValueError(f"the line gives no size there: {got} degrees of eccentricity; it is a far-periphery line")
        return sizes

    def inverse(self, size_deg: Any, *, extrapolate: bool = False) -> Tensor:
        """The eccentricity E in degrees at which S(E) is ``size_deg``; the same rules. ValueError if alpha is 0."""
        if not torch.as_tensor(self.alpha).detach().any():
            raise ValueError("alpha is 0: the size is the same everywhere and tells no eccentricity")
        sizes = angles.size(size_deg)
        where = (sizes - self._like(self.beta, sizes)) / self._like(self.alpha, sizes)
        slack = _slack(sizes)
        off = (where < self.low_deg - slack) | (where > self.high_deg + slack)
        if not extrapolate and off.any():
            ends = self._line(torch.tensor([self.low_deg, self.high_deg], dtype=torch.float64)).detach().sort().values
            span = f"{ends[0]:.4g} .. {ends[1]:.4g} degrees, as the line has them"
            raise ValueError(
                f"size_deg must be within {span}, got {angles.first(sizes, off):g}; or say extrapolate=True"
            )
        if extrapolate:
            return angles.eccentricity(where, "the eccentricity of size_deg")
        return where.clamp(self.low_deg, self.high_deg)

    def inside(self, eccentricity_deg: Any) -> Tensor:
        """Whether the line was fitted there; bool, of the shape given. A rounding beyond the ends is inside."""
        where = angles.eccentricity(eccentricity_deg)
        slack = _slack(where)
        return (where >= self.low_deg - slack) & (where <= self.high_deg + slack)

    def tested(self, eccentricity_deg: Any) -> Tensor:
        """Whether S(E) is among the sizes that the study showed, 5 .. 26 deg; bool, at any eccentricity.

        Table 2.2 keeps lines that reach up to 4 deg beyond them at 70 deg: such sizes are flagged, not refused.
        """
        sizes = self._line(angles.eccentricity(eccentricity_deg))
        return (sizes >= TESTED_DEG[0]) & (sizes <= TESTED_DEG[1])

    def _line(self, where: Tensor) -> Tensor:
        return self._like(self.alpha, where) * where + self._like(self.beta, where)

    @staticmethod
    def _like(value: float | Tensor, other: Tensor) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64).to(other)


def _slack(values: Tensor) -> float:
    """Degrees that rounding may bring beyond the ends, as of an angle found from coordinates, or of an inverse."""
    return 1e-9 if values.dtype == torch.float64 else 1e-4
