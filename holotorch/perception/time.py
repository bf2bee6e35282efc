"""Perception time of a pattern as a logarithmic function of its size, one such law per eccentricity."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.perception import angles


@dataclass(frozen=True, eq=False)
class PerceptionTime:
    """Perception time T(S) = a ln S + b in seconds of a pattern of S degrees: one law, or a batch of laws [...].

    As in the thesis, the time includes the observer's decision and the press of a button.

    Attributes:
        slope: a in seconds, [...]; negative if a larger pattern is perceived sooner.
        intercept: b in seconds, [...]; the time for a pattern of 1 degree.
        covariance: Covariance of (a, b) in s^2, [..., 2, 2]; NaN for a fit to two points.
        deviation: Standard deviation of the residuals in seconds, [...]; NaN for a fit to two points.
        freedom: Degrees of freedom of the residuals, the number of points minus two, [...].

    Source: thesis Eq. 2.3, which is in milliseconds.
    """

    slope: Tensor
    intercept: Tensor
    covariance: Tensor | None = None
    deviation: Tensor | None = None
    freedom: Tensor | None = None

    def __post_init__(self):
        for name in ("slope", "intercept"):  # numbers become tensors
            object.__setattr__(self, name, angles.as_tensor(name, getattr(self, name), "seconds"))
        if self.slope.shape != self.intercept.shape:
            shapes = f"{tuple(self.slope.shape)} and {tuple(self.intercept.shape)}"
            raise ValueError(f"slope and intercept must share a shape, got {shapes}")

    @classmethod
    def fit(cls, size_deg: Any, seconds: Any, *, seen: Tensor | None = None) -> "PerceptionTime":
        """Fit a law to each set of N patterns by least squares, in float64; differentiable in the times.

        Args:
            size_deg: Sizes of the patterns, [N] or [..., N].
            seconds: Measured perception times, [..., N].
            seen: Whether each pattern was seen, bool [..., N]. Times of unseen patterns are ignored and may be NaN.

        Raises:
            TypeError: ``seen`` is not bool.
            ValueError: A time is not above zero, the median time exceeds 30 s, or a set has fewer than two seen sizes.
        """
        times = seconds if isinstance(seconds, Tensor) else torch.as_tensor(seconds, dtype=torch.float64)
        seen = torch.ones_like(times, dtype=torch.bool) if seen is None else seen
        if seen.dtype != torch.bool:
            raise TypeError(f"seen must be a bool tensor, got {seen.dtype}")
        times = angles.as_tensor("seconds", torch.where(seen, times, torch.ones_like(times)), "seconds").double()
        if times.ndim == 0 or (times <= 0).any():
            raise ValueError("seconds must be times above zero with the patterns on their last axis")
        if (median := times.detach()[seen.expand_as(times)].median()) > 30:
            raise ValueError(f"seconds must be in seconds, got a median of {median:g}; 450 ms is 0.45")
        x, times, weight = torch.broadcast_tensors(angles.size(size_deg).to(times).log(), times, seen.to(times))
        count = weight.sum(-1)
        mean_x = (weight * x).sum(-1, keepdim=True) / count.clamp(min=1)[..., None]
        spread = (weight * (x - mean_x).square()).sum(-1)
        bad = ~(spread > 1e-12)
        if bad.any():
            which = f" in {int(bad.sum())} of {bad.numel()} laws" if bad.ndim else ""
            got = "no seen pattern" if angles.first(count, bad) == 0 else "one size only"
            raise ValueError(f"a law T(S) = a ln S + b needs patterns of two sizes or more, got {got}{which}")
        slope = (weight * (x - mean_x) * times).sum(-1) / spread
        intercept = (weight * times).sum(-1) / count - slope * mean_x[..., 0]
        freedom = count - 2
        residual = times - slope[..., None] * x - intercept[..., None]
        variance = (weight * residual.square()).sum(-1) / freedom.clamp(min=1)
        variance = torch.where(freedom > 0, variance, math.nan)
        slope_variance, mixed = 1 / spread, -mean_x[..., 0] / spread  # for residuals of variance 1
        rows = [slope_variance, mixed, mixed, 1 / count + mean_x[..., 0].square() / spread]
        covariance = variance[..., None, None] * torch.stack(rows, -1).unflatten(-1, (2, 2))
        # If all data lie on the line, the variance is 0, where sqrt has an infinite gradient; 1e-300 prevents this.
        return cls(slope, intercept, covariance, (variance + 1e-300).sqrt(), freedom)

    @property
    def falls(self) -> Tensor:
        """Whether a < 0, so that a larger pattern is perceived sooner; :meth:`size` requires this. bool [...]."""
        return self.slope < 0

    def __getitem__(self, index) -> "PerceptionTime":
        """Select laws of the batch [...] by an index, a slice or a mask."""
        parts = (self.slope, self.intercept, self.covariance, self.deviation, self.freedom)
        return PerceptionTime(*(None if part is None else part[index] for part in parts))  # type: ignore[arg-type]

    def seconds(self, size_deg: Any) -> Tensor:
        """T(S) in seconds for sizes that broadcast with the batch [...]. ValueError unless 0 < size <= 360."""
        return self.slope * angles.size(size_deg).to(self.slope.device).log() + self.intercept

    def size(self, seconds: Any) -> Tensor:
        """The size S in degrees with T(S) = ``seconds``, which broadcast with the batch [...].

        A size above 360 deg is returned as infinity, with gradient 0. ValueError for a law with a >= 0, by which a
        larger pattern is not perceived sooner.
        """
        times = angles.as_tensor("seconds", seconds, "seconds").to(self.slope.device)
        if (bad := ~self.falls).any():
            laws = f"a = {angles.first(self.slope, bad):g} s in {int(bad.sum())} of {bad.numel()} laws"
            cure = "select the laws that fall with time[time.falls]"
            raise ValueError(f"a larger pattern is not perceived sooner ({laws}), so no size is the answer; {cure}")
        exponent = (times - self.intercept) / self.slope
        limit = math.log(360.0)
        return torch.where(exponent > limit, math.inf, exponent.clamp(max=limit).exp())
