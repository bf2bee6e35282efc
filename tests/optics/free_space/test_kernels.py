import math
from decimal import Decimal, localcontext

import pytest
import torch

from holotorch import Grid
from holotorch.core.fourier import filter_spectrum
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel, window_taper

GRID = Grid((5, 6), (5e-6, 4e-6))
FINE = Grid((5, 6), (0.2e-6, 0.24e-6))


def angular(grid, wavelength, distance):
    return angular_spectrum_kernel(grid, wavelength, distance, band_limit=False)


def limited(grid, wavelength, distance):
    return angular_spectrum_kernel(grid, wavelength, distance)


@pytest.mark.parametrize(
    ("kernel", "grid", "distance"),
    [
        (angular, GRID, 20e-6),
        (limited, GRID, 100e-6),
        (angular, GRID, -20e-6),
        (angular, FINE, 0.4e-6),
        (angular, FINE, -0.4e-6),
        (fresnel_kernel, GRID, 20e-6),
        (fresnel_kernel, GRID, -20e-6),
    ],
    ids=["asm", "band-limited", "backwards", "evanescent", "evanescent backwards", "Fresnel", "Fresnel backwards"],
)
def test_gradcheck_through_field_distance_and_wavelength(kernel, grid, distance):
    # Relative changes, so that gradcheck's step of 1e-6 is small against metres of 1e-7.
    def propagated(field, wavelength_factor, distance_factor):
        wavelength, z = 530e-9 * wavelength_factor, distance * distance_factor
        transfer = kernel(grid.padded(2), wavelength, z) * carrier(wavelength, z)[..., None, None]
        return filter_spectrum(field, transfer)

    field = torch.randn(5, 6, dtype=torch.complex128, requires_grad=True)
    factors = torch.tensor([1.0, 0.98], dtype=torch.float64)
    inputs = (field, factors.clone().requires_grad_(), factors.flip(0).clone().requires_grad_())
    assert torch.autograd.gradcheck(propagated, inputs)


def test_wavelength_and_distance_broadcast():
    wavelength = torch.tensor([630e-9, 530e-9, 445e-9])[:, None]
    distance = torch.tensor([1e-3, -2e-3], dtype=torch.float64)
    for kernel in (angular, limited, fresnel_kernel):
        batch = kernel(GRID, wavelength, distance)
        assert batch.shape == (3, 2, 5, 6) and batch.dtype == torch.complex128
        single = kernel(GRID, wavelength[1, 0].double(), distance[1])
        torch.testing.assert_close(batch[1, 1], single, rtol=1e-14, atol=0)
    assert carrier(wavelength, distance).shape == (3, 2)


def test_carrier_is_reduced_before_it_is_rounded():
    # 2 m of 500 nm light are exactly 4e6 turns, an eighth of a wavelength more is 45 degrees.
    distance = 2 + 500e-9 / 8
    wanted = complex(math.cos(math.pi / 4), math.sin(math.pi / 4))
    # The distance itself is only known to 2.2e-16 m * 2 out of 5e-7 m.
    assert carrier(500e-9, distance).item() == pytest.approx(wanted, abs=2 * math.pi * 2 * 2.3e-16 / 500e-9)


def test_small_angles_do_not_cancel():
    # At 2.65e-4 rad, k_z - k is 3.5e-8 of k: a difference of the two in float64 is wrong by 3e-9 of itself.
    grid = Grid((1, 2), (1e-3, 1e-3))
    phase = torch.angle(angular(grid, 530e-9, 2.0)[0, 1])
    with localcontext() as context:
        context.prec = 40
        sine = Decimal(530e-9) / Decimal(2e-3)
        wanted = float(2 * ((1 - sine**2).sqrt() - 1) / Decimal(530e-9)) * 2 * math.pi
    assert phase.item() == pytest.approx(wanted, rel=1e-12)


def test_evanescent_waves_decay_forwards_and_backwards():
    forward, backward = angular(FINE, 700e-9, 5e-6), angular(FINE, 700e-9, -5e-6)
    torch.testing.assert_close(backward, forward.conj(), rtol=1e-12, atol=0)
    assert forward.abs().max() <= 1
    assert forward[2, 3].abs() < 1e-20


def test_band_limit_drops_exactly_the_light_that_leaves_the_padded_window():
    grid, wavelength, distance = Grid((40, 60), (4e-6, 3e-6)), 530e-9, 2e-3
    kernel = angular_spectrum_kernel(grid, wavelength, distance)
    fy, fx = grid.frequencies()
    sine = wavelength * torch.hypot(fx, fy)
    travel = distance * sine / torch.sqrt(1 - sine**2) / torch.hypot(fx, fy).clamp(min=1e-9)
    stays = (travel * fy.abs() <= 80e-6) & (travel * fx.abs() <= 90e-6)
    assert torch.equal(kernel != 0, stays)
    assert 0.01 < stays.double().mean() < 0.9


def test_fresnel_kernel_is_the_small_angle_limit():
    grid, wavelength, distance = Grid(32, 20e-6), 530e-9, 10e-3
    difference = (angular(grid, wavelength, distance) - fresnel_kernel(grid, wavelength, distance)).abs().max()
    k, sine2 = 2 * math.pi / wavelength, 2 * (wavelength / (2 * 20e-6)) ** 2
    assert difference.item() == pytest.approx(k * distance * sine2**2 / 8, rel=1e-3)


def test_kernel_stays_finite_at_grazing_incidence():
    # lambda f = 1 exactly at Nyquist: the root is zero there, its gradient must not be infinite.
    wavelength = torch.tensor(1e-6, dtype=torch.float64, requires_grad=True)
    kernel = angular(Grid((1, 4), (1e-3, 0.5e-6)), wavelength, 1e-6)
    (gradient,) = torch.autograd.grad(kernel.abs().sum() + kernel.real.sum(), wavelength)
    assert torch.isfinite(torch.view_as_real(kernel)).all() and torch.isfinite(gradient)


@pytest.mark.parametrize("paraxial", [True, False])
def test_a_window_keeps_what_can_reach_it_and_nothing_that_wraps(paraxial):
    grid, wave, far, reach = Grid((400, 300), 4e-6), 520e-9, 20e-3, (0.5e-3, 0.4e-3)
    weights = window_taper(grid, wave, far, reach, paraxial=paraxial)
    fy, fx = (wave * each for each in grid.frequencies())
    cosine = 1.0 if paraxial else torch.sqrt(1 - fy.square() - fx.square())
    away = [far * sine.abs() / cosine + 0 * weights for sine in (fy, fx)]
    ends = [extent - start for extent, start in zip(grid.extent, reach, strict=True)]
    kept = (away[0] < 0.99 * reach[0]) & (away[1] < 0.99 * reach[1])
    dropped = (away[0] > 1.01 * ends[0]) | (away[1] > 1.01 * ends[1])
    assert kept.any() and dropped.any() and ((weights >= 0) & (weights <= 1)).all()
    assert (weights[kept] == 1).all() and (weights[dropped] < 1e-30).all()
    assert ((weights > 0) & (weights < 1)).any()
    with pytest.raises(ValueError, match="a window of 0.0009 m to either side needs 0.0018 m, padded are 0.0016"):
        window_taper(grid, wave, far, (0.9e-3, 0.4e-3))


def test_a_window_of_one_line_and_steep_light():
    line = window_taper(Grid((1, 64), 4e-6), 520e-9, 1e-3, (1e-9, 0.1e-3))
    assert line.shape[-1] == 64 and (line == 1).all()  # 65 um at most
    # Half a wavelength of pitch: the angle in the other plane counts.
    steep = window_taper(Grid(64, 0.4e-6), 500e-9, 10e-6, (5e-6, 5e-6))
    fy = torch.tensor(0.55 / 500e-9)
    row, column = (int((each.flatten() - fy).abs().argmin()) for each in Grid(64, 0.4e-6).frequencies())
    assert steep[row, 0] > steep[row, column]
