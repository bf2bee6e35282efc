"""Analyses of variance from printed summaries: means, standard deviations and counts of groups, without the raw data.

All of them assume independent values, normal within each group with one common variance. A study in which every
participant is in every group violates the first assumption: the p-values are then only nominal.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]


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
    k = m.size
    return _contrast(np.eye(k)[1:] - np.eye(k)[:1], m.ravel(), n.ravel(), variance, freedom)


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
        raise ValueError(f"means must be [A, B] with two or more rows and columns, got {m.shape}")
    a, b = m.shape
    rows, columns = np.eye(a)[1:] - np.eye(a)[:1], np.eye(b)[1:] - np.eye(b)[:1]
    hypotheses = np.kron(rows, np.ones(b) / b), np.kron(np.ones(a) / a, columns), np.kron(rows, columns)
    return TwoWayTest(*(_contrast(each, m.ravel(), n.ravel(), variance, freedom) for each in hypotheses))


def f_of_p(p: float, freedom: tuple[int, int]) -> float:
    """The F whose p-value is ``p`` in (0, 1), for degrees of freedom (hypothesis, error) >= 1."""
    if not (0 < p < 1 and min(freedom) >= 1):
        raise ValueError(f"expected 0 < p < 1 and degrees of freedom >= 1, got {p:g} and {freedom}")
    first, second = freedom
    x = special.betaincinv(second / 2, first / 2, p)  # P(F > f) = I_x(d2 / 2, d1 / 2), exact for small p as well
    return float(second / first * (1 - x) / x)


def error_freedom(f: float, p: float, between: int, *, f_step: float, p_step: float, most: int = 1000) -> list[int]:
    """All degrees of freedom of the error, 1 to ``most``, with which a printed F has its printed p-value.

    Args:
        f: Printed statistic.
        p: Printed p-value.
        between: Degrees of freedom of the hypothesis.
        f_step: Last printed digit of F, such as 0.01 for 7.02; the true F is within half a step.
        p_step: Last printed digit of p, such as 1e-4 for 0.0002.
        most: The greatest number to try.
    """
    error = np.arange(1, most + 1)
    above = special.fdtrc(between, error, f - f_step / 2) >= p - p_step / 2
    below = special.fdtrc(between, error, f + f_step / 2) <= p + p_step / 2
    return error[above & below].tolist()


def _checked(means: Any, deviations: Any, counts: Any) -> tuple[Array, float, Array, int]:
    """Means and counts as arrays, the variance within the groups, and its degrees of freedom."""
    m, s, n = (np.asarray(value, dtype=np.float64) for value in (means, deviations, counts))
    if not m.shape == s.shape == n.shape or m.size < 2:
        shapes = f"{m.shape}, {s.shape} and {n.shape}"
        raise ValueError(f"means, deviations and counts must share a shape with two or more groups, got {shapes}")
    if not np.isfinite(n).all() or (n < 1).any() or (n % 1).any():
        raise ValueError("counts must be whole numbers of 1 or more")
    s = np.where(n > 1, s, 0.0)  # a single value has no deviation; often it is printed as NaN
    if not (np.isfinite(m).all() and np.isfinite(s).all()) or (s < 0).any():
        raise ValueError("means and deviations must be finite, and deviations not below zero")
    freedom = int((n - 1).sum())
    variance = float(((n - 1) * s**2).sum()) / freedom if freedom else 0.0
    if variance == 0:
        raise ValueError("there is no variance within the groups, or no group has two values")
    return m, variance, n, freedom


def _contrast(hypothesis: NDArray[Any], means: Array, counts: Array, variance: float, freedom: int) -> VarianceTest:
    """Test of ``hypothesis`` [R, K] @ true means [K] = 0: F = m' L' (L N^-1 L')^-1 L m / (R variance)."""
    value = hypothesis @ means
    squares = float(value @ np.linalg.solve(hypothesis / counts @ hypothesis.T, value))
    f = squares / len(hypothesis) / variance
    between = len(hypothesis)
    return VarianceTest(f, float(special.fdtrc(between, freedom, f)), (between, freedom))
