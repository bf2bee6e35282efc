"""A batch of nothing gives nothing of the right shape: of every operator, picture and figure of merit."""

import pytest
import torch
from operators import CASES, GRID, WAVELENGTHS, Case

from holotorch import Grid, metrics
from holotorch.correction import APG, LBFGS, PECProblem, deconvolve, gerchberg_saxton
from holotorch.hologram import focal_stack, perspective, refocused
from holotorch.modulator import PhasedArray, PhaseModulator, ThermalCrosstalk
from holotorch.optics import (
    Display,
    Eye,
    EyeLens,
    Fraunhofer,
    Propagator,
    equal_power,
    gamut_map,
    propagate,
    propagate_collapsed,
    propagate_elements,
    retinal_image,
    tone_map,
)

pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
PICTURE = torch.rand(0, 3, 12, 17)
FIELD = torch.complex(torch.rand(0, 2, *GRID.shape), torch.rand(0, 2, *GRID.shape))
LOOK = {"display": Display(20e-3, 25e-3, 50e-3), "eye": Eye()}
OUT = Grid((10, 9), 6e-6)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_operators(case: Case):
    operator, x, y = case.build(), case.input(3, 0).requires_grad_(), case.output(3, 0).requires_grad_()
    for apply, given, wanted in ((operator, x, y), (operator.adjoint, y, x)):
        result = apply(given)
        assert result.shape == wanted.shape and result.dtype == wanted.dtype
        (gradient,) = torch.autograd.grad(result.abs().sum(), given)
        assert gradient.shape == given.shape


@pytest.mark.parametrize(
    ("make", "shape"),
    [
        (lambda: EyeLens(GRID, WAVELENGTHS, Eye())(FIELD), (0, 2, 12, 17)),
        (lambda: Propagator(GRID, WAVELENGTHS, 2e-3, out_grid=OUT)(FIELD), (0, 2, 10, 9)),
        (lambda: propagate(FIELD, GRID, 530e-9, 2e-3), (0, 2, 12, 17)),
        (lambda: propagate(FIELD, GRID, 530e-9, 2e-3, out_grid=OUT), (0, 2, 10, 9)),
        (lambda: propagate(FIELD, GRID, torch.tensor(WAVELENGTHS), torch.tensor([1e-3, 2e-3])), (0, 2, 12, 17)),
        (lambda: propagate(FIELD, GRID, 530e-9, 2e-3, measure=True), (0, 2, 12, 17)),
        (lambda: propagate_collapsed(FIELD, GRID, WAVELENGTHS, **LOOK), (0, 2, 12, 17)),
        (lambda: propagate_elements(FIELD, GRID, WAVELENGTHS, **LOOK), (0, 2, 12, 17)),
        (lambda: retinal_image(FIELD, GRID, WAVELENGTHS, **LOOK), (0, 2, 12, 17)),
        (lambda: refocused(FIELD, GRID, 530e-9, 2e-3), (0, 2, 12, 17)),
        (lambda: torch.stack(list(focal_stack(FIELD, GRID, 530e-9, [1e-3, 2e-3]))), (2, 0, 2, 12, 17)),
        (lambda: perspective(FIELD, GRID, 530e-9, direction=(0.0, 0.0), aperture=0.01), None),
        (lambda: PhasedArray(WAVELENGTHS, ThermalCrosstalk(0.6))(FIELD.real), (0, 2, 12, 17)),
        (lambda: PhaseModulator(GRID, WAVELENGTHS)(FIELD.real), (0, 2, 12, 17)),
        (lambda: PhaseModulator(GRID, WAVELENGTHS).levels(FIELD.real), (0, 2, 12, 17)),
        (lambda: metrics.psnr(PICTURE, PICTURE, data_range=1.0), (0, 3)),
        (lambda: metrics.ssim(PICTURE, PICTURE, data_range=1.0), (0, 3)),
        (lambda: metrics.ssim_map(PICTURE, PICTURE, data_range=1.0), (0, 3, 2, 7)),
        (lambda: metrics.speckle_contrast(PICTURE), (0, 3)),
        (lambda: metrics.power_spectrum(PICTURE), (0, 3, 12, 17)),
        (lambda: metrics.grain_size(PICTURE), (0, 3, 2)),
        (lambda: metrics.anisotropy(PICTURE).ratio, (0, 3)),
        (lambda: metrics.sharpness(PICTURE, PICTURE), (0, 3)),
        (lambda: metrics.dark_spots(PICTURE, PICTURE), (0, 3)),
        (lambda: metrics.seed_statistics(torch.rand(2, 0, 12, 17)).mean, (0, 12, 17)),
        (lambda: tone_map(PICTURE), (0, 3, 12, 17)),
        (lambda: gamut_map(PICTURE), (0, 3, 12, 17)),
        (lambda: equal_power(PICTURE, PICTURE), (0, 3, 12, 17)),
        (lambda: deconvolve(ThermalCrosstalk(0.6), PICTURE), (0, 3, 12, 17)),
    ],
)
def test_calls(make, shape):
    result = make()
    assert 0 in result.shape
    if shape is not None:
        assert tuple(result.shape) == shape


@pytest.mark.parametrize("solver", [APG(max_steps=3), LBFGS(max_steps=3)], ids=["APG", "LBFGS"])
def test_solvers(solver):
    problem = PECProblem(ThermalCrosstalk(0.6), Fraunhofer(GRID, WAVELENGTHS), torch.ones(2, *GRID.shape))
    solution = solver(problem, FIELD.real)
    assert solution.x.shape == FIELD.shape and solution.converged.shape == (0, 2)


def test_phase_retrieval():
    found = gerchberg_saxton(Fraunhofer(GRID, WAVELENGTHS), torch.ones(2, *GRID.shape), FIELD.real, max_steps=2)
    assert found.x.shape == FIELD.shape
