"""Analyses of variance from printed summaries: means, standard deviations and counts of groups, without the raw data.

All of them assume independent values, normal within each group with one common variance. A study in which every
participant is in every group violates the first assumption: the p-values are then only nominal.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.perception import angles


@dataclass(frozen=True)
class VarianceTest:
    """An F test: the statistic ``f``, its p-value, and the degrees of freedom (hypothesis, error)."""

    f: float
    p: float
    freedom: tuple[int, int]


@dataclass(frozen=True)
class TwoWayTest:
    """A two-way analysis: the effects of the two factors and their interaction."""

    rows: VarianceTest
    columns: VarianceTest
    interaction: VarianceTest


def one_way_from_summary(means: Any, deviations: Any, counts: Any) -> VarianceTest:
    """One-way analysis of variance of K groups from their summaries; equals that of the raw data.

    Args:
        means: Mean of each group, [K] or any shape with K >= 2 elements.
        deviations: Standard deviation of each group with divisor n - 1, in the unit of the means, in the same shape;
            0 or anything else for a group of one value.
        counts: Number of values of each group, whole numbers >= 1, in the same shape.

    Raises:
        ValueError: The shapes differ, a number is not finite, a count is below 1, there are fewer than two groups, no
            group has two values, or all deviations are 0.

    Source: Montgomery, Design and Analysis of Experiments, Sec. 3.3.
    """
    m, variance, n, freedom = _checked(means, deviations, counts)
    return _contrast(_differences(m.numel()), m.flatten(), n.flatten(), variance, freedom)


def two_way_from_summary(means: Any, deviations: Any, counts: Any) -> TwoWayTest:
    """Two-way analysis of variance with interaction of A x B groups from their summaries.

    The main effects compare unweighted means of the cells (type III), so that for equal counts they are the usual ones,
    and for unequal counts no cell counts more than another.

    Args:
        means: Mean of each cell, [A, B] with A, B >= 2.
        deviations: Standard deviation of each cell with divisor n - 1, [A, B].
        counts: Number of values of each cell, >= 1, [A, B]. A design with empty cells has no such analysis.

    Raises:
        ValueError: As :func:`one_way_from_summary`, or the summaries are not [A, B] with A, B >= 2.

    Source: Searle, Linear Models for Unbalanced Data, Sec. 4.6 (weighted squares of means).
    """
    m, variance, n, freedom = _checked(means, deviations, counts)
    if m.ndim != 2 or min(m.shape) < 2:
        raise ValueError(f"means must be [A, B] with two or more rows and columns, got {tuple(m.shape)}")
    a, b = m.shape
    rows, columns = _differences(a), _differences(b)
    average_a, average_b = m.new_full((1, a), 1 / a), m.new_full((1, b), 1 / b)
    hypotheses = torch.kron(rows, average_b), torch.kron(average_a, columns), torch.kron(rows, columns)
    return TwoWayTest(*(_contrast(each, m.flatten(), n.flatten(), variance, freedom) for each in hypotheses))


def f_of_p(p: float, freedom: tuple[int, int]) -> float:
    """The F whose p-value is ``p`` in (0, 1), for degrees of freedom (hypothesis, error) >= 1."""
    if not (0 < p < 1 and min(freedom) >= 1):
        raise ValueError(f"expected 0 < p < 1 and degrees of freedom >= 1, got {p:g} and {freedom}")
    low, high = -700.0, 700.0  # logarithm of F
    for _ in range(100):  # the last bit of F, from a range of 1400
        middle = (low + high) / 2
        low, high = (middle, high) if p_of_f(math.exp(middle), freedom) > p else (low, middle)
    return math.exp((low + high) / 2)


def p_of_f(f: float, freedom: tuple[int, int]) -> float:
    """Probability of an F >= ``f`` >= 0 by chance, for degrees of freedom (hypothesis, error) >= 1.

    It is I_x(d2 / 2, d1 / 2) at x = d2 / (d2 + d1 f), with I the regularised incomplete beta function, which torch
    lacks. Very small probabilities have all their digits.
    Source: Abramowitz and Stegun, Eqs. 26.6.2 and 26.5.8.
    """
    first, second = freedom
    total = second + first * f
    if math.isinf(total):
        return 0.0
    x, y = second / total, first * f / total  # y = 1 - x, without a loss of digits
    a, b = second / 2, first / 2
    if y == 0:
        return 1.0
    # The fraction converges quickly below the mean of the beta distribution; above it, I_x(a, b) = 1 - I_y(b, a).
    below = x < (a + 1) / (a + b + 2)
    value = _beta_fraction(a, b, x, y) if below else 1 - _beta_fraction(b, a, y, x)
    return min(max(value, 0.0), 1.0)


def _beta_fraction(a: float, b: float, x: float, y: float) -> float:
    """I_x(a, b) by its continued fraction, evaluated from the front (modified Lentz method); y is 1 - x."""
    beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    front = math.exp(a * math.log(x) + b * math.log(y) - beta) / a
    tiny = 1e-300
    c, d = 1.0, 1 / ((1 - (a + b) * x / (a + 1)) or tiny)
    value = d
    for m in range(1, 10_000):
        for term in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d, c = 1 / ((1 + term * d) or tiny), (1 + term / c) or tiny
            value *= d * c
        if abs(d * c - 1) < 1e-15:
            break
    return front * value


def error_freedom(f: float, p: float, between: int, *, f_step: float, p_step: float) -> list[int]:
    """All degrees of freedom of the error, 1 to 1000, with which a printed F has its printed p-value.

    Args:
        f: Printed statistic.
        p: Printed p-value.
        between: Degrees of freedom of the hypothesis.
        f_step: Last printed digit of F, such as 0.01 for 7.02; the true F is within half a step.
        p_step: Last printed digit of p, such as 1e-4 for 0.0002.
    """
    low, high = p - p_step / 2, p + p_step / 2
    return [
        error
        for error in range(1, 1001)
        if p_of_f(f - f_step / 2, (between, error)) >= low and p_of_f(f + f_step / 2, (between, error)) <= high
    ]


def _checked(means: Any, deviations: Any, counts: Any) -> tuple[Tensor, float, Tensor, int]:
    """Means and counts as tensors, the variance within the groups, and its degrees of freedom."""
    m, n = angles.as_tensor("means", means, "one unit").double(), angles.as_tensor("counts", counts, "values").double()
    s = torch.as_tensor(deviations, dtype=torch.float64)
    if not m.shape == s.shape == n.shape or m.numel() < 2:
        shapes = f"{tuple(m.shape)}, {tuple(s.shape)} and {tuple(n.shape)}"
        raise ValueError(f"means, deviations and counts must share a shape with two or more groups, got {shapes}")
    if (n < 1).any() or (n % 1).any():
        raise ValueError("counts must be whole numbers of 1 or more")
    s = torch.where(n > 1, s, 0.0)  # a single value has no deviation; often it is printed as NaN
    if not s.isfinite().all() or (s < 0).any():
        raise ValueError("deviations must be finite and not below zero")
    freedom = int((n - 1).sum())
    variance = float(((n - 1) * s**2).sum()) / freedom if freedom else 0.0
    if variance == 0:
        raise ValueError("there is no variance within the groups, or no group has two values")
    return m, variance, n, freedom


def _differences(groups: int) -> Tensor:
    """Differences of all groups from the first, [groups - 1, groups]."""
    identity = torch.eye(groups, dtype=torch.float64)
    return identity[1:] - identity[:1]


def _contrast(hypothesis: Tensor, means: Tensor, counts: Tensor, variance: float, freedom: int) -> VarianceTest:
    """Test of ``hypothesis`` [R, K] @ true means [K] = 0: F = m' L' (L N^-1 L')^-1 L m / (R variance)."""
    value = hypothesis @ means
    squares = float(value @ torch.linalg.solve(hypothesis / counts @ hypothesis.T, value))
    between = len(hypothesis)
    f = squares / between / variance
    return VarianceTest(f, p_of_f(f, (between, freedom)), (between, freedom))
