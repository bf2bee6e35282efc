import numpy as np
import pytest
import torch
from oracles import dense

from holotorch import Grid
from holotorch.correction import deconvolve, gerchberg_saxton, iterative_pec
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import DepthStack, Fraunhofer, Fresnel

GRID = Grid((12, 17), (5e-6, 4e-6))


def setting():
    target = torch.rand(1, *GRID.shape, dtype=torch.float64)
    start = torch.rand(1, *GRID.shape, dtype=torch.float64) * 2 * torch.pi
    return Fraunhofer(GRID, 530e-9), target / target.mean(), start


@pytest.mark.parametrize("spread", [False, True], ids=["plain", "basic IPEC"])
def test_follows_algorithm_1(spread):
    """Algorithm 1 with matrices, as printed; for basic IPEC B = S exp(i P(phs(A)))."""
    propagator, target, start = setting()
    transform = dense.centred_unitary_dft(GRID.shape)
    matrix = dense.convolution(GRID.shape, dense.heat_kernel(0.66, 7)) if spread else np.eye(12 * 17)
    amplitude = np.sqrt(target.numpy().ravel())
    a = transform.conj().T @ (amplitude * np.exp(1j * start.numpy().ravel()))
    phase, losses = np.empty(0), []
    for _ in range(6):
        phase = np.angle(a) % (2 * np.pi)
        c = transform @ np.exp(1j * matrix @ phase)
        losses.append(((amplitude - np.abs(c)) ** 2).sum())
        a = transform.conj().T @ (amplitude * np.exp(1j * np.angle(c)))

    crosstalk = ThermalCrosstalk(0.66, 7) if spread else None
    solution = gerchberg_saxton(propagator, target, start, max_steps=5, crosstalk=crosstalk)
    # A rounding of 1e-16 can turn a phase at 0 into one at 2 pi; compare where that makes no difference.
    np.testing.assert_allclose(np.exp(1j * solution.x.numpy().ravel()), np.exp(1j * phase), atol=1e-9)
    assert solution.losses[:, 0].tolist() == pytest.approx(losses, rel=1e-9)
    assert solution.evaluations == 6 and solution.steps.item() == 5
    assert (solution.x >= 0).all() and (solution.x < 2 * torch.pi).all()


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")  # periodic, as in the thesis
@pytest.mark.parametrize("corrected", [False, True], ids=["plain", "multi-plane IPEC"])
def test_several_depths_constrain_one_hologram(corrected):
    """Algorithm 1 with matrices over two depths (thesis Sec. 4.4.5.4): fields of both, propagated back, are added."""
    wavelength, depths = 530e-9, (0.4e-3, 0.5e-3)
    stack = DepthStack([Fresnel(GRID, wavelength, each, pad=1) for each in depths])
    matrices = [
        dense.spectral_filter(GRID.shape, dense.fresnel_transfer(GRID.shape, GRID.pitch, wavelength, each))
        for each in depths
    ]
    target = torch.rand(1, 2, *GRID.shape, dtype=torch.float64)
    target = target / target.mean()
    start = torch.rand(1, 2, *GRID.shape, dtype=torch.float64) * 2 * torch.pi
    crosstalk = ThermalCrosstalk(0.66, 7)
    heat = dense.convolution(GRID.shape, dense.heat_kernel(0.66, 7))
    amplitude = np.sqrt(target.numpy().reshape(2, -1))
    images, losses = amplitude * np.exp(1j * start.numpy().reshape(2, -1)), []
    phase = np.empty(0)
    for _ in range(4):
        back = sum(matrix.conj().T @ image for matrix, image in zip(matrices, images, strict=True))
        phase = np.angle(back) % (2 * np.pi)
        if corrected:
            wanted = torch.from_numpy(phase).reshape(1, *GRID.shape)
            phase = deconvolve(crosstalk, wanted, max_steps=30).numpy().ravel()
        formed = [matrix @ np.exp(1j * (heat @ phase if corrected else phase)) for matrix in matrices]
        losses.append(sum(((a - np.abs(f)) ** 2).sum() for a, f in zip(amplitude, formed, strict=True)))
        images = [a * np.exp(1j * np.angle(f)) for a, f in zip(amplitude, formed, strict=True)]
    if corrected:
        solution = iterative_pec(stack, crosstalk, target, start, max_steps=3)
    else:
        solution = gerchberg_saxton(stack, target, start, max_steps=3)
    assert solution.x.shape == (1, *GRID.shape) and solution.losses.shape == (4, 1)
    np.testing.assert_allclose(np.exp(1j * solution.x.numpy().ravel()), np.exp(1j * phase), atol=1e-6)
    assert solution.losses[:, 0].tolist() == pytest.approx(losses, rel=1e-6)
    assert losses[-1] < losses[0]


def test_plain_error_never_rises():
    propagator, target, start = setting()
    losses = gerchberg_saxton(propagator, target, start, max_steps=50).losses[:, 0]
    assert (losses[1:] <= losses[:-1] * (1 + 1e-12)).all()
    assert losses[-1] < 0.5 * losses[0]


def test_a_dark_far_field_sample_does_not_make_nan():
    propagator, target, start = setting()
    target[0, 3:6] = 0
    solution = gerchberg_saxton(propagator, target / target.mean(), torch.zeros_like(start), max_steps=5)
    assert torch.isfinite(solution.x).all()


def test_refuses_bad_arguments():
    propagator, target, start = setting()
    with pytest.raises(ValueError, match="max_steps must be at least 1"):
        gerchberg_saxton(propagator, target, start, max_steps=0)
    with pytest.raises(ValueError, match="start must be finite"):
        gerchberg_saxton(propagator, target, start * float("nan"))
    with pytest.raises(ValueError, match="target is an intensity and must be >= 0"):
        gerchberg_saxton(propagator, -target, start)
    with pytest.raises(ValueError, match=r"start must end in \(C, H, W\)"):
        gerchberg_saxton(propagator, target, start[0])
    with pytest.raises(TypeError, match="real floating-point"):
        gerchberg_saxton(propagator, target, start.to(torch.int64))
    with pytest.raises(ValueError, match="target must be finite"):
        gerchberg_saxton(propagator, target * float("inf"), start)
