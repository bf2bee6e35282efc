"""Heater phases [..., F, C, H, W] of frames that share an image: the layout is the same in problems and solvers."""

import numpy as np
import pytest
import torch
from oracles import dense, pec
from torch import nn

from holotorch import Grid, correction
from holotorch.correction import APG, LBFGS, PECProblem, ProjectedAdam, proximal_pec
from holotorch.modulator import HeatCycle, ThermalCrosstalk
from holotorch.optics import Fraunhofer

GRID, WAVELENGTHS = Grid((6, 7), 9e-6), (630e-9, 530e-9)
SOLVERS = {"APG": APG(max_steps=8), "ProjectedAdam": ProjectedAdam(max_steps=8), "LBFGS": LBFGS(max_steps=8)}


def setting(frames: int, *batch: int):
    target = torch.rand(2, *GRID.shape, dtype=torch.float64) + 0.1
    target = target / target.mean((-2, -1), keepdim=True)
    problem = PECProblem(ThermalCrosstalk(0.8, 5), Fraunhofer(GRID, WAVELENGTHS), target, frames=True)
    return problem, torch.rand(*batch, frames, 2, *GRID.shape, dtype=torch.float64) * 4


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_image_is_the_mean_over_the_first_axis_of_the_frames(frames):
    """With two frames of two colours no shape tells the axes apart."""
    problem, phase = setting(frames)
    single = PECProblem(problem.crosstalk, problem.propagator, problem.target)
    wanted = torch.stack([single.intensity(each) for each in phase]).mean(0)
    torch.testing.assert_close(problem.intensity(phase), wanted, rtol=1e-13, atol=0)
    torch.testing.assert_close(problem(phase), single.misfit(wanted), rtol=1e-13, atol=0)


def test_one_frame_has_the_loss_of_the_oracle():
    problem, phase = setting(1)
    matrix = dense.convolution(GRID.shape, dense.heat_kernel(0.8, 5))
    transform = dense.centred_unitary_dft(GRID.shape)
    wanted = [
        pec.objective(phase[0, c].numpy().ravel(), problem.target[c].numpy().ravel(), matrix, transform) for c in (0, 1)
    ]
    np.testing.assert_allclose(problem(phase), wanted, rtol=1e-12)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_colours_and_holograms_are_independent_items(name, frames):
    """A colour alone takes the same steps as beside another one, and so does a hologram of a batch."""
    problem, start = setting(frames, 3)
    together = SOLVERS[name](problem, start)
    assert together.x.shape == start.shape and together.losses.shape[1:] == (3, 2)
    for c, wavelength in enumerate(WAVELENGTHS):
        target = problem.target[c : c + 1]
        single = PECProblem(problem.crosstalk, Fraunhofer(GRID, wavelength), target, frames=True)
        for i in range(3):
            alone = SOLVERS[name](single, start[i, :, c : c + 1])
            # Eight steps amplify the rounding of 1e-16 by less than 1e6.
            torch.testing.assert_close(together.x[i, :, c : c + 1], alone.x, rtol=0, atol=1e-9)
            torch.testing.assert_close(together.losses[:, i, c : c + 1], alone.losses, rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", SOLVERS)
def test_an_objective_may_name_any_axes_of_its_items(name):
    """The losses of x [2, B, 3] are [B] where the first and the last axis belong to an item."""

    wanted = torch.rand(2, 4, 3, dtype=torch.float64)

    class Distance:
        unknown_axes: tuple[int, ...] = (-3, -1)

        def __call__(self, x):
            return (x - wanted).square().sum((0, 2))

    solution = SOLVERS[name](Distance(), torch.ones(2, 4, 3, dtype=torch.float64))
    assert solution.losses.shape[1:] == (4,) and (solution.losses[-1] < solution.losses[0]).all()
    Distance.unknown_axes = (-1,)
    with pytest.raises(ValueError, match=r"one loss per item, axes \[0, 1\] of \(2, 4, 3\), got \(4,\)"):
        SOLVERS[name](Distance(), torch.ones(2, 4, 3, dtype=torch.float64))


def test_proximal_pec_takes_frames():
    problem, start = setting(2)
    options = {"solver": APG(max_steps=3), "frames": True}
    solution = proximal_pec(problem.crosstalk, problem.propagator, problem.target, start, **options)
    assert torch.equal(solution.x, APG(max_steps=3)(problem, start).x)


def test_other_layouts_are_refused():
    problem, _ = setting(3)
    with pytest.raises(ValueError, match=r"phase must end in \(F, C, H, W\), as frames=True has it, got \(2, 6, 7\)"):
        problem(torch.rand(2, 6, 7))
    with pytest.raises(ValueError, match=r"must end in \(C, H, W\) = \(2, 6, 7\), got \(2, 3, 6, 7\)"):
        problem(torch.rand(2, 3, 6, 7))


@pytest.mark.parametrize(("old", "new"), [("limited", "penalty_schedule"), ("below", "limit_peak_phase")])
def test_old_names_still_work_and_warn(old, new):
    with pytest.warns(DeprecationWarning, match=f"holotorch.correction.{old} is now called {new}"):
        assert getattr(correction, old) is getattr(correction, new)
    with pytest.raises(AttributeError, match="has no attribute 'belows'"):
        _ = correction.belows


def test_the_laser_weights_the_frames_and_can_be_learned():
    problem, phase = setting(3)
    powers = torch.rand(3, 2, dtype=torch.float64) + 0.5
    images = torch.stack([problem.intensity(each[None]) for each in phase])
    weighted = PECProblem(problem.crosstalk, problem.propagator, problem.target, frames=True, laser=powers)
    wanted = (powers[..., None, None] * images).mean(0)
    torch.testing.assert_close(weighted.intensity(phase), wanted, rtol=1e-12, atol=0)
    laser = nn.Parameter(torch.ones(3, 2))
    learned = PECProblem(problem.crosstalk, problem.propagator, wanted, frames=True, laser=laser)
    optimiser = torch.optim.Adam([laser], lr=0.05)
    for _ in range(400):
        optimiser.zero_grad()
        learned(phase).sum().backward()
        optimiser.step()
    torch.testing.assert_close(laser.detach().double(), powers, rtol=0, atol=2e-2)


def test_a_laser_shines_at_every_moment_of_its_frame():
    problem, phase = setting(3)
    powers = torch.rand(3, 2, dtype=torch.float64)
    cycle = HeatCycle(
        ThermalCrosstalk(0.8, 5), 1.0, 1e-3, moments=(0.5, 1.0)
    )  # nothing is left, so both moments are equal
    one, two = (
        PECProblem(heat, problem.propagator, problem.target, frames=True, laser=powers).intensity(phase)
        for heat in (problem.crosstalk, cycle)
    )
    torch.testing.assert_close(one, two, rtol=1e-12, atol=0)


@pytest.mark.parametrize("laser", [torch.ones(3), -torch.ones(3, 2), torch.ones(3, 2, requires_grad=True)])
def test_wrong_powers_are_refused(laser):
    problem, _ = setting(3)
    with pytest.raises(ValueError, match="laser"):
        PECProblem(problem.crosstalk, problem.propagator, problem.target, frames=True, laser=laser)


def test_powers_of_other_frames_are_refused():
    problem, phase = setting(3)
    two = PECProblem(problem.crosstalk, problem.propagator, problem.target, frames=True, laser=torch.ones(2, 2))
    with pytest.raises(ValueError, match="frames of laser, 2, got 3"):
        two(phase)
    with pytest.raises(ValueError, match="with frames=False"):
        PECProblem(problem.crosstalk, problem.propagator, problem.target, laser=torch.ones(2, 2))
