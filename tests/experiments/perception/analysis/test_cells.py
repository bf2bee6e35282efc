"""Analyses of variance over all pairs of eccentricity and size."""

import json

import numpy as np
import pytest
from scipy import stats

from holotorch.experiments.perception.analysis.cells import cell_tests
from holotorch.experiments.perception.analysis.config import CleaningSettings, SimulationSettings
from holotorch.experiments.perception.analysis.curves import Times, perception_times
from holotorch.experiments.perception.analysis.simulation import simulate


def times(seconds, eccentricities, sizes):
    people = len(seconds)
    kept = np.full(np.shape(seconds), 5)
    return Times(np.arange(people), np.array(eccentricities, float), np.array(sizes, float), seconds, kept, {})


def test_all_cells_equal_scipy_and_the_far_ones_have_two_factors():
    generator = np.random.default_rng(2)
    seconds = generator.normal(0.5, 0.1, (12, 4, 3))
    seconds[:, 0, 2] = np.nan  # a pair that was not shown
    seconds[3, 2, 1] = np.nan  # a missing time
    found = cell_tests(times(seconds, (10, 40, 50, 60), (5, 8, 11)), 40)
    cells = seconds.reshape(12, -1).T
    groups = [cell[np.isfinite(cell)] for cell in cells if np.isfinite(cell).any()]
    assert found.cells == 11 == len(groups)
    assert found.one_way.f == pytest.approx(float(stats.f_oneway(*groups).statistic))
    assert found.two_way is not None and found.two_way.interaction.freedom == (4, 12 * 9 - 1 - 9)
    assert "not testable here" in found.in_words()[0] and json.dumps(found.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    "seconds",
    [np.full((3, 2, 2), 0.4), np.random.default_rng(0).random((1, 2, 2)), np.random.default_rng(0).random((3, 1, 1))],
    ids=["no variance", "one person", "one cell"],
)
def test_what_cannot_be_tested_is_not(seconds):
    shape = seconds.shape
    found = cell_tests(times(seconds, (40, 50)[: shape[1]], (5, 8)[: shape[2]]), 40)
    assert found.two_way is None
    assert found.to_json()["p"] is None and json.dumps(found.to_json(), allow_nan=False)


def test_the_simulated_study_does_not_have_the_printed_p():
    """What the guide says: at the noise of Table 2.2 the p of all cells is below 1e-50, the thesis prints 1.3e-6."""
    made = perception_times(simulate(SimulationSettings(), np.random.default_rng(0)), CleaningSettings())
    found = cell_tests(made, 40)
    assert found.cells == 52 and found.one_way.freedom == (51, 2028)
    assert found.one_way.f > 10 > 2.254 and found.one_way.p < 1e-50
