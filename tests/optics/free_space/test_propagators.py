"""Arguments and the border of validity of the propagator modules; their results are in the contracts and oracles."""

import warnings

import pytest
import torch

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.optics import AngularSpectrum, Fraunhofer, Fresnel, least_padding

GRID = Grid((64, 48), (8e-6, 10e-6))


@pytest.mark.parametrize("kind", [AngularSpectrum, Fresnel])
def test_warns_exactly_beyond_the_padding_that_serves_the_full_band(kind):
    distance = 8e-3
    needed = max(least_padding(GRID, 630e-9, distance, paraxial=kind is Fresnel))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kind(GRID, (630e-9, 530e-9), distance, pad=needed)
    with pytest.warns(SamplingWarning, match=r"pad=\(.*\) keeps all of it") as caught:
        kind(GRID, (630e-9, 530e-9), distance, pad=1.25)
    assert caught[0].filename == __file__


def test_light_that_wraps_is_an_error_of_order_one_and_the_advised_padding_removes_it():
    # White phase at z lambda / (2 pitch) = 1.26 extents: what the warning is about.
    grid, wavelength, distance = Grid(64, 8e-6), 515e-9, 20e-3
    source = torch.exp(2j * torch.pi * torch.rand(1, 64, 64, dtype=torch.float64))
    advised = least_padding(grid, wavelength, distance)
    with pytest.warns(SamplingWarning):
        short = AngularSpectrum(grid, wavelength, distance, pad=1.25)(source)
    exact = AngularSpectrum(grid, wavelength, distance, pad=16)(source)
    good = AngularSpectrum(grid, wavelength, distance, pad=advised)(source)
    scale = exact.abs().square().mean().sqrt()
    assert (short - exact).abs().square().mean().sqrt() / scale > 0.3
    # A full-band pixel has sinc tails 1 / (pi n). Their share beyond the margin of m = 3 sqrt(lambda z) / pitch samples
    # is 2 / (pi^2 m) per axis, and the root of the sum over both axes is the error that is left.
    margin = 3 * (wavelength * distance) ** 0.5 / grid.pitch[0]
    assert (good - exact).abs().square().mean().sqrt() / scale < (2 * 2 / (torch.pi**2 * margin)) ** 0.5


def test_no_padding_is_offered_below_half_a_wavelength():
    with pytest.warns(SamplingWarning, match="no padding keeps all of it, since the pitch is at most half"):
        AngularSpectrum(Grid(16, 0.2e-6), 500e-9, 1e-6)


@pytest.mark.parametrize("kind", [AngularSpectrum, Fresnel])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 1e-3), "wavelength must be above zero in metres, got 0.0"),
        ((-530e-9, 1e-3), "wavelength must be above zero"),
        (([530e-9, float("nan")], 1e-3), "wavelength must be finite"),
        (([], 1e-3), "at least one"),
        ((530e-9, float("nan")), "distance must be finite in metres, got nan"),
        ((530e-9, float("inf")), "distance must be finite"),
    ],
)
def test_refuses_impossible_light(kind, arguments, message):
    with pytest.raises(ValueError, match=message):
        kind(GRID, *arguments)


def test_refuses_a_padding_below_one_and_a_wavelength_that_is_no_number():
    with pytest.raises(ValueError, match="pad must be a finite factor of at least 1"):
        AngularSpectrum(GRID, 530e-9, 1e-3, pad=0.5)
    with pytest.raises(TypeError, match="wavelength must be a number in metres, got str '530 nm'"):
        Fraunhofer(GRID, ["530 nm"])  # type: ignore[list-item]


def test_a_distance_with_a_gradient_that_is_no_parameter_is_refused():
    with pytest.raises(ValueError, match="distance requires a gradient, but a module keeps no graph: give an nn.Param"):
        AngularSpectrum(GRID, 530e-9, torch.tensor(1e-3, requires_grad=True))


def test_far_field_of_a_tilted_wave_is_one_bright_sample():
    y, x = GRID.coordinates()
    wave = torch.exp(2j * torch.pi * (5 * y / GRID.extent[0] - 7 * x / GRID.extent[1]))[None]
    far = Fraunhofer(GRID, 530e-9)(wave).abs().square()[0]
    assert far[32 + 5, 24 - 7].item() == pytest.approx(64 * 48)
    assert far.sum().item() == pytest.approx(64 * 48)


def test_modules_print_what_they_are():
    assert "pitch=(8e-06, 1e-05)" in repr(AngularSpectrum(GRID, 530e-9, 1e-3))


def test_fresnel_says_where_its_model_ends():
    """Padding suffices at both distances; only the phase beyond Fresnel differs."""
    grid = Grid(160, 1.5e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Fresnel(grid, 530e-9, 3e-4)
    with pytest.warns(SamplingWarning, match=r"lacks a phase of 3.5 rad; AngularSpectrum and CroppedKernel"):
        Fresnel(grid, 530e-9, -6e-4)
