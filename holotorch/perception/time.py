"""How long a pattern takes to be perceived: a logarithmic law in its size, one per eccentricity."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.perception import angles

_LARGEST = 360.0  # degrees; the visual field holds no larger pattern


@dataclass(frozen=True, eq=False)
class PerceptionTime:
    """T(S) = a ln S + b, seconds for a pattern of S degrees. One law, or [...] of them, such as one per eccentricity.

    The time contains the decision and the press of a button, as in the thesis. The logarithm is natural.

    Attributes:
        slope: a in seconds, [...]; below zero where a larger pattern is perceived sooner.
        intercept: b in seconds, [...]: the time at 1 degree.
        covariance: Of (a, b) in s^2, [..., 2, 2]; NaN without it, or where two points leave nothing to judge it by.
        deviation: Standard deviation of the residuals in seconds, [...]; NaN as above.
        freedom: Points less two, [...].

    Source: thesis Eq. 2.3 (in milliseconds there).
    """

    slope: Tensor
    intercept: Tensor
    covariance: Tensor | None = None
    deviation: Tensor | None = None
    freedom: Tensor | None = None

    def __post_init__(self):
        for name in ("slope", "intercept"):
            object.__setattr__(self, name, angles.as_tensor(name, getattr(self, name), "seconds"))
        if self.slope.shape != self.intercept.shape:
            shapes = f"{tuple(self.slope.shape)} and {tuple(self.intercept.shape)}"
            raise ValueError(f"slope and intercept must share a shape, got {shapes}")

    @classmethod
    def fit(cls, size_deg: Any, seconds: Any, *, seen: Tensor | None = None) -> "PerceptionTime":
        """Least squares over the last axis, in float64; differentiable in the times.

        Args:
            size_deg: Sizes of the patterns, [N] or [..., N].
            seconds: Times measured with them, [..., N].
            seen: bool [..., N]: False for patterns that were missed, whose ``seconds`` may be anything, NaN included.

        Raises:
            ValueError: Times that are not above zero, or a law that has fewer than two different sizes to stand on.
        """
        times = seconds if isinstance(seconds, Tensor) else torch.as_tensor(seconds, dtype=torch.float64)
        if seen is not None:
            if seen.dtype != torch.bool:
                raise TypeError(f"seen must be a bool tensor, got {seen.dtype}")
            times = torch.where(seen, times, torch.ones_like(times))
        times = angles.as_tensor("seconds", times, "seconds").double()
        known = times.detach() if seen is None else times.detach()[seen.expand_as(times)]
        if times.ndim == 0 or (times <= 0).any():
            raise ValueError("seconds must be times above zero with the patterns on their last axis")
        if known.median() > 30:
            raise ValueError(f"seconds must be in seconds, got a median of {known.median():g}; 450 ms is 0.45")
        x, times = torch.broadcast_tensors(angles.size(size_deg).to(times).log(), times)
        weight = torch.ones_like(times) if seen is None else seen.to(times).expand_as(times)
        count = weight.sum(-1)
        middle = (weight * x).sum(-1, keepdim=True) / count.clamp(min=1)[..., None]
        spread = (weight * (x - middle).square()).sum(-1)
        bad = ~(spread > 1e-12)
        if bad.any():
            which = f", as {int(bad.sum())} of {bad.numel()} have" if bad.ndim else ""
            got = "no seen pattern" if angles.first(count, bad) == 0 else "one size only"
            raise ValueError(f"a law T(S) = a ln S + b needs patterns of two sizes or more, got {got}{which}")
        mean = (weight * times).sum(-1) / count
        slope = (weight * (x - middle) * times).sum(-1) / spread
        intercept = mean - slope * middle[..., 0]
        freedom = count - 2
        rest = times - slope[..., None] * x - intercept[..., None]
        variance = (weight * rest.square()).sum(-1) / freedom.clamp(min=1)
        variance = torch.where(freedom > 0, variance, math.nan)
        low, across = 1 / spread, -middle[..., 0] / spread
        rows = [low, across, across, 1 / count + middle[..., 0].square() / spread]
        covariance = variance[..., None, None] * torch.stack(rows, -1).unflatten(-1, (2, 2))
        # The root's gradient is infinite at 0, where the data lie on the line; nothing there depends on 1e-300.
        return cls(slope, intercept, covariance, (variance + 1e-300).sqrt(), freedom)

    @property
    def falls(self) -> Tensor:
        """Whether a larger pattern is perceived sooner (a < 0), so that :meth:`size` exists; bool [...]."""
        return self.slope < 0

    def __getitem__(self, index) -> "PerceptionTime":
        """Some of the laws: an index, a slice or a mask over [...]."""
        rest = (self.covariance, self.deviation, self.freedom)
        rest = (None if part is None else part[index] for part in rest)
        return PerceptionTime(self.slope[index], self.intercept[index], *rest)

    def seconds(self, size_deg: Any) -> Tensor:
        """T(S) in seconds for sizes that broadcast against [...]. ValueError for sizes that are not above zero."""
        return self.slope * angles.size(size_deg).to(self.slope.device).log() + self.intercept

    def size(self, seconds: Any) -> Tensor:
        """The size in degrees that takes ``seconds``, which broadcast against [...]; infinite above 360 deg.

        An infinite size has gradient 0. Whether a size was among those tested is for :class:`EqualEfficiencyScale`.

        Raises:
            ValueError: A law has a >= 0: larger is not faster there, and no size answers the question.
        """
        times = angles.as_tensor("seconds", seconds, "seconds").to(self.slope.device)
        if not self.falls.all():
            bad = (
                f"a = {angles.first(self.slope, ~self.falls):g} s in {int((~self.falls).sum())} of {self.slope.numel()}"
            )
            cure = "select the laws that fall with time[time.falls]"
            raise ValueError(f"a larger pattern is not perceived sooner ({bad} laws), so no size is the answer; {cure}")
        exponent = (times - self.intercept) / self.slope
        limit = math.log(_LARGEST)
        return torch.where(exponent > limit, math.inf, exponent.clamp(max=limit).exp())
