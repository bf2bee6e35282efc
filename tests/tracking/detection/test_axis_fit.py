"""Axis fits against tubes that numpy made by counting fine samples, and what comes to be known against a new fit."""

import math

import numpy as np
import pytest
from oracles import strips

from holotorch.tracking.detection.axis_fit import AxisFit, fit_axis

T = np.linspace(-150, 150, 41)  # places along, on three bands of
BAND = np.digitize(T, [-50, 50])
LEVEL = np.array([0.30, 0.22, 0.40])
REACH = np.array([1, T.max(), 1, T.max()])


def tube(width, blur, shade=None, noise=0.0, seed=0, offset=0.3, slope=0.004, taper=0.002, left=0.05, right=0.08):
    """Light [S, U] of a tube on a line, and its true sides."""
    count = 2 * math.ceil(0.6 * width + 4 + 2 * blur) + 1
    shade = shade or np.ones_like
    light = strips.tube(offset + slope * T, width + taper * T, blur, LEVEL[BAND], left, right, count, shade)
    light = light + noise * np.random.default_rng(seed).normal(size=light.shape)
    return light, np.array([offset, slope, width, taper])


def axis(light, width, noise, taper=0.0, known=0.35, blur=0.9, start=None):
    return fit_axis(
        light, np.full_like(light, noise**-2), T, BAND, LEVEL, np.abs(LEVEL), (width, taper), blur, known, start
    )


def deviations(fit: AxisFit) -> np.ndarray:
    return np.sqrt(fit.covariance.diagonal())


@pytest.mark.parametrize(("width", "blur"), [(6, 0.7), (15, 0.9), (15, 2.0), (40, 0.9)])
def test_flat_tubes_without_noise_are_found(width, blur):
    """The last step is below 0.035 px, and what is left a third of it; a fit from there on leaves a sixth of that."""
    light, true = tube(width, blur)
    fit = axis(light, 1.15 * width, 1e-3)
    assert np.abs((fit.sides - true) * REACH).max() < 0.035 / 3
    assert fit.unknown[4] == pytest.approx(blur, abs=5e-3)
    assert fit.reach == T.max()
    again = axis(light, 1.15 * width, 1e-3, start=fit.unknown)
    assert np.abs((again.sides - true) * REACH).max() < 2e-3


SHADES = {
    "flat": np.ones_like,
    "facing": strips.lambert(0.4, 0.0),
    "aside": strips.lambert(0.4, 0.4),
    "half in shadow": strips.lambert(0.4, 1.2),
    "cubic": lambda q: 0.8 + 0.2 * q - 0.15 * q**3,
    "glossy": strips.lambert(0.4, 0.4, 0.3),
}


@pytest.mark.parametrize("shade", SHADES)
@pytest.mark.parametrize(("width", "blur"), [(3.5, 0.7), (6, 0.7), (6, 1.5), (15, 0.9)])
def test_shaded_tubes_keep_their_direction(shade, width, blur):
    """Shading, alike along the tube, may shift the middle of what is seen, a part of the width; it cannot turn it.

    4 stated deviations of 0.01 to 0.03 px at the ends, and what the kink where the shadow begins adds to them.
    """
    light, true = tube(width, blur, SHADES[shade], 0.004)
    fit = axis(light, 1.1 * width, 0.004)
    offset, slope, wide, _ = np.abs(fit.sides - true)
    reach = np.abs(T).max()
    assert slope * reach < 4 * deviations(fit)[1] * reach + 0.05
    assert offset < 0.2 * width and wide < 0.35 * width
    if shade != "glossy":  # a highlight at the side passes for a sharper side
        assert fit.unknown[4] == pytest.approx(blur, abs=0.35 * blur)
    assert np.linalg.eigvalsh(fit.covariance).min() > 0


@pytest.mark.parametrize("shade", SHADES)
@pytest.mark.parametrize("width", [6, 10])
def test_who_knows_the_width_finds_the_middle(shade, width):
    """The tracker's second look: the pose gives the width. What is left is what a shadow's kink feigns."""
    light, true = tube(width, 0.8, SHADES[shade], 0.004)
    fit = axis(light, width, 0.004, taper=0.002, known=0.003)
    assert abs(fit.sides[0] - true[0]) < 0.06 * width


@pytest.mark.parametrize("shade", [shade for shade in SHADES if shade != "glossy"])
@pytest.mark.parametrize("width", [6, 10, 15])
def test_who_learns_the_width_afterwards_finds_the_middle_as_well(shade, width):
    """As above, but to first order, and from a width that was a twentieth off to begin with.

    A highlight, of which the model knows nothing, is left out: what it moves the first fit by stays.
    """
    light, true = tube(width, 0.8, SHADES[shade], 0.004)
    fit = axis(light, 1.05 * width, 0.004).given((width, 0.002), 0.003)
    assert abs(fit.sides[0] - true[0]) < 0.06 * width


@pytest.mark.parametrize(("shade", "width"), [("flat", 6), ("flat", 15), ("cubic", 15)])
def test_axes_scatter_by_the_stated_deviation(shade, width):
    """Of 40 fits the scatter is known to 1 / sqrt(80) = 11 %; four times that. Shadings that the model holds."""
    true, noise, found, stated = np.zeros(4), 0.008, [], []
    for seed in range(40):
        light, true = tube(width, 0.9, SHADES[shade], noise, seed)
        fit = axis(light, 1.1 * width, noise)
        found.append(fit.sides)
        stated.append(deviations(fit))
    ratio = np.std(found, 0) / np.median(stated, 0)
    assert (ratio > 1 - 4 * 0.11).all() and (ratio < 1 + 4 * 0.11).all(), ratio
    # Where the shading is free, its prior pulls the middle by a part of a deviation at most.
    assert (np.abs(np.mean(found, 0) - true) < (4 / math.sqrt(40) + 1.5) * np.median(stated, 0)).all()


def test_more_noise_makes_the_axis_less_sure():
    one, other = (deviations(axis(tube(10, 0.9, None, noise)[0], 10.0, noise)) for noise in (0.004, 0.016))
    ratio = other / one
    assert (ratio > 2).all() and (ratio < 5).all()  # 4, less what the priors hold


def test_stations_that_show_something_else_are_left_out():
    light, true = tube(10, 0.9, None, 0.004)
    spoiled = light.copy()
    spoiled[18:23] = np.roll(spoiled[18:23], 6, 1)
    fit = axis(spoiled, 10.0, 0.004)
    assert fit.weight[18:23].max() < 0.2 and fit.weight[:17].min() > 0.2 and fit.weight[24:].min() > 0.2
    limit = 5 * deviations(fit)[0] + 0.03
    assert abs(fit.sides[0] - true[0]) < limit


def test_contrast_tells_one_sided_strips():
    """Paper: the band's colour goes on to one side."""
    both = axis(tube(10, 0.9, None, 0.004)[0], 10.0, 0.004)
    assert min(both.contrast) > 0.8 and max(both.contrast) == 1
    ones = np.ones_like(T)
    light = strips.tube(0.3 * ones, 10 * ones, 0.9, 0.25 * ones, 0.25, 0.02, 25)
    light = light + 0.004 * np.random.default_rng(3).normal(size=light.shape)
    weight = np.full_like(light, 0.004**-2)
    fit = fit_axis(light, weight, T, np.zeros(41, dtype=int), np.array([0.25]), np.array([0.25]), (10.0, 0.0), 0.9)
    assert min(fit.contrast) < 0.15
    assert fit.contrast[0] < fit.contrast[1]  # left is the side of negative u


def test_a_fit_to_nothing_is_no_number_to_trust():
    fit = axis(np.full((41, 21), 0.2), 8.0, 0.004)
    assert np.isfinite(fit.sides).all()
    lost = axis(np.full((41, 21), np.nan), 8.0, 0.004)
    assert not np.isfinite(lost.covariance).all()
    assert not np.isfinite(lost.given((8.0, 0.0), 0.003).covariance).all()


def test_a_fit_that_begins_at_an_earlier_one_ends_there():
    """Steps below 0.05 px are not sought on, and each is a third of the one before: 0.025 px and less remain.

    Deviations are of the noise before the last step, in which shadings still move: a tenth larger at most.
    """
    light, _ = tube(10, 0.8, SHADES["aside"], 0.004)
    one = axis(light, 10.0, 0.004)
    again = axis(light, 10.0, 0.004, start=one.unknown)
    assert np.abs((again.sides - one.sides) * REACH).max() < 0.025
    np.testing.assert_allclose(deviations(again), deviations(one), rtol=0.12)


def settled(light, width, taper, known, noise, start):
    """A fit with a prior, from where an earlier one ended, until it moves no more."""
    fit = axis(light, width, noise, taper, known, start=start)
    for _ in range(5):
        fit = axis(light, width, noise, taper, known, start=fit.unknown)
    return fit


HELD = [shade for shade in SHADES if shade != "glossy"]  # that the model holds


@pytest.mark.parametrize("shade", HELD)
@pytest.mark.parametrize("wrong", [0.99, 1.0, 1.01])
@pytest.mark.parametrize(("width", "blur"), [(6, 0.8), (15, 0.8), (15, 2.0)])
def test_a_width_that_comes_to_be_known_does_what_a_new_fit_would(shade, wrong, width, blur):
    """To first order: of second order is the width's change squared, over the width.

    The first fit knows the width to a hundredth, as the tracker does from where colours change: where it is free, light
    from aside has a second answer, which no step of first order leaves.

    The first fit ends with a step below 0.03 px; where a shadow begins the next are half as long each, which leaves
    as much. Deviations are those of where the
    first fit ended: a shading turned to the other side by an eighth makes a third of them.
    """
    light, _ = tube(width, blur, SHADES[shade], 0.004)
    first = axis(light, wrong * width, 0.004, known=0.01)
    given, new = first.given((width, 0.002), 0.003), settled(light, width, 0.002, 0.003, 0.004, first.unknown)
    changed = abs(first.sides[2] - new.sides[2])
    pulled = abs(wrong - 1) * width / (1 + (0.01 / 0.003) ** 2)  # by what was known before
    assert np.abs((given.sides - new.sides) * REACH).max() < pulled + changed**2 / width + 0.03
    np.testing.assert_allclose(deviations(given), deviations(new), rtol=0.35)
    # It is sure of the width afterwards, and no less sure of anything.
    assert deviations(given)[2] <= 0.003 * width and (deviations(given) <= deviations(first) * (1 + 1e-9)).all()
    assert given.weight is first.weight and given.contrast == first.contrast and given.reach == first.reach
