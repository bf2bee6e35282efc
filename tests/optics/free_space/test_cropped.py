"""The cropped kernel at every distance, against quadrature over the band; no FFT in the oracle."""

import numpy as np
import pytest
import torch
from oracles import dense

from holotorch import Grid
from holotorch.optics import CroppedKernel
from holotorch.optics.free_space.impulse_response import fresnel_taps, remainder_kernel
from holotorch.optics.free_space.kernels import carrier

SHAPE = (20, 24)


def white(grid: Grid) -> torch.Tensor:
    return torch.exp(2j * torch.pi * torch.rand(1, *grid.shape, dtype=torch.float64))


def relative_error(operator, matrix: np.ndarray, field: torch.Tensor) -> float:
    wanted = (matrix @ field[0].numpy().ravel()).reshape(operator.grid.shape)
    return float(np.linalg.norm(operator(field)[0].numpy() - wanted) / np.linalg.norm(wanted))


def estimate(grid: Grid, wavelength: float, distance: float, paraxial: bool) -> float:
    """Twice the expected relative error for white phases, for the scatter of a single small field.

    Near the cross-over distance the factor beyond Fresnel moves the steepest light, of sine s, by d = N s^2 / 2
    samples; its kernel falls off as d / (pi n^2), and what lies beyond the margin of m = N / 8 samples is lost:
    d / (pi sqrt(3) m^1.5) = 2.1 s^2 / sqrt(N). The oracle rounds its phase 2 pi z / lambda, a few times 1e-16 of it.
    """
    rounding = 1e-11 + 4e-16 * 2 * np.pi * abs(distance) / wavelength
    sine = wavelength / (2 * min(grid.pitch))
    return rounding + (0 if paraxial else 2 * 2.1 * sine**2 / min(grid.shape) ** 0.5)


@pytest.mark.parametrize("paraxial", [True, False], ids=["paraxial", "exact"])
@pytest.mark.parametrize("crossovers", [0.02, 0.3, 0.8, 1.0, 1.2, 3.0, -1.0, 30.0])
@pytest.mark.parametrize("pitch", [(8e-6, 7.5e-6), (3.74e-6, 4e-6)], ids=["8 um", "3.74 um"])
def test_white_phase_at_every_distance(pitch, crossovers, paraxial):
    grid, wavelength = Grid(SHAPE, pitch), 530e-9
    distance = crossovers * 2 * grid.extent[1] * pitch[1] / wavelength
    nodes = 250 if abs(crossovers) < 5 else 1600
    matrix = dense.band_limited_propagation(SHAPE, pitch, wavelength, distance, paraxial, nodes)
    error = relative_error(CroppedKernel(grid, wavelength, distance, paraxial=paraxial), matrix, white(grid))
    assert error <= estimate(grid, wavelength, distance, paraxial)


@pytest.mark.parametrize("pitch", [1.5e-6, 1.0e-6, 0.6e-6])
@pytest.mark.parametrize("crossovers", [0.3, 1.0, 3.0])
def test_fine_pitches_down_to_the_border(pitch, crossovers):
    grid, wavelength = Grid(SHAPE, pitch), 630e-9
    distance = crossovers * 2 * grid.extent[1] * pitch / wavelength
    matrix = dense.band_limited_propagation(SHAPE, grid.pitch, wavelength, distance, False, 400)
    error = relative_error(CroppedKernel(grid, wavelength, distance), matrix, white(grid))
    assert error <= estimate(grid, wavelength, distance, False)


@pytest.mark.parametrize("paraxial", [True, False], ids=["paraxial", "exact"])
@pytest.mark.parametrize("offset", [(4e-6, 3.75e-6), (-60e-6, 130e-6), (0.0, 400e-6)], ids=["half", "aside", "outside"])
@pytest.mark.parametrize("crossovers", [0.0, 0.3, 1.0, -3.0])
def test_windows_beside_the_axis(crossovers, offset, paraxial):
    """(0, 400 um) lies wholly outside the light's own window of 180 um; there it is compared with the light inside."""
    grid, wavelength = Grid(SHAPE, (8e-6, 7.5e-6)), 530e-9
    distance = crossovers * 2 * grid.extent[1] * 7.5e-6 / wavelength
    matrix = dense.band_limited_propagation(SHAPE, grid.pitch, wavelength, distance, paraxial, 400, offset)
    operator, field = CroppedKernel(grid, wavelength, distance, paraxial=paraxial, offset=offset), white(grid)
    wanted = (matrix @ field[0].numpy().ravel()).reshape(SHAPE)
    error = np.linalg.norm(operator(field)[0].numpy() - wanted) / np.linalg.norm(field)
    assert error <= estimate(grid, wavelength, distance, paraxial)


def test_beyond_the_border_it_is_refused_with_the_way_out():
    with pytest.raises(ValueError, match=r"pitch of at least 0\.9 wavelengths, got 5e-07 m at 6\.3e-07 m; use Angular"):
        CroppedKernel(Grid(16, 0.5e-6), 630e-9, 1e-3)
    CroppedKernel(Grid(16, 0.5e-6), 630e-9, 1e-3, paraxial=True)


@pytest.mark.parametrize("distance", [float("nan"), float("inf")])
def test_refuses_an_impossible_distance(distance):
    with pytest.raises(ValueError, match="distance must be finite"):
        CroppedKernel(Grid(16, 8e-6), 530e-9, distance)


@pytest.mark.parametrize("distance", [1e-6, 1e-3, 1e3, -1e3])
def test_stays_finite_from_micrometres_to_kilometres(distance):
    grid = Grid((1, 33), 8e-6)
    out = CroppedKernel(grid, 530e-9, distance)(white(grid))
    assert torch.isfinite(torch.view_as_real(out)).all()
    # No more light than there was, up to the rim where the window cuts it.
    assert out.norm() <= 1.01 * grid.shape[1] ** 0.5


def test_gradcheck_of_the_kernel_through_wavelength_and_distance():
    index, fy, fx = torch.arange(-6, 7), torch.linspace(-1e5, 1e5, 4).double()[:, None], torch.zeros(1, 1).double()

    def kernel(wavelength_factor, distance_factor):
        wavelength, distance = 530e-9 * wavelength_factor, 1e-3 * distance_factor
        taps = fresnel_taps(index, 8e-6, wavelength, distance)
        return taps, remainder_kernel(fy, fx, wavelength, distance) * carrier(wavelength, distance)

    factors = [torch.ones((), dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(kernel, factors)
