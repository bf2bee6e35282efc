"""A loss whose views are drawn at random in each step of a solver."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.correction import PECProblem, ProjectedAdam

_LEARNING_RATE = 0.15  # rad, of Adam
_BETAS = 0.9, 0.99  # of Adam; its square of the gradient follows that of about 100 steps
_FINAL = 0.01  # learning rate of the last step relative to the first
STEPS_OF_ADAM = 3  # of some of the views, for each step of L-BFGS with all


class Group(NamedTuple):
    """Views, by their indices, of which each step takes ``taken``."""

    views: Sequence[int]
    taken: int


class SampledViews:
    """The loss of some of many views; :meth:`at_step` draws others.

    Each group of views is taken in random order, and again in another one when it is used up. What a step draws follows
    from its number and the seed alone, so that a run may be resumed, and processes that share it draw the same.

    Args:
        problem: Function that makes the loss of some views, given by their indices.
        groups: What each step takes.
        seed: Of the random orders.
    """

    def __init__(self, problem: Callable[[list[int]], PECProblem], groups: Sequence[Group], seed: int):
        self._problem, self._groups, self._seed = problem, groups, seed
        self.at_step(0)
        self.unknown_axes = self._drawn.unknown_axes

    def at_step(self, step: int) -> None:
        """Draw the views of a step."""
        self._drawn = self._problem([view for group in self._groups for view in self._order(group, step)])

    def _order(self, group: Group, step: int) -> Iterator[int]:
        for place in range(step * group.taken, (step + 1) * group.taken):
            again, k = divmod(place, len(group.views))
            generator = torch.Generator().manual_seed(self._seed + again)
            yield group.views[int(torch.randperm(len(group.views), generator=generator)[k])]

    def __call__(self, phase: Tensor) -> Tensor:
        """Loss [C] of heater phases [F, C, H, W] in rad."""
        return self._drawn(phase)


def adam(steps: int) -> ProjectedAdam:
    """The solver for views that are drawn at random in each step."""
    return ProjectedAdam(_LEARNING_RATE, _BETAS, _FINAL, max_steps=steps, tolerance=0.0)
