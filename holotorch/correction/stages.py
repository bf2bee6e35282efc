"""Solver runs in sequence, each of which starts from the result of the previous one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.correction.lbfgs import LBFGS
from holotorch.correction.problem import PECProblem
from holotorch.correction.run import Box, Callback, Objective, Solution, Solver, State, nonnegative
from holotorch.correction.solvers import APG


@dataclass(frozen=True)
class Stage:
    """One run: the objective, its solver, and the box that bounds the unknown."""

    objective: Objective
    solver: Solver
    box: Box = nonnegative


def run_stages(
    stages: Sequence[Stage], start: Tensor, *, callback: Callback | None = None, resume: State | None = None
) -> Solution:
    """Run ``stages`` one after another from ``start``; ``callback`` and ``resume`` are those of :class:`Solver`.

    The losses of the solution are those of all stages in sequence, each computed by the objective of its stage;
    ``converged`` and ``stalled`` are those of the last stage.
    """
    first, before, inner = 0, None, None
    if resume:
        first, before = int(resume["stage"]), _previous_stages(resume)
        inner = {name.removeprefix("inner_"): resume[name] for name in resume if name.startswith("inner_")}
        start = before.x if before else start
    for k, stage in enumerate(stages[first:], first):

        def report(solution: Solution, k: int = k, before: Solution | None = before) -> None:
            if callback:
                callback(_joined(before, solution, k))

        solution = stage.solver(stage.objective, start, stage.box, callback=report, resume=inner)
        inner = None
        before = _joined(before, solution, k)
        start = before.x
    assert before is not None
    return before


def penalty_schedule(
    make: Callable[..., PECProblem], solver: LBFGS, spread: float, limit: float | None, *, amplitude: bool = True
) -> list[Stage]:
    """Stages of L-BFGS that compute a hologram, with or without a ``limit`` on the phase P(X) after spreading.

    The first stage minimises the loss of the amplitude, whose gradient does not vanish in dark pixels. Without a limit,
    the second and last stage minimises the loss of the intensity. With a limit, the first stage is confined to the box
    X <= limit / sum K, in which no P(X) exceeds the limit. The later stages have no upper bound but a penalty with
    growing weight on P(X) above 98.5 % of the limit, so that ``limit_peak_phase`` has to scale down little afterwards.

    Args:
        make: Function that builds a ``PECProblem`` from its keywords ``amplitude``, ``limit`` and ``limit_weight``.
        solver: L-BFGS, whose ``max_steps`` is the sum over all stages.
        spread: Sum of the kernel K.
        limit: Largest P(X) in rad, or None.
        amplitude: Whether to begin with the loss of the amplitude.
    """
    total, spread = solver.max_steps, checks.positive("spread", spread)
    parts: list[tuple[dict[str, Any], Box, int]]
    if limit is None:
        first = total // 6 if amplitude else 0
        parts = [({"amplitude": True}, nonnegative, first), ({}, nonnegative, total - first)]
    else:
        limit = checks.positive("limit", limit, "rad")
        first = total // 3
        parts = [({"amplitude": amplitude}, Box(0.0, limit / spread), first)]
        ends = [first + round((total - first) * fraction) for fraction in (0.0, 0.3, 0.6, 0.85, 1.0)]
        for weight, (start, end) in zip((1.0, 10.0, 100.0, 1000.0), pairwise(ends), strict=True):
            parts.append(({"limit": 0.985 * limit, "limit_weight": weight}, nonnegative, end - start))
    return [
        Stage(make(**keywords), replace(solver, max_steps=steps), box) for keywords, box, steps in parts if steps > 0
    ]


def proximal_pec(
    crosstalk: Callable[[Tensor], Tensor],
    propagator: Callable[[Tensor], Tensor],
    target: Tensor,
    start: Tensor,
    *,
    solver: Solver | None = None,
    callback: Callback | None = None,
    **options: Any,
) -> Solution:
    """Proximal PEC (PPEC), thesis Algorithm 2: minimise ``PECProblem`` from the heater phases ``start`` in rad.

    With a Fresnel propagator it is the thesis's Fresnel PEC (FPEC). The other arguments are those of ``PECProblem``,
    including ``options``, and of :class:`Solver`; ``solver`` is ``APG()`` by default.
    """
    return (solver or APG())(PECProblem(crosstalk, propagator, target, **options), start, callback=callback)


def limit_peak_phase(limit: float, phase: Tensor, crosstalk: Callable[[Tensor], Tensor]) -> Tensor:
    """Scale down each hologram of ``phase`` [..., H, W] whose phase after spreading exceeds ``limit`` in rad.

    Raises ValueError for a limit that is not finite and above zero, or a phase that is not finite.
    """
    limit = checks.positive("limit", limit, "rad")
    checks.all_finite("phase", phase)
    peak = crosstalk(phase).amax((-2, -1), keepdim=True)
    allowed = limit * (1 - 1e-6)  # with a margin for the rounding of float32
    return torch.where(peak > allowed, phase * (allowed / peak.clamp(min=allowed)), phase)


def _joined(before: Solution | None, now: Solution, k: int) -> Solution:
    """Solution of the stages before k and of stage k, ``now``, with the state to resume from."""
    state = {f"inner_{name}": values for name, values in now.state.items()} | {"stage": torch.tensor(k)}
    if before is None:
        return replace(now, state=state)
    state |= {"before_x": before.x, "before_losses": before.losses, "before_steps": before.steps}
    state["before_evaluations"] = torch.tensor(before.evaluations)
    losses, steps = torch.cat([before.losses, now.losses[1:]]), before.steps + now.steps
    return replace(now, losses=losses, steps=steps, evaluations=before.evaluations + now.evaluations, state=state)


def _previous_stages(state: State) -> Solution | None:
    """Solution of all stages before the interrupted one; None if this is the first stage."""
    if "before_x" not in state:
        return None
    x, losses, steps = (state[f"before_{name}"] for name in ("x", "losses", "steps"))
    never = torch.zeros_like(steps, dtype=torch.bool)
    return Solution(x, losses, steps, never, never, int(state["before_evaluations"]))
