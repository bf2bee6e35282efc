"""Analyses of variance of the perception times over all pairs of eccentricity and size, the cells of the design."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from holotorch.experiments.perception.analysis.curves import Times
from holotorch.experiments.perception.analysis.statistics import Anova, Array, one_way
from holotorch.perception.anova import TwoWayTest, two_way_from_summary
from holotorch.perception.table import ALL_CELLS_P


@dataclass(frozen=True)
class CellTests:
    """Tests of the participants' median times; those of one participant are treated as independent, as in the thesis.

    ``cells``: number of pairs of eccentricity and size that were shown. ``one_way``: all of them as groups (Sec. 2.4).
    ``two_way``: eccentricity (rows) by size (columns) over the peripheral part, where every size is shown at every
    eccentricity; None if there is no such part with at least two of each and times in every cell.
    """

    cells: int
    one_way: Anova
    two_way: TwoWayTest | None

    def to_json(self) -> dict[str, Any]:
        """The tests as JSON data, without numbers that are undefined."""
        first, two = self.one_way, self.two_way
        finite = math.isfinite(first.f) and math.isfinite(first.p)
        data = {"cells": self.cells, "f": first.f if finite else None, "p": first.p if finite else None}
        return data | {"freedom": list(first.freedom), "two_way": asdict(two) if two else None}

    def in_words(self) -> list[str]:
        """One line for each test."""
        first, second = self.one_way.freedom
        lines = [
            f"All cells  one-way ANOVA of the times over {self.cells} pairs of eccentricity and size: F({first}, "
            f"{second}) = {self.one_way.f:.3g}, p = {self.one_way.p:.3g}; the thesis prints p = {ALL_CELLS_P:g} for "
            "its data, without the means, deviations and counts that a test of it needs: not testable here"
        ]
        if self.two_way:
            tests = (("eccentricity", self.two_way.rows), ("size", self.two_way.columns))
            tests = (*tests, ("interaction", self.two_way.interaction))
            parts = [f"{name} F({t.freedom[0]}, {t.freedom[1]}) = {t.f:.3g}, p = {t.p:.3g}" for name, t in tests]
            lines.append(f"             two-way in the far periphery: {'; '.join(parts)}")
        return lines


def cell_tests(times: Times, from_deg: float) -> CellTests:
    """Test the times of all cells, and of those of ``from_deg`` degrees or more by eccentricity and size."""
    seconds = times.seconds.reshape(len(times.participants), -1)
    shown = np.isfinite(seconds).any(0)
    far = times.seconds[:, times.eccentricities >= from_deg]
    far = far[:, :, np.isfinite(far).any((0, 1))]
    return CellTests(int(shown.sum()), one_way(seconds[:, shown]), _two_way(far))


def _two_way(seconds: Array) -> TwoWayTest | None:
    """The two-way analysis of times [P, E, S]; None where ``two_way_from_summary`` needs more cells or values."""
    counts = np.isfinite(seconds).sum(0)
    if min(counts.shape) < 2 or counts.min() < 1 or counts.max() < 2:
        return None
    means = np.nanmean(seconds, 0)
    squares = np.nansum((seconds - means) ** 2, 0)
    if squares.sum() <= 1e-24 * np.square(means).sum():  # all equal within rounding errors
        return None
    return two_way_from_summary(means, np.sqrt(squares / np.maximum(counts - 1, 1)), counts)
