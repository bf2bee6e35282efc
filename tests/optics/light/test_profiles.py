"""Beams, gratings and patterns against closed forms and against propagation."""

import math

import pytest
import torch

from holotorch import Grid
from holotorch.core.complex import intensity, phasor
from holotorch.optics import AngularSpectrum, Fraunhofer
from holotorch.optics.elements.lens import lens_phase
from holotorch.optics.light import profiles

GRID, WAVELENGTH = Grid((128, 96), (4e-6, 5e-6)), 530e-9


@pytest.mark.parametrize("distance", [2e-3, -3e-3])
def test_a_gaussian_beam_propagates_into_itself(distance):
    waist = profiles.gaussian_beam(GRID, WAVELENGTH, 40e-6)
    wanted = profiles.gaussian_beam(GRID, WAVELENGTH, 40e-6, distance)
    got = AngularSpectrum(GRID, WAVELENGTH, distance)(waist[None])[0]
    # The paraxial phase k z s^4 / 8 at the divergence s = wavelength / (pi waist) = 4.2 mrad is 1e-6 rad; the window
    # ends at 6 and 5 waists, where the amplitude is 2e-11.
    assert (got - wanted).norm() < 1e-5 * wanted.norm()


def test_the_width_and_power_of_a_gaussian_beam():
    rayleigh = math.pi * 40e-6**2 / WAVELENGTH
    there = intensity(profiles.gaussian_beam(GRID, WAVELENGTH, 40e-6, rayleigh))
    assert there.max().item() == pytest.approx(0.5)  # half the intensity on the axis
    power = intensity(profiles.gaussian_beam(GRID, WAVELENGTH, 40e-6)).sum()
    assert there.sum().item() == pytest.approx(power.item(), rel=1e-6)


def test_a_blazed_grating_deflects_and_a_binary_one_splits():
    period = 8 * GRID.pitch[1]
    blazed = profiles.blazed_grating(GRID, (math.inf, period))
    far = intensity(Fraunhofer(GRID, WAVELENGTH)(phasor(blazed)[None]))[0]
    assert far.flatten().argmax() == 64 * 96 + 48 + 96 // 8
    far = intensity(Fraunhofer(GRID, WAVELENGTH)(phasor(profiles.binary_grating(GRID, (math.inf, period)))[None]))[0]
    orders = far[64, [48 - 12, 48, 48 + 12]] / far.sum()
    # A continuous profile sends (2 / pi)^2 into each order; 8 samples a period, 1 / (16 sin^2(pi / 8)) of all light.
    share = 1 / (16 * math.sin(math.pi / 8) ** 2)
    torch.testing.assert_close(orders.double(), torch.tensor([share, 0, share], dtype=torch.float64))


def test_a_vortex_winds_and_two_cylinders_are_a_lens():
    phase = profiles.vortex_phase(Grid(9, 1e-6), 3)
    ring = [(4, 8), (8, 4), (4, 0), (0, 4), (4, 8)]
    turns = [phase[a] - phase[b] for a, b in zip(ring[1:], ring[:-1], strict=True)]
    assert sum(float(torch.remainder(t, 2 * math.pi)) for t in turns) == pytest.approx(3 * 2 * math.pi)
    both = sum(profiles.cylindrical_phase(GRID, WAVELENGTH, 0.2, axis) for axis in (0, 1))
    torch.testing.assert_close(both, lens_phase(GRID, WAVELENGTH, 0.2))


def test_patterns():
    board = profiles.checkerboard(Grid((4, 6), 1e-6), 2)
    assert board.tolist() == [[0, 0, 1, 1, 0, 0]] * 2 + [[1, 1, 0, 0, 1, 1]] * 2
    star = profiles.siemens_star(Grid(65, 1e-6), 6)
    assert star.mean().item() == pytest.approx(0.5, abs=0.02)
    edges = (star[32 + 20, :] != star[32 + 20, :].roll(1)).sum()
    assert edges >= 4
    groups = profiles.bars(Grid((64, 96), 1e-6), (1, 2))
    assert groups[3, 2:7].tolist() == [1, 0, 1, 0, 1]
    assert groups[:, 2 + 7 : 2 + 7 + 10].amax() == 1 and groups[:, 30:].amax() == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: profiles.gaussian_beam(GRID, 530, 1e-4), "wavelength"),
        (lambda: profiles.blazed_grating(GRID, (math.inf, 6e-6)), "period must be at least two pixels"),
        (lambda: profiles.cylindrical_phase(GRID, WAVELENGTH, 0.1, 2), "axis must be 0"),
        (lambda: profiles.checkerboard(GRID, 0), "pixels must be at least 1"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError, match="charge must be a whole number"):
        profiles.vortex_phase(GRID, 1.5)  # type: ignore[arg-type]
