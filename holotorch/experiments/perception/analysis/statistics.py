"""Lines, intervals and analyses of variance of equal-efficiency scales, with the participant as the unit."""

import importlib.util
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from holotorch.experiments.config.errors import ConfigError

Array = NDArray[np.float64]
LEAST = 5  # participants for an interval; the resamples of fewer repeat themselves


@dataclass(frozen=True, eq=False)
class Line:
    """S(E) = alpha E + beta through the medians over participants, and intervals.

    Attributes:
        alpha: Degrees per degree; NaN where a median is missing, or half the scales or more are at a limit.
        beta: Degrees.
        alpha_interval: Lower and upper end; NaN with fewer than ``LEAST`` participants who have a scale.
        beta_interval: As above.
        medians: Degrees [K].
        quartiles: 25 % and 75 % of the participants, [2, K].
        median_intervals: [2, K].
        refused: Why there is no line, or nothing.
    """

    alpha: float
    beta: float
    alpha_interval: tuple[float, float]
    beta_interval: tuple[float, float]
    medians: Array
    quartiles: Array
    median_intervals: Array
    refused: str = ""


def fit_line(
    eccentricities: Array,
    degrees: Array,
    generator: np.random.Generator,
    *,
    inside: NDArray[np.bool_],
    limits: tuple[float, float],
    resamples: int,
    confidence: float,
) -> Line:
    """Least squares through the medians of ``degrees`` [P, K] at those eccentricities [K] that are ``inside``.

    One participant gives a scale at every eccentricity, and these go together, as they share one target time. So whole
    participants are drawn with replacement, and the ends of an interval are percentiles of the lines that result. As
    percentiles are too narrow for few participants, the levels are those at which they equal a t interval for a mean
    (Hesterberg 2015, "expanded" percentiles).
    """
    some = degrees[np.isfinite(degrees).any(1)]  # who has no scale at all is no participant of this line
    people, number = len(some), np.isfinite(degrees).sum(0)
    medians, quartiles = _median(degrees), _quantiles(degrees, [0.25, 0.75])
    # Half of them are enough: the mean of two in the middle, one of them at a limit, would say what the limit is.
    at_limit = np.maximum((degrees <= limits[0]).sum(0), (degrees >= limits[1]).sum(0))
    refused = ""
    if inside.sum() < 2:
        refused = f"a line needs two eccentricities in its range, got {int(inside.sum())}"
    elif not np.isfinite(medians[inside]).all():
        where = ", ".join(f"{e:g}" for e in eccentricities[inside & ~np.isfinite(medians)])
        refused = f"no participant has a scale at {where} deg"
    elif (beyond := inside & (2 * at_limit >= number)).any():
        where = ", ".join(f"{e:g}" for e in eccentricities[beyond])
        refused = (
            f"half the participants or more have no scale within {limits[0]:g} .. {limits[1]:g} deg at {where} deg"
        )
    nowhere, wide = (math.nan, math.nan), np.full((2, len(medians)), np.nan)
    level = _expanded(people, confidence) if people >= LEAST else None
    if level is not None:
        drawn = _median(some[generator.integers(people, size=(resamples, people))], 1)
        wide = _quantiles(drawn, [level, 1 - level])
    else:
        drawn = np.empty((0, len(medians)))
    if refused:
        return Line(math.nan, math.nan, nowhere, nowhere, medians, quartiles, wide, refused)
    design = np.stack([eccentricities[inside], np.ones(int(inside.sum()))], -1)
    solve = np.linalg.pinv(design)
    alpha, beta = solve @ medians[inside]
    ends = np.full((2, 2), np.nan)
    if level is not None:
        ends = _quantiles(drawn[:, inside] @ solve.T, [level, 1 - level])
    return Line(
        float(alpha),
        float(beta),
        (float(ends[0, 0]), float(ends[1, 0])),
        (float(ends[0, 1]), float(ends[1, 1])),
        medians,
        quartiles,
        wide,
    )


def _expanded(people: int, confidence: float) -> float:
    from scipy import stats

    t = stats.t.ppf((1 - confidence) / 2, people - 1)
    return float(stats.norm.cdf(math.sqrt(people / (people - 1)) * t))


def _median(values: Array, axis: int = 0) -> Array:
    return _ignoring(np.median, np.nanmedian, values, axis)


def _quantiles(values: Array, levels: Sequence[float]) -> Array:
    return _ignoring(
        lambda v, axis: np.quantile(v, levels, axis=axis),
        lambda v, axis: np.nanquantile(v, levels, axis=axis),
        values,
        0,
    )


def _ignoring(whole: Callable[..., Array], holed: Callable[..., Array], values: Array, axis: int) -> Array:
    """The first of two functions where nothing is missing, as it is many times faster; NaN for a column of NaN."""
    if not np.isnan(values).any():
        return whole(values, axis=axis)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")
        return holed(values, axis=axis)


@dataclass(frozen=True)
class Anova:
    """An analysis of variance.

    Attributes:
        f: The statistic; NaN where there is too little to compare, or nothing to compare it with.
        p: Its p-value.
        freedom: Degrees of freedom between, and within or of the error.
        participants: How many were used.
        left_out: Scales (one-way) or participants (repeated measures) that were missing or undefined.
        epsilon: Greenhouse and Geisser's; 1 for a one-way analysis.
        p_corrected: p with both degrees of freedom times epsilon.
    """

    f: float
    p: float
    freedom: tuple[int, int]
    participants: int
    left_out: int
    epsilon: float = 1.0
    p_corrected: float = math.nan


def one_way(values: Array) -> Anova:
    """The thesis's analysis: the columns of ``values`` [P, K] as independent groups, NaN left out. SciPy.

    It takes a participant's values as independent, which they are not: its p is not what it says.
    """
    from scipy import stats

    groups = [column[np.isfinite(column)] for column in values.T]
    groups = [group for group in groups if len(group)]
    number, missing = sum(map(len, groups)), int((~np.isfinite(values)).sum())
    people = int(np.isfinite(values).any(1).sum())
    freedom = (len(groups) - 1, number - len(groups))
    if min(freedom) < 1:
        return Anova(math.nan, math.nan, freedom, people, missing)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # equal values throughout: F is NaN or infinite, which says it
        f, p = stats.f_oneway(*groups)
    return Anova(float(f), float(p), freedom, people, missing, p_corrected=float(p))


def repeated_measures(values: Array) -> Anova:
    """The same with participants as blocks (statsmodels' AnovaRM); those with a NaN are left out, as it needs all.

    AnovaRM takes the differences between all pairs of columns to vary alike; ``p_corrected`` does not.

    Raises:
        ConfigError: statsmodels is missing.
    """
    need_statsmodels()
    import pandas
    from scipy import stats
    from statsmodels.stats.anova import AnovaRM

    whole = values[np.isfinite(values).all(1)]
    people, columns = whole.shape
    freedom = (columns - 1, (columns - 1) * (people - 1))
    if min(freedom) < 1:
        return Anova(math.nan, math.nan, freedom, people, len(values) - people, math.nan)
    person, column = np.indices(whole.shape)
    frame = pandas.DataFrame({"scale": whole.ravel(), "participant": person.ravel(), "place": column.ravel()})
    centred = np.eye(columns) - 1 / columns
    spread = centred @ np.cov(whole.T) @ centred
    if np.trace(spread) <= 1e-24 * np.square(whole).mean():  # all alike but for rounding, which F would be made of
        return Anova(math.nan, math.nan, freedom, people, len(values) - people, math.nan)
    row = AnovaRM(frame, "scale", "participant", within=["place"]).fit().anova_table.iloc[0]
    f, p = float(row["F Value"]), float(row["Pr > F"])
    epsilon = float(np.trace(spread) ** 2 / ((columns - 1) * np.trace(spread @ spread)))
    corrected = float(stats.f.sf(f, epsilon * freedom[0], epsilon * freedom[1]))
    return Anova(f, p, freedom, people, len(values) - people, epsilon, corrected)


@dataclass(frozen=True)
class Mixed:
    """A linear mixed model of the scale over the eccentricity.

    Attributes:
        alpha: Slope of the participants' mean, degrees per degree.
        beta: Intercept in degrees.
        alpha_interval: Lower and upper end.
        beta_interval: As above.
        p: Of alpha = 0.
        effects: What differs between participants: "line" (both alpha and beta) or "intercept".
        participants: How many were used.
        values: How many scales.
    """

    alpha: float
    beta: float
    alpha_interval: tuple[float, float]
    beta_interval: tuple[float, float]
    p: float
    effects: str
    participants: int
    values: int


def mixed_model(eccentricities: Array, values: Array, confidence: float = 0.95) -> Mixed | None:
    """Fit S = alpha E + beta with lines or, where that does not converge, intercepts of participants (MixedLM, REML).

    It is a model of means, which a few large scales move, and takes those missing to be missing at random.

    Returns:
        None where there is too little to fit, or nothing converges.

    Raises:
        ConfigError: statsmodels is missing.
    """
    need_statsmodels()
    from scipy import stats
    from statsmodels.regression.mixed_linear_model import MixedLM

    person, column = np.nonzero(np.isfinite(values))
    people = len(np.unique(person))
    if people < 3 or len(np.unique(column)) < 2:
        return None
    scale, where = values[person, column], eccentricities[column]
    middle, unit = float(where.mean()), float(where.std())
    design = np.stack([np.ones_like(where), (where - middle) / unit], -1)
    for effects in ("line", "intercept"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # whether it converged is asked below
            try:
                random = design if effects == "line" else design[:, :1]
                fit = MixedLM(scale, design, groups=person, exog_re=random).fit(reml=True)
            except (np.linalg.LinAlgError, ValueError):
                continue
        covariance = np.asarray(fit.cov_params())[:2, :2]
        if not (fit.converged and np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()):
            continue
        back = np.array([[0, 1 / unit], [1, -middle / unit]])  # (alpha, beta) from the centred line
        (alpha, beta), covariance = back @ np.asarray(fit.fe_params), back @ covariance @ back.T
        t = float(stats.t.isf((1 - confidence) / 2, people - 1))
        a, b = np.sqrt(np.diag(covariance))
        return Mixed(
            float(alpha),
            float(beta),
            (float(alpha - t * a), float(alpha + t * a)),
            (float(beta - t * b), float(beta + t * b)),
            float(2 * stats.t.sf(abs(alpha / a), people - 1)),
            effects,
            people,
            len(scale),
        )
    return None


def has_statsmodels() -> bool:
    """Whether the extra is installed."""
    return importlib.util.find_spec("statsmodels") is not None


def need_statsmodels() -> None:
    """ConfigError with the line that installs it where it is missing."""
    if not has_statsmodels():
        raise ConfigError(
            ["statsmodels is missing: pip install 'holotorch[stats]', or leave it out with repeated_measures=false"]
        )
