"""Plans for measured fields: what the window's edges diffract belongs to the field, however even its inside."""

import math
import warnings

import numpy as np
import pytest
import torch
from oracles import diffraction

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import phasor
from holotorch.optics import Propagator, plan_propagation, propagate

GRID, WAVE, TOLERANCE = Grid((40, 33), (8e-6, 7e-6)), 530e-9, 1e-3
DISTANCES = (1e-6, 1e-4, 1e-3, -1e-2, 0.1)


def field_of(kind: str) -> torch.Tensor:
    y, x = GRID.coordinates()
    ones, none = (torch.full(GRID.shape, value, dtype=torch.complex128) for value in (1.0, 0.0))
    if kind == "whole periods":
        return ones * phasor(2 * math.pi * 3 / GRID.extent[1] * x)
    if kind == "half periods":
        return ones * phasor(2 * math.pi * (3.5 / GRID.extent[1] * x - 6.5 / GRID.extent[0] * y))
    if kind == "point":
        none[11, 20] = 1
        return none
    if kind == "half lit":
        return ones * (y < 0)
    if kind == "one bright pixel":
        ones[3, 5] = 100
    return ones


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("kind", ["uniform", "whole periods", "half periods", "point", "half lit", "one bright pixel"])
def test_a_measured_plan_errs_as_it_says(kind, distance):
    field = field_of(kind)
    wanted = torch.from_numpy(diffraction.band_limited_sum(field.numpy(), GRID.pitch, WAVE, distance))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        got = propagate(field, GRID, WAVE, distance, tolerance=TOLERANCE, measure=True)
    plan = plan_propagation(GRID, WAVE, distance, field=field, dtype=field.dtype)
    module = Propagator(GRID, WAVE, distance, example=field)
    assert plan.adequate and plan.predicted_error > 0
    for result in (got, module(field[None])[0]):
        assert (result - wanted).norm() <= 2 * TOLERANCE * wanted.norm()


@pytest.mark.parametrize("distance", [1e-5, 1e-3, 0.1])
def test_a_described_narrow_band_has_edges_too(distance):
    field = field_of("uniform")
    wanted = torch.from_numpy(diffraction.band_limited_sum(field.numpy(), GRID.pitch, WAVE, distance))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        got = propagate(field, GRID, WAVE, distance, tolerance=TOLERANCE, band=(10.0, 10.0))
    assert (got - wanted).norm() <= 2 * TOLERANCE * wanted.norm() or caught[0].category is SamplingWarning


def test_the_sum_that_judges_is_the_first_rayleigh_sommerfeld_integral():
    """A beam whose spectrum ends within the band, and none of the panel's orders in the window."""
    y, x = (axis.numpy() for axis in GRID.coordinates())
    beam = np.exp(-((y - 8e-6) ** 2 + x**2) / 35e-6**2 + 2j * np.pi * 2e4 * x)
    points = [(y[i, 0], x[0, j]) for i in (3, 20, 31) for j in (9, 16, 30)]
    wanted = diffraction.rayleigh_sommerfeld_sum(beam, GRID.pitch, WAVE, 10e-3, points)
    got = diffraction.band_limited_sum(beam, GRID.pitch, WAVE, 10e-3)
    assert np.abs(got[[3, 3, 3, 20, 20, 20, 31, 31, 31], [9, 16, 30] * 3] - wanted).max() <= 1e-5 * np.abs(wanted).max()
