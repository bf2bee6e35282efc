"""The line of a tube among labels."""

import numpy as np
import pytest

from holotorch.tracking.detection.bands import find_axis


def fan(offset, slope, thick=5.0, length=201, half=20, coloured=1.0, seed=7, every=1):
    """Labels [T, U] of a tube u = offset + slope t, t and u; every other one, or fewer, along and across."""
    t, u = np.arange(length) - (length - 1) / 2, np.arange(2 * half + 1.0) - half
    lit = np.abs(u - offset - slope * t[:, None]) < thick / 2
    lit &= np.random.default_rng(seed).random(lit.shape) < coloured
    band = 1 + np.minimum(np.arange(length) * 3 // length, 2)
    labels = (lit * band[:, None]).astype(np.uint8)
    return labels[::every, ::every], t[::every], u[::every]


TUBES = [(0.0, 0.0), (6.3, 0.04), (-9.0, -0.05), (3.0, 0.058)]


@pytest.mark.parametrize(("offset", "slope"), TUBES)
def test_the_axis_of_a_tube_is_found(offset, slope):
    """Whole pixels: each row's middle is off by up to half of one, and on average by little."""
    found = find_axis(*fan(offset, slope), 0.06)
    assert found is not None
    assert found[0] == pytest.approx(offset, abs=0.25) and found[1] == pytest.approx(slope, abs=0.004)


@pytest.mark.parametrize(("offset", "slope"), TUBES)
def test_every_second_pixel_of_every_second_row_is_enough(offset, slope):
    """As above, of whole second pixels: twice as far off."""
    found = find_axis(*fan(offset, slope, every=2), 0.06)
    assert found is not None
    assert found[0] == pytest.approx(offset, abs=0.5) and found[1] == pytest.approx(slope, abs=0.008)


def test_long_strips_with_many_pixels_are_searched_as_well():
    """Some hundred of the 5,000 coloured pixels vote; all of them say where the line lies."""
    found = find_axis(*fan(-20.0, 0.03, length=1001, half=60), 0.06)
    assert found is not None
    assert found[0] == pytest.approx(-20.0, abs=0.25) and found[1] == pytest.approx(0.03, abs=0.001)


@pytest.mark.parametrize("reach", [0.06, 0.15])
def test_slopes_to_what_is_asked_for_are_found(reach):
    found = find_axis(*fan(2.0, 0.95 * reach), reach)
    assert found is not None
    assert found[0] == pytest.approx(2.0, abs=0.25) and found[1] == pytest.approx(0.95 * reach, abs=0.004)


def test_the_axis_is_found_among_specks_and_gaps():
    labels, t, u = fan(4.0, 0.03, coloured=0.6)
    labels = np.where(np.random.default_rng(2026).random(labels.shape) < 0.02, 2, labels)
    labels[90:110] = 0
    found = find_axis(labels, t, u, 0.06)
    assert found is not None
    assert found[0] == pytest.approx(4.0, abs=0.5) and found[1] == pytest.approx(0.03, abs=0.008)


def test_rows_of_one_colour_are_no_tube():
    labels, t, u = fan(4.0, 0.03)
    labels[:60] = 1  # cloth
    found = find_axis(labels, t, u, 0.06)
    assert found is not None and found[0] == pytest.approx(4.0, abs=0.5)
    assert find_axis(np.full_like(labels, 2), t, u, 0.06) is None


def test_without_colours_there_is_no_axis():
    labels, t, u = fan(0.0, 0.0)
    assert find_axis(np.zeros_like(labels), t, u, 0.06) is None
    few = np.zeros_like(labels)
    few[3, 4:10] = 1
    assert find_axis(few, t, u, 0.06) is None
    column = np.zeros_like(labels)
    column[50, 2:22] = 1  # in one row only: no direction
    assert find_axis(column, t, u, 0.06) is None
