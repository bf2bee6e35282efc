"""Chirp-z reading of a spectrum, against plain Fourier sums."""

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.optics import Propagator, ResampledKernel
from holotorch.optics.free_space.zoomed import chirp, zoom, zoom_adjoint

GRID, OUT, OFFSET = Grid((12, 17), (5e-6, 4e-6)), Grid((9, 14), (3e-6, 7e-6)), (11e-6, -30e-6)
WAVES = (630e-9, 530e-9)


@pytest.mark.parametrize("size", [1, 2, 7, 12, 17])
@pytest.mark.parametrize(("step", "start", "count"), [(1.0, 0.0, 12), (0.37, -4.2, 5), (-2.5, 30.0, 21), (0.0, 1.5, 1)])
def test_equals_the_fourier_sum(size, step, start, count):
    spectrum = torch.randn(3, size, dtype=torch.complex128)
    index = np.fft.fftfreq(size, 1 / size)
    index[size // 2] = abs(index[size // 2]) * (-1 if size % 2 == 0 else 1) if size > 1 else 0
    matrix = np.exp(2j * np.pi * np.outer(start + step * np.arange(count), index) / size) / size
    factors = chirp(size, step, start, count)
    wanted = torch.from_numpy(spectrum.numpy() @ matrix.T)
    # Two transforms of at most 40 samples, and phases of some turns.
    torch.testing.assert_close(zoom(spectrum, factors), wanted, rtol=0, atol=1e-13)
    values = torch.randn(3, count, dtype=torch.complex128)
    back = torch.from_numpy(values.numpy() @ matrix.conj())
    torch.testing.assert_close(zoom_adjoint(values, factors), back, rtol=0, atol=1e-13)


def test_the_planned_reading_equals_the_dense_one():
    grid, out = Grid(96, 8e-6), Grid((200, 180), (3e-6, 3.5e-6))
    y, x = grid.coordinates()
    field = torch.exp(-(y**2 + x**2) / 80e-6**2).to(torch.complex128)[None]
    module = Propagator(grid, 530e-9, 3e-3, tolerance=1e-6, out_grid=out, example=field)
    assert module.plan.method == "angular spectrum, zoomed"
    wanted = ResampledKernel(grid, 530e-9, 3e-3, out)(field)
    assert (module(field) - wanted).norm() <= 1e-6 * wanted.norm()
