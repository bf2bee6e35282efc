"""Targets, arrays and crosstalk on which solvers could fail silently: each is solved, or refused in words."""

import math

import pytest
import torch

from holotorch import Grid
from holotorch.correction import (
    APG,
    LBFGS,
    PECProblem,
    ProjectedAdam,
    Stage,
    penalty_schedule,
    proximal_pec,
    run_stages,
    spread_preconditioner,
)
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer, Fresnel

pytestmark = pytest.mark.filterwarnings("ignore:target has a mean")  # dimmed targets are among the hard ones

SOLVERS = {"APG": APG, "ProjectedAdam": ProjectedAdam, "LBFGS": LBFGS}


def make(target: torch.Tensor, crosstalk: ThermalCrosstalk, **options) -> PECProblem:
    shape = (target.shape[-2], target.shape[-1])
    return PECProblem(crosstalk, Fraunhofer(Grid(shape, 9e-6), 530e-9), target, **options)


def solvers(crosstalk: ThermalCrosstalk, steps: int = 25):
    precondition = spread_preconditioner(crosstalk.kernel)
    return APG(max_steps=steps), LBFGS(3, precondition, max_steps=steps)


def hot(shape, dtype=torch.float32):
    return torch.rand(1, *shape, dtype=dtype) * 2 * math.pi


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("value", [0.0, 2.0])
def test_a_uniform_start_of_a_fourier_hologram_is_refused(name, value):
    """Without crosstalk a uniform array of any phase is stationary; with it, only the cold one."""
    crosstalk = ThermalCrosstalk(0.66, 7) if value == 0 else ThermalCrosstalk(0)
    problem = make(torch.rand(1, 16, 16) + 0.1, crosstalk)
    start = torch.full((1, 16, 16), value)
    with pytest.raises(ValueError, match=r"gradient vanishes at the start of item \(0,\).*random phases"):
        SOLVERS[name]()(problem, start)
    with pytest.raises(ValueError, match="gradient vanishes at the start"):
        run_stages([Stage(problem, SOLVERS[name]())], start)
    with pytest.raises(ValueError, match="gradient vanishes at the start"):
        run_stages(
            penalty_schedule(lambda **options: make(problem.target, crosstalk, **options), LBFGS(), 1.44, None), start
        )
    with pytest.raises(ValueError, match="gradient vanishes at the start"):
        proximal_pec(problem.crosstalk, problem.propagator, problem.target, start, solver=SOLVERS[name]())


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.2, 0.25, 0.3, 0.33])
def test_narrow_crosstalk_makes_no_denormal_numbers(sigma):
    crosstalk = ThermalCrosstalk(sigma, 7)
    point = torch.zeros(15, 15)
    point[7, 7] = 1
    spread, tiny = crosstalk(point), torch.finfo(torch.float32).tiny
    assert ((spread == 0) | (spread >= tiny)).all() and ((crosstalk.kernel == 0) | (crosstalk.kernel >= tiny)).all()
    for solver in solvers(crosstalk):
        solution = solver(make(torch.rand(1, 15, 15) + 0.1, crosstalk), hot((15, 15)))
        assert solution.losses[-1] < solution.losses[0] and torch.isfinite(solution.x).all()


@pytest.mark.parametrize("size", [7, None], ids=["7 taps", "all taps"])
@pytest.mark.parametrize("sigma", [1.66, 1.6686, 1.68, 2.0])
def test_crosstalk_that_erases_patterns_is_solved(sigma, size):
    crosstalk = ThermalCrosstalk(sigma, size)
    target = torch.rand(1, 24, 24) + 0.1
    for solver in solvers(crosstalk):
        solution = solver(make(target / target.mean(), crosstalk), hot((24, 24)))
        assert torch.isfinite(solution.x).all() and torch.isfinite(solution.losses).all()
        assert solution.losses[-1] < 0.5 * solution.losses[0]


def picture(kind: str, height: int = 16, width: int = 16) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = {
        "white": torch.ones(height, width),
        "checkerboard": ((x + y) % 2).float(),
        "single pixel": ((x == 3) & (y == 5)).float(),
        "half black": (x < width // 2).float(),
    }[kind]
    return (image / image.mean())[None]


@pytest.mark.parametrize("amplitude", [False, True], ids=["intensity", "amplitude"])
@pytest.mark.parametrize("dimmed", [1.0, 1e-3])
@pytest.mark.parametrize("kind", ["white", "checkerboard", "single pixel", "half black"])
def test_hard_targets(kind, dimmed, amplitude):
    """The loss falls, and well where the target is in reach: dimmed ones are not for a propagation that keeps light.

    APG never lengthens its first step, which a free scale on a dimmed target makes a millionth of what it should be.
    """
    crosstalk = ThermalCrosstalk(0.66, 7)
    for options in ({}, {"scale_free": True}):
        problem = make(dimmed * picture(kind), crosstalk, amplitude=amplitude, **options)
        for solver in solvers(crosstalk, 15):
            solution = solver(problem, hot((16, 16)))
            assert torch.isfinite(solution.x).all() and torch.isfinite(solution.losses).all()
            assert solution.losses[-1] < solution.losses[0] and (solution.x >= 0).all()
            if dimmed == 1 or (options and isinstance(solver, LBFGS)):
                assert solution.losses[-1] < 0.8 * solution.losses[0]


@pytest.mark.parametrize("kind", ["checkerboard", "half black"])
def test_the_scale_of_a_target_does_not_matter_to_a_free_scale(kind):
    crosstalk = ThermalCrosstalk(0.66, 7)
    start = hot((16, 16), torch.float64)
    runs = []
    for scale in (1.0, 1e-3):
        problem = make(scale * picture(kind).double(), crosstalk, scale_free=True)
        runs.append(LBFGS(max_steps=15, tolerance=0)(problem, start))
    # Losses go with the square; the first step is set in radians, so that the steps are the same.
    torch.testing.assert_close(runs[1].losses * 1e6, runs[0].losses, rtol=1e-6, atol=0)


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (5, 5), (1, 64), (63, 65)])
@pytest.mark.parametrize("limit", [None, 9.0])
def test_small_and_odd_arrays(shape, limit):
    crosstalk = ThermalCrosstalk(0.66)
    target = torch.rand(1, *shape) + 0.1
    target = target / target.mean()
    start = hot(shape)
    stages = penalty_schedule(
        lambda **options: make(target, crosstalk, **options), solvers(crosstalk, 24)[1], crosstalk.total, limit
    )
    runs = [lambda: run_stages(stages, start)]
    runs += [lambda solver=solver: solver(make(target, crosstalk), start) for solver in solvers(crosstalk, 24)]
    for run in runs:
        solution = run()
        assert torch.isfinite(solution.x).all() and torch.isfinite(solution.losses).all()
        if shape == (1, 1):  # one pixel has the light it has, and nothing to improve
            assert solution.losses.max() <= 1e-12
        else:
            final = make(target, crosstalk)(solution.x)
            assert final < make(target, crosstalk)(start)


def test_one_pixel_that_cannot_be_improved_is_refused_in_words():
    crosstalk = ThermalCrosstalk(0.66)
    for solver in solvers(crosstalk):
        with pytest.raises(ValueError, match="gradient vanishes at the start"):
            solver(make(torch.full((1, 1, 1), 2.0), crosstalk), hot((1, 1)))


@pytest.mark.parametrize("shape", [(3, 3), (1, 64)])
def test_seven_taps_on_a_smaller_array_are_refused_in_words(shape):
    crosstalk = ThermalCrosstalk(0.66, 7)
    for solver in solvers(crosstalk):
        with pytest.raises(ValueError, match="larger than the array"):
            solver(make(torch.rand(1, *shape) + 0.1, crosstalk), hot(shape))


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
def test_a_cold_start_of_a_fresnel_hologram_is_none_to_refuse():
    """Near the chip a uniform array shows its edges, which is enough of a gradient."""
    target = torch.rand(1, 16, 16) + 0.1
    problem = PECProblem(ThermalCrosstalk(0.66, 7), Fresnel(Grid(16, 9e-6), 530e-9, 5e-3), target / target.mean())
    for solver in solvers(ThermalCrosstalk(0.66, 7)):
        solution = solver(problem, torch.zeros(1, 16, 16))
        assert solution.losses[-1] < solution.losses[0]
