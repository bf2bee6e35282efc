"""Analyses of variance by sums over the table, and the F distribution by integration."""

import math
from collections.abc import Sequence


def one_way(groups: Sequence[Sequence[float]]) -> tuple[float, int, int]:
    """F and its degrees of freedom for independent groups."""
    values = [value for group in groups for value in group]
    grand = sum(values) / len(values)
    between = within = 0.0
    for group in groups:
        mean = sum(group) / len(group)
        between += len(group) * (mean - grand) ** 2
        for value in group:
            within += (value - mean) ** 2
    first, second = len(groups) - 1, len(values) - len(groups)
    return (between / first) / (within / second), first, second


def repeated(rows: Sequence[Sequence[float]]) -> tuple[float, int, int]:
    """F and its degrees of freedom for the columns of a table whose rows are participants."""
    people, columns = len(rows), len(rows[0])
    grand = sum(map(sum, rows)) / (people * columns)
    person = [sum(row) / columns for row in rows]
    place = [sum(row[k] for row in rows) / people for k in range(columns)]
    effect = people * sum((mean - grand) ** 2 for mean in place)
    error = sum(
        (rows[i][k] - person[i] - place[k] + grand) ** 2 for i in range(people) for k in range(columns)
    )  # what neither a participant nor a place explains
    first, second = columns - 1, (columns - 1) * (people - 1)
    return (effect / first) / (error / second), first, second


def epsilon(rows: Sequence[Sequence[float]]) -> float:
    """Greenhouse and Geisser's, by Box's formula from the covariances of the columns."""
    people, k = len(rows), len(rows[0])
    mean = [sum(row[i] for row in rows) / people for i in range(k)]
    s = [
        [sum((row[i] - mean[i]) * (row[j] - mean[j]) for row in rows) / (people - 1) for j in range(k)]
        for i in range(k)
    ]
    grand = sum(map(sum, s)) / k**2
    diagonal = sum(s[i][i] for i in range(k)) / k
    means = [sum(row) / k for row in s]
    squares = sum(value**2 for row in s for value in row)
    below = (k - 1) * (squares - 2 * k * sum(m**2 for m in means) + k**2 * grand**2)
    return k**2 * (diagonal - grand) ** 2 / below


def survival(f: float, first: float, second: float, steps: int = 20000) -> float:
    """P(F > f), by Simpson's rule over the beta density; for second >= 2, where the integrand is bounded."""
    end = second / (second + first * f)
    a, b = second / 2, first / 2
    constant = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)

    # P = I_end(a, b); with x = u^2 a density of a >= 1 has no infinite slope at 0.
    def density(u: float) -> float:
        x = u * u
        return 0.0 if x == 0 else 2 * u * math.exp(constant + (a - 1) * math.log(x) + (b - 1) * math.log1p(-x))

    top = math.sqrt(end)
    h = top / steps
    total = density(0.0) + density(top)
    for i in range(1, steps):
        total += (4 if i % 2 else 2) * density(i * h)
    return total * h / 3
