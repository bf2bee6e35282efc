"""Base class of the solvers, the result they return, the set they project onto, and the bookkeeping of a run.

An objective maps the unknown x to one nonnegative loss for each item, a part of x such as one hologram. The items are
independent: each has its own step length and stops separately, so a batch gives the same results as single items.

An objective may have an attribute ``unknown_axes``: the axes of x, counted from the end, that hold the elements of one
item. They are (-2, -1) where each hologram [H, W] has a loss, and (-4, -2, -1) where all frames of each colour of
[F, C, H, W] share one. The losses have the remaining axes of x. Without the attribute the losses have the first axes of
x: losses [...] for x [..., *unknown].
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.learning import fixed

Objective = Callable[[Tensor], Tensor]
Projection = Callable[[Tensor], Tensor]
Callback = Callable[["Solution"], None]
State = dict[str, Tensor]
_STATE = ("x", "active", "steps", "calm", "stalled")  # attributes of a Run that are saved to resume it


@dataclass(frozen=True)
class Box:
    """The set lower <= x <= upper; a call projects onto it. Bounds are numbers or tensors that broadcast against x.

    Raises ValueError for a bound that is NaN, or a lower bound above the upper bound.
    """

    lower: float | Tensor = 0.0
    upper: float | Tensor = torch.inf

    def __post_init__(self):
        if not bool((torch.as_tensor(self.lower) <= torch.as_tensor(self.upper)).all()):
            raise ValueError(f"a box needs lower <= upper everywhere, got {self.lower!r} and {self.upper!r}")

    def __call__(self, x: Tensor) -> Tensor:
        """The nearest point of the box."""
        if not isinstance(self.lower, Tensor) and not isinstance(self.upper, Tensor):
            return x.clamp(self.lower, self.upper)
        lower, upper = (torch.as_tensor(bound, dtype=x.dtype, device=x.device) for bound in (self.lower, self.upper))
        return torch.minimum(torch.maximum(x, lower), upper)


nonnegative = Box()  # x >= 0, since heaters cannot cool; calling it is the proximal operator of thesis Eq. 4.13


@dataclass(frozen=True)
class Solution:
    """Result of a solver, final or intermediate.

    Attributes:
        x: The unknown, shaped as the start.
        losses: Loss at the start and after each step, [steps + 1, ...]. An item that has stopped repeats its last loss.
        steps: Steps that each item took, integer [...].
        converged: Whether each item met the stop rule, [...]; False where it ran out of steps or stalled.
        stalled: Whether each item stopped because no step, however short, was accepted, [...].
        evaluations: Number of evaluations of the objective, with or without gradient.
        state: Tensors by name. If they are passed as ``resume``, the same solver continues from them; on a CPU the
            result is identical to that of an uninterrupted run.
    """

    x: Tensor
    losses: Tensor
    steps: Tensor
    converged: Tensor
    stalled: Tensor
    evaluations: int
    state: State = field(default_factory=dict, repr=False)


class Run:
    """State of a running solver: the unknown, the losses, which items are still active, and the evaluations so far."""

    def __init__(
        self, solver: "Solver", objective: Objective, start: Tensor, project: Projection, resume: State | None
    ):
        checks.real("start", start)
        fixed("start", start, "a solution has no derivative with respect to its start; give start.detach()")
        checks.all_finite("start", start)
        self.solver, self.objective, self.project = solver, objective, project
        self.x, self.evaluations = project(start.detach()), 0
        loss, self.gradient = self.value_and_gradient(self.x)
        items, unknown = _split_axes(objective, self.x, loss)
        self.items, self.axes = loss.ndim, items + unknown  # all axes of x, those of the items first
        self.broadcast = [size if axis in items else 1 for axis, size in enumerate(self.x.shape)]
        checks.all_finite("loss at the start", loss)
        if loss.numel() and loss.min() < 0:
            raise ValueError(f"the objective must not be negative, got {loss.min().item():g} at the start")
        # Stuck: to first order, a change of all elements by 1 rad changes the loss by less than 1000 rounding errors.
        rounding = 1e3 * torch.finfo(loss.dtype).eps * loss
        stuck = (self.total(self.gradient.abs()) <= rounding) & (loss > 0)
        if stuck.any():
            item = tuple(stuck.nonzero()[0].tolist())
            raise ValueError(
                f"the gradient vanishes at the start of item {item}, so no step can leave it; "
                "start elsewhere, for example from random phases"
            )
        self.losses = loss.new_empty(solver.max_steps + 1, *loss.shape)
        self.losses[0], self.step = loss, 0
        self.active = loss > 0
        self.steps = torch.zeros_like(loss, dtype=torch.int64)
        self.calm = torch.zeros_like(self.steps)  # steps in a row whose change of loss was within the tolerance
        self.stalled = torch.zeros_like(self.active)
        self.any_active: bool | None = None  # whether any item is active, if a step has read this from the device
        self.resumed: State = {}
        if resume:
            self._restore(resume)

    @property
    def loss(self) -> Tensor:
        """Losses [...] at ``x``."""
        return self.losses[self.step]

    def rows(self, values: Tensor) -> Tensor:
        """Reshape values shaped as x to one row of elements per item, [..., N]."""
        return values.permute(self.axes).flatten(self.items)

    def from_rows(self, rows: Tensor) -> Tensor:
        """Inverse of :meth:`rows`; the axes of the items may be flattened."""
        shape = [self.x.shape[axis] for axis in self.axes]
        return rows.reshape(shape).permute([self.axes.index(axis) for axis in range(len(shape))])

    def total(self, values: Tensor) -> Tensor:
        """Sum of values shaped as x over the elements of each item, [...]."""
        return self.rows(values).sum(-1)

    def expanded(self, values: Tensor) -> Tensor:
        """Reshape one value per item, [...], so that it broadcasts against x."""
        return values.reshape(self.broadcast)

    def value(self, x: Tensor) -> Tensor:
        """Losses [...] at ``x``."""
        self.evaluations += 1
        with torch.no_grad():
            return self.objective(x)

    def value_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Losses [...] at ``x`` and the gradient of each, shaped as x."""
        self.evaluations += 1
        with torch.enable_grad():
            x = x.detach().requires_grad_(True)
            losses = self.objective(x)
            (gradient,) = torch.autograd.grad(losses.sum(), x)
        return losses.detach(), gradient

    def read(self, *flags: Tensor) -> list[bool]:
        """Whether each of some tensors holds a true element, read back from the device as one number."""
        code = int(sum(flag.any() * 2**bit for bit, flag in enumerate(flags)))
        return [bool(code & 2**bit) for bit in range(len(flags))]

    def remaining(self, loss: Tensor, stalled: Tensor) -> Tensor:
        """Which items are still active after :meth:`advance` with these losses."""
        return self.active & ~stalled & (self._calm(loss) < self.solver.patience) & (loss > 0)

    def _calm(self, loss: Tensor) -> Tensor:
        settled = (loss - self.loss).abs() < self.solver.tolerance * self.loss  # thesis Eq. 4.36
        return torch.where(settled, self.calm + 1, 0)

    def advance(self, x: Tensor, loss: Tensor, stalled: Tensor, *, any_active: bool | None = None) -> None:
        """Move the active items to ``x``, and stop those that have converged or stalled."""
        last, self.any_active = self.loss, any_active
        self.stalled = self.stalled | (self.active & stalled)
        self.active = self.active & ~stalled
        # Unconditional, since a test would wait for the GPU.
        self.x = torch.where(self.expanded(self.active), x, self.x)
        loss = torch.where(self.active, loss, last)
        self.calm = self._calm(loss)
        self.step += 1
        self.losses[self.step] = loss
        self.steps = self.steps + self.active
        self.active = self.active & (self.calm < self.solver.patience) & (loss > 0)

    def solution(self, **extra: Tensor) -> Solution:
        """The result so far; ``extra`` holds the tensors that only this solver needs to resume."""
        losses = self.losses[: self.step + 1]
        state = extra | {name: getattr(self, name) for name in _STATE} | {"losses": losses}
        state["counts"] = torch.tensor([self.step, self.evaluations])
        return Solution(self.x, losses, self.steps, ~self.active & ~self.stalled, self.stalled, self.evaluations, state)

    def _restore(self, state: State) -> None:
        held, start = ((tuple(x.shape), x.dtype) for x in (state["x"], self.x))
        if held != start:
            raise ValueError(f"resume holds x of {held[0]} {held[1]}, the start is {start[0]} {start[1]}")
        state = {name: values.to(self.x.device) for name, values in state.items()}
        self.step, self.evaluations = (int(number) for number in state["counts"])
        if self.step + 1 > len(self.losses):
            raise ValueError(f"resume has taken {self.step} steps already, more than max_steps {len(self.losses) - 1}")
        self.losses[: self.step + 1] = state["losses"]
        for name in _STATE:
            setattr(self, name, state[name])
        self.resumed = state


def _split_axes(objective: Objective, x: Tensor, loss: Tensor) -> tuple[list[int], list[int]]:
    """Axes of ``x`` that count items, and those within an item; ValueError if the shape of ``loss`` does not match."""
    size = x.ndim
    named = getattr(objective, "unknown_axes", None)
    unknown = [axis % size for axis in (range(loss.ndim - size, 0) if named is None else named)]
    items = [axis for axis in range(size) if axis not in unknown]
    if not unknown or loss.shape != tuple(x.shape[axis] for axis in items):
        which = "the first axes" if named is None else f"axes {items}"
        raise ValueError(
            f"the objective must return one loss per item, {which} of {tuple(x.shape)}, got {tuple(loss.shape)}"
        )
    return items, unknown


class Solver:
    """Base class of the solvers: frozen dataclasses that are called with an objective, a start and a projection.

    Attributes:
        max_steps: Largest number of steps.
        tolerance: Relative change of the loss (thesis Eq. 4.36) below which a step counts towards ``patience``.
        patience: Number of such steps in a row after which an item stops.

    Raises:
        ValueError: An attribute out of range; in a call: a start that is not finite, or at which a loss is negative or
            not finite, or at which the gradient of a positive loss vanishes, as at X = 0 for a Fourier hologram.
    """

    max_steps: int
    tolerance: float
    patience: int

    def __post_init__(self):
        checks.whole("max_steps", self.max_steps, 1)
        checks.whole("patience", self.patience, 1)
        checks.nonnegative("tolerance", self.tolerance)

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
            objective: Function from the unknown to one loss per item, see ``holotorch.correction.run``.
            start: The unknown at the start, real and finite.
            project: Function to the nearest point of the allowed set; :class:`LBFGS` needs a :class:`Box`.
            callback: Called with the solution so far after every step.
            resume: The ``state`` of an earlier solution of the same problem.
        """
        run = Run(self, objective, start, project, resume)
        extra = {name: run.resumed.get(name, value) for name, value in self._begin(run).items()}
        del run.gradient  # a step that needs it holds it in ``extra``
        while run.step < self.max_steps and (run.active.any() if run.any_active is None else run.any_active):
            extra = self._advance(run, **extra)
            if callback:
                callback(run.solution(**extra))
        return run.solution(**extra)

    def _begin(self, run: Run) -> State:
        """Tensors that the first step needs besides ``run``."""
        raise NotImplementedError

    def _advance(self, run: Run, *_: Any, **extra: Any) -> State:
        """Take one step with the tensors ``extra``, and return those that the next step needs besides ``run``."""
        raise NotImplementedError
