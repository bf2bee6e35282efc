"""Chirp-z reading of a spectrum, against plain Fourier sums."""

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.optics import Propagator, ResampledKernel, ZoomedFilter
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


def filtered() -> tuple[ZoomedFilter, np.ndarray, np.ndarray]:
    """A filter with a random kernel on 20 x 24 samples, and its two dense factors: to the spectrum, and to places."""
    kernel = torch.randn(2, 20, 24, dtype=torch.complex128)
    forward, back = [], []
    for axis, padded in enumerate((20, 24)):
        n, m, p, q = GRID.shape[axis], OUT.shape[axis], GRID.pitch[axis], OUT.pitch[axis]
        f = np.fft.fftfreq(padded, p)
        source, reached = np.arange(n) * p, (np.arange(m) - m // 2) * q + OFFSET[axis] + n // 2 * p
        forward.append(np.exp(-2j * np.pi * np.outer(f, source)))
        back.append(np.exp(2j * np.pi * np.outer(reached, f)) / padded)
    to_spectrum, to_places = np.kron(*forward), np.kron(*back)
    dense = np.stack([to_places @ (each.ravel()[:, None] * to_spectrum) for each in kernel.numpy()])
    return ZoomedFilter(GRID, WAVES, kernel, OUT, offset=OFFSET), dense, kernel.numpy()


def test_contracts():
    operator, dense, _ = filtered()
    x = torch.randn(3, 2, *GRID.shape, dtype=torch.complex128)
    y = torch.randn(3, 2, *OUT.shape, dtype=torch.complex128)
    out = operator(x)
    wanted = np.einsum("cpq,bcq->bcp", dense, x.numpy().reshape(3, 2, -1)).reshape(out.shape)
    torch.testing.assert_close(out, torch.from_numpy(wanted), rtol=0, atol=1e-12)
    assert abs((out.conj() * y).sum() - (x.conj() * operator.adjoint(y)).sum()) <= 1e-12 * out.norm() * y.norm()
    torch.testing.assert_close(operator(x[1]), out[1], rtol=0, atol=1e-13)
    assert operator(x.to(torch.complex64)).dtype == torch.complex64
    assert torch.equal(operator.float().half()(x), out)
    assert torch.autograd.gradcheck(operator, (x[:1].requires_grad_(),), fast_mode=True)
    compiled = torch.compile(operator, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x.detach()), out, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"field must end in \(C, H, W\)"):
        operator(y)


def test_the_planned_reading_equals_the_dense_one():
    grid, out = Grid(96, 8e-6), Grid((200, 180), (3e-6, 3.5e-6))
    y, x = grid.coordinates()
    field = torch.exp(-(y**2 + x**2) / 80e-6**2).to(torch.complex128)[None]
    module = Propagator(grid, 530e-9, 3e-3, tolerance=1e-6, out_grid=out, example=field)
    assert module.plan.method == "angular spectrum, zoomed"
    wanted = ResampledKernel(grid, 530e-9, 3e-3, out)(field)
    assert (module(field) - wanted).norm() <= 1e-6 * wanted.norm()
