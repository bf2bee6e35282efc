"""Pictures under a spectrum: wavelengths made from a neighbour against every one followed through the optics."""

import math

import pytest
import torch

from holotorch import Grid
from holotorch.optics import Display, Eye, Spectrum, propagate_collapsed, propagate_elements, spectral_image
from holotorch.optics.light.quadrature import gauss_rule
from holotorch.optics.light.spectral import neighbours
from holotorch.optics.light.wavelength_sampling import (
    least_count,
    neighbour_error,
    pupil_illumination,
    select_wavelengths,
)

PITCH, GREEN, FAR = 3.74e-6, 520e-9, 30e-3
GRID = Grid((128, 120), PITCH)
DISPLAY = Display(FAR + 140e-3 / 9, 20e-3, 50e-3)
HARD, SOFT = Eye(1.5e-3, 24e-3, 120e-3), Eye(1.5e-3, 24e-3, 120e-3, softness=50e-6)
SMALL, NEAR = Grid((24, 20), 8e-6), Display.planar(20e-3)
PRESETS = (Spectrum.laser, Spectrum.narrow_sled, Spectrum.sled, Spectrum.led)


def random_phase(grid: Grid = GRID, dtype=torch.complex128) -> torch.Tensor:
    """A hologram that fills its window and its band: speckle all over, to the edges of the picture."""
    turns = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns).to(dtype)


def relative(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).norm() / wanted.norm()).item()


@pytest.mark.parametrize("eye", [HARD, Eye(0.5e-3, 24e-3, 120e-3, softness=20e-6)], ids=["pupil", "narrow pupil"])
@pytest.mark.parametrize("preset", PRESETS, ids=lambda preset: preset.__name__)
def test_a_quarter_of_the_wavelengths_gives_the_sum_over_every_nanometre(preset, eye):
    """The issue asks for 1 %, of the thesis's sum; the narrow pupil cuts light that the hologram sends to its rim."""
    places, weights = preset(GREEN).every(1e-9)
    field = random_phase(dtype=torch.complex64)
    wanted = spectral_image(field, GRID, places, weights, DISPLAY, eye, count=len(places))
    got = spectral_image(field, GRID, places, weights, DISPLAY, eye, count=len(places) // 4)
    assert relative(got, wanted) < 0.01
    # The middle wavelength alone is no picture of a wide source at all.
    alone = spectral_image(field, GRID, [GREEN], [1.0], DISPLAY, eye, count=1)
    assert relative(alone, wanted) > 5 * relative(got, wanted) or preset in PRESETS[:2]


@pytest.mark.parametrize("preset", PRESETS[1:], ids=lambda preset: preset.__name__)
def test_the_error_is_foreseen(preset):
    """From above: light is taken to be at a hard rim evenly, and all errors to be seen in a picture without speckle."""
    grid, eye = Grid(256, PITCH), Eye(0.5e-3, 24e-3, 120e-3, softness=20e-6)
    spectrum = preset(GREEN)
    places, weights = spectrum.every(spectrum.fwhm / 5)
    light, field = pupil_illumination(grid, GREEN, DISPLAY, eye), random_phase(grid, torch.complex64)
    assert 0.3 < light.edge < 0.5
    wanted = spectral_image(field, grid, places, weights, DISPLAY, eye, count=len(places))
    expected = [neighbour_error(places, weights, count, light) for count in (1, 3, len(places))]
    for count, limit in zip((1, 3), expected, strict=False):
        assert relative(spectral_image(field, grid, places, weights, DISPLAY, eye, count=count), wanted) < limit
    assert 0.1 > expected[0] > 2 * expected[1] and expected[2] == 0.0


def test_the_tolerance_decides_how_many_are_followed():
    grid, eye = Grid(256, PITCH), Eye(0.5e-3, 24e-3, 120e-3)
    places, weights = Spectrum.sled(GREEN).every(1e-9)
    counts = [least_count(places, weights, t, grid, DISPLAY, eye) for t in (0.1, 0.03, 0.01, 1e-5)]
    assert counts == sorted(counts) and counts[0] == 1 and counts[-1] == len(places)
    light = pupil_illumination(grid, places.mean().item(), DISPLAY, eye)
    assert neighbour_error(places, weights, counts[2], light) <= 0.01
    assert neighbour_error(places, weights, counts[2] - 1, light) > 0.01
    field = random_phase(grid, torch.complex64)
    few = spectral_image(field, grid, places, weights, DISPLAY, eye, tolerance=0.03)
    assert torch.equal(few, spectral_image(field, grid, places, weights, DISPLAY, eye, count=counts[1]))


def test_rays_find_the_rim_and_the_paths():
    """A hologram far larger than the pupil's view of it lights the whole rim; one far smaller, none of it."""
    wide, narrow = Grid(4096, PITCH), Grid(64, PITCH)
    planar, eye = Display.planar(0.33), Eye(1e-3, 24e-3, 0.3)
    seen = pupil_illumination(wide, GREEN, planar, eye, reach=1e-4)
    assert seen.edge == 1.0
    # From the axis the pupil's rim is 1 / 300 away: paths differ by FAR / 2 times its square, off the axis by more.
    assert seen.path_difference == pytest.approx(FAR / 2 * (1.1e-3 / 0.3) ** 2, rel=0.1)
    assert pupil_illumination(narrow, GREEN, DISPLAY, Eye(3e-3, 24e-3, 120e-3)).edge == 0.0
    one = pupil_illumination(Grid((1, 64), PITCH), GREEN, planar, eye)
    assert 0 <= one.edge <= 1 and one.path_difference > 0


@pytest.mark.parametrize("paraxial", [True, False])
@pytest.mark.parametrize("elements", [True, False])
def test_a_neighbour_equals_the_wavelength_itself(elements, paraxial):
    """Away from the edges, through a soft pupil: 4 nm beside the green, where no speckle is left as it was."""
    grid, eye = Grid((72, 64), 12e-6), Eye(1e-3, 24e-3, 60e-3, softness=60e-6)
    display, other = Display.planar(80e-3), GREEN + 4e-9
    field, way = random_phase(grid, torch.complex64)[None], propagate_elements if elements else propagate_collapsed
    image, wanted = (way(field, grid, wave, display, eye, paraxial=paraxial)[0] for wave in (GREEN, other))
    (got,) = neighbours(image, grid, GREEN, [other], display, eye, elements=elements)
    got, before, wanted = (each[12:-12, 12:-12].abs().square() for each in (got, image, wanted))
    # The rim moves by 4 / 520 of its 1 mm, an eighth of its softness: sqrt(2 / 8 * 4 / 520 / 2) of the amplitude.
    assert relative(got, wanted) < 0.035
    assert relative(before, wanted) > 2.5 * relative(got, wanted)


@pytest.mark.parametrize("elements", [True, False])
def test_the_errors_of_the_eye_are_those_of_each_wavelength(elements):
    """Half a wave of defocus and coma, and the colour error that the eye has besides."""
    grid, display = Grid((72, 64), 10e-6), Display.planar(80e-3)
    eye = Eye(1e-3, 24e-3, 60e-3, {4: 0.2e-6, 8: 0.1e-6}, chromatic_reference=GREEN, softness=60e-6)
    field, way, other = (
        random_phase(grid, torch.complex64)[None],
        propagate_elements if elements else propagate_collapsed,
        GREEN + 4e-9,
    )
    image, wanted = (way(field, grid, wave, display, eye, paraxial=True)[0] for wave in (GREEN, other))
    (got,) = neighbours(image, grid, GREEN, [other], display, eye, elements=elements)
    perfect = Eye(1e-3, 24e-3, 60e-3, softness=60e-6)
    (left,) = neighbours(image, grid, GREEN, [other], display, perfect, elements=elements)
    got, left, wanted = (each[12:-12, 12:-12].abs().square() for each in (got, left, wanted))
    # The moving rim as above, whose light these errors bring together.
    assert relative(got, wanted) < 0.05 and relative(left, wanted) > 2.5 * relative(got, wanted)


def test_an_eye_whose_errors_cannot_be_told_from_samples():
    """Its pupil takes more than the band of the picture: every wavelength is followed, and neighbours refuse."""
    eye = Eye(4e-3, 24e-3, 120e-3, chromatic_reference=GREEN)
    places, weights = Spectrum.led(GREEN).every(1e-9)
    assert least_count(places, weights, 0.5, GRID, DISPLAY, eye) == len(places)
    with pytest.raises(ValueError, match="propagate every wavelength, or use a smaller pupil or a finer grid"):
        next(neighbours(random_phase(), GRID, GREEN, [GREEN], DISPLAY, eye))


def test_light_from_beyond_the_edges_is_there():
    """Neighbours farther away move light sideways; the picture's outermost samples are as good as all."""
    places, weights = Spectrum.led(GREEN).every(4e-9)
    wanted, got = (
        spectral_image(random_phase(), GRID, places, weights, DISPLAY, SOFT, count=count) for count in (len(places), 1)
    )
    assert relative(got[:3], wanted[:3]) < 0.03 and relative(got[:, -3:], wanted[:, -3:]) < 0.03


def test_the_hologram_in_focus_shows_no_difference_of_paths():
    """At distance 0 all wavelengths make the same picture but for the pupil; behind the hologram it works as before."""
    display = Display.planar(80e-3)
    at, behind = (Eye(1e-3, 24e-3, far, softness=60e-6) for far in (80e-3, 100e-3))
    grid, other = Grid((96, 80), 8e-6), GREEN + 4e-9
    for eye in (at, behind):
        image, wanted = (
            propagate_collapsed(random_phase(grid)[None], grid, wave, display, eye)[0] for wave in (GREEN, other)
        )
        (got,) = neighbours(image, grid, GREEN, [other], display, eye)
        inside = slice(12, -12), slice(12, -12)
        assert relative(got[inside].abs().square(), wanted[inside].abs().square()) < 0.035


def test_several_spectra_at_once():
    eye = Eye(0.8e-3, 24e-3, 15e-3, softness=60e-6)
    places, first = Spectrum.sled(GREEN).every(4e-9)
    both = torch.stack([first, first.flip(0).square()])
    fields = torch.stack([random_phase(SMALL), random_phase(SMALL).conj()])
    got = spectral_image(fields, SMALL, places, both, NEAR, eye, count=len(places))
    assert got.shape == (2, 2, *SMALL.shape)
    for k, weights in enumerate(both):
        one = spectral_image(fields, SMALL, places, weights, NEAR, eye, count=len(places))
        assert torch.allclose(got[k], one, rtol=1e-12, atol=1e-15)


def test_followed_have_equal_shares_of_the_power():
    places = torch.linspace(500e-9, 540e-9, 41, dtype=torch.float64)
    even = torch.ones(41, dtype=torch.float64)
    nodes, owners = select_wavelengths(places, even, 4)
    assert nodes == [5, 15, 25, 35] and all(9 <= owners.count(k) <= 11 for k in range(4))  # ties
    assert select_wavelengths(places, even, 41) == (list(range(41)), list(range(41)))
    peaked = even * 1e-9
    peaked[20] = 1.0
    assert select_wavelengths(places, peaked, 3)[0] == [20]  # all three fall on it
    away, shares = gauss_rule(places - 520e-9, even / 41, 5)
    assert select_wavelengths(520e-9 + away, shares, 1)[0] == [2]


def test_gradients_reach_hologram_weights_and_accommodation():
    places = [516e-9, 519e-9, 520e-9, 523e-9]
    eye = Eye(0.8e-3, 24e-3, 15e-3, softness=60e-6)
    target = torch.rand(SMALL.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(field, weights, far):
        looking = Eye(0.8e-3, 24e-3, far, softness=60e-6)
        light = spectral_image(field, SMALL, places, weights, NEAR, looking, count=2, recompute=True)
        return (light * target).sum()

    given = (random_phase(SMALL), torch.tensor([0.1, 0.35, 0.35, 0.2], dtype=torch.float64),
             torch.tensor(eye.accommodation, dtype=torch.float64))  # fmt: skip
    given = tuple(each.requires_grad_() for each in given)
    grads = torch.autograd.grad(loss(*given), given)
    generator = torch.Generator().manual_seed(2)
    for k, step in enumerate((1e-6, 1e-6, 1e-8)):
        way = torch.randn(given[k].shape, generator=generator, dtype=given[k].dtype)
        ends = [
            loss(*[x.detach() + sign * step * way if i == k else x.detach() for i, x in enumerate(given)])
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2 * step)
        along = (grads[k].conj() * way).real.sum() if way.is_complex() else (grads[k] * way).sum()
        assert along.item() == pytest.approx(slope.item(), rel=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": None}, "either count or tolerance, got None and None"),
        ({"tolerance": 0.1}, "either count or tolerance, got 1 and 0.1"),
        ({"count": 0}, "count"),
        ({"count": 4}, "count must be at most 3, the number of wavelengths given, got 4"),
        ({"count": None, "tolerance": 0.0}, "tolerance"),
        (
            {"wavelengths": [GREEN, GREEN, 530e-9]},
            "wavelengths must increase, with one weight each, got 3 wavelengths, weights \\(3,\\)",
        ),
        ({"weights": [1.0]}, "got 3 wavelengths, weights \\(1,\\)"),
        ({"wavelengths": [-GREEN, GREEN, 530e-9]}, "wavelength"),
        ({"wavelengths": [math.nan, GREEN, 530e-9]}, "wavelength"),
        ({"weights": [1.0, math.nan, 1.0]}, "weights"),
        ({"weights": [1.0, -1.0, 1.0]}, "weights"),
        ({"field": torch.ones(3, 3)}, "field"),
        ({"field": torch.ones(3, 3, dtype=torch.complex64)}, "field"),
    ],
)
def test_bad_input_is_refused(change, message):
    eye = Eye(0.8e-3, 24e-3, 15e-3)
    given = {
        "field": random_phase(SMALL),
        "wavelengths": [510e-9, GREEN, 530e-9],
        "weights": [1.0] * 3,
        "count": 1,
    } | change
    words = [given.pop(name) for name in ("field", "wavelengths", "weights")]
    with pytest.raises((ValueError, TypeError), match=message):
        spectral_image(words[0], SMALL, words[1], words[2], NEAR, eye, **given)
