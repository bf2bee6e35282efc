"""Lines, intervals and analyses of variance of equal-efficiency scales, with the participant as the unit."""

import importlib.util
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from holotorch.experiments.config.errors import ConfigError

Array = NDArray[np.float64]
LEAST = 5  # participants needed for an interval; fewer give too few distinct bootstrap resamples


@dataclass(frozen=True, eq=False)
class Line:
    """The line S(E) = alpha E + beta through the medians over participants, with confidence intervals (lower, upper).

    The intervals are NaN if fewer than ``LEAST`` participants have a scale.
    """

    eccentricities: Array  # degrees [K]
    alpha: float  # degrees per degree; NaN without a line
    beta: float  # degrees; NaN without a line
    alpha_interval: tuple[float, float]
    beta_interval: tuple[float, float]
    medians: Array  # degrees [K]
    median_intervals: Array  # lower and upper ends in degrees, [2, K]
    refused: str  # why there is no line, such as a missing median or half the scales at a limit; otherwise empty


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
    """Fit a line by least squares to the medians of ``degrees`` [P, K] at the eccentricities [K] that are ``inside``.

    ``degrees`` are the scales of P participants, clipped to ``limits`` in degrees. The scales of one participant are
    correlated, because they share one target time. The bootstrap therefore draws whole participants with replacement,
    and the intervals are percentiles of the resulting lines. Plain percentiles are too narrow for few participants; the
    levels used here are expanded to match a t interval of a mean (Hesterberg 2015).
    """
    some = degrees[np.isfinite(degrees).any(1)]  # participants without any scale are ignored
    people = len(some)
    medians = _median(degrees)
    drawn, level = np.full_like(medians, np.nan)[None], 0.5  # with too few participants, every interval is NaN
    if people >= LEAST:
        drawn = _median(some[generator.integers(people, size=(resamples, people))], axis=1)
        level = _expanded_level(people, confidence)
    levels = [level, 1 - level]
    refused = _refusal(eccentricities, degrees, medians, inside, limits)
    alpha, beta, ends = math.nan, math.nan, np.full((2, 2), np.nan)
    if not refused:
        design = np.stack([eccentricities[inside], np.ones(int(inside.sum()))], -1)
        solve = np.linalg.pinv(design)
        alpha, beta = (solve @ medians[inside]).tolist()
        ends = _quantiles(drawn[:, inside] @ solve.T, levels)
    alpha_interval, beta_interval = zip(*ends.tolist(), strict=True)
    median_intervals = _quantiles(drawn, levels)
    return Line(eccentricities, alpha, beta, alpha_interval, beta_interval, medians, median_intervals, refused)


def _refusal(
    eccentricities: Array, degrees: Array, medians: Array, inside: NDArray[np.bool_], limits: tuple[float, float]
) -> str:
    """The reason why no line can be fitted to the medians that are ``inside``; empty if it can."""
    if inside.sum() < 2:
        return f"a line needs two eccentricities in its range, got {int(inside.sum())}"
    if not np.isfinite(medians[inside]).all():
        return f"no participant has a scale at {listed(eccentricities[inside & ~np.isfinite(medians)])} deg"
    # Exactly half is already too many: the median would then average a scale with the limit itself.
    at_limit = np.maximum((degrees <= limits[0]).sum(0), (degrees >= limits[1]).sum(0))
    beyond = inside & (2 * at_limit >= np.isfinite(degrees).sum(0))
    if beyond.any():
        range_deg = f"{limits[0]:g} .. {limits[1]:g} deg"
        return f"half the participants or more have no scale within {range_deg} at {listed(eccentricities[beyond])} deg"
    return ""


def listed(values: Array) -> str:
    """Numbers separated by commas."""
    return ", ".join(f"{value:g}" for value in values)


def _expanded_level(people: int, confidence: float) -> float:
    """Lower percentile level that makes a percentile interval as wide as a t interval of a mean."""
    t = stats.t.ppf((1 - confidence) / 2, people - 1)
    return float(stats.norm.cdf(math.sqrt(people / (people - 1)) * t))


def _ignore_nan(
    plain: Callable[..., Array], nan_aware: Callable[..., Array], values: Array, *args: Any, axis: int = 0
) -> Array:
    """Call ``plain``, which is much faster, if no value is NaN, otherwise ``nan_aware``; NaN for a column of NaN."""
    if not np.isnan(values).any():
        return plain(values, *args, axis=axis)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")
        return nan_aware(values, *args, axis=axis)


_median = partial(_ignore_nan, np.median, np.nanmedian)
_quantiles = partial(_ignore_nan, np.quantile, np.nanquantile)


@dataclass(frozen=True)
class Anova:
    """Result of an analysis of variance, one-way or with repeated measures."""

    f: float  # the F statistic; NaN if there are too few values, or no variance within the groups
    p: float
    freedom: tuple[int, int]  # between the groups, and within the groups (one-way) or of the error (repeated)
    participants: int  # number of participants used
    left_out: int  # number of scales (one-way) or participants (repeated measures) that are missing or undefined
    epsilon: float = 1.0  # Greenhouse-Geisser epsilon; 1 for a one-way analysis
    p_corrected: float = math.nan  # p-value with both degrees of freedom multiplied by epsilon


def one_way(values: Array) -> Anova:
    """One-way ANOVA of the columns of ``values`` [P, K] as independent groups, as in the thesis; NaN is left out.

    The values of one participant are not independent, so that the p-value is only nominal.
    """
    groups = [column[np.isfinite(column)] for column in values.T if np.isfinite(column).any()]
    number, missing = sum(map(len, groups)), int((~np.isfinite(values)).sum())
    people = int(np.isfinite(values).any(1).sum())
    freedom = (len(groups) - 1, number - len(groups))
    if min(freedom) < 1:
        return Anova(math.nan, math.nan, freedom, people, missing)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SciPy warns if all values are equal; F is then NaN or infinite
        f, p = stats.f_oneway(*groups)
    return Anova(float(f), float(p), freedom, people, missing, p_corrected=float(p))


def repeated_measures(values: Array) -> Anova:
    """Repeated-measures ANOVA with participants as blocks (AnovaRM of statsmodels); participants with NaN are left out.

    The uncorrected p-value assumes sphericity: differences between all pairs of columns have the same variance.
    ``p_corrected`` does not assume it.

    Raises:
        ConfigError: statsmodels is not installed.
    """
    need_statsmodels()
    import pandas
    from statsmodels.stats.anova import AnovaRM

    complete = values[np.isfinite(values).all(1)]
    people, columns = complete.shape
    freedom = (columns - 1, (columns - 1) * (people - 1))
    undefined = Anova(math.nan, math.nan, freedom, people, len(values) - people, math.nan)
    if min(freedom) < 1:
        return undefined
    person, column = np.indices(complete.shape)
    frame = pandas.DataFrame({"scale": complete.ravel(), "participant": person.ravel(), "column": column.ravel()})
    centred = np.eye(columns) - 1 / columns
    spread = centred @ np.cov(complete.T) @ centred
    if np.trace(spread) <= 1e-24 * np.square(complete).mean():  # all equal within rounding errors
        return undefined
    row = AnovaRM(frame, "scale", "participant", within=["column"]).fit().anova_table.iloc[0]
    f, p = float(row["F Value"]), float(row["Pr > F"])
    epsilon = float(np.trace(spread) ** 2 / ((columns - 1) * np.trace(spread @ spread)))
    corrected = float(stats.f.sf(f, epsilon * freedom[0], epsilon * freedom[1]))
    return Anova(f, p, freedom, people, len(values) - people, epsilon, corrected)


@dataclass(frozen=True)
class Mixed:
    """A linear mixed model of the scale over the eccentricity, with confidence intervals (lower, upper)."""

    alpha: float  # slope of the mean over participants, degrees per degree
    beta: float  # intercept in degrees
    alpha_interval: tuple[float, float]
    beta_interval: tuple[float, float]
    p: float  # p-value of the hypothesis alpha = 0
    effects: str  # random effects of a participant: "line" (alpha and beta) or "intercept"
    participants: int  # number of participants used
    values: int  # number of scales used


def mixed_model(eccentricities: Array, values: Array, confidence: float = 0.95) -> Mixed | None:
    """Fit the mixed model S = alpha E + beta by REML (MixedLM of statsmodels).

    The random effects are a line for each participant or, if that fit does not converge, an intercept. The model
    describes means, which are sensitive to a few large scales, and assumes that values are missing at random.

    Returns:
        The model, or None if there are too few values or neither fit converges.

    Raises:
        ConfigError: statsmodels is not installed.
    """
    need_statsmodels()
    from statsmodels.regression.mixed_linear_model import MixedLM

    person, column = np.nonzero(np.isfinite(values))
    people = len(np.unique(person))
    if people < 3 or len(np.unique(column)) < 2:
        return None
    scale, where = values[person, column], eccentricities[column]
    middle, unit = float(where.mean()), float(where.std())
    design = np.stack([np.ones_like(where), (where - middle) / unit], -1)
    for effects, random in (("line", design), ("intercept", design[:, :1])):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # convergence is checked below
            try:
                fit = MixedLM(scale, design, groups=person, exog_re=random).fit(reml=True)
            except (np.linalg.LinAlgError, ValueError):
                continue
        covariance = np.asarray(fit.cov_params())[:2, :2]
        if not (fit.converged and np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()):
            continue
        to_line = np.array([[0, 1 / unit], [1, -middle / unit]])  # (alpha, beta) from the normalised coefficients
        line, errors = to_line @ np.asarray(fit.fe_params), np.sqrt(np.diag(to_line @ covariance @ to_line.T))
        half = float(stats.t.isf((1 - confidence) / 2, people - 1)) * errors
        alpha_interval, beta_interval = zip((line - half).tolist(), (line + half).tolist(), strict=True)
        p = float(2 * stats.t.sf(abs(line[0] / errors[0]), people - 1))
        alpha, beta = line.tolist()
        return Mixed(alpha, beta, alpha_interval, beta_interval, p, effects, people, len(scale))
    return None


def has_statsmodels() -> bool:
    """Whether statsmodels is installed."""
    return importlib.util.find_spec("statsmodels") is not None


def need_statsmodels() -> None:
    """Raise ConfigError with the command that installs statsmodels, unless it is installed."""
    if not has_statsmodels():
        raise ConfigError(
            ["statsmodels is missing: pip install 'holotorch[stats]', or leave it out with repeated_measures=false"]
        )
