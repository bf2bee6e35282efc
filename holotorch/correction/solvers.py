"""Solvers: frozen dataclasses that are called with an objective, a start and a projection.

An objective maps x [..., C, H, W] to one loss per leading index, [..., C], that is never negative and 0 for a perfect
fit, as sums of squares are. The items are independent: each has its own step length and its own stop, so a batch gives
what its items give alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks

Objective = Callable[[Tensor], Tensor]
Projection = Callable[[Tensor], Tensor]
Callback = Callable[["Solution"], None]


def nonnegative(x: Tensor) -> Tensor:
    """Project onto x >= 0, since heaters cannot cool: the proximal operator of Eq. 4.13."""
    return x.clamp(min=0)


@dataclass(frozen=True)
class Solution:
    """What a solver found, or has so far.

    Attributes:
        x: The unknown, [..., C, H, W].
        losses: Loss at the start and after each step, [steps + 1, ..., C]; an item that has stopped repeats its last.
        steps: Steps that each item took, integer [..., C].
        converged: Whether each item met the stop rule, [..., C]; False where it ran out of steps or stalled.
        stalled: Whether each item stopped because no step, however short, was accepted, [..., C].
        evaluations: How often the objective was evaluated, with or without its gradient.
    """

    x: Tensor
    losses: Tensor
    steps: Tensor
    converged: Tensor
    stalled: Tensor
    evaluations: int


@dataclass(frozen=True)
class APG:
    """Accelerated proximal gradient with a backtracking step: thesis Algorithm 2 and Eq. 4.14.

    The printed test g(Z) < g' gets a rounding slack, without which it can never hold near convergence and the step
    collapses. As printed, the step only shrinks.

    Attributes:
        step: First step length tau.
        shrink: Factor beta in (0, 1) on a refused step.
        max_steps: Most iterations.
        tolerance: Stop an item once its relative change of loss (Eq. 4.36) stays below this ...
        patience: ... for so many iterations in a row.

    Raises:
        ValueError: A field out of range; in a call: a start that is not finite, whose loss is negative or not finite,
            or whose gradient vanishes although its loss does not (X = 0 is such a point for a Fourier hologram).
    """

    step: float = 1.0
    shrink: float = 0.5
    max_steps: int = 400
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        checks.positive("step", self.step)
        if not 0 < self.shrink < 1:
            raise ValueError(f"shrink must lie between 0 and 1, got {self.shrink!r}")
        _check_stop_rule(self.max_steps, self.tolerance, self.patience)

    def __call__(
        self,
        objective: Objective,
        start: Tensor,
        project: Projection = nonnegative,
        *,
        callback: Callback | None = None,
    ) -> Solution:
        """Minimise ``objective`` over the set that ``project`` projects onto, from ``start`` [..., C, H, W].

        ``callback`` sees the state after every step.
        """
        run = _Run(objective, project(start), self.max_steps, self.tolerance, self.patience)
        previous = run.x
        step = torch.full_like(run.x[..., :1, :1], self.step)
        for k in range(self.max_steps):
            y = run.x + k / (k + 3) * (run.x - previous)
            value, gradient = run.value_and_gradient(y)
            x, loss, step, stalled = self._descend(run, project, y, value, gradient, step)
            previous = run.x
            run.advance(x, loss, stalled)
            if callback:
                callback(run.solution())
            if not run.active.any():
                break
        return run.solution()

    def _descend(self, run: "_Run", project: Projection, y, value, gradient, step):
        """One proximal step from ``y``, its length shortened per item until Beck and Teboulle's bound holds."""
        slack = 8 * torch.finfo(y.dtype).eps * value
        least = self.step * torch.finfo(y.dtype).eps ** 2
        shortened = torch.zeros_like(run.active)
        while True:
            z = project(y - step * gradient)
            moved = z - y
            loss = run.value(z)
            bound = value + (gradient * moved).sum((-2, -1)) + moved.square().sum((-2, -1)) / (2 * step[..., 0, 0])
            refused = run.active & ~(loss <= bound + slack)
            stalled = refused & (step[..., 0, 0] <= least)
            if not (refused & ~stalled).any():
                # Shortened until nothing moves is no progress either; unmoved at once is a minimum on the border.
                stalled = stalled | (shortened & (moved == 0).all(-1).all(-1))
                return z, loss, step, stalled
            step = torch.where(refused[..., None, None], step * self.shrink, step)
            shortened = shortened | refused


@dataclass(frozen=True)
class ProjectedAdam:
    """Adam with a projection after every step.

    Attributes:
        learning_rate: Of Adam, in the unit of the unknown.
        betas: Decay of its two running means.
        max_steps: Most iterations, one evaluation each.
        tolerance: Stop rule as for :class:`APG`.
        patience: Stop rule as for :class:`APG`.

    Raises as :class:`APG`. The loss need not fall at every step; the best point seen is not kept.
    """

    learning_rate: float = 0.1
    betas: tuple[float, float] = (0.9, 0.999)
    max_steps: int = 400
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        checks.positive("learning_rate", self.learning_rate)
        _check_stop_rule(self.max_steps, self.tolerance, self.patience)

    def __call__(
        self,
        objective: Objective,
        start: Tensor,
        project: Projection = nonnegative,
        *,
        callback: Callback | None = None,
    ) -> Solution:
        """Minimise ``objective`` as :meth:`APG.__call__` does."""
        run = _Run(objective, project(start), self.max_steps, self.tolerance, self.patience)
        x = run.x.clone()
        adam = torch.optim.Adam([x], lr=self.learning_rate, betas=self.betas)
        x.grad = run.start_gradient
        for _ in range(self.max_steps):
            adam.step()
            x.copy_(torch.where(run.active[..., None, None], project(x), run.x))
            loss, x.grad = run.value_and_gradient(x)
            run.advance(x.clone(), loss, ~torch.isfinite(loss))
            if callback:
                callback(run.solution())
            if not run.active.any():
                break
        return run.solution()


class _Run:
    """Bookkeeping that solvers share: evaluations, history, and which items still move."""

    def __init__(self, objective: Objective, start: Tensor, max_steps: int, tolerance: float, patience: int):
        checks.real("start", start)
        checks.all_finite("start", start)
        self.objective, self.tolerance, self.patience = objective, tolerance, patience
        self.x, self.evaluations = start.detach(), 0
        loss, self.start_gradient = self.value_and_gradient(self.x)
        if loss.shape != self.x.shape[:-2]:
            raise ValueError(
                f"the objective must return one loss per item, {tuple(self.x.shape[:-2])}, got {tuple(loss.shape)}"
            )
        checks.all_finite("loss at the start", loss)
        if loss.min() < 0:
            raise ValueError(f"the objective must not be negative, got {loss.min().item():g} at the start")
        # To first order, moving every element by one unit (a radian) would change the loss by less than its rounding.
        rounding = 1e3 * torch.finfo(loss.dtype).eps * loss
        stuck = (self.start_gradient.abs().sum((-2, -1)) <= rounding) & (loss > 0)
        if stuck.any():
            item = tuple(stuck.nonzero()[0].tolist())
            raise ValueError(
                f"the gradient vanishes at the start of item {item}, so no step can leave it; "
                "start elsewhere, for example from random phases"
            )
        self.losses = loss.new_empty(max_steps + 1, *loss.shape)
        self.losses[0], self.step = loss, 0
        self.active = loss > 0
        self.steps = torch.zeros_like(loss, dtype=torch.int64)
        self.calm = torch.zeros_like(self.steps)
        self.stalled = torch.zeros_like(self.active)

    def value(self, x: Tensor) -> Tensor:
        self.evaluations += 1
        with torch.no_grad():
            return self.objective(x)

    def value_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        self.evaluations += 1
        with torch.enable_grad():
            x = x.detach().requires_grad_(True)
            losses = self.objective(x)
            (gradient,) = torch.autograd.grad(losses.sum(), x)
        return losses.detach(), gradient

    def advance(self, x: Tensor, loss: Tensor, stalled: Tensor) -> None:
        """Take ``x`` for the items that still move, and stop those that have settled (Eq. 4.36) or stalled."""
        last = self.losses[self.step]
        self.stalled = self.stalled | (self.active & stalled)
        self.active = self.active & ~stalled
        self.x = torch.where(self.active[..., None, None], x, self.x)
        loss = torch.where(self.active, loss, last)
        self.step += 1
        self.losses[self.step] = loss
        self.steps += self.active
        settled = (loss - last).abs() < self.tolerance * last
        self.calm = torch.where(settled, self.calm + 1, 0)
        self.active = self.active & (self.calm < self.patience) & (loss > 0)

    def solution(self) -> Solution:
        converged = ~self.active & ~self.stalled
        losses = self.losses[: self.step + 1]
        return Solution(self.x, losses, self.steps.clone(), converged, self.stalled, self.evaluations)


def _check_stop_rule(max_steps: int, tolerance: float, patience: int) -> None:
    checks.whole("max_steps", max_steps, 1)
    checks.whole("patience", patience, 1)
    if not tolerance >= 0:
        raise ValueError(f"tolerance must be at least 0, got {tolerance!r}")
