"""First-order solvers: accelerated proximal gradient and projected Adam."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.correction.run import Run, Solver, State


@dataclass(frozen=True)
class APG(Solver):
    """Accelerated proximal gradient with a backtracking step: thesis Algorithm 2 and Eq. 4.14.

    Departure from the thesis: the step test, printed as g(Z) < g', is relaxed by the rounding error of g. Otherwise it
    fails near convergence for any step length, and the step length shrinks to zero. As printed, the step length only
    shrinks and the momentum only grows; ``grow`` and ``restart`` change that.

    Attributes:
        step: First step length tau.
        shrink: Factor beta in (0, 1) on the step length after a refused step.
        grow: Factor >= 1 on the step length after each accepted step.
        restart: Reset the momentum of an item whose loss has risen (O'Donoghue and Candes 2015).

    The other attributes, the call and the errors are those of :class:`Solver`.
    """

    step: float = 1.0
    shrink: float = 0.5
    grow: float = 1.0
    restart: bool = False
    max_steps: int = 400
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        super().__post_init__()
        checks.positive("step", self.step)
        if not 0 < self.shrink < 1:
            raise ValueError(f"shrink must lie between 0 and 1, got {self.shrink!r}")
        if checks.finite("grow", self.grow) < 1:
            raise ValueError(f"grow must be at least 1, got {self.grow!r}")

    def _begin(self, run: Run) -> State:
        step = torch.full_like(run.loss, self.step)
        return {"previous": run.x, "step_length": step, "count": torch.zeros_like(step)}

    def _advance(self, run: Run, *, previous: Tensor, step_length: Tensor, count: Tensor) -> State:
        y = run.x + run.expanded(count / (count + 3)) * (run.x - previous)
        x, loss, step_length, stalled, any_active = self._descend(run, y, step_length)
        count = count + 1
        if self.restart:
            count = torch.where(loss > run.loss, 0, count)
        previous = run.x
        run.advance(x, loss, stalled, any_active=any_active)
        return {"previous": previous, "step_length": step_length * self.grow, "count": count}

    def _descend(self, run: Run, y: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, bool]:
        """One proximal step from ``y``, its length shortened per item until Beck and Teboulle's bound holds.

        Returns the point, its losses, the step lengths, which items stalled, and whether any remains active.
        """
        value, gradient = run.value_and_gradient(y)
        slack = 8 * torch.finfo(y.dtype).eps * value
        least = self.step * torch.finfo(y.dtype).eps ** 2
        shortened = torch.zeros_like(run.active)
        while True:
            z = run.project(y - run.expanded(step) * gradient)
            moved = z - y
            loss = run.value(z)
            bound = value + run.total(gradient * moved) + run.total(moved.square()) / (2 * step)
            refused = run.active & ~(loss <= bound + slack)
            stalled = refused & (step <= least)
            # An item whose step was shortened until z = y has stalled as well. An item that does not move in the
            # first trial is at a minimum on the boundary of the set.
            unmoved = stalled | (shortened & (run.total(moved != 0) == 0))
            shorten, any_active = run.read(refused & ~stalled, run.remaining(loss, unmoved))
            if not shorten:
                return z, loss, step, unmoved, any_active
            step = torch.where(refused, step * self.shrink, step)
            shortened = shortened | refused


@dataclass(frozen=True)
class ProjectedAdam(Solver):
    """Adam with a projection after every step (Kingma and Ba 2015).

    The loss may rise in a step, and the result is the last point, not the best one. Each step evaluates the objective
    once. An objective that changes from step to step, such as one of views that are drawn at random, has a method
    ``at_step``, which is called with the number of the step before it.

    Attributes:
        learning_rate: Step length in the unit of the unknown.
        betas: Decay rates of the running means of the gradient and of its square.
        final: Fraction in (0, 1] of the learning rate that the last of ``max_steps`` approaches, along half a cosine;
            1 keeps the rate. An objective that changes needs it, since its gradient does not vanish. A run is resumed
            with the same ``max_steps``.

    The other attributes, the call and the errors are those of :class:`Solver`.
    """

    learning_rate: float = 0.1
    betas: tuple[float, float] = (0.9, 0.999)
    final: float = 1.0
    max_steps: int = 400
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        super().__post_init__()
        checks.positive("learning_rate", self.learning_rate)
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas must be at least 0 and below 1, got {self.betas!r}")
        if not 0 < checks.finite("final", self.final) <= 1:
            raise ValueError(f"final must be above 0 and at most 1, got {self.final!r}")

    def _begin(self, run: Run) -> State:
        return {"gradient": run.gradient, "mean": torch.zeros_like(run.x), "square": torch.zeros_like(run.x)}

    def _advance(self, run: Run, *, gradient: Tensor, mean: Tensor, square: Tensor) -> State:
        mean = mean + (1 - self.betas[0]) * (gradient - mean)
        square = square + (1 - self.betas[1]) * (gradient.square() - square)
        step = run.step + 1
        scale = torch.sqrt(square / (1 - self.betas[1] ** step)) + 1e-8
        cosine = (1 + math.cos(math.pi * run.step / self.max_steps)) / 2
        rate = self.learning_rate * (self.final + (1 - self.final) * cosine)
        x = run.project(run.x - rate / (1 - self.betas[0] ** step) * mean / scale)
        x = torch.where(run.expanded(run.active), x, run.x)
        if at_step := getattr(run.objective, "at_step", None):
            at_step(step)
        loss, gradient = run.value_and_gradient(x)
        run.advance(x, loss, ~torch.isfinite(loss))
        return {"gradient": gradient, "mean": mean, "square": square}
