"""Propagation onto another grid, against quadrature over the band."""

import numpy as np
import pytest
import torch
from oracles import dense

from holotorch import Grid
from holotorch.optics import CroppedKernel, ResampledKernel

GRID, WAVE = Grid((16, 12), (8e-6, 7e-6)), 530e-9
TARGETS = {
    "finer": (Grid((9, 14), (3e-6, 2.5e-6)), (0.0, 0.0)),
    "coarser, aside": (Grid((7, 10), (20e-6, 31e-6)), (40e-6, -150e-6)),
    "the same": (GRID, (0.0, 0.0)),
}


def white(*batch: int) -> torch.Tensor:
    return torch.exp(2j * torch.pi * torch.rand(*batch, 1, *GRID.shape, dtype=torch.float64))


@pytest.mark.parametrize("crossovers", [0.1, 1.0, -4.0])
@pytest.mark.parametrize("target", TARGETS)
def test_equals_quadrature(target, crossovers):
    out_grid, offset = TARGETS[target]
    distance = crossovers * 2 * GRID.extent[1] * GRID.pitch[1] / WAVE
    matrix = dense.band_limited_to_points(
        GRID.shape, GRID.pitch, out_grid.shape, out_grid.pitch, offset, WAVE, distance
    )
    operator, field = ResampledKernel(GRID, WAVE, distance, out_grid, offset=offset), white()
    got = operator(field)
    assert got.shape == (1, *out_grid.shape)
    wanted = (matrix @ field[0].numpy().ravel()).reshape(out_grid.shape)
    # 2.1 s^2 / sqrt(N) as for the cropped kernel, twice for the scatter of one small field.
    sine = WAVE / (2 * min(GRID.pitch))
    scale = np.linalg.norm(field) / np.sqrt(GRID.shape[0] * GRID.shape[1] / wanted.size)
    assert np.linalg.norm(got[0].numpy() - wanted) / scale <= 2 * 2.1 * sine**2 / 12**0.5


def test_the_same_grid_gives_what_the_cropped_kernel_gives():
    smooth = torch.hann_window(16, dtype=torch.float64)[:, None] * torch.hann_window(12, dtype=torch.float64)
    field = smooth.to(torch.complex128)[None]
    for distance in (1e-3, 20e-3):
        wanted = CroppedKernel(GRID, WAVE, distance)(field)
        torch.testing.assert_close(ResampledKernel(GRID, WAVE, distance, GRID)(field), wanted, rtol=0, atol=1e-5)


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="distance must not be 0"):
        ResampledKernel(GRID, WAVE, 0.0, GRID)
    with pytest.raises(ValueError, match=r"pitch must be at least 0\.9 wavelengths"):
        ResampledKernel(Grid(8, 0.4e-6), WAVE, 1e-3, GRID)
    with pytest.raises(ValueError, match="offset must be finite"):
        ResampledKernel(GRID, WAVE, 1e-3, GRID, offset=(float("nan"), 0.0))
    with pytest.raises(ValueError, match=r"field must end in \(C, H, W\)"):
        ResampledKernel(GRID, WAVE, 1e-3, GRID)(white().transpose(-1, -2))
