"""Stages: several solver runs in a row, each starting from the result of the one before, as one solution."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.correction.lbfgs import LBFGS
from holotorch.correction.problem import PECProblem
from holotorch.correction.run import Box, Callback, Objective, Solution, State, nonnegative
from holotorch.correction.solvers import APG


class Solver(Protocol):
    """Interface of ``APG``, ``ProjectedAdam`` and ``LBFGS``."""

    def __call__(
        self,
        objective: Objective,
        start: Tensor,
        project: Box = nonnegative,
        *,
        callback: Callback | None = None,
        resume: State | None = None,
    ) -> Solution:
        """Minimise ``objective`` over the set that ``project`` projects onto."""
        ...


@dataclass(frozen=True)
class Stage:
    """One run: the objective, the solver that minimises it, and the box that bounds the unknown."""

    objective: Objective
    solver: Solver
    box: Box = nonnegative


def run_stages(
    stages: Sequence[Stage], start: Tensor, *, callback: Callback | None = None, resume: State | None = None
) -> Solution:
    """Run ``stages`` one after another from ``start``; ``callback`` and ``resume`` as for a single solver.

    The losses of all stages are in a row, each computed by the objective of its stage; ``converged`` and ``stalled``
    are those of the last stage.
    """
    first, before, inner = 0, None, None
    if resume:
        first, before = int(resume["stage"]), _from_state(resume)
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
    """Stages in which L-BFGS computes a hologram, under a limit on the phase after spreading if one is given.

    The first stage minimises the loss of the amplitude, whose gradient does not vanish in dark pixels. Without a limit,
    the second and last stage minimises the loss of the intensity. With a limit, the first stage stays in the box X <=
    limit / sum K, in which no P(X) exceeds the limit; the stages after it have no such box, but a penalty with growing
    weight on P(X) above 98.5 % of the limit. The margin of 1.5 % leaves little for ``limit_peak_phase`` to scale down.

    Args:
        make: Builds the problem from ``amplitude``, ``limit`` and ``limit_weight``, as keywords of ``PECProblem``.
        solver: Its ``max_steps`` is the sum over all stages.
        spread: Sum of the kernel.
        limit: On P(X), in rad.
        amplitude: Whether the first stage minimises the loss of the amplitude.
    """
    total = solver.max_steps
    spread = checks.positive("spread", spread)
    if limit is None:
        first = total // 6 if amplitude else 0
        parts: list[tuple[dict[str, Any], Box, int]] = [({"amplitude": True}, nonnegative, first)]
        parts.append(({}, nonnegative, total - first))
    else:
        limit = checks.positive("limit", limit, "rad")
        first = total // 3
        parts = [({"amplitude": amplitude}, Box(0.0, limit / spread), first)]
        ends = [first + round((total - first) * share) for share in (0.0, 0.3, 0.6, 0.85, 1.0)]
        for weight, begin, end in zip((1.0, 10.0, 100.0, 1000.0), ends, ends[1:], strict=False):
            parts.append(({"limit": 0.985 * limit, "limit_weight": weight}, nonnegative, end - begin))
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
    """Proximal PEC (PPEC), thesis Algorithm 2: minimise ``PECProblem`` from ``start``.

    With a Fresnel propagator it is the thesis's Fresnel PEC (FPEC).

    Args:
        crosstalk: P.
        propagator: F, as for ``PECProblem``.
        target: Wanted intensity.
        start: Heater phases in rad, real [..., C, H, W], or [..., F, C, H, W] with ``frames=True``.
        solver: ``APG()`` by default.
        callback: Called with the solution so far after every step.
        options: Further keywords of ``PECProblem``.
    """
    return (solver or APG())(PECProblem(crosstalk, propagator, target, **options), start, callback=callback)


def limit_peak_phase(limit: float, phase: Tensor, crosstalk: Callable[[Tensor], Tensor]) -> Tensor:
    """Scale down each hologram of ``phase`` [..., H, W] whose phase after spreading exceeds ``limit`` in rad.

    Raises:
        ValueError: A limit that is not finite and above zero, or a phase that is not finite.
    """
    limit = checks.positive("limit", limit, "rad")
    checks.all_finite("phase", phase)
    peak = crosstalk(phase).amax((-2, -1), keepdim=True)
    allowed = limit * (1 - 1e-6)  # the margin is the rounding of float32: in float64 the limit must hold too
    return torch.where(peak > allowed, phase * (allowed / peak.clamp(min=allowed)), phase)


def _joined(before: Solution | None, now: Solution, k: int) -> Solution:
    """Solution ``now`` of stage k behind that of all stages before it, with the state to resume from."""
    state = {f"inner_{name}": values for name, values in now.state.items()} | {"stage": torch.tensor(k)}
    if before is None:
        return replace(now, state=state)
    state |= {"before_x": before.x, "before_losses": before.losses, "before_steps": before.steps}
    state["before_evaluations"] = torch.tensor(before.evaluations)
    losses, steps = torch.cat([before.losses, now.losses[1:]]), before.steps + now.steps
    return replace(now, losses=losses, steps=steps, evaluations=before.evaluations + now.evaluations, state=state)


def _from_state(state: State) -> Solution | None:
    """Solution of all stages before the interrupted one; None in the first stage."""
    if "before_x" not in state:
        return None
    x, losses, steps = (state[f"before_{name}"] for name in ("x", "losses", "steps"))
    never = torch.zeros_like(steps, dtype=torch.bool)
    return Solution(x, losses, steps, never, never, int(state["before_evaluations"]))
