"""Stages: one solver run after another, each from where the last one ended, as one solution."""

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
    """What ``APG``, ``ProjectedAdam`` and ``LBFGS`` are."""

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
    """One run: what is minimised, by what, and within which box."""

    objective: Objective
    solver: Solver
    box: Box = nonnegative


def run_stages(
    stages: Sequence[Stage], start: Tensor, *, callback: Callback | None = None, resume: State | None = None
) -> Solution:
    """Run ``stages`` one after another from ``start``; ``callback`` and ``resume`` as for a single solver.

    The solution's losses are those of all stages in a row, each in the measure of its own objective; ``converged`` and
    ``stalled`` are those of the last.
    """
    first, before, inner = 0, None, None
    if resume:
        first, before = int(resume["stage"]), _unpacked(resume)
        inner = {name[6:]: values for name, values in resume.items() if name.startswith("inner_")}
        start = before.x if before else start
    for k, stage in enumerate(stages[first:], first):

        def seen(solution: Solution, k: int = k, before: Solution | None = before) -> None:
            if callback:
                callback(_joined(before, solution, k))

        solution = stage.solver(stage.objective, start, stage.box, callback=seen, resume=inner)
        inner = None
        before = _joined(before, solution, k)
        start = before.x
    assert before is not None
    return before


def limited(
    make: Callable[..., PECProblem], solver: LBFGS, spread: float, limit: float | None, *, amplitude: bool = True
) -> list[Stage]:
    """Stages by which L-BFGS finds good holograms, within a limit on the phase after spreading if there is one.

    The amplitude's loss comes first, as its gradient does not vanish in dark pixels. With a limit it is minimised in
    the box that certainly keeps it, X <= limit / sum K; then the box is opened and the limit becomes a penalty of
    growing weight, 1.5 % below the limit so that what is left over it can be taken off by scaling.

    Args:
        make: Builds the problem from ``amplitude``, ``limit`` and ``limit_weight``, as keywords of ``PECProblem``.
        solver: Its ``max_steps`` is the sum over all stages.
        spread: Sum of the kernel.
        limit: On P(X), in rad.
        amplitude: Whether to begin with the amplitude's loss.
    """
    whole = solver.max_steps
    spread = checks.positive("spread", spread)
    if limit is not None:
        limit = checks.positive("limit", limit, "rad")
    if limit is None:
        begin = whole // 6 if amplitude else 0
        parts: list[tuple[dict[str, Any], Box, int]] = [({"amplitude": True}, nonnegative, begin)]
        parts.append(({}, nonnegative, whole - begin))
    else:
        box, soft = Box(0.0, limit / spread), {"limit": 0.985 * limit}
        begin = whole // 3
        parts = [({"amplitude": amplitude}, box, begin)]
        ends = [begin + round((whole - begin) * share) for share in (0.0, 0.3, 0.6, 0.85, 1.0)]
        shares = zip((1.0, 10.0, 100.0, 1000.0), ends, ends[1:], strict=False)
        parts += [({**soft, "limit_weight": w}, nonnegative, end - before) for w, before, end in shares]
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
    """Proximal PEC, thesis Algorithm 2: minimise ``PECProblem`` from ``start``; with a Fresnel propagator it is FPEC.

    Args:
        crosstalk: P.
        propagator: F, as for ``PECProblem``.
        target: Wanted intensity.
        start: Heater phases in rad, real [..., C, H, W]; with ``frames=True`` the unknown [..., C, F, H, W] that
            ``PECProblem.unknown`` makes of heater phases [..., F, C, H, W].
        solver: ``APG()`` by default.
        callback: Sees the state after every step.
        options: Further keywords of ``PECProblem``.
    """
    return (solver or APG())(PECProblem(crosstalk, propagator, target, **options), start, callback=callback)


def below(limit: float, phase: Tensor, crosstalk: Callable[[Tensor], Tensor]) -> Tensor:
    """``phase`` [..., H, W] scaled down where its spread passes ``limit`` in rad, hologram by hologram.

    Raises:
        ValueError: A limit that is not finite and above zero, or a phase that is not finite: neither holds anything.
    """
    limit = checks.positive("limit", limit, "rad")
    checks.all_finite("phase", phase)
    peak = crosstalk(phase).amax((-2, -1), keepdim=True)
    held = limit * (1 - 1e-6)  # what float32 rounds may not pass the limit in float64
    return torch.where(peak > held, phase * (held / peak.clamp(min=held)), phase)


def _joined(before: Solution | None, now: Solution, k: int) -> Solution:
    state = {f"inner_{name}": values for name, values in now.state.items()} | {"stage": torch.tensor(k)}
    if before is None:
        return replace(now, state=state)
    state |= {
        "before_x": before.x,
        "before_losses": before.losses,
        "before_steps": before.steps,
        "before_evaluations": torch.tensor(before.evaluations),
    }
    losses = torch.cat([before.losses, now.losses[1:]])
    return Solution(
        now.x,
        losses,
        before.steps + now.steps,
        now.converged,
        now.stalled,
        before.evaluations + now.evaluations,
        state,
    )


def _unpacked(state: State) -> Solution | None:
    if "before_x" not in state:
        return None
    steps = state["before_steps"]
    never = torch.zeros_like(steps, dtype=torch.bool)
    evaluations = int(state["before_evaluations"])
    return Solution(state["before_x"], state["before_losses"], steps, never, never, evaluations)
