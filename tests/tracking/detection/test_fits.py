"""Edge fits against edges that numpy made by counting fine samples."""

import itertools
import math
import warnings

import numpy as np
import pytest
from oracles import strips

from holotorch.tracking.detection.fits import fit_edges, median

BEFORE = np.array([[0.40, 0.05, 0.06]] * 5)  # red, green: light of a row's three channels
AFTER = np.array([[0.05, 0.30, 0.10]] * 5)


def edges(place, blur, count=23):
    return strips.edge(np.asarray(place, float), blur, BEFORE, AFTER, count)


def normal(shape, seed=2026):
    return np.random.default_rng(seed).normal(size=shape)


def test_the_median_of_an_even_number_is_the_one_above_the_middle():
    assert median(np.array([3.0, 1.0, 2.0])) == 2.0 and median(np.array([4.0, 1.0, 3.0, 2.0])) == 3.0


@pytest.mark.parametrize("blur", [0.4, 0.7, 1.0, 2.0, 3.0])
def test_edges_without_noise_are_found(blur):
    """Sums over samples a 32nd of a pixel wide have a variance of 1 / 12 / 32^2 more: a blur 2e-4 larger at most.

    Blurs are not sought on after a step below 0.16, which leaves a twentieth of it, 0.008, and of levels where the edge
    lies, a tenth of the samples, as little of the step as the blur is off; places are.
    """
    place = np.linspace(-1.4, 1.4, 15)
    light = edges(place, blur)
    fit = fit_edges(light, np.full_like(light, 1e4))
    assert np.abs(fit.place - place).max() < 1e-4
    assert np.abs(fit.blur - math.hypot(blur, 1 / 32 / math.sqrt(12))).max() < 8e-3
    assert fit.levels.shape == fit.steps.shape == (15, 5, 3)
    assert np.abs(fit.levels - BEFORE).max() < 3e-4
    assert np.abs(fit.steps - (AFTER - BEFORE)).max() < 6e-4


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_edges_scatter_by_the_stated_deviation(noise):
    """White noise: the stated deviation is 1.2 times the scatter, for samples that share pixels. Of 600 edges the
    scatter is known to 1 / sqrt(1200) = 2.9 %, the mean to a 24th of it; four times that may be missed."""
    rng = np.random.default_rng(1)
    place = rng.uniform(-1, 1, 600)
    light = edges(place, 0.9)
    light = light + noise * rng.normal(size=light.shape)
    fit = fit_edges(light, np.full_like(light, noise**-2))
    missed = fit.place - place
    assert 1.2 * missed.std() / np.median(fit.deviation) == pytest.approx(1, abs=4 * 0.029)
    assert abs(missed.mean()) < 4 * missed.std() / math.sqrt(600)
    free = 23 * 15 - 32
    assert fit.noise.mean() == pytest.approx(1, abs=4 / math.sqrt(2 * free * 600) + 1e-3)
    # The blur is one for all edges, from the same samples: as many of them as edges know it better.
    assert fit.blur.mean() == pytest.approx(0.9, abs=8 * missed.std() / math.sqrt(600) + 1e-3)


def test_weights_that_are_wrong_are_noticed():
    light = edges(np.zeros(200), 0.9)
    light = light + 0.02 * normal(light.shape, 2)
    right = fit_edges(light, np.full_like(light, 0.02**-2))
    bold = fit_edges(light, np.full_like(light, 0.01**-2))
    np.testing.assert_allclose(bold.noise, 2 * right.noise, rtol=1e-6, atol=0)
    np.testing.assert_allclose(bold.deviation, right.deviation, rtol=1e-6, atol=0)


def test_weight_zero_leaves_samples_out():
    light = edges([0.3, -0.6], 0.8)
    weight = np.full_like(light, 1e4)
    weight[:, :4], weight[:, :, 4] = 0, 0
    spoiled = light.copy()
    spoiled[:, :4], spoiled[:, :, 4] = 7.0, -3.0
    one, other = fit_edges(light, weight), fit_edges(spoiled, weight)
    for name in ("place", "blur", "noise", "deviation"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-7)
    np.testing.assert_allclose(other.place, [0.3, -0.6], atol=1e-4, rtol=0)
    unspoiled = fit_edges(spoiled, np.full_like(light, 1e4))
    assert np.abs(unspoiled.place - one.place).min() > 0.05


def test_where_there_is_no_edge_the_deviation_is_large():
    flat = np.zeros((2, 23, 5, 3), dtype=np.float32)
    flat[1] = 0.3
    there = edges([0.4], 0.9).astype(np.float32)
    fit = fit_edges(np.concatenate([flat, there]), np.full((3, 23, 5, 3), 1e4))
    assert (fit.deviation[:2] > 1e6).all() and np.isfinite(fit.place).all()
    assert fit.place[2] == pytest.approx(0.4, abs=1e-4) and fit.deviation[2] < 0.05
    noise = 0.3 + 0.01 * normal((200, 23, 5, 3))
    # Steps of noise: the best of 200 is known 5 times worse than a real one, the usual one not to a pixel or so.
    alone = fit_edges(noise, np.full_like(noise, 1e4)).deviation
    assert alone.min() > 5 * fit.deviation[2] and np.median(alone) > 0.6
    unweighed = fit_edges(there, np.zeros_like(there))
    assert not np.isfinite(unweighed.deviation).any()


def test_another_edge_nearby_makes_the_place_doubtful():
    """A second step, 6 px away: what is left is no noise, and the deviation grows far above that of one edge."""
    light = edges([0.0], 0.9) + 0.5 * (edges([0.0], 0.9, 35)[:, :23] - edges([0.0], 0.9, 35)[:, :1])
    weight = np.full_like(light, 0.004**-2)
    noise = 0.004 * normal(light.shape)
    alone = fit_edges(edges([0.0], 0.9) + noise, weight)
    assert fit_edges(light + noise, weight).deviation > 5 * alone.deviation


def test_an_edge_that_another_blur_made_is_none():
    """One lens blurs all edges of a frame: a soft step among sharp ones is something else, a dim one only unsure."""
    sharp, soft = edges([0.2, -0.3, 0.1], 0.9), edges([0.0], 3.0)
    light = np.concatenate([sharp, soft, 0.3 + 0.01 * (soft - 0.3)])
    noise = 0.004 * normal(light.shape, 0)
    deviation = fit_edges(light + noise, np.full_like(light, 0.004**-2)).deviation
    assert deviation[:3].max() < 0.02 and np.isinf(deviation[3]) and deviation[4] > 0.02


def test_of_two_fits_the_surer_one_is_taken_edge_by_edge():
    light = edges([0.3, -0.4], 0.9)
    weight = np.full_like(light, 1e4)
    weight[0, :, 1:] = 0
    one, other = fit_edges(light, weight), fit_edges(light, weight[::-1])
    both = one.or_better(other)
    assert both.deviation.tolist() == [other.deviation[0], one.deviation[1]]
    assert both.place.tolist() == [other.place[0], one.place[1]]
    assert np.array_equal(both.steps[1], one.steps[1]) and np.array_equal(both.levels[0], other.levels[0])


def test_channels_that_put_edges_apart_make_all_of_them_unsure():
    """Colours half a pixel on, as codecs leave them: no place is right for all channels, so none is sure.

    Places of channels that agree scatter by noise alone: their spread over it is known to 1 / sqrt(2 * 200 * 2) = 4 %.
    """
    noise = 0.01 * normal((200, 23, 5, 3), 4)
    one, far = edges(np.zeros(200), 0.9), edges(np.full(200, 0.5), 0.9)
    weight = np.full_like(one, 1e4)
    mixed = np.concatenate([one[..., :1], far[..., 1:]], -1)
    alike, apart = fit_edges(one + noise, weight), fit_edges(mixed + noise, weight)
    assert alike.apart[0] == 1 and (apart.apart == apart.apart[0]).all() and apart.apart[0] > 2.5
    missed = np.minimum(np.abs(apart.place), np.abs(apart.place - 0.5))
    assert np.median(missed) > 4 * np.median(alike.deviation)  # far from either place for what noise alone would say
    assert np.median(apart.deviation) > np.median(missed) / 3


@pytest.mark.parametrize("weights", [*itertools.permutations((1e4, 349.0, 0.0)), (0.0, 0.0, 0.0)], ids=str)
def test_edges_of_any_blur_and_weight_are_fitted_quietly(weights):
    """Blurs so far apart that none is like what they have in common, or no edge at all: no 0 / 0 on the way."""
    light = np.concatenate([edges([0.1], 0.35), edges([0.2], 5.0), edges([-0.2], 0.9)])
    weight = np.ones_like(light) * np.array(weights)[:, None, None, None]
    with np.errstate(all="raise", under="ignore"), warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fit_edges(light, weight)
    assert np.isfinite(fit.blur).all() and np.isfinite(fit.place).all()
    assert np.isinf(fit.deviation[np.equal(weights, 0)]).all()
