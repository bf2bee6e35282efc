"""The objective and its gradient against closed forms with explicit matrices."""

import warnings

import numpy as np
import pytest
import torch
from oracles import dense, pec

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.correction import PECProblem
from holotorch.correction import problem as problem_module
from holotorch.correction.problem import best_scale
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import AngularSpectrum, Fraunhofer, Fresnel

GRID, WAVE, DISTANCE = Grid((12, 17), (5e-6, 4e-6)), 530e-9, 0.4e-3
PATCH = torch.tensor([[0.05, 0.3, 0.1], [0.2, 1.0, 0.4], [0.0, 0.25, 0.15]], dtype=torch.float64)
CROSSTALK = {
    "Gaussian": (lambda: ThermalCrosstalk(0.9, 7), dense.heat_kernel(0.9, 7)),
    "measured": (lambda: ThermalCrosstalk.from_patch(PATCH), PATCH.numpy()),
}


def transfer(kind: str, pad: float) -> np.ndarray:
    big = GRID.padded(pad)
    if kind == "fresnel":
        return dense.fresnel_transfer(big.shape, big.pitch, WAVE, DISTANCE)
    return dense.angular_spectrum_transfer(big.shape, big.pitch, WAVE, DISTANCE, True)


PROPAGATORS = {
    "Fourier": (lambda: Fraunhofer(GRID, WAVE), lambda: dense.centred_unitary_dft(GRID.shape)),
    "Fresnel": (
        lambda: Fresnel(GRID, WAVE, DISTANCE, pad=2),
        lambda: dense.spectral_filter(GRID.shape, transfer("fresnel", 2)),
    ),
    "Fresnel, periodic": (
        lambda: Fresnel(GRID, WAVE, DISTANCE, pad=1),
        lambda: dense.spectral_filter(GRID.shape, transfer("fresnel", 1)),
    ),
    "angular spectrum": (
        lambda: AngularSpectrum(GRID, WAVE, DISTANCE, pad=2),
        lambda: dense.spectral_filter(GRID.shape, transfer("angular", 2)),
    ),
}
pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")


def relative(got, wanted) -> float:
    return float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted))


def setting(crosstalk: str, propagator: str):
    phase = (torch.rand(1, *GRID.shape, dtype=torch.float64) * 2 * torch.pi).requires_grad_()
    target = torch.rand(1, *GRID.shape, dtype=torch.float64)
    problem = PECProblem(CROSSTALK[crosstalk][0](), PROPAGATORS[propagator][0](), target / target.mean())
    loss = problem(phase)
    (gradient,) = torch.autograd.grad(loss.sum(), phase)
    matrix = dense.convolution(GRID.shape, CROSSTALK[crosstalk][1])
    flat = phase.detach().numpy().ravel(), problem.target.numpy().ravel(), matrix
    return loss.item(), gradient.numpy().ravel(), flat


@pytest.mark.parametrize("propagator", PROPAGATORS)
@pytest.mark.parametrize("crosstalk", CROSSTALK)
def test_loss_and_gradient_equal_the_closed_form(crosstalk, propagator):
    loss, gradient, flat = setting(crosstalk, propagator)
    matrix = PROPAGATORS[propagator][1]()
    assert loss == pytest.approx(pec.objective(*flat, matrix), rel=1e-12)
    assert relative(gradient, pec.gradient(*flat, matrix)) <= 1e-12


@pytest.mark.parametrize("crosstalk", CROSSTALK)
def test_fourier_gradient_of_the_thesis_corrected_and_as_printed(crosstalk):
    _, gradient, flat = setting(crosstalk, "Fourier")
    transform = dense.centred_unitary_dft(GRID.shape)
    assert relative(gradient, pec.fourier_gradient(*flat, transform)) <= 1e-12
    printed = pec.fourier_gradient_as_printed(*flat, transform)
    assert relative(gradient, printed) > 0.5
    assert abs(printed @ gradient) / np.linalg.norm(printed) / np.linalg.norm(gradient) < 0.5


@pytest.mark.parametrize("crosstalk", CROSSTALK)
@pytest.mark.parametrize(("propagator", "kind"), [("Fresnel, periodic", "fresnel")])
def test_fresnel_gradient_of_the_thesis_corrected_and_as_printed(crosstalk, propagator, kind):
    _, gradient, flat = setting(crosstalk, propagator)
    transform = np.kron(dense.dft(12), dense.dft(17)) / np.sqrt(12 * 17)
    wave = transfer(kind, 1).ravel()
    assert relative(gradient, pec.fresnel_gradient(*flat, transform, wave)) <= 1e-12
    assert relative(gradient, pec.fresnel_gradient_as_printed(*flat, transform, wave)) > 0.5
    # H must not be conjugated either.
    assert relative(gradient, pec.fresnel_gradient(*flat, transform, wave.conj())) > 0.5


def test_the_transpose_matters_for_a_kernel_that_is_not_symmetric():
    _, gradient, (phase, target, matrix) = setting("measured", "Fourier")
    transform = dense.centred_unitary_dft(GRID.shape)
    inner = np.linalg.solve(matrix.T, pec.fourier_gradient(phase, target, matrix, transform))
    assert relative(gradient, matrix @ inner) > 1e-2


@pytest.mark.parametrize("scale_free", [False, True])
@pytest.mark.parametrize("propagator", PROPAGATORS)
def test_gradcheck(propagator, scale_free):
    target = torch.rand(1, *GRID.shape, dtype=torch.float64)
    problem = PECProblem(
        ThermalCrosstalk(0.66), PROPAGATORS[propagator][0](), target / target.mean(), scale_free=scale_free
    )
    phase = torch.rand(2, 1, *GRID.shape, dtype=torch.float64, requires_grad=True)
    assert problem(phase).shape == (2, 1)
    assert torch.autograd.gradcheck(problem, (phase,), fast_mode=True)


@pytest.mark.parametrize("propagator", PROPAGATORS)
def test_frames_in_turn_give_the_same_loss_and_gradient(propagator, monkeypatch):
    target = torch.rand(1, *GRID.shape, dtype=torch.float64)
    fields = []
    operator = PROPAGATORS[propagator][0]()
    operator.register_forward_pre_hook(lambda _, given: fields.append(given[0].shape[-4]))
    problem = PECProblem(ThermalCrosstalk(0.66), operator, target, frames=True, limit=1.0, light_weight=0.1)
    results = []
    for at_once in (problem_module.FRAMES_AT_ONCE, 0):
        monkeypatch.setattr(problem_module, "FRAMES_AT_ONCE", at_once)
        phase = torch.rand(3, 5, 1, *GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        loss = problem(phase.requires_grad_(True))
        results.append((loss.detach(), *torch.autograd.grad(loss.sum(), phase)))
    assert fields == [5] + 5 * [1]
    for at_once, in_turn in zip(*results, strict=True):
        assert relative(in_turn, at_once) < 1e-13


def test_scale_free_loss_ignores_brightness_and_keeps_its_optimum():
    target = torch.rand(1, *GRID.shape, dtype=torch.float64) + 0.1
    target = target / target.mean()
    plain = PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, WAVE), target)
    free = PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, WAVE), target, scale_free=True)
    phase = torch.rand(1, *GRID.shape, dtype=torch.float64)
    formed = plain.intensity(phase)
    assert best_scale(3 * target, target).item() == pytest.approx(1 / 3)
    tried = torch.stack([(10**s * formed - target).square().sum() for s in torch.linspace(-4, 1, 2000)])
    assert free(phase).item() <= tried.min().item()
    # Steps of 0.6 % in s leave at most (0.003)^2 of the formed picture's power above the minimum.
    assert free(phase).item() == pytest.approx(tried.min().item(), rel=1e-5)


def test_unitary_propagation_keeps_the_mean_at_one():
    target = torch.ones(1, *GRID.shape)
    for name in ("Fourier", "Fresnel, periodic"):
        problem = PECProblem(ThermalCrosstalk(0.66), PROPAGATORS[name][0](), target)
        assert problem.intensity(torch.rand(1, *GRID.shape)).mean().item() == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize("mean", [0.45, 2.0])
def test_a_target_that_no_array_is_as_bright_as_is_warned_of(mean):
    target = torch.full((2, *GRID.shape), 1.0)
    target[1] = mean
    with pytest.warns(SamplingWarning, match=f"target has a mean of {mean:g} in a channel"):
        PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, [WAVE] * 2), target)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, [WAVE] * 2), target, scale_free=True)
        PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, [WAVE] * 2), target, mask=torch.ones(1))
        PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, [WAVE] * 2), target / target.mean((-2, -1), keepdim=True))


def test_heat_in_the_place_of_the_propagator_is_refused():
    with pytest.raises(TypeError, match="got ThermalCrosstalk, which is the first argument"):
        PECProblem(Fraunhofer(GRID, WAVE), ThermalCrosstalk(0.66))


@pytest.mark.parametrize("shape", [(3, 12, 1), (1, 12, 17), (3, 1, 17)])
def test_a_target_of_another_shape_is_not_broadcast(shape):
    problem = PECProblem(ThermalCrosstalk(0), Fraunhofer(GRID, [WAVE] * 3), torch.ones(shape))
    with pytest.raises(ValueError, match=r"target must end in \(C, H, W\) = \(3, 12, 17\)"):
        problem(torch.rand(3, *GRID.shape))


@pytest.mark.parametrize("shape", [(12, 17), (2, 12, 17), (3, 12, 16)])
def test_a_phase_of_another_shape_is_named_as_the_phase(shape):
    problem = PECProblem(ThermalCrosstalk(0.66), Fraunhofer(GRID, [WAVE] * 3), torch.ones(3, *GRID.shape))
    wanted = (3, *GRID.shape)
    for call in (problem, problem.intensity):
        with pytest.raises(ValueError) as caught:
            call(torch.rand(shape))
        assert str(caught.value) == f"phase must end in (C, H, W) = {wanted}, got {shape}"


@pytest.mark.parametrize(
    ("target", "error", "message"),
    [
        (torch.ones(2, 3), ValueError, r"axes .*\(C, H, W\)"),
        (torch.ones(1, 4, 4, dtype=torch.int64), TypeError, "real floating-point"),
        (torch.full((1, 4, 4), float("nan")), ValueError, r"element \(0, 0, 0\) is nan"),
        (-torch.ones(1, 4, 4), ValueError, "must be >= 0, got a minimum of -1"),
        (torch.stack([torch.ones(4, 4), torch.zeros(4, 4)]), ValueError, "channel 1 is black"),
    ],
)
def test_refuses_what_is_no_target(target, error, message):
    with pytest.raises(error, match=message):
        PECProblem(ThermalCrosstalk(0), Fraunhofer(Grid(4, 1e-6), WAVE), target)
