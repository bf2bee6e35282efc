"""What the solvers share: the result they return, the set they project onto, and the bookkeeping of a run.

An objective maps the unknown x to one loss per item. The items are independent: each has its own step length and its
own stop, so a batch gives the same results as its items alone. A loss is never negative, and 0 for a perfect fit, as
sums of squares are.

An objective may have an attribute ``unknown_axes``: the axes of x, counted from its end, that hold the elements of one
item. They are (-2, -1) where each hologram [H, W] has a loss, and (-4, -2, -1) for frames [F, C, H, W] of which each
colour has one loss. The losses have the other axes of x. Without that attribute the axes of the losses are the first
ones of x: losses [...] for x [..., *unknown].
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from holotorch.core import checks

Objective = Callable[[Tensor], Tensor]
Projection = Callable[[Tensor], Tensor]
Callback = Callable[["Solution"], None]
State = dict[str, Tensor]


@dataclass(frozen=True)
class Box:
    """The set lower <= x <= upper, called to project onto it; bounds are numbers or tensors that broadcast.

    Raises:
        ValueError: A bound that is NaN, or a lower one above the upper one.
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


# X >= 0, since heaters cannot cool: the proximal operator of Eq. 4.13.
nonnegative = Box()


@dataclass(frozen=True)
class Solution:
    """Result of a solver, final or so far.

    Attributes:
        x: The unknown, shaped as the start.
        losses: Loss at the start and after each step, [steps + 1, ...]. An item that has stopped repeats its last loss.
        steps: Steps that each item took, integer [...].
        converged: Whether each item met the stop rule, [...]; False where it ran out of steps or stalled.
        stalled: Whether each item stopped because no step, however short, was accepted, [...].
        evaluations: How often the objective was evaluated, with or without its gradient.
        state: Tensors by name. The same solver continues from them when they are passed as ``resume``, on a CPU with
            the same bits as an uninterrupted run.
    """

    x: Tensor
    losses: Tensor
    steps: Tensor
    converged: Tensor
    stalled: Tensor
    evaluations: int
    state: State = field(default_factory=dict, repr=False)


class Run:
    """Bookkeeping of a solver: evaluations, losses, which items are still active, and the state to resume from."""

    def __init__(
        self,
        objective: Objective,
        start: Tensor,
        project: Projection,
        max_steps: int,
        tolerance: float,
        patience: int,
        resume: State | None,
    ):
        checks.real("start", start)
        checks.all_finite("start", start)
        self.objective, self.tolerance, self.patience = objective, tolerance, patience
        self.x, self.evaluations = project(start.detach()), 0
        loss, self.gradient = self.value_and_gradient(self.x)
        items, unknown = _split_axes(objective, self.x, loss)
        # The axes of x with those of the items first, and the shape of a value per item that broadcasts against x.
        self.items, self.axes = loss.ndim, items + unknown
        self.broadcast = [size if axis in items else 1 for axis, size in enumerate(self.x.shape)]
        checks.all_finite("loss at the start", loss)
        if loss.numel() and loss.min() < 0:
            raise ValueError(f"the objective must not be negative, got {loss.min().item():g} at the start")
        # To first order, moving every element by one unit (a radian) would change the loss by less than its rounding.
        rounding = 1e3 * torch.finfo(loss.dtype).eps * loss
        stuck = (self.total(self.gradient.abs()) <= rounding) & (loss > 0)
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
        self.extra: State = {}
        if resume:
            self._restore(resume)

    @property
    def loss(self) -> Tensor:
        """Of the point ``x``, [...]."""
        return self.losses[self.step]

    def rows(self, values: Tensor) -> Tensor:
        """Values shaped as x, as one row of elements for each item, [..., N]."""
        return values.permute(self.axes).flatten(self.items)

    def from_rows(self, rows: Tensor) -> Tensor:
        """Inverse of :meth:`rows`; all axes of the items may be one."""
        shape = [self.x.shape[axis] for axis in self.axes]
        return rows.reshape(shape).permute([self.axes.index(axis) for axis in range(len(shape))])

    def total(self, values: Tensor) -> Tensor:
        """Sum of values shaped as x over the elements of each item, [...]."""
        return self.rows(values).sum(-1)

    def each(self, values: Tensor) -> Tensor:
        """One value per item, [...], in a shape that broadcasts against x."""
        return values.reshape(self.broadcast)

    def value(self, x: Tensor) -> Tensor:
        """Losses at ``x``."""
        self.evaluations += 1
        with torch.no_grad():
            return self.objective(x)

    def value_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Losses at ``x`` and their gradient."""
        self.evaluations += 1
        with torch.enable_grad():
            x = x.detach().requires_grad_(True)
            losses = self.objective(x)
            (gradient,) = torch.autograd.grad(losses.sum(), x)
        return losses.detach(), gradient

    def advance(self, x: Tensor, loss: Tensor, stalled: Tensor) -> None:
        """Take ``x`` for the active items, and stop those that have converged (Eq. 4.36) or stalled."""
        last = self.loss
        self.stalled = self.stalled | (self.active & stalled)
        self.active = self.active & ~stalled
        self.x = x if self.active.all() else torch.where(self.each(self.active), x, self.x)
        loss = torch.where(self.active, loss, last)
        self.step += 1
        self.losses[self.step] = loss
        self.steps = self.steps + self.active
        settled = (loss - last).abs() < self.tolerance * last
        self.calm = torch.where(settled, self.calm + 1, 0)
        self.active = self.active & (self.calm < self.patience) & (loss > 0)

    def solution(self, **extra: Tensor) -> Solution:
        """The result so far; ``extra`` holds the tensors that the solver itself needs to resume."""
        losses = self.losses[: self.step + 1]
        state = {
            **extra,
            "x": self.x,
            "active": self.active,
            "steps": self.steps,
            "calm": self.calm,
            "stalled": self.stalled,
            "losses": losses,
            "counts": torch.tensor([self.step, self.evaluations]),
        }
        return Solution(self.x, losses, self.steps, ~self.active & ~self.stalled, self.stalled, self.evaluations, state)

    def _restore(self, state: State) -> None:
        if state["x"].shape != self.x.shape or state["x"].dtype != self.x.dtype:
            raise ValueError(
                f"resume holds x of {tuple(state['x'].shape)} {state['x'].dtype}, the start is "
                f"{tuple(self.x.shape)} {self.x.dtype}"
            )
        state = {name: values.to(self.x.device) for name, values in state.items()}
        self.step, self.evaluations = (int(number) for number in state["counts"])
        if self.step + 1 > len(self.losses):
            raise ValueError(f"resume has taken {self.step} steps already, more than max_steps {len(self.losses) - 1}")
        self.losses[: self.step + 1] = state["losses"]
        self.x, self.active, self.steps = state["x"], state["active"], state["steps"]
        self.calm, self.stalled = state["calm"], state["stalled"]
        self.extra = state


def _split_axes(objective: Objective, x: Tensor, loss: Tensor) -> tuple[list[int], list[int]]:
    """Axes of ``x`` that the losses have, and those of the elements of one item; ValueError if the losses differ."""
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


def check_stop_rule(max_steps: int, tolerance: float, patience: int) -> None:
    """ValueError unless the fields of a solver's stop rule are in range."""
    checks.whole("max_steps", max_steps, 1)
    checks.whole("patience", patience, 1)
    checks.nonnegative("tolerance", tolerance)
