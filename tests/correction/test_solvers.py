import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from host_reads import HostReads
from scipy.optimize import nnls

from holotorch import Grid
from holotorch.correction import APG, LBFGS, PECProblem, ProjectedAdam, Solution, nonnegative
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer

SOLVERS = [APG(), ProjectedAdam(), LBFGS()]
each_solver = pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)


class LeastSquares:
    """|| M x - b ||^2 per item; its constrained minimum is known from SciPy."""

    def __init__(self, items: int):
        generator = np.random.default_rng(5)
        self.matrix = torch.as_tensor(generator.normal(size=(items, 12, 6)))
        self.wanted = torch.as_tensor(generator.normal(size=(items, 12)))

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return ((self.matrix @ x.flatten(-2)[..., None])[..., 0] - self.wanted).square().sum(-1)

    def best(self) -> torch.Tensor:
        pairs = zip(self.matrix.numpy(), self.wanted.numpy(), strict=True)
        return torch.as_tensor(np.stack([nnls(matrix, wanted)[0] for matrix, wanted in pairs])).view(-1, 2, 3)


def pec_problem(channels: int = 2, dtype: torch.dtype = torch.float64) -> tuple[PECProblem, torch.Tensor]:
    grid = Grid(16, 9e-6)
    target = torch.rand(channels, 16, 16, dtype=dtype) + 0.05
    problem = PECProblem(
        ThermalCrosstalk(0.66), Fraunhofer(grid, [530e-9] * channels), target / target.mean((-2, -1), keepdim=True)
    )
    return problem, torch.rand(channels, 16, 16, dtype=dtype) * 2 * math.pi


@pytest.mark.parametrize(
    "solver",
    [
        APG(max_steps=3000, tolerance=1e-12),
        ProjectedAdam(learning_rate=0.01, max_steps=6000, tolerance=1e-12),
        LBFGS(tolerance=1e-12),
    ],
    ids=["APG", "ProjectedAdam", "LBFGS"],
)
def test_finds_the_constrained_minimum_and_says_converged(solver):
    problem = LeastSquares(4)
    solution = solver(problem, torch.ones(4, 2, 3, dtype=torch.float64))
    torch.testing.assert_close(solution.x, problem.best(), rtol=0, atol=1e-4)
    assert solution.converged.all() and not solution.stalled.any()
    assert (problem.best() == 0).any() and (problem.best() > 0).any()  # the constraint is at work


def test_apg_takes_the_steps_of_algorithm_2():
    """Two iterations, written out by hand from the page, on one item."""
    problem, start = pec_problem(1)

    def value_and_gradient(x):
        x = x.clone().requires_grad_()
        loss = problem(x).sum()
        return loss.item(), torch.autograd.grad(loss, x)[0]

    tau, beta, x, before = 1.0, 0.5, start, start
    losses = [problem(start).item()]
    for k in range(2):
        y = x + k / (k + 3) * (x - before)
        value, gradient = value_and_gradient(y)
        while True:
            z = (y - tau * gradient).clamp(min=0)
            bound = value + (gradient * (z - y)).sum().item() + (z - y).square().sum().item() / (2 * tau)
            if problem(z).item() <= bound:
                break
            tau *= beta
        before, x = x, z
        losses.append(problem(z).item())

    solution = APG(step=1.0, shrink=0.5, max_steps=2)(problem, start)
    torch.testing.assert_close(solution.x, x, rtol=1e-12, atol=1e-12)
    assert solution.losses[:, 0].tolist() == pytest.approx(losses, rel=1e-12)
    assert tau < 1  # the search was exercised


@each_solver
def test_a_batch_gives_what_its_items_give_alone(solver):
    problem, start = pec_problem(1)
    # In each step of L-BFGS rounding grows by a tenth, as does a change of the start by 1e-15: to 1e-11 in 40 steps.
    # With the others, items settle soon, each in a step of its own.
    solver = replace(solver, max_steps=40) if isinstance(solver, LBFGS) else replace(solver, tolerance=0.01)
    starts = torch.stack([start, start.flip(-1) * 0.3, start * 2])
    together = solver(problem, starts)
    assert isinstance(solver, LBFGS) or (together.converged.all() and len(together.steps.unique()) == 3)
    for i in range(3):
        alone = solver(problem, starts[i])
        torch.testing.assert_close(together.x[i], alone.x, rtol=1e-9, atol=1e-9)
        assert together.steps[i].item() == alone.steps.item()
        assert together.converged[i].item() == alone.converged.item()
    if isinstance(solver, APG):
        assert (together.losses[1:] <= together.losses[:-1] * (1 + 1e-9)).float().mean() > 0.8


@each_solver
def test_history_counts_and_callback(solver):
    problem, start = pec_problem()
    seen: list[Solution] = []
    calls = 0

    def counted(x):
        nonlocal calls
        calls += 1
        return problem(x)

    solution = solver(counted, start, callback=seen.append)
    assert len(seen) == len(solution.losses) - 1 == solution.steps.max()
    assert solution.losses.shape == (len(seen) + 1, 2)
    assert solution.evaluations == calls == seen[-1].evaluations
    torch.testing.assert_close(solution.losses[0], problem(nonnegative(start)))
    torch.testing.assert_close(solution.losses[-1], problem(solution.x))
    assert (solution.x >= 0).all()
    first = seen[0].losses[-1].clone()
    torch.testing.assert_close(first, solution.losses[1])


@each_solver
def test_stop_rule_of_equation_4_36(solver):
    problem, start = pec_problem(1)
    solution = replace(solver, tolerance=0.02, patience=5, max_steps=2000)(problem, start)
    assert solution.converged.all()
    losses = solution.losses[:, 0]
    change = (losses[1:] - losses[:-1]).abs() / losses[:-1]
    assert (change[-5:] < 0.02).all()
    calm = (change < 0.02).float().unfold(0, 5, 1).sum(-1)
    assert (calm[:-1] < 5).all()  # it stopped the first time that the rule held


@each_solver
def test_out_of_steps_is_not_converged(solver):
    problem, start = pec_problem(1)
    solution = replace(solver, max_steps=3)(problem, start)
    assert not solution.converged.any() and solution.steps.item() == 3


@each_solver
def test_a_solved_item_stays_where_it_is(solver):
    def distance(x):
        return (x - 1).square().sum((-2, -1))

    start = torch.stack([torch.ones(1, 2, 2), torch.full((1, 2, 2), 5.0)]).double()
    solution = solver(distance, start)
    assert torch.equal(solution.x[0], start[0])
    assert solution.steps[0].item() == 0 and solution.converged[0].item()


@each_solver
def test_float32_descends_without_stalling(solver):
    problem, start = pec_problem(2, torch.float32)
    solution = solver(problem, start)
    assert solution.x.dtype == torch.float32
    assert (solution.losses[-1] < 0.05 * solution.losses[0]).all()
    assert not solution.stalled.any()


@each_solver
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_says_when_the_start_is_a_stationary_point(solver, dtype):
    # A uniform phase puts all light into one sample of the far field; only rounding moves it from there.
    problem, start = pec_problem(2, dtype)
    start[1] = 0
    with pytest.raises(ValueError, match=r"gradient vanishes at the start of item \(1,\).*random phases"):
        solver(problem, start)


@each_solver
@pytest.mark.parametrize(
    ("objective", "start", "message"),
    [
        (lambda x: x.square().sum((-2, -1)), torch.full((1, 2, 2), float("nan")), "start must be finite"),
        (lambda x: x.log().sum((-2, -1)), torch.zeros(1, 2, 2), "loss at the start must be finite"),
        (
            lambda x: x.square().sum().expand(3),
            torch.ones(1, 2, 2),
            r"one loss per item, the first axes of \(1, 2, 2\)",
        ),
        (lambda x: x.square(), torch.ones(1, 2, 2), r"one loss per item, .*, got \(1, 2, 2\)"),
        (lambda x: -x.square().sum((-2, -1)), torch.ones(1, 2, 2), "objective must not be negative, got -4"),
    ],
)
def test_refuses_a_start_or_an_objective_that_cannot_be_used(solver, objective, start, message):
    with pytest.raises(ValueError, match=message):
        solver(objective, start)


def test_apg_says_stalled_when_no_step_is_accepted_and_keeps_what_it_has():
    def cliff(x):  # a finite gradient, and no finite value anywhere below
        value = x.square().sum((-2, -1))
        return torch.where(value < 16, torch.full_like(value, float("nan")), value)

    start = torch.full((1, 2, 2), 2.0, dtype=torch.float64)
    solution = APG()(cliff, start)
    assert solution.stalled.all() and not solution.converged.any()
    assert torch.isfinite(solution.x).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: APG(step=0.0), "step must be above zero"),
        (lambda: APG(step=float("nan")), "step must be finite"),
        (lambda: APG(shrink=1.0), "shrink must lie between 0 and 1"),
        (lambda: APG(max_steps=0), "max_steps must be at least 1"),
        (lambda: APG(max_steps=2.5), "max_steps must be a whole number, got float 2.5"),  # type: ignore[arg-type]
        (lambda: APG(max_steps=True), "max_steps must be a whole number, got bool True"),
        (lambda: APG(tolerance=-1.0), "tolerance must be (at least zero|finite)"),
        (lambda: APG(tolerance=float("nan")), "tolerance must be (at least zero|finite)"),
        (lambda: ProjectedAdam(learning_rate=-0.1), "learning_rate must be above zero"),
        (lambda: ProjectedAdam(patience=0), "at least 1"),
        (lambda: ProjectedAdam(final=0.0), "final must be above 0 and at most 1"),
        (lambda: APG(grow=0.5), "grow must be at least 1"),
        (lambda: LBFGS(memory=0), "memory must be at least 1"),
        (lambda: LBFGS(first=0.0), "first must be above zero"),
    ],
)
def test_refuses_impossible_settings(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


@each_solver
def test_a_complex_start_is_named(solver):
    problem, start = pec_problem()
    with pytest.raises(TypeError, match="start must be a real floating-point tensor, got torch.complex128"):
        solver(problem, start.to(torch.complex128))


@each_solver
@pytest.mark.parametrize("weights", [(1.0, 1.0), (0.0, 1.0)], ids=["all active", "one is done"])
def test_a_step_reads_one_number_back(solver, weights):
    """Each read makes a GPU wait; a trial that is refused takes another."""
    problem, start = pec_problem()
    single = 2 if isinstance(solver, APG) else 1  # evaluations of a step whose first trial is accepted
    seen: list[tuple[int, int]] = []
    with HostReads() as reads:
        replace(solver, max_steps=30, tolerance=0.0)(
            lambda x: problem(x) * torch.tensor(weights),
            start,
            callback=lambda solution: seen.append((solution.evaluations, reads.count)),
        )
    steps = [(after[1] - before[1]) for before, after in pairwise(seen) if after[0] - before[0] == single]
    assert len(steps) > 10 and set(steps) == {1}


class _Drawn:
    """The squared distance from one of two points, another one in each step."""

    def __init__(self):
        self.steps: list[int] = []

    def at_step(self, step: int) -> None:
        self.steps.append(step)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return (x - (1.0 if len(self.steps) % 2 else 3.0)).square().sum((-2, -1))


def test_a_falling_learning_rate_settles_between_the_minima_of_an_objective_that_changes():
    start, rest = torch.full((1, 4, 4), 2.5, dtype=torch.float64), {"max_steps": 200, "tolerance": 0.0}
    changed = _Drawn()
    settled = ProjectedAdam(0.2, final=0.01, **rest)(changed, start).x
    assert changed.steps == list(range(1, 201))
    restless = ProjectedAdam(0.2, **rest)(_Drawn(), start).x
    # Steps around the middle are as long as the rate, which falls to a hundredth.
    assert (settled - 2).abs().max() < 0.1 * (restless - 2).abs().max()
