"""Edge and axis fits against edges and tubes that numpy made by counting fine samples."""

import math

import numpy as np
import pytest
import torch
from oracles import strips

from holotorch.tracking.fits import fit_axis, fit_edges

BEFORE = np.array([[0.40, 0.05, 0.06]] * 5)  # red, green: light of a row's three channels
AFTER = np.array([[0.05, 0.30, 0.10]] * 5)
T = np.linspace(-150, 150, 41)  # places along, on three bands of
BAND = np.digitize(T, [-50, 50])
LEVEL = np.array([0.30, 0.22, 0.40])


def edges(place, blur, count=23):
    return torch.from_numpy(strips.edge(np.asarray(place, float), blur, BEFORE, AFTER, count))


@pytest.mark.parametrize("blur", [0.4, 0.7, 1.0, 2.0, 3.0])
def test_edges_without_noise_are_found(blur):
    """Sums over samples a 32nd of a pixel wide have a variance of 1 / 12 / 32^2 more: a blur 2e-4 larger at most.

    Blurs are not sought on after a step below 0.03, which leaves a hundredth of it; places are.
    """
    place = np.linspace(-1.4, 1.4, 15)
    light = edges(place, blur)
    fit = fit_edges(light, torch.full_like(light, 1e4))
    assert np.abs(fit.place.numpy() - place).max() < 1e-4
    assert np.abs(fit.blur.numpy() - math.hypot(blur, 1 / 32 / math.sqrt(12))).max() < 3e-4
    torch.testing.assert_close(fit.levels, torch.from_numpy(BEFORE).expand_as(fit.levels), atol=1e-5, rtol=0)
    torch.testing.assert_close(fit.steps, torch.from_numpy(AFTER - BEFORE).expand_as(fit.steps), atol=2e-5, rtol=0)


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_edges_scatter_by_the_stated_deviation(noise):
    """White noise: the stated deviation is 1.2 times the scatter, for samples that share pixels. Of 600 edges the
    scatter is known to 1 / sqrt(1200) = 2.9 %, the mean to a 24th of it; four times that may be missed."""
    rng = np.random.default_rng(1)
    place = rng.uniform(-1, 1, 600)
    light = edges(place, 0.9)
    light = light + noise * torch.from_numpy(rng.normal(size=light.shape))
    fit = fit_edges(light, torch.full_like(light, noise**-2))
    missed = fit.place.numpy() - place
    assert 1.2 * missed.std() / float(fit.deviation.median()) == pytest.approx(1, abs=4 * 0.029)
    assert abs(missed.mean()) < 4 * missed.std() / math.sqrt(600)
    free = 23 * 15 - 32
    assert float(fit.noise.mean()) == pytest.approx(1, abs=4 / math.sqrt(2 * free * 600) + 1e-3)
    # The blur is one for all edges, from the same samples: as many of them as edges know it better.
    assert float(fit.blur.mean()) == pytest.approx(0.9, abs=8 * missed.std() / math.sqrt(600) + 1e-3)


def test_weights_that_are_wrong_are_noticed():
    rng = np.random.default_rng(2)
    light = edges(np.zeros(200), 0.9)
    light = light + 0.02 * torch.from_numpy(rng.normal(size=light.shape))
    right = fit_edges(light, torch.full_like(light, 0.02**-2))
    bold = fit_edges(light, torch.full_like(light, 0.01**-2))
    torch.testing.assert_close(bold.noise, 2 * right.noise, rtol=1e-6, atol=0)
    torch.testing.assert_close(bold.deviation, right.deviation, rtol=1e-6, atol=0)


def test_weight_zero_leaves_samples_out():
    light = edges([0.3, -0.6], 0.8)
    weight = torch.full_like(light, 1e4)
    weight[:, :4], weight[:, :, 4] = 0, 0
    spoiled = light.clone()
    spoiled[:, :4], spoiled[:, :, 4] = 7.0, -3.0
    one, other = fit_edges(light, weight), fit_edges(spoiled, weight)
    for name in ("place", "blur", "noise", "deviation"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=1e-7)
    torch.testing.assert_close(other.place, torch.tensor([0.3, -0.6], dtype=torch.float64), atol=1e-4, rtol=0)
    unspoiled = fit_edges(spoiled, torch.full_like(light, 1e4))
    assert (unspoiled.place - one.place).abs().min() > 0.05


def test_where_there_is_no_edge_the_deviation_is_large():
    flat = torch.zeros(3, 23, 5, 3)
    flat[1], flat[2] = 0.3, torch.nan
    there = edges([0.4], 0.9).to(torch.float32)
    fit = fit_edges(torch.cat([flat, there]), torch.full((4, 23, 5, 3), 1e4))
    assert (fit.deviation[:3] > 1e6).all() and fit.place.isfinite().all()
    assert float(fit.place[3]) == pytest.approx(0.4, abs=1e-4) and float(fit.deviation[3]) < 0.05
    noise = 0.3 + 0.01 * torch.randn(200, 23, 5, 3, dtype=torch.float64)
    # Steps of noise: the best of 200 is known 5 times worse than a real one, the usual one not to a pixel or so.
    alone = fit_edges(noise, torch.full_like(noise, 1e4)).deviation
    assert float(alone.min()) > 5 * float(fit.deviation[3]) and float(alone.median()) > 0.6
    unweighed = fit_edges(there, torch.zeros_like(there))
    assert not unweighed.deviation.isfinite().any()


def test_another_edge_nearby_makes_the_place_doubtful():
    """A second step, 6 px away: what is left is no noise, and the deviation grows far above that of one edge."""
    light = edges([0.0], 0.9) + 0.5 * (edges([0.0], 0.9, 35)[:, :23] - edges([0.0], 0.9, 35)[:, :1])
    weight = torch.full_like(light, 0.004**-2)
    noise = 0.004 * torch.randn_like(light)
    alone = fit_edges(edges([0.0], 0.9) + noise, weight)
    assert fit_edges(light + noise, weight).deviation > 5 * alone.deviation


def test_an_edge_that_another_blur_made_is_none():
    """One lens blurs all edges of a frame: a soft step among sharp ones is something else, a dim one only unsure."""
    sharp, soft = edges([0.2, -0.3, 0.1], 0.9), edges([0.0], 3.0)
    light = torch.cat([sharp, soft, 0.3 + 0.01 * (soft - 0.3)])
    noise = 0.004 * torch.randn(light.shape, generator=torch.Generator().manual_seed(0), dtype=light.dtype)
    deviation = fit_edges(light + noise, torch.full_like(light, 0.004**-2)).deviation
    assert deviation[:3].max() < 0.02 and deviation[3].isinf() and float(deviation[4]) > 0.02


def test_of_two_fits_the_surer_one_is_taken_edge_by_edge():
    light = edges([0.3, -0.4], 0.9)
    weight = torch.full_like(light, 1e4)
    weight[0, :, 1:] = 0
    one, other = fit_edges(light, weight), fit_edges(light, weight.flip(0))
    both = one.or_better(other)
    assert both.deviation.tolist() == [float(other.deviation[0]), float(one.deviation[1])]
    assert torch.equal(both.steps[1], one.steps[1]) and torch.equal(both.levels[0], other.levels[0])


def tube(width, blur, shade=None, noise=0.0, seed=0, offset=0.3, slope=0.004, taper=0.002, left=0.05, right=0.08):
    """Light [S, U] of a tube on a line, and its true sides."""
    count = 2 * math.ceil(0.6 * width + 4 + 2 * blur) + 1
    shade = shade or np.ones_like
    light = strips.tube(offset + slope * T, width + taper * T, blur, LEVEL[BAND], left, right, count, shade)
    light = light + noise * np.random.default_rng(seed).normal(size=light.shape)
    return torch.from_numpy(light), np.array([offset, slope, width, taper])


def axis(light, width, noise, taper=0.0, known=0.35):
    weight = torch.full_like(light, noise**-2)
    places = torch.from_numpy(T), torch.from_numpy(BAND), torch.from_numpy(LEVEL)
    return fit_axis(light, weight, *places, (width, taper), 0.9, known)


@pytest.mark.parametrize(("width", "blur"), [(6, 0.7), (15, 0.9), (15, 2.0), (40, 0.9)])
def test_flat_tubes_without_noise_are_found(width, blur):
    light, true = tube(width, blur)
    fit = axis(light, 1.15 * width, 1e-3)
    reach = np.array([1, T.max(), 1, T.max()])
    assert np.abs((fit.sides.numpy() - true) * reach).max() < 2e-3
    assert fit.blur == pytest.approx(blur, abs=5e-3)


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
    offset, slope, wide, _ = np.abs(fit.sides.numpy() - true)
    reach = np.abs(T).max()
    assert slope * reach < 4 * float(fit.covariance[1, 1].sqrt()) * reach + 0.05
    assert offset < 0.2 * width and wide < 0.35 * width
    if shade != "glossy":  # a highlight at the side passes for a sharper side
        assert fit.blur == pytest.approx(blur, abs=0.35 * blur)
    assert torch.linalg.eigvalsh(fit.covariance).min() > 0


@pytest.mark.parametrize("shade", SHADES)
@pytest.mark.parametrize("width", [6, 10])
def test_who_knows_the_width_finds_the_middle(shade, width):
    """The tracker's second look: the pose gives the width. What is left is what a shadow's kink feigns."""
    light, true = tube(width, 0.8, SHADES[shade], 0.004)
    fit = axis(light, width, 0.004, taper=0.002, known=0.003)
    assert abs(float(fit.sides[0]) - true[0]) < 0.06 * width


@pytest.mark.parametrize(("shade", "width"), [("flat", 6), ("flat", 15), ("cubic", 15)])
def test_axes_scatter_by_the_stated_deviation(shade, width):
    """Of 40 fits the scatter is known to 1 / sqrt(80) = 11 %; four times that. Shadings that the model holds."""
    true, noise, found, stated = np.zeros(4), 0.008, [], []
    for seed in range(40):
        light, true = tube(width, 0.9, SHADES[shade], noise, seed)
        fit = axis(light, 1.1 * width, noise)
        found.append(fit.sides.numpy())
        stated.append(fit.covariance.diagonal().sqrt().numpy())
    ratio = np.std(found, 0) / np.median(stated, 0)
    assert (ratio > 1 - 4 * 0.11).all() and (ratio < 1 + 4 * 0.11).all(), ratio
    # Where the shading is free, its prior pulls the middle by a part of a deviation at most.
    assert (np.abs(np.mean(found, 0) - true) < (4 / math.sqrt(40) + 1.5) * np.median(stated, 0)).all()


def test_more_noise_makes_the_axis_less_sure():
    one, other = (axis(tube(10, 0.9, None, noise)[0], 10.0, noise).covariance for noise in (0.004, 0.016))
    ratio = (other.diagonal() / one.diagonal()).sqrt()
    assert (ratio > 2).all() and (ratio < 5).all()  # 4, less what the priors hold


def test_stations_that_show_something_else_are_left_out():
    light, true = tube(10, 0.9, None, 0.004)
    spoiled = light.clone()
    spoiled[18:23] = spoiled[18:23].roll(6, 1)
    fit = axis(spoiled, 10.0, 0.004)
    assert fit.weight[18:23].max() < 0.2 and fit.weight[:17].min() > 0.2 and fit.weight[24:].min() > 0.2
    limit = 5 * float(fit.covariance[0, 0].sqrt()) + 0.03
    assert abs(float(fit.sides[0]) - true[0]) < limit


def test_contrast_tells_one_sided_strips():
    """Paper: the band's colour goes on to one side."""
    both = axis(tube(10, 0.9, None, 0.004)[0], 10.0, 0.004)
    assert both.contrast.min() > 0.8
    ones = np.ones_like(T)
    light = torch.from_numpy(strips.tube(0.3 * ones, 10 * ones, 0.9, 0.25 * ones, 0.25, 0.02, 25))
    light = light + 0.004 * torch.randn_like(light)
    level = torch.tensor([0.25], dtype=torch.float64)
    weight = torch.full_like(light, 0.004**-2)
    fit = fit_axis(light, weight, torch.from_numpy(T), torch.zeros(41, dtype=torch.long), level, (10.0, 0.0), 0.9)
    assert fit.contrast.min() < 0.15


def test_a_fit_to_nothing_is_no_number_to_trust():
    flat = torch.full((41, 21), 0.2, dtype=torch.float64)
    fit = axis(flat, 8.0, 0.004)
    assert fit.sides.isfinite().all()
    lost = axis(torch.full((41, 21), torch.nan, dtype=torch.float64), 8.0, 0.004)
    assert not lost.covariance.isfinite().all()
