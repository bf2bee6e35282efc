"""Sums over wavelengths and over an extended source, exposure and colour."""

import math

import pytest
import torch

from holotorch import Grid
from holotorch.optics.light.coherence import path_difference
from holotorch.optics.light.incoherent import disc_source, incoherent_sum, tilted_wave
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.picture import equal_power, gamut_map, linear_srgb, tone_map
from holotorch.optics.planning.propagate import propagate


def test_the_sum_is_weighted_and_streams():
    alive = []

    def intensity_of(wavelength: float) -> torch.Tensor:
        assert isinstance(wavelength, float)
        alive.append(wavelength)
        return torch.full((2, 3), wavelength, dtype=torch.float32)

    places, weights = Spectrum.sled(520e-9).samples(4)
    total = incoherent_sum(intensity_of, places, weights)
    assert total.dtype == torch.float32 and alive == places.tolist()
    torch.testing.assert_close(total, torch.full((2, 3), (places @ weights).item()), rtol=1e-6, atol=0)


@pytest.mark.parametrize("recompute", [False, True])
def test_gradients_pass_through_optics_and_weights(recompute):
    grid, places = Grid((6, 7), 4e-6), torch.tensor([500e-9, 540e-9], dtype=torch.float64)
    field = torch.randn(1, 6, 7, dtype=torch.complex128, requires_grad=True)
    weights = torch.tensor([0.3, 0.7], dtype=torch.float64, requires_grad=True)
    calls = []

    def total(field, weights):
        def intensity_of(wavelength):
            calls.append(wavelength)
            return propagate(field, grid, wavelength, 1e-4).abs().square()

        return incoherent_sum(intensity_of, places, weights, recompute=recompute)

    total(field, weights).sum().backward()
    assert len(calls) == (4 if recompute else 2)
    assert torch.autograd.gradcheck(total, (field, weights), fast_mode=True)


def test_an_extended_source_blurs_by_its_disc():
    # A lens focuses each tilt at f times its sine: the second moment of a disc is radius^2 / 4 per axis.
    points, weights = disc_source(3e-3, 3)
    assert len(points) == 36 and weights.sum().item() == pytest.approx(1, rel=1e-14)
    sines = torch.tensor(points, dtype=torch.float64)
    for powers in ((0, 0), (1, 0), (2, 0), (0, 2), (2, 2), (4, 0), (6, 2), (5, 3), (10, 0)):
        got = (sines[:, 0] ** powers[0] * sines[:, 1] ** powers[1]) @ weights
        a, b = powers
        # Over the unit disc: 2 / (a + b + 2) times the mean of sin^a cos^b round the circle.
        turn = torch.arange(1000, dtype=torch.float64) * (2 * math.pi / 1000)
        wanted = 2 / (a + b + 2) * (turn.sin() ** a * turn.cos() ** b).mean() * 3e-3 ** (a + b)
        assert got.item() == pytest.approx(wanted.item(), rel=1e-12, abs=1e-14 * 3e-3 ** (a + b))
    grid, wave = Grid((12, 17), (5e-6, 4e-6)), 520e-9
    tilted = tilted_wave(grid, wave, (2 * wave / (12 * 5e-6), -3 * wave / (17 * 4e-6)))
    assert tilted[6, 8].item() == pytest.approx(1)
    spectrum = torch.fft.fft2(tilted).abs()
    assert divmod(int(spectrum.argmax()), 17) == (2, 14) and spectrum.max().item() == pytest.approx(12 * 17)


def test_equal_power_and_exposure():
    generator = torch.Generator().manual_seed(1)
    sled = torch.rand(2, 3, 8, 9, generator=generator, dtype=torch.float64)
    laser = 5 * torch.rand(2, 3, 8, 9, generator=generator, dtype=torch.float64) ** 4
    laser[0, 1] = 0
    scaled = equal_power(laser, sled)
    wanted = sled.sum((-2, -1))
    wanted[0, 1] = 0
    torch.testing.assert_close(scaled.sum((-2, -1)), wanted, rtol=1e-12, atol=0)
    peak = sled.amax((-3, -2, -1), keepdim=True)
    picture = tone_map(sled)
    torch.testing.assert_close(picture, (sled / peak).sqrt())
    assert picture.amax((-3, -2, -1)).tolist() == [1, 1]
    over = tone_map(scaled, peak=peak)
    assert over.max() == 1 and (scaled > peak).any()
    torch.testing.assert_close(tone_map(sled, gamma=1.0), sled / peak)


def test_an_empty_picture_is_black_with_finite_gradients():
    image = torch.zeros(3, 4, 5, requires_grad=True)
    picture = tone_map(equal_power(image, torch.ones(3, 4, 5)))
    picture.sum().backward()
    assert torch.equal(picture, torch.zeros(3, 4, 5)) and image.grad is not None
    assert torch.isfinite(image.grad).all()
    half = torch.rand(1, 4, 5, dtype=torch.float64) + 0.1
    peak = torch.tensor(2.0, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: tone_map(x, peak=peak), (half.requires_grad_(),))


def test_colours_are_one_product_and_fit_the_gamut():
    matrix = torch.tensor([[2.0, -0.5, 0.1], [-0.2, 1.5, -0.1], [0.0, -0.1, 1.2]], dtype=torch.float64)
    light = torch.rand(2, 3, 4, 5, dtype=torch.float64, requires_grad=True)
    colour = linear_srgb(light, matrix)
    torch.testing.assert_close(colour[1, :, 2, 3], matrix @ light[1, :, 2, 3])
    shown = gamut_map(colour)
    luminance = torch.tensor([0.2126390059, 0.7151686788, 0.0721923153], dtype=torch.float64)
    inside = (colour >= 0).all(-3)
    assert inside.any() and not inside.all() and (shown >= 0).all()
    torch.testing.assert_close(shown.movedim(-3, 0)[:, inside], colour.movedim(-3, 0)[:, inside], rtol=1e-12, atol=0)
    brightness = [torch.einsum("c,...chw->...hw", luminance, part) for part in (shown, colour)]
    torch.testing.assert_close(*brightness, rtol=1e-8, atol=1e-12)
    # Hue: what is taken from each pixel is a multiple of its distance from grey.
    grey = brightness[1][:, None]
    torch.testing.assert_close(
        torch.linalg.cross(shown - grey, colour - grey, dim=-3), torch.zeros_like(colour), rtol=0, atol=1e-9
    )
    assert torch.autograd.gradcheck(lambda x: gamut_map(linear_srgb(x, matrix)), (light,), fast_mode=True)
    assert torch.equal(gamut_map(torch.zeros(3, 2, 2)), torch.zeros(3, 2, 2))
    assert torch.equal(gamut_map(-torch.ones(3, 2, 2)), torch.zeros(3, 2, 2))


def test_refusals():
    image = torch.rand(3, 4, 5)
    with pytest.raises(ValueError, match="equally many and at least one, got 2, 1"):
        incoherent_sum(lambda w: image, [1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="at least one, got 0, 0"):
        incoherent_sum(lambda w: image, [], [])
    with pytest.raises(TypeError, match="intensity must be a real"):
        incoherent_sum(lambda w: torch.polar(image, image), [1.0], [1.0])
    with pytest.raises(ValueError, match="radius is a sine"):
        disc_source(1.0)
    with pytest.raises(ValueError, match="beyond what a pitch of 4e-06 m samples"):
        tilted_wave(Grid(8, 4e-6), 520e-9, (0.0, 0.07))
    with pytest.raises(ValueError, match="channels must match"):
        equal_power(image, torch.rand(2, 4, 5))
    with pytest.raises(ValueError, match="gamma must be above zero"):
        tone_map(image, gamma=0.0)
    with pytest.raises(ValueError, match=r"needs a matrix \[3, K\]"):
        linear_srgb(image, torch.rand(3, 4))
    with pytest.raises(ValueError, match="red, green, blue"):
        gamut_map(torch.rand(4, 4, 5))
    assert path_difference(0.0, 0.1) == 0
