"""The stability suite on few points: no method errs by ten tolerances without a word."""

import math

import numpy as np
import pytest
import torch
from oracles.propagation import random_case

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.experiments.stability import chart, reference
from holotorch.experiments.stability.sweep import Answer, Sweep

SWEEPS = chart.all_sweeps()


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.name)
def test_no_point_is_silent(sweep):
    silent = [point for point in sweep.thinned(3).points() if not point.ok]
    assert not silent, chart.verdict(silent)


def test_sweeps_have_different_names():
    assert len({sweep.name for sweep in SWEEPS}) == len(SWEEPS)


@pytest.mark.parametrize("seed", range(12))
def test_the_reference_of_propagation_agrees_with_the_oracle(seed):
    case = random_case(seed)
    got = reference.propagated(
        torch.from_numpy(case.field), Grid(case.field.shape, case.pitch), case.wavelength, case.distance,
        Grid(case.out_shape, case.out_pitch), case.offset, case.tilt,
    ).numpy()  # fmt: skip
    wanted = case.exact()
    # Relative to the light that is sent, since a window may lie beside the light.
    assert np.linalg.norm(got - wanted) < 1e-9 * np.linalg.norm(case.field)


def points_of(answer, tolerance=1e-3):
    sweep = Sweep("a method", "a size (m)", (1.0, 2.0, 3.0), answer, lambda _: torch.ones(2), tolerance)
    return sweep.points()


def test_an_error_beyond_ten_tolerances_is_silent_unless_said():
    import warnings

    def warned(value):
        warnings.warn("too coarse", SamplingWarning, stacklevel=1)
        return Answer(torch.ones(2) * value)

    def refused(value):
        raise ValueError("a distance must be shorter")

    silent = points_of(lambda value: Answer(torch.ones(2) * value))
    assert [point.ok for point in silent] == [True, False, False]
    assert {(p.ok, p.said, p.words) for p in points_of(warned)} == {(True, "warned", "too coarse")}
    assert {(p.ok, p.said, math.isnan(p.measured)) for p in points_of(refused)} == {(True, "refused", True)}
    # A result that is not finite is never right.
    assert not any(point.ok for point in points_of(lambda value: Answer(torch.full((2,), math.nan))))


def test_a_change_of_the_chosen_method_is_a_switch():
    chosen = ["short", "short", "long"]
    points = points_of(lambda value: Answer(torch.ones(2), chosen=chosen[int(value) - 1]))
    assert [point.said for point in points] == ["nothing", "nothing", "switched"]


def test_the_verdict_counts_and_names_silent_points():
    points = points_of(lambda value: Answer(torch.ones(2) * (1 + 0.1 * (value - 1)), predicted=0.2))
    lines = "\n".join(chart.verdict(points))
    assert "3 points of 1 sweeps; said: 3 nothing, 0 switched, 0 warned, 0 refused" in lines
    assert "without a word): 2" in lines and "silent: a method, a size (m) = 3: error 2.0e-01 for 1.0e-03" in lines
    assert "predicted / measured error: median 1.50" in lines
