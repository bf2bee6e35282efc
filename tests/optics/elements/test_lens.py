import math

import pytest
import torch

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.optics import Aperture, Fresnel, Lens
from holotorch.optics.elements.lens import lens_limit, lens_phase, pupil

GRID = Grid((12, 17), (5e-6, 4e-6))
RED, GREEN, BLUE = 636e-9, 520e-9, 455e-9


def field(grid: Grid = GRID, channels: int = 1) -> torch.Tensor:
    return torch.randn(2, channels, *grid.shape, dtype=torch.complex128)


@pytest.mark.parametrize("paraxial", [True, False])
def test_phase_is_the_textbook_s(paraxial):
    found = lens_phase(GRID, torch.tensor([RED, GREEN], dtype=torch.float64), 3e-4, paraxial=paraxial)
    assert found.shape == (2, 12, 17)
    for c, wave in enumerate((RED, GREEN)):
        for i, j in ((6, 8), (0, 0), (11, 3)):
            square = ((i - 6) * 5e-6) ** 2 + ((j - 8) * 4e-6) ** 2
            path = square / 6e-4 if paraxial else math.sqrt(square + 9e-8) - 3e-4
            assert found[c, i, j].item() == pytest.approx(-2 * math.pi / wave * path, abs=1e-7)


def test_phase_is_differentiable_and_ends_at_no_lens():
    for paraxial in (True, False):
        length = torch.tensor([3e-4, -2e-3], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda f, p=paraxial: lens_phase(GRID, RED, f * 1e-3, paraxial=p), length * 1e3)
        assert not lens_phase(GRID, RED, math.inf, paraxial=paraxial).any()
        back = lens_phase(GRID, RED, -3e-4, paraxial=paraxial)
        torch.testing.assert_close(back, -lens_phase(GRID, RED, 3e-4, paraxial=paraxial))


def test_a_lens_focuses_to_the_airy_ring():
    """First dark ring of the Airy pattern at 1.22 lambda f / (2 r)."""
    grid, length, radius = Grid(256, 4e-6), 10e-3, 0.4e-3
    light = torch.ones(1, 256, 256, dtype=torch.complex128)
    spot = Fresnel(grid, RED, length, pad=2.1)(Lens(grid, RED, length, radius=radius)(light))[0, 128].abs().square()
    ring = 1.2197 * RED * length / (2 * radius) / 4e-6  # 2.42 samples
    x = torch.arange(256) - 128
    # J1(v)/v squared at the samples next to the ring, relative to the centre.
    v = math.pi * 2 * radius * x[129:132] * 4e-6 / (RED * length)
    wanted = (2 * torch.special.bessel_j1(v) / v) ** 2
    # A rim cut along samples: its area is off by about a sample's share of its perimeter, 1 %.
    torch.testing.assert_close((spot / spot[128])[129:132].double(), wanted.double(), rtol=0, atol=0.01)
    assert 2 < ring < 3


def test_limit_of_the_sampling():
    # The numbers for f = 20 mm at 3.74 um.
    for wave, limit in ((RED, 1.70e-3), (GREEN, 1.39e-3), (BLUE, 1.22e-3)):
        assert lens_limit(3.74e-6, wave, 20e-3) == pytest.approx(limit, abs=5e-6)
        grid = Grid((1, 2048), 3.74e-6)
        assert Lens(grid, wave, 20e-3, radius=limit * 0.99).radius == limit * 0.99  # no warning, an error in this suite
        with pytest.warns(SamplingWarning, match=f"only up to {limit * 1e3:.3g} mm from the axis, but it reaches 3.83"):
            Lens(grid, wave, 20e-3)
    with pytest.warns(SamplingWarning, match="a pitch of 1.66e-06 m or less would do"):
        Lens(Grid((1, 2048), 3.74e-6), RED, 20e-3)
    Lens(Grid((1, 4614), 1.66e-6), RED, 20e-3)
    # The spherical phase is less steep, and has no limit from a pitch of half a wavelength on.
    assert lens_limit(3.74e-6, RED, 20e-3, paraxial=False) > lens_limit(3.74e-6, RED, 20e-3)
    assert lens_limit(0.3e-6, RED, 20e-3, paraxial=False) == math.inf
    # It is where neighbouring samples differ by pi.
    steps = lens_phase(Grid((1, 2048), 3.74e-6), RED, 20e-3)[0].diff().abs()
    first = next(i for i in range(1024) if steps[1024 + i] > math.pi) * 3.74e-6
    assert first == pytest.approx(1.70e-3, abs=3.74e-6)


def test_an_aperture_passes_the_samples_within_its_radius():
    kept = Aperture(GRID, (RED, BLUE), 2.1e-5)(torch.ones(2, 12, 17, dtype=torch.complex128)).real[0]
    y, x = GRID.coordinates()
    assert torch.equal(kept > 0, y**2 + x**2 <= 2.1e-5**2)


def test_soft_pupil_has_the_gradient_of_its_area():
    grid, radius = Grid(64, 5e-6), torch.tensor(100e-6, dtype=torch.float64, requires_grad=True)
    area = pupil(grid, radius, softness=5e-6).square().sum() * 25e-12
    # Of the square of 1 / (1 + e^t) the integral lies softness further in: area about pi (r - softness)^2, derivative
    # 2 pi (r - softness); the curvature of the edge and the samples leave a percent.
    (gradient,) = torch.autograd.grad(area, radius)
    assert gradient.item() == pytest.approx(2 * math.pi * 95e-6, rel=0.01)
    with pytest.raises(ValueError, match="a hard edge has no gradient"):
        pupil(grid, radius)


def test_impossible_elements():
    with pytest.raises(ValueError, match="focal_length must be other than zero"):
        Lens(GRID, RED, 0.0)
    with pytest.raises(ValueError, match="radius must be above zero"):
        Lens(GRID, RED, 1e-3, radius=0.0)
    with pytest.raises(ValueError, match="one number or one per wavelength"):
        Lens(GRID, (RED, BLUE), [1e-3])
    with pytest.raises(ValueError, match=r"values in 0 \.\. 1"):
        Aperture(GRID, RED, torch.full((12, 17), 2.0))
    with pytest.raises(ValueError, match="must be above zero"):
        Aperture(GRID, RED, 0.0)
