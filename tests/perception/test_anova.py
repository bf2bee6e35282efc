"""Analyses of variance from summaries, against those of the raw data by SciPy, statsmodels and sums of squares."""

import numpy as np
import pytest
from scipy import stats

from holotorch.perception import TABLE_2_2, one_way_from_summary, two_way_from_summary
from holotorch.perception.anova import error_freedom, f_of_p, p_of_f
from holotorch.perception.table import ALL_CELLS_P


def summaries(groups):
    return [np.array([function(g) for g in groups]) for function in (np.mean, lambda g: np.std(g, ddof=1), len)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("apart", [0.0, 0.3, 5.0])
def test_one_way_equals_that_of_the_raw_data(seed, apart):
    generator = np.random.default_rng(seed)
    counts = generator.integers(2, 40, size=generator.integers(2, 9))
    groups = [apart * k + generator.normal(0.45, 0.1, count) for k, count in enumerate(counts)]
    expected = stats.f_oneway(*groups)
    found = one_way_from_summary(*summaries(groups))
    assert found.f == pytest.approx(float(expected.statistic), rel=1e-9)
    assert found.p == pytest.approx(float(expected.pvalue), rel=1e-7, abs=1e-300)
    assert found.freedom == (len(counts) - 1, counts.sum() - len(counts))


def test_a_group_of_one_value_has_no_deviation():
    groups = [[0.4, 0.5, 0.47], [0.6], [0.7, 0.62]]
    means, _, counts = summaries([np.array(g) for g in groups[:1] + groups[2:]])
    means, counts = np.insert(means, 1, 0.6), np.insert(counts, 1, 1)
    deviations = [np.std(groups[0], ddof=1), np.nan, np.std(groups[2], ddof=1)]
    assert one_way_from_summary(means, deviations, counts).f == pytest.approx(float(stats.f_oneway(*groups).statistic))


def test_two_way_of_equal_counts_is_the_one_of_the_textbook():
    """Sums of squares of rows, columns and interaction, which add up to that between all cells."""
    generator = np.random.default_rng(3)
    a, b, n = 3, 4, 6
    values = generator.normal(size=(a, b, n)) + np.arange(a)[:, None, None] + 0.5 * np.arange(b)[:, None] ** 2
    mean, row, column = values.mean(), values.mean((1, 2)), values.mean((0, 2))
    rows, columns = b * n * ((row - mean) ** 2).sum(), a * n * ((column - mean) ** 2).sum()
    cells = n * ((values.mean(-1) - mean) ** 2).sum()
    error = ((values - values.mean(-1, keepdims=True)) ** 2).sum() / (a * b * (n - 1))
    found = two_way_from_summary(values.mean(-1), values.std(-1, ddof=1), np.full((a, b), n))
    inter = cells - rows - columns
    for test, squares, freedom in zip(
        (found.rows, found.columns, found.interaction), (rows, columns, inter), (2, 3, 6), strict=True
    ):
        assert test.freedom == (freedom, a * b * (n - 1))
        assert test.f == pytest.approx(squares / freedom / error, rel=1e-9)
        assert test.p == pytest.approx(stats.f.sf(test.f, *test.freedom), rel=1e-9)


def test_two_way_of_unequal_counts_is_of_type_three():
    pytest.importorskip("statsmodels", reason="pip install 'holotorch[stats]'")
    import pandas
    from statsmodels.formula.api import ols
    from statsmodels.stats.anova import anova_lm

    generator = np.random.default_rng(5)
    counts = generator.integers(1, 9, size=(3, 4))
    cells = [[generator.normal(i + j, 1, counts[i, j]) for j in range(4)] for i in range(3)]
    rows = [{"a": i, "b": j, "y": y} for i in range(3) for j in range(4) for y in cells[i][j]]
    table = anova_lm(ols("y ~ C(a, Sum) * C(b, Sum)", pandas.DataFrame(rows)).fit(), typ=3)
    means = [[np.mean(c) for c in row] for row in cells]
    deviations = [[np.std(c, ddof=1) if len(c) > 1 else 0 for c in row] for row in cells]
    found = two_way_from_summary(means, deviations, counts)
    for name, test in (("C(a, Sum)", found.rows), ("C(b, Sum)", found.columns)):
        assert test.f == pytest.approx(table["F"][name], rel=1e-7)
    assert found.interaction.f == pytest.approx(table["F"]["C(a, Sum):C(b, Sum)"], rel=1e-7)


def test_what_is_no_summary_is_refused():
    cases = [
        (([1, 2], [1, 1], [3]), "share a shape"),
        (([1], [1], [3]), "two or more groups"),
        (([1, 2], [1, 1], [3, 0]), "whole numbers of 1 or more"),
        (([1, 2], [1, 1], [3, 2.5]), "whole numbers of 1 or more"),
        (([1, np.nan], [1, 1], [3, 3]), "finite"),
        (([1, 2], [1, np.inf], [3, 3]), "finite"),
        (([1, 2], [1, -1], [3, 3]), "not below zero"),
        (([1, 2], [0, 0], [3, 3]), "no variance"),
        (([1, 2], [1, 1], [1, 1]), "no group has two values"),
    ]
    for summary, words in cases:
        with pytest.raises(ValueError, match=words):
            one_way_from_summary(*summary)
    with pytest.raises(ValueError, match=r"\[A, B\]"):
        two_way_from_summary([1, 2], [1, 1], [3, 3])
    with pytest.raises(ValueError, match="0 < p < 1"):
        f_of_p(0, (3, 10))


@pytest.mark.parametrize(("p", "freedom"), [(0.3, (3, 10)), (1.3e-6, (51, 2028)), (1e-200, (3, 900))])
def test_f_of_p_is_the_inverse(p, freedom):
    assert stats.f.sf(f_of_p(p, freedom), *freedom) == pytest.approx(p, rel=1e-7)


def test_p_of_f_is_that_of_scipy():
    generator = np.random.default_rng(8)
    for f in (0, 1e-12, 1, 1e9, *generator.lognormal(0, 2, 500)):
        freedom = (int(generator.integers(1, 80)), int(10 ** generator.uniform(0, 4)))
        assert p_of_f(f, freedom) == pytest.approx(stats.f.sf(f, *freedom), rel=1e-9, abs=1e-300)


def test_degrees_of_freedom_from_a_rounded_f_and_p():
    f, p = 8.514, float(stats.f.sf(8.514, 3, 148))
    found = error_freedom(round(f, 2), float(f"{p:.2e}"), 3, f_step=0.01, p_step=1e-7)
    assert 148 in found and 10 not in found and len(found) < 20


def test_every_row_of_table_2_2_agrees_with_itself_and_half_of_them_have_missing_scales():
    """The verdict of the guide: F and p of all ten rows fit together, five of them not with 40 x 4 scales."""
    found = {(row.size_deg, row.eccentricity_deg): row.error_freedom for row in TABLE_2_2}
    assert all(found.values())
    incomplete = [key for key, freedom in found.items() if 156 not in freedom]
    assert incomplete == [(5, 20), (5, 30), (5, 40), (10, 20), (15, 20)]
    assert all(max(found[key]) < 156 for key in incomplete)  # some scales are missing; there are never more
    assert found[5, 20] == [152, 153] and found[10, 20] == [147, 148, 149]


def test_the_f_that_belongs_to_the_p_of_all_cells():
    # 40 participants in 52 cells.
    assert f_of_p(ALL_CELLS_P, (51, 52 * 39)) == pytest.approx(2.254, abs=5e-4)
