"""Thesis Table 2.2: lines S(E) of equal perception time, and analyses of variance of the sizes."""

import math
from dataclasses import dataclass

from holotorch.perception.anova import error_freedom

# p-value of the one-way ANOVA of the perception times with all 52 pairs of eccentricity and size as groups (Sec. 2.4).
# The thesis prints neither its F and degrees of freedom nor means, deviations and counts of the groups.
ALL_CELLS_P = 1.3e-6


@dataclass(frozen=True)
class EqualEfficiencyRow:
    """One row: a target pattern, the line S(E) = alpha E + beta of equal perception time, and a one-way ANOVA.

    ``size_deg`` and ``eccentricity_deg`` describe the target. ``alpha`` is in degrees of size per degree of
    eccentricity, ``beta`` in degrees. The ANOVA compares the sizes at four eccentricities, and treats those of one
    participant as independent. ``freedom`` is its between-group degrees of freedom, ``f`` its F, ``p`` its p-value.
    """

    size_deg: float
    eccentricity_deg: float
    alpha: float
    beta: float
    freedom: int
    f: float
    p: float

    @property
    def error_freedom(self) -> list[int]:
        """All degrees of freedom within the groups, up to 1000, with which F has its p-value to the printed digits.

        40 participants with a scale at each of four eccentricities have 156. Fewer mean that scales are missing.
        """
        step = max(1e-4 if self.p >= 1e-4 else 0.0, 10.0 ** (math.floor(math.log10(self.p)) - 2))
        return error_freedom(self.f, self.p, self.freedom, f_step=0.01, p_step=step)


# Equal-efficiency scales that the thesis measured, Table 2.2.
TABLE_2_2 = (
    EqualEfficiencyRow(5, 10, 0.47, -11.04, 3, 7.02, 0.0002),
    EqualEfficiencyRow(5, 20, 0.55, -16.3, 3, 11.96, 4.46e-7),
    EqualEfficiencyRow(5, 30, 0.54, -15.08, 3, 7.96, 5.75e-5),
    EqualEfficiencyRow(5, 40, 0.54, -17.64, 3, 12.48, 2.45e-7),
    EqualEfficiencyRow(10, 10, 0.52, -13.11, 3, 4.78, 0.0033),
    EqualEfficiencyRow(10, 20, 0.58, -14.8, 3, 9.3, 1.13e-5),
    EqualEfficiencyRow(10, 30, 0.65, -16.52, 3, 7.04, 0.0002),
    EqualEfficiencyRow(15, 10, 0.65, -18.49, 3, 4.22, 0.0067),
    EqualEfficiencyRow(15, 20, 0.51, -6.67, 3, 5.32, 0.0017),
    EqualEfficiencyRow(15, 30, 0.67, -18.74, 3, 5.31, 0.0017),
)
