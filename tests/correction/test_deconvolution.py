"""Deconvolutions against dense matrices and SciPy, and Algorithm 1 with them against a transcription of the page."""

import numpy as np
import pytest
import torch
from oracles import dense
from scipy.optimize import nnls

from holotorch import Grid
from holotorch.correction import deconvolve, deconvolve_admm, gerchberg_saxton, inverse, iterative_pec
from holotorch.io.images import fit_image, load_image
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer

SHAPE = (5, 7)
LOPSIDED = torch.tensor([[0.05, 0.3, 0.1], [0.2, 1.0, 0.4], [0.0, 0.25, 0.15]], dtype=torch.float64)
CROSSTALK = {
    "Gaussian": (ThermalCrosstalk(0.66, 5), dense.heat_kernel(0.66, 5)),
    "lopsided": (ThermalCrosstalk.from_patch(LOPSIDED), LOPSIDED.numpy()),
}


def best(kernel, phase):
    """The non-negative least squares solution, by SciPy."""
    matrix = dense.convolution(phase.shape[-2:], kernel)
    return np.stack([nnls(matrix, item.ravel())[0].reshape(item.shape) for item in phase.numpy()])


@pytest.mark.parametrize(("sigma", "size"), [(0.66, 7), (0.9, 5), (1.5, 7), (0.0, 1)])
def test_inverse_solves_the_dense_system(sigma, size):
    phase = torch.rand(2, 9, 8, dtype=torch.float64) * 6
    matrix = dense.convolution((9, 8), dense.heat_kernel(sigma, size) if sigma else np.ones((1, 1)))
    wanted = np.linalg.solve(matrix, phase.reshape(2, -1).numpy().T).T.reshape(2, 9, 8)
    crosstalk = ThermalCrosstalk(sigma, size)
    found = inverse(crosstalk, phase)
    tolerance = 1e-11 + 10 * 1e-16 * np.linalg.cond(matrix) * np.abs(wanted).max()
    np.testing.assert_allclose(found, wanted, rtol=0, atol=tolerance)  # taps below 1e-12 are dropped
    torch.testing.assert_close(crosstalk(found), phase, rtol=0, atol=tolerance * crosstalk.total)
    single = inverse(crosstalk, phase.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), found, rtol=0, atol=1e-6 * np.linalg.cond(matrix))


def test_inverse_of_a_symmetric_patch_that_separates():
    rows, columns = torch.tensor([0.2, 1.0, 0.2]).double(), torch.tensor([0.1, 0.4, 1.0, 0.4, 0.1]).double()
    crosstalk = ThermalCrosstalk.from_patch(rows[:, None] * columns)
    phase = torch.rand(1, 6, 9, dtype=torch.float64)
    torch.testing.assert_close(crosstalk(inverse(crosstalk, phase)), phase, rtol=0, atol=1e-12)


def test_inverse_refuses_a_kernel_that_erases_a_pattern():
    """Above sigma 1.6686 px seven taps turn the highest frequencies round; on n pixels one crosses zero soon after."""

    def least(sigma: float) -> float:
        taps, offsets = np.exp(-(np.arange(7) ** 2) / sigma**2), np.abs(np.subtract.outer(np.arange(24), np.arange(24)))
        return np.linalg.eigvalsh(np.where(offsets < 4, taps[np.minimum(offsets, 6)], 0))[0]

    low, high = 1.6, 1.9
    assert least(low) > 0 > least(high)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if least(middle) > 0 else (low, middle)
    # 1.6686 for an endless row of pixels; n of them reach it later by 11.4 / n^2, as 48, 96 and 400 say to 3 % of that.
    assert low == pytest.approx(1.6686 + 11.4 / 24**2, abs=0.03 * 11.4 / 24**2)
    with pytest.raises(ValueError, match=r"has no inverse on \(24, 9\) px: it erases some patterns"):
        inverse(ThermalCrosstalk(low, 7), torch.rand(1, 24, 9))
    assert torch.isfinite(inverse(ThermalCrosstalk(low + 1e-3, 7), torch.rand(1, 24, 9, dtype=torch.float64))).all()
    assert torch.isfinite(deconvolve(ThermalCrosstalk(low, 7), torch.rand(1, 24, 9))).all()


def test_inverse_refuses_what_both_axes_together_amplify_beyond_rounding():
    """Each axis alone is invertible; with both, heater phases came back 4 % off."""
    crosstalk = ThermalCrosstalk(3.0)
    inverse(crosstalk, torch.rand(37, 1, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"has no inverse on \(37, 30\) px"):
        inverse(crosstalk, torch.rand(37, 30, dtype=torch.float64))


@pytest.mark.parametrize("solve", [inverse, deconvolve_admm])
@pytest.mark.parametrize("patch", [LOPSIDED, LOPSIDED + LOPSIDED.flip(0, 1)], ids=["lopsided", "not separable"])
def test_matrix_methods_refuse_other_kernels(solve, patch):
    with pytest.raises(ValueError, match="must be separable and symmetric .*; use deconvolve"):
        solve(ThermalCrosstalk.from_patch(patch), torch.rand(1, *SHAPE))


@pytest.mark.parametrize("kind", CROSSTALK)
def test_deconvolve_finds_the_non_negative_least_squares(kind):
    crosstalk, kernel = CROSSTALK[kind]
    phase = torch.rand(3, *SHAPE, dtype=torch.float64) * 6
    wanted = best(kernel, phase)
    assert (wanted == 0).any() and (wanted > 0).any()  # the constraint is at work
    np.testing.assert_allclose(deconvolve(crosstalk, phase, max_steps=1000), wanted, rtol=0, atol=1e-6)
    elsewhere = deconvolve(crosstalk, phase, max_steps=1000, start=torch.rand_like(phase) - 0.5)
    np.testing.assert_allclose(elsewhere, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", CROSSTALK)
def test_deconvolve_keeps_the_bound_of_accelerated_gradients(kind):
    """F(x_k) - F* <= 2 L |x_0 - x*|^2 / (k + 1)^2 with F half the squared distance (Beck and Teboulle 2009)."""
    crosstalk, kernel = CROSSTALK[kind]
    phase = torch.rand(1, *SHAPE, dtype=torch.float64) * 6
    optimum = torch.as_tensor(best(kernel, phase))
    least, far = (crosstalk(optimum) - phase).square().sum() / 2, (optimum - phase).square().sum()
    for steps in (1, 2, 5, 10, 30):
        x = deconvolve(crosstalk, phase, max_steps=steps)
        assert (x >= 0).all()
        excess = (crosstalk(x) - phase).square().sum() / 2 - least
        # The momentum k / (k + 3) of the thesis has the bound with (k + 1)^2 / 4 for (k + 1)^2 / 2 at worst.
        assert 0 <= excess <= 4 * crosstalk.kernel.sum() ** 2 * far / (steps + 1) ** 2


@pytest.mark.parametrize("weight", [0.3, 1.0, 10.0])
def test_admm_finds_the_same(weight):
    crosstalk, kernel = CROSSTALK["Gaussian"]
    phase = torch.rand(3, *SHAPE, dtype=torch.float64) * 6
    x = deconvolve_admm(crosstalk, phase, max_steps=1000, weight=weight)
    np.testing.assert_allclose(x, best(kernel, phase), rtol=0, atol=1e-6)
    short = deconvolve_admm(crosstalk, phase.float(), max_steps=5, weight=weight)
    assert (short >= 0).all() and short.dtype == torch.float32


@pytest.mark.parametrize("solve", [deconvolve, deconvolve_admm])
def test_refuses_bad_input(solve):
    crosstalk, phase = CROSSTALK["Gaussian"][0], torch.rand(1, *SHAPE)
    with pytest.raises(ValueError, match="phase must be finite"):
        solve(crosstalk, phase * torch.nan)
    with pytest.raises(ValueError, match="max_steps must be at least 1"):
        solve(crosstalk, phase, max_steps=0)
    with pytest.raises(TypeError, match="phase must be a real floating-point tensor"):
        solve(crosstalk, phase.to(torch.int64))
    with pytest.raises(ValueError, match="weight must be above zero"):
        deconvolve_admm(crosstalk, phase, weight=0)
    with pytest.raises(TypeError, match="phase must be a real floating-point tensor"):
        inverse(crosstalk, torch.complex(phase, phase))


def light():
    target = torch.rand(1, *SHAPE, dtype=torch.float64) ** 2
    start = torch.rand(1, *SHAPE, dtype=torch.float64) * 2 * torch.pi
    return Fraunhofer(Grid(SHAPE, 9e-6), 530e-9), target / target.mean(), start


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "signal region"])
@pytest.mark.parametrize("kind", CROSSTALK)
def test_iterative_pec_follows_algorithm_1(kind, masked):
    """As printed, with matrices; within a pass the deconvolution by Eqs. 4.32-4.35, corrected to M^T phi."""
    propagator, target, start = light()
    transform, matrix = dense.centred_unitary_dft(SHAPE), dense.convolution(SHAPE, CROSSTALK[kind][1])
    inside = np.zeros(SHAPE, bool)
    inside[1:4, 2:6] = True
    inside = inside.ravel() if masked else np.ones(inside.size, bool)
    amplitude, step = np.sqrt(target.numpy().ravel()), 1 / CROSSTALK[kind][1].sum() ** 2
    far, x, losses = amplitude * np.exp(1j * start.numpy().ravel()), np.empty(0), []
    for _ in range(4):
        wanted = np.angle(transform.conj().T @ far) % (2 * np.pi)
        x = last = wanted
        for k in range(6):
            y = x + k / (k + 3) * (x - last)
            last, x = x, np.maximum(y - step * (matrix.T @ (matrix @ y) - matrix.T @ wanted), 0)
        formed = transform @ np.exp(1j * matrix @ x)
        losses.append(((amplitude - np.abs(formed)) ** 2)[inside].sum())
        far = np.where(inside, amplitude * np.exp(1j * np.angle(formed)), formed)  # Eqs. 4.7 and 4.8

    mask = torch.as_tensor(inside.reshape(SHAPE), dtype=torch.float64) if masked else None
    crosstalk, seen = CROSSTALK[kind][0], []
    solution = iterative_pec(
        propagator, crosstalk, target, start, max_steps=3, inner_steps=6, mask=mask, callback=seen.append
    )
    np.testing.assert_allclose(solution.x.numpy().ravel(), x, rtol=0, atol=1e-9)
    assert solution.losses[:, 0].tolist() == pytest.approx(losses, rel=1e-9)
    assert len(seen) == 3 and torch.equal(seen[-1].x, solution.x) and (solution.x >= 0).all()


def test_a_deconvolution_sees_the_last_heater_phases():
    propagator, target, start = light()
    crosstalk, given, made = CROSSTALK["Gaussian"][0], [], []

    def record(wanted, last):
        given.append(last)
        made.append(deconvolve(crosstalk, wanted, max_steps=3, start=last))
        return made[-1]

    solution = gerchberg_saxton(propagator, target, start, max_steps=2, crosstalk=crosstalk, deconvolution=record)
    assert given[0] is None and given[1] is made[0] and given[2] is made[1]
    assert torch.equal(solution.x, made[2])
    assert solution.evaluations == 3


def photograph(size: int = 48):
    image = fit_image(load_image("camera"), (size, size)).float()
    start = torch.rand(1, size, size) * 2 * torch.pi
    return Fraunhofer(Grid(size, 9e-6), 530e-9), image / image.mean(), start


def test_a_signal_region_is_formed_better_than_the_whole():
    propagator, target, start = photograph()
    mask = torch.zeros(48, 48)
    mask[12:36, 12:36] = 1
    whole = gerchberg_saxton(propagator, target, start, max_steps=40)
    region = gerchberg_saxton(propagator, target, start, max_steps=40, mask=mask)
    formed = propagator(torch.polar(torch.ones_like(whole.x), whole.x)).abs()
    error = (mask * (formed - target.sqrt())).square().sum()
    assert region.losses[-1] < 0.1 * error  # speckle moves out of a region with three times as many free samples


def test_iterative_pec_beats_the_loop_without_a_deconvolution():
    propagator, target, start = photograph()
    crosstalk = ThermalCrosstalk(0.66, 7)
    basic = gerchberg_saxton(propagator, target, start, max_steps=20, crosstalk=crosstalk)
    full = iterative_pec(propagator, crosstalk, target, start, max_steps=20)
    assert full.losses[-1] < 0.5 * basic.losses[-1]
    assert full.losses[-1] < 0.5 * full.losses[0]
