"""A run that is stopped and resumed is the run that was not, to the bit."""

import io
from collections.abc import Collection
from dataclasses import replace
from functools import cache

import pytest
import torch

from holotorch import Grid
from holotorch.correction import (
    APG,
    LBFGS,
    PECProblem,
    ProjectedAdam,
    Solution,
    Stage,
    penalty_schedule,
    run_stages,
    spread_preconditioner,
)
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer

CROSSTALK = ThermalCrosstalk(0.8, 7)
RULE = {"max_steps": 30, "tolerance": 0.01, "patience": 2}  # of two items, one settles before the other
SOLVERS = {
    "APG": APG(**RULE),
    "APG, free": APG(grow=1.3, restart=True, **RULE),
    "ProjectedAdam": ProjectedAdam(**RULE),
    "LBFGS": LBFGS(**RULE),
    "LBFGS, preconditioned": LBFGS(2, spread_preconditioner(CROSSTALK.kernel), **RULE),
}
STEPS = LBFGS(3, spread_preconditioner(CROSSTALK.kernel), max_steps=24, tolerance=0)
AFTER, AFTER_STAGES = (1, 4, 9), (1, 4, 5, 8, 9, 13, 20, 23)  # steps in which runs are stopped
each_solver = pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)


class Interrupted(Exception):
    pass


def make_problem(**options) -> PECProblem:
    generator = torch.Generator().manual_seed(4)
    target = torch.rand(2, 12, 17, generator=generator, dtype=torch.float64) ** 4
    propagator = Fraunhofer(Grid((12, 17), 9e-6), [630e-9, 530e-9])
    return PECProblem(CROSSTALK, propagator, target / target.mean((-2, -1), keepdim=True), **options)


def beginning() -> torch.Tensor:
    return torch.rand(2, 12, 17, generator=torch.Generator().manual_seed(8), dtype=torch.float64) * 6


def interrupted(run, after: Collection[int]) -> dict[int, dict]:
    """The states that the callback of ``run`` sees in the steps ``after``, in the last of which it ends the run.

    Each goes through a file.
    """
    files: dict[int, io.BytesIO] = {}
    step = 0

    def stop(now: Solution):
        nonlocal step
        step += 1
        if step in after:
            torch.save(now.state, files.setdefault(step, io.BytesIO()))
        if step == max(after):
            raise Interrupted

    with pytest.raises(Interrupted):
        run(callback=stop)
    states = {}
    for step, file in files.items():
        file.seek(0)
        states[step] = torch.load(file, weights_only=True)
    return states


@cache
def whole_and_states(name: str) -> tuple[Solution, dict[int, dict]]:
    """The run of a solver that was not stopped, and its states where it was."""
    problem, start, solver = make_problem(), beginning(), SOLVERS[name]
    return solver(problem, start), interrupted(lambda callback: solver(problem, start, callback=callback), AFTER)


@cache
def stages_and_states(limit: float | None) -> tuple[list[Stage], Solution, dict[int, dict]]:
    """A penalty schedule, its run that was not stopped, and the states where it was."""
    stages, start = penalty_schedule(make_problem, STEPS, CROSSTALK.total, limit), beginning()
    states = interrupted(lambda callback: run_stages(stages, start, callback=callback), AFTER_STAGES)
    return stages, run_stages(stages, start), states


def assert_same(resumed: Solution, whole: Solution):
    assert torch.equal(resumed.x, whole.x) and torch.equal(resumed.losses, whole.losses)
    assert torch.equal(resumed.steps, whole.steps) and resumed.evaluations == whole.evaluations
    assert torch.equal(resumed.converged, whole.converged) and torch.equal(resumed.stalled, whole.stalled)
    assert resumed.state.keys() == whole.state.keys()
    for name, values in whole.state.items():
        assert torch.equal(resumed.state[name], values), name


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("after", AFTER)
def test_resumed_after_an_interruption(name, after):
    whole, states = whole_and_states(name)
    assert_same(SOLVERS[name](make_problem(), beginning(), resume=states[after]), whole)


@pytest.mark.parametrize("name", SOLVERS)
def test_more_steps_than_were_asked_for_at_first(name):
    problem, start = make_problem(), beginning()
    short = replace(SOLVERS[name], max_steps=6)(problem, start)
    assert_same(SOLVERS[name](problem, start, resume=short.state), whole_and_states(name)[0])


@each_solver
def test_a_finished_run_does_not_go_on(solver):
    problem, start = make_problem(), beginning()
    solver = replace(solver, tolerance=0.2)
    whole = solver(problem, start)
    assert whole.converged.all() and whole.steps.max() < RULE["max_steps"]
    assert_same(solver(problem, start, resume=whole.state), whole)


@pytest.mark.parametrize("limit", [None, 12.0])
@pytest.mark.parametrize("after", AFTER_STAGES)
def test_stages_resume_within_and_between_each_other(limit, after):
    stages, whole, states = stages_and_states(limit)
    assert_same(run_stages(stages, beginning(), resume=states[after]), whole)
    assert_same(run_stages(stages, beginning(), resume=whole.state), whole)


def test_stages_of_different_solvers_resume():
    stages = [Stage(make_problem(), solver) for solver in SOLVERS.values()]
    whole = run_stages(stages, beginning())
    after = (3, 20, len(whole.losses) - 2)
    states = interrupted(lambda callback: run_stages(stages, beginning(), callback=callback), after)
    for step in after:
        assert_same(run_stages(stages, beginning(), resume=states[step]), whole)


def assert_states_stay(run):
    """No state that a callback has seen is changed by later steps."""
    seen: list[tuple[Solution, dict, torch.Tensor]] = []
    last = run(lambda now: seen.append((now, {name: v.clone() for name, v in now.state.items()}, now.losses.clone())))
    assert len(seen) == len(last.losses) - 1
    for now, state, losses in seen:
        assert torch.equal(now.losses, losses) and torch.equal(now.x, seen[len(losses) - 2][0].x)
        for name, values in state.items():
            assert torch.equal(now.state[name], values), name


@each_solver
def test_states_do_not_change_later(solver):
    assert_states_stay(lambda callback: solver(make_problem(), beginning(), callback=callback))


def test_states_of_stages_do_not_change_later():
    stages = penalty_schedule(make_problem, STEPS, CROSSTALK.total, 12.0)
    assert_states_stay(lambda callback: run_stages(stages, beginning(), callback=callback))


@each_solver
def test_resuming_leaves_the_state_as_it_was(solver):
    problem, start = make_problem(), beginning()
    state = replace(solver, max_steps=5)(problem, start).state
    before = {name: values.clone() for name, values in state.items()}
    solver(problem, start, resume=state)
    assert all(torch.equal(state[name], values) for name, values in before.items())


@each_solver
def test_refuses_a_state_of_another_run(solver):
    problem, start = make_problem(), beginning()
    state = replace(solver, max_steps=5)(problem, start).state
    with pytest.raises(
        ValueError, match=r"resume holds x of \(2, 12, 17\) torch.float64, the start is \(1, 2, 12, 17\)"
    ):
        solver(problem, start[None], resume=state)
    with pytest.raises(ValueError, match=r"resume holds x of .* torch.float64, the start is .* torch.float32"):
        solver(problem, start.float(), resume=state)
    with pytest.raises(ValueError, match="resume has taken 5 steps already, more than max_steps 4"):
        replace(solver, max_steps=4)(problem, start, resume=state)


@pytest.mark.parametrize("limit", [None, 12.0])
@pytest.mark.parametrize("steps", [1, 2, 3, 7, 8, 24, 50])
def test_a_penalty_schedule_shares_all_steps_among_its_stages(limit, steps):
    stages = penalty_schedule(make_problem, replace(STEPS, max_steps=steps), CROSSTALK.total, limit)
    assert sum(stage.solver.max_steps for stage in stages if isinstance(stage.solver, LBFGS)) == steps
    assert len(run_stages(stages, beginning()).losses) == steps + 1
