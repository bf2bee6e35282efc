"""Propagators against textbook solutions, all computed without an FFT."""

import numpy as np
import pytest
import torch
from oracles import diffraction

from holotorch import Grid
from holotorch.optics import AngularSpectrum, Fresnel

# What the issue asks of AngularSpectrum where it is valid: relative to the field's maximum.
LIMITS = {torch.complex64: 1e-6, torch.complex128: 1e-9}
precisions = pytest.mark.parametrize("dtype", LIMITS)


def propagate(operator, source: np.ndarray, dtype: torch.dtype) -> np.ndarray:
    return operator(torch.as_tensor(source, dtype=dtype)[None])[0].numpy()


def error(got: np.ndarray, wanted: np.ndarray) -> float:
    return np.abs(got - wanted).max() / np.abs(wanted).max()


@precisions
@pytest.mark.parametrize("distance", [0.3e-3, -0.3e-3])
def test_tilted_beam_against_the_rayleigh_sommerfeld_sum(dtype, distance):
    grid, wavelength, waist = Grid((64, 69), (1.5e-6, 1.65e-6)), 633e-9, 8e-6
    y, x = (axis.numpy() for axis in grid.coordinates())
    envelope = np.exp(-((y - 4e-6) ** 2 + (x + 3e-6) ** 2) / waist**2)
    source = envelope * np.exp(2j * np.pi * (3e4 * x - 2e4 * y))
    rows, columns = range(0, 64, 7), range(0, 69, 8)
    points = [(y[i, 0], x[0, j]) for i in rows for j in columns]
    if distance > 0:
        wanted = diffraction.rayleigh_sommerfeld_sum(source, grid.pitch, wavelength, distance, points)
    else:  # time reversal
        wanted = diffraction.rayleigh_sommerfeld_sum(source.conj(), grid.pitch, wavelength, -distance, points).conj()
    got = propagate(AngularSpectrum(grid, wavelength, distance, pad=2.25), source, dtype)
    assert error(np.array([got[i, j] for i in rows for j in columns]), wanted) <= LIMITS[dtype]


@precisions
def test_gaussian_beam(dtype):
    grid, wavelength, waist, distance = Grid((96, 81), (4e-6, 5e-6)), 530e-9, 20e-6, 2e-3
    y, x = (axis.numpy() for axis in grid.coordinates())
    radius = np.hypot(y, x)
    source = np.exp(-((radius / waist) ** 2))
    wanted = diffraction.gaussian_beam(waist, wavelength, distance, radius.ravel()).reshape(grid.shape)
    assert error(propagate(AngularSpectrum(grid, wavelength, distance), source, dtype), wanted) <= LIMITS[dtype]
    paraxial = diffraction.paraxial_gaussian_beam(waist, wavelength, distance, radius)
    assert error(propagate(Fresnel(grid, wavelength, distance), source, dtype), paraxial) <= LIMITS[dtype]
    # The two theories differ by more than either limit, so neither operator passes for the other.
    assert error(paraxial, wanted) > 1e-5


@precisions
@pytest.mark.parametrize("distance", [40e-3, -40e-3])
def test_on_axis_behind_a_circular_hole(dtype, distance):
    grid, radius, wavelength = Grid(384, 6e-6), 0.2e-3, 500e-9
    # Light of the edge that reaches the axis has f = R / (lambda z) = 1e4 per metre; the roll-off starts at 3.3e4.
    source = diffraction.sampled_from_spectrum(
        lambda fy, fx: diffraction.hole_spectrum(radius, fy, fx), grid.shape, grid.pitch, 33e3, 83e3
    )
    wanted = diffraction.behind_hole_on_axis(radius, wavelength, abs(distance))
    wanted = wanted if distance > 0 else wanted.conj()
    got = propagate(AngularSpectrum(grid, wavelength, distance), source, dtype)[192, 192]
    # complex64 rounds against the maximum of the field, about 2, in every pixel.
    assert abs(got - wanted) <= LIMITS[dtype] * 2


@precisions
def test_fresnel_rectangle(dtype):
    grid, wavelength, distance, half_sides = Grid((420, 407), (6e-6, 5.5e-6)), 500e-9, 80e-3, (0.15e-3, 0.2e-3)
    source = diffraction.sampled_from_spectrum(
        lambda fy, fx: diffraction.rectangle_spectrum(half_sides, fy, fx), grid.shape, grid.pitch, 30e3, 83e3
    )
    y, x = (axis.numpy().ravel() for axis in grid.coordinates())
    wanted = diffraction.fresnel_rectangle(half_sides, wavelength, distance, y, x)
    got = propagate(Fresnel(grid, wavelength, distance, pad=3), source, dtype)
    # Inside 0.2 mm the edges' light stays below 1e4 per metre, where the source's spectrum is untouched.
    near = np.ix_(np.abs(y) < 0.2e-3, np.abs(x) < 0.2e-3)
    assert error(got[near], wanted[near]) <= LIMITS[dtype]


def test_forth_and_back_returns_a_beam_that_stayed_inside():
    grid, wavelength = Grid((96, 81), (4e-6, 5e-6)), 530e-9
    y, x = grid.coordinates()
    source = torch.exp(-(y**2 + x**2) / 20e-6**2).to(torch.complex128)[None]
    there = AngularSpectrum(grid, wavelength, 2e-3)(source)
    torch.testing.assert_close(AngularSpectrum(grid, wavelength, -2e-3)(there), source, rtol=0, atol=1e-11)


def test_two_short_steps_equal_a_long_one():
    grid, wavelength = Grid((96, 81), (4e-6, 5e-6)), 530e-9
    y, x = grid.coordinates()
    source = torch.exp(-(y**2 + x**2) / 20e-6**2).to(torch.complex128)[None]
    half, whole = AngularSpectrum(grid, wavelength, 1e-3), AngularSpectrum(grid, wavelength, 2e-3)
    torch.testing.assert_close(half(half(source)), whole(source), rtol=0, atol=1e-11)
