import math
from fractions import Fraction

import numpy as np
import pytest
from oracles import anova

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.analysis.statistics import fit_line, mixed_model, one_way, repeated_measures
from holotorch.perception.scale import EqualEfficiencyScale

# Six participants, three places. By hand: means 5, 9, 10 and 8 in all; between 6 (9 + 1 + 4) = 84, within 16 + 24 + 28
# = 68; F = (84 / 2) / (68 / 15) = 315 / 34. Rows have means 9, 29/3, 8, 8, 16/3, 8: participants
# 3 (1 + 25/9 + 64/9) = 98/3, error 68 - 98/3 = 106/3; F = (84 / 2) / (106 / 30) = 630 / 53.
TABLE = np.array([[6, 8, 13], [8, 12, 9], [4, 9, 11], [5, 11, 8], [3, 6, 7], [4, 8, 12]], dtype=float)
PLACES = np.array([40.0, 50, 60, 70])
INSIDE = np.ones(4, dtype=bool)


def needs_statsmodels():
    return pytest.importorskip("statsmodels", reason="pip install 'holotorch[stats]'")


def line(values, places=PLACES, inside=INSIDE, *, seed=0, limits=(1, 60), resamples=400, confidence=0.95):
    return fit_line(
        places,
        values,
        np.random.default_rng(seed),
        inside=inside,
        limits=limits,
        resamples=resamples,
        confidence=confidence,
    )


def people(seed, number, *, own=3.0, noise=2.0, tilt=0.0):
    generator = np.random.default_rng(seed)
    tilts = tilt * generator.standard_normal((number, 1)) * (PLACES - 55)
    return (
        0.5 * PLACES
        - 10
        + own * generator.standard_normal((number, 1))
        + tilts
        + noise * generator.standard_normal((number, 4))
    )


def test_a_hand_worked_table():
    found = one_way(TABLE)
    assert found.f == pytest.approx(float(Fraction(315, 34)), rel=1e-12)
    assert found.freedom == (2, 15) and found.left_out == 0
    # With two degrees of freedom above, P(F > f) = (1 + 2 f / d)^(-d / 2).
    assert found.p == pytest.approx((1 + 2 * 315 / 34 / 15) ** -7.5, rel=1e-10)


def test_a_hand_worked_table_of_repeated_measures():
    needs_statsmodels()
    found = repeated_measures(TABLE)
    assert found.f == pytest.approx(float(Fraction(630, 53)), rel=1e-10)
    assert found.freedom == (2, 10)
    assert found.p == pytest.approx((1 + 2 * 630 / 53 / 10) ** -5, rel=1e-8)
    assert found.epsilon == pytest.approx(anova.epsilon(TABLE.tolist()), rel=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_analyses_equal_their_libraries_and_the_sums(seed):
    needs_statsmodels()
    from scipy import stats

    values = people(seed, 11)
    plain, blocked = one_way(values), repeated_measures(values)
    f, p = stats.f_oneway(*values.T)
    assert (plain.f, plain.p) == (f, p)
    for found, (f, first, second) in (
        (plain, anova.one_way(values.T.tolist())),
        (blocked, anova.repeated(values.tolist())),
    ):
        assert found.f == pytest.approx(f, rel=1e-9)
        assert found.freedom == (first, second)
        assert found.p == pytest.approx(anova.survival(f, first, second), rel=1e-6)  # Simpson: h^4 = 1e-17, times 1/h
    epsilon = anova.epsilon(values.tolist())
    assert blocked.epsilon == pytest.approx(epsilon, rel=1e-9) and 1 / 3 <= epsilon <= 1
    assert blocked.p_corrected == pytest.approx(anova.survival(blocked.f, 3 * epsilon, 30 * epsilon), rel=1e-6)


def test_missing_values_are_left_out_and_counted():
    needs_statsmodels()
    values = people(3, 9)
    holed = values.copy()
    holed[2, 1] = holed[2, 3] = holed[5, 0] = np.nan
    plain, blocked = one_way(holed), repeated_measures(holed)
    groups = [[v for v in column if not math.isnan(v)] for column in holed.T.tolist()]
    assert plain.f == pytest.approx(anova.one_way(groups)[0]) and plain.left_out == 3 and plain.freedom == (3, 29)
    whole = np.delete(values, [2, 5], 0)
    assert blocked.f == pytest.approx(anova.repeated(whole.tolist())[0])
    assert (blocked.participants, blocked.left_out) == (7, 2)


def test_too_little_to_compare_is_said_not_raised():
    needs_statsmodels()
    alike = np.tile([1.0, 2, 3, 4], (6, 1)) + 0.1  # nothing differs between people
    assert math.isnan(repeated_measures(alike).f) and math.isnan(repeated_measures(alike).p_corrected)
    for values in (np.full((3, 4), np.nan), TABLE[:1], TABLE[:, :1]):
        assert math.isnan(one_way(values).f) and math.isnan(repeated_measures(values).f)
        assert mixed_model(PLACES[: values.shape[1]], values) is None


def test_mixed_model_is_the_line_of_means_with_the_spread_of_slopes():
    """For whole data: the slope is that through the means, and its variance that of the participants' slopes."""
    needs_statsmodels()
    values = people(4, 24, tilt=0.15)
    found = mixed_model(PLACES, values)
    assert found is not None and found.effects == "line"
    slopes = np.polyfit(PLACES, values.T, 1)[0]
    assert found.alpha == pytest.approx(slopes.mean(), rel=1e-6)
    from scipy import stats

    half = stats.t.isf(0.025, 23) * slopes.std(ddof=1) / math.sqrt(24)
    # REML stops at a relative change of the likelihood; its variances are good to about 1e-3.
    assert found.alpha_interval[1] - found.alpha == pytest.approx(half, rel=5e-3)
    fewer = values.copy()
    fewer[3, 0] = np.nan
    other = mixed_model(PLACES, fewer)
    assert other is not None and (other.participants, other.values) == (24, 95)
    assert abs(other.alpha - found.alpha) < half


def test_the_line_is_that_of_the_perception_module():
    values = people(5, 15)
    found = line(values)
    own = EqualEfficiencyScale.fit(PLACES.tolist(), np.median(values, 0).tolist())
    assert (found.alpha, found.beta) == pytest.approx((float(own.alpha), float(own.beta)), rel=1e-10)
    assert found.alpha_interval[0] < found.alpha < found.alpha_interval[1]
    assert np.all(found.median_intervals[0] <= found.medians) and np.all(found.medians <= found.median_intervals[1])
    again = line(values)
    assert again.alpha_interval == found.alpha_interval
    assert line(values, confidence=0.5).alpha_interval[0] > found.alpha_interval[0]


def test_intervals_of_lines_hold_their_level_where_values_of_a_person_go_together():
    """A person's level moves all their values: it widens the interval of beta, not that of alpha."""
    runs, held, independent = 150, np.zeros(2), 0
    for seed in range(runs):
        values = people(seed, 25, own=8.0, noise=1.0)
        found = line(values, seed=seed, limits=(-100, 100), resamples=300)
        held += [a <= true <= b for (a, b), true in ((found.alpha_interval, 0.5), (found.beta_interval, -10))]
        # What treating the values as independent would claim for the line's height at 55 deg.
        half = 1.96 * 1.2533 * values.std(0, ddof=1).mean() / math.sqrt(25 * 4)
        independent += abs(found.alpha * 55 + found.beta - 17.5) <= half
    # 150 trials at 0.95 have a standard deviation of 1.8 %; four of them.
    assert np.all(held / runs > 0.95 - 4 * 0.018)
    assert independent / runs < 0.85


def test_a_line_is_refused_where_medians_are_no_scales():
    values = people(6, 9)
    beyond = values.copy()
    beyond[:6, 3] = 60
    found = line(beyond)
    assert math.isnan(found.alpha) and "70 deg" in found.refused and "60 deg" in found.refused
    half = people(6, 6)
    half[:3, 3] = 60
    assert np.median(half[:, 3]) < 60 and "70 deg" in line(half).refused
    empty = values.copy()
    empty[:, 1] = np.nan
    assert "50 deg" in line(empty).refused
    assert "two eccentricities" in line(values, inside=np.array([True, False, False, False])).refused
    few = line(values[:4])
    assert math.isfinite(few.alpha) and math.isnan(few.alpha_interval[0])


def test_people_without_any_scale_change_nothing():
    values = people(7, 9)
    holed = np.concatenate([np.full((3, 4), np.nan), values])
    assert (line(holed).alpha_interval, line(holed).medians.tolist()) == (
        line(values).alpha_interval,
        line(values).medians.tolist(),
    )
    few = line(holed[:7])
    assert math.isfinite(few.alpha) and math.isnan(few.alpha_interval[0])


def test_missing_statsmodels_gives_the_line_that_installs_it(monkeypatch):
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'holotorch\[stats\]'"):
        repeated_measures(TABLE)
