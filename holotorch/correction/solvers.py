"""First-order solvers: frozen dataclasses that are called with an objective, a start and a projection."""

from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.correction.run import Callback, Objective, Projection, Run, Solution, State, check_stop_rule, nonnegative


@dataclass(frozen=True)
class APG:
    """Accelerated proximal gradient with a backtracking step: thesis Algorithm 2 and Eq. 4.14.

    Departure from the thesis: the printed test g(Z) < g' is relaxed by the rounding of g. Without that it fails near
    convergence for any step length, and the step collapses to zero. As printed, the step only shrinks and the momentum
    only grows; ``grow`` and ``restart`` change that.

    Attributes:
        step: First step length tau.
        shrink: Factor beta in (0, 1) on a refused step.
        grow: Factor >= 1 on the step length after each accepted step.
        restart: Reset the momentum of an item whose loss has risen (O'Donoghue and Candes 2015).
        max_steps: Most iterations.
        tolerance: Stop an item once its relative change of loss (Eq. 4.36) stays below this ...
        patience: ... for so many iterations in a row.

    Raises:
        ValueError: A field out of range; in a call: a start that is not finite, whose loss is negative or not finite,
            or whose gradient vanishes although its loss does not (X = 0 is such a point for a Fourier hologram).
    """

    step: float = 1.0
    shrink: float = 0.5
    grow: float = 1.0
    restart: bool = False
    max_steps: int = 400
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        checks.positive("step", self.step)
        if not 0 < self.shrink < 1:
            raise ValueError(f"shrink must lie between 0 and 1, got {self.shrink!r}")
        if checks.finite("grow", self.grow) < 1:
            raise ValueError(f"grow must be at least 1, got {self.grow!r}")
        check_stop_rule(self.max_steps, self.tolerance, self.patience)

    def __call__(
        self,
        objective: Objective,
        start: Tensor,
        project: Projection = nonnegative,
        *,
        callback: Callback | None = None,
        resume: State | None = None,
    ) -> Solution:
        """Minimise ``objective`` over the set that ``project`` projects onto, beginning at ``start``.

        Args:
            objective: From the unknown to one loss per item, see ``holotorch.correction.run``.
            start: The unknown at the start, real and finite.
            project: To the nearest point of the allowed set.
            callback: Called with the solution so far after every step.
            resume: The ``state`` of an earlier solution of the same work.
        """
        run = Run(objective, start, project, self.max_steps, self.tolerance, self.patience, resume)
        previous = run.extra.get("previous", run.x)
        step = run.extra.get("step_length", torch.full_like(run.loss, self.step))
        count = run.extra.get("count", torch.zeros_like(run.loss))
        while run.step < self.max_steps and run.active.any():
            y = run.x + run.each(count / (count + 3)) * (run.x - previous)
            value, gradient = run.value_and_gradient(y)
            x, loss, step, stalled = self._descend(run, project, y, value, gradient, step)
            count = count + 1
            if self.restart:
                count = torch.where(loss > run.loss, 0, count)
            previous = run.x
            run.advance(x, loss, stalled)
            step = step * self.grow
            if callback:
                callback(run.solution(previous=previous, step_length=step, count=count))
        return run.solution(previous=previous, step_length=step, count=count)

    def _descend(self, run: Run, project: Projection, y: Tensor, value: Tensor, gradient: Tensor, step: Tensor):
        """One proximal step from ``y``, its length shortened per item until Beck and Teboulle's bound holds."""
        slack = 8 * torch.finfo(y.dtype).eps * value
        least = self.step * torch.finfo(y.dtype).eps ** 2
        shortened = torch.zeros_like(run.active)
        while True:
            z = project(y - run.each(step) * gradient)
            moved = z - y
            loss = run.value(z)
            bound = value + run.total(gradient * moved) + run.total(moved.square()) / (2 * step)
            refused = run.active & ~(loss <= bound + slack)
            stalled = refused & (step <= least)
            if not (refused & ~stalled).any():
                # An item whose step was shortened until z = y has stalled as well. One that does not move at its first
                # trial is at a minimum on the boundary of the set.
                stalled = stalled | (shortened & (run.total(moved != 0) == 0))
                return z, loss, step, stalled
            step = torch.where(refused, step * self.shrink, step)
            shortened = shortened | refused


@dataclass(frozen=True)
class ProjectedAdam:
    """Adam with a projection after every step.

    Attributes:
        learning_rate: In the unit of the unknown.
        betas: Decay rates of the running means of the gradient and of its square.
        max_steps: Most iterations, one evaluation each.
        tolerance: Stop rule as for :class:`APG`.
        patience: Stop rule as for :class:`APG`.

    Raises as :class:`APG`. The loss may rise in a step, and the result is the last point, not the best one.
    Source: Kingma and Ba (2015).
    """

    learning_rate: float = 0.1
    betas: tuple[float, float] = (0.9, 0.999)
    max_steps: int = 400
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        checks.positive("learning_rate", self.learning_rate)
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas must be at least 0 and below 1, got {self.betas!r}")
        check_stop_rule(self.max_steps, self.tolerance, self.patience)

    def __call__(
        self,
        objective: Objective,
        start: Tensor,
        project: Projection = nonnegative,
        *,
        callback: Callback | None = None,
        resume: State | None = None,
    ) -> Solution:
        """Minimise ``objective`` as :meth:`APG.__call__` does."""
        run = Run(objective, start, project, self.max_steps, self.tolerance, self.patience, resume)
        gradient = run.extra.get("gradient", run.gradient)
        mean = run.extra.get("mean", torch.zeros_like(run.x))
        square = run.extra.get("square", torch.zeros_like(run.x))
        while run.step < self.max_steps and run.active.any():
            mean = mean + (1 - self.betas[0]) * (gradient - mean)
            square = square + (1 - self.betas[1]) * (gradient.square() - square)
            step = run.step + 1
            scale = torch.sqrt(square / (1 - self.betas[1] ** step)) + 1e-8
            x = project(run.x - self.learning_rate / (1 - self.betas[0] ** step) * mean / scale)
            x = torch.where(run.each(run.active), x, run.x)
            loss, gradient = run.value_and_gradient(x)
            run.advance(x, loss, ~torch.isfinite(loss))
            if callback:
                callback(run.solution(gradient=gradient, mean=mean, square=square))
        return run.solution(gradient=gradient, mean=mean, square=square)
