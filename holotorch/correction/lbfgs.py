"""LBFGS: projected, preconditioned, limited-memory quasi-Newton steps for many items at once."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft2, filter_real
from holotorch.correction.run import Box, Callback, Objective, Run, Solution, State, check_stop_rule, nonnegative

_ENOUGH = 1e-4  # of the decrease that the slope promises (Armijo)
_SHRINK, _SHORTEST = 0.5, 2.0**-12


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS within a box, each item of a batch with a memory, a step length and a stop of its own.

    Elements that lie on a bound and want to leave the box are held; the others take the quasi-Newton step and are
    projected, the step being halved until the loss falls enough (Bertsekas 1982). The first guess of the inverse
    Hessian is ``precondition``, scaled; products with the memory are taken by inner products of whole histories, so
    that a step costs a few passes over them whatever the number of items.

    Attributes:
        memory: Pairs of steps and changes of gradient that are kept. Holograms gain nothing from more than 3, and at
            strong crosstalk they lose (``holotorch chart pec``).
        precondition: Symmetric positive linear operator on x, such as :func:`spread_preconditioner`; identity if None.
        first: Largest change of an element in the first step, in the unit of x.
        max_steps: Most iterations.
        tolerance: Stop rule as for ``APG``.
        patience: Stop rule as for ``APG``.

    Raises as ``APG``. Source: Nocedal and Wright, Algorithm 7.4.
    """

    memory: int = 3
    precondition: Callable[[Tensor], Tensor] | None = None
    first: float = 0.5
    max_steps: int = 200
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        checks.whole("memory", self.memory, 1)
        checks.positive("first", self.first)
        check_stop_rule(self.max_steps, self.tolerance, self.patience)

    def __call__(
        self,
        objective: Objective,
        start: Tensor,
        project: Box = nonnegative,
        *,
        callback: Callback | None = None,
        resume: State | None = None,
    ) -> Solution:
        """Minimise ``objective`` within the box ``project``, from ``start`` [..., *unknown]; else as ``APG``."""
        rule = {"max_steps": self.max_steps, "tolerance": self.tolerance, "patience": self.patience}
        run = Run(objective, start, project, **rule, resume=resume)
        gradient = run.extra.get("gradient", run.gradient)
        memory = _Memory(self.memory, run)
        flat = (*memory.s.shape[:1], -1)
        while run.step < self.max_steps and run.active.any():
            free = self._free(run.x, gradient, project)
            steepest = free * gradient
            guess = self._preconditioned(steepest)
            direction = free * memory.direction(steepest.reshape(flat), guess.reshape(flat)).reshape(run.x.shape)
            lost = ~(run.total(direction * gradient) < 0)
            if lost.any():
                # The memory no longer fits, as where the set of held elements has changed: forget it.
                memory.forget(lost.reshape(-1))
                direction = torch.where(run.each(lost), -free * guess, direction)
            largest = direction.abs().flatten(run.items).amax(-1)
            reach = self.first / largest.clamp(min=torch.finfo(largest.dtype).tiny)
            length = torch.where(memory.empty.reshape(run.loss.shape), reach, 1.0)
            x, loss, after, failed = self._search(run, project, direction, gradient, length)
            # A step that fails with a memory may succeed without; one that fails without never will.
            stalled = failed & memory.empty.reshape(run.loss.shape)
            change = after - gradient
            if failed.any():
                memory.forget(failed.reshape(-1))
            memory.add(*(part.reshape(flat) for part in (x - run.x, change, self._preconditioned(change))))
            run.advance(x, loss, stalled)
            gradient = after if run.active.all() else torch.where(run.each(run.active), after, gradient)
            if callback:
                callback(run.solution(gradient=gradient, **memory.state()))
        return run.solution(gradient=gradient, **memory.state())

    def _preconditioned(self, x: Tensor) -> Tensor:
        return x if self.precondition is None else self.precondition(x)

    @staticmethod
    def _free(x: Tensor, gradient: Tensor, box: Box) -> Tensor:
        """1 where an element may move, 0 where it lies on a bound that the descent would cross."""
        lower, upper = (torch.as_tensor(bound, dtype=x.dtype, device=x.device) for bound in (box.lower, box.upper))
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        return (~held).to(x.dtype)

    def _search(self, run: Run, project: Box, direction: Tensor, gradient: Tensor, length: Tensor):
        """Halve the step of each item until its loss falls enough; a gradient comes with every trial."""
        slack = 8 * torch.finfo(run.x.dtype).eps * run.loss
        accepted, failed = ~run.active, torch.zeros_like(run.active)
        shortest = length * _SHORTEST
        best, best_loss, best_gradient = run.x, run.loss, gradient
        while True:
            x = project(run.x + run.each(length) * direction)
            loss, after = run.value_and_gradient(x)
            promised = _ENOUGH * run.total(gradient * (x - run.x))
            enough = ~accepted & (loss <= run.loss + promised + slack)
            if enough.all():  # all at the first trial, as is most common
                return x, loss, after, failed
            taken = run.each(enough)
            best, best_gradient = torch.where(taken, x, best), torch.where(taken, after, best_gradient)
            best_loss = torch.where(enough, loss, best_loss)
            accepted = accepted | enough
            failed = ~accepted & (length <= shortest)
            if (accepted | failed).all():
                return best, best_loss, best_gradient, failed
            length = torch.where(accepted, length, length * _SHRINK)


class _Memory:
    """The last m steps s, changes of gradient y, and z = H0 y, of every item, oldest first; never changed in place.

    A place whose pair shows no positive curvature along s is left zero for that item, and takes no part.
    """

    def __init__(self, size: int, run: Run):
        items = max(1, run.loss.numel())
        make = run.x.new_zeros
        self.s = self.y = self.z = make(items, size, run.x.numel() // items)
        # Inner products s_i y_j and y_i z_j, in float64: triangular systems are solved with them.
        self.sy = self.yz = make(items, size, size, dtype=torch.float64)
        self.scale = make(items, dtype=torch.float64) + 1
        for name in _MEMORY if "memory_s" in run.extra else ():
            setattr(self, name, run.extra[f"memory_{name}"])

    def state(self) -> State:
        """Tensors by name, for ``Solution.state``."""
        return {f"memory_{name}": getattr(self, name) for name in _MEMORY}

    @property
    def empty(self) -> Tensor:
        """Which items remember nothing, [items]."""
        return (self.sy.diagonal(dim1=-2, dim2=-1) == 0).all(-1)

    def forget(self, which: Tensor) -> None:
        """Drop all pairs of the items [items]."""
        for name in ("s", "y", "z", "sy", "yz"):
            setattr(self, name, torch.where(which[:, None, None], 0, getattr(self, name)))
        self.scale = torch.where(which, 1, self.scale)

    def add(self, step: Tensor, change: Tensor, preconditioned: Tensor) -> None:
        """Keep one more pair, all [items, length], and drop the oldest."""
        curvature = (step * change).sum(-1)
        good = curvature > 1e-8 * (step.square().sum(-1) * change.square().sum(-1)).sqrt()
        bad = ~good[:, None, None]
        new = [part[:, None].masked_fill(bad, 0) for part in (step, change, preconditioned)]
        self.s, self.y, self.z = (
            torch.cat([old[:, 1:], part], 1) for old, part in zip((self.s, self.y, self.z), new, strict=True)
        )
        column, row = (self.s @ new[1].mT).double(), (new[0] @ self.y.mT).double()
        self.sy = _bordered(self.sy, column, row)
        bent = (self.y @ new[2].mT).double()
        self.yz = _bordered(self.yz, bent, bent.mT)
        newest = bent[:, -1, 0]
        self.scale = torch.where(newest > 0, curvature.double() / newest.clamp(min=1e-300), self.scale)

    def direction(self, gradient: Tensor, preconditioned: Tensor) -> Tensor:
        """-H g for gradients [items, length] and their H0 g, by the compact form of the inverse (Byrd et al. 1994)."""
        scale = self.scale[:, None, None]
        curvature = self.sy.diagonal(dim1=-2, dim2=-1)
        upper = self.sy.triu() + torch.diag_embed((curvature == 0).double())
        a = (self.s @ gradient[..., None]).double()
        b = scale * (self.z @ gradient[..., None]).double()
        u = torch.linalg.solve_triangular(upper, a, upper=True)
        middle = torch.diag_embed(curvature) + scale * self.yz
        v = torch.linalg.solve_triangular(upper.mT, middle @ u - b, upper=False)
        back, forth, scale = (part.to(gradient.dtype) for part in (v.mT, (scale * u).mT, scale[:, 0]))
        return (forth @ self.z - back @ self.s)[:, 0] - scale * preconditioned


_MEMORY = ("s", "y", "z", "sy", "yz", "scale")


def _bordered(square: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Matrices [items, m, m] without their first row and column, and with a new last column and row, [m] each."""
    inner = torch.cat([square[:, 1:, 1:], column[:, :-1]], -1)
    return torch.cat([inner, row], -2)


def spread_preconditioner(kernel: Tensor, floor: float = 0.1) -> Callable[[Tensor], Tensor]:
    """Approximate inverse Hessian for unknowns that a ``kernel`` spreads: 1 / (|K|^2 / max |K|^2 + floor) in frequency.

    Where heat is smoothed away the gradient is small and the step should not be. The convolution is taken as periodic,
    which a first guess may be.

    Args:
        kernel: Real, [h, w], such as ``ThermalCrosstalk.kernel``.
        floor: Above 0; the ratio of the strongest to the weakest correction is (1 + floor) / floor at most.
    """
    checks.positive("floor", floor)
    factors: dict[tuple, Tensor] = {}

    def precondition(x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        key = (height, width, x.dtype, x.device)
        if key not in factors:
            # As large as the kernel at least: a small array sees it wrapped.
            taps = torch.zeros(height, width, dtype=torch.float64)
            for i, row in enumerate(kernel.tolist()):
                for j, tap in enumerate(row):
                    taps[(i - kernel.shape[0] // 2) % height, (j - kernel.shape[1] // 2) % width] += tap
            power = fft2(taps.to(torch.complex128))[:, : width // 2 + 1].abs().square()
            factors.clear()
            factors[key] = (1 / (power / power.max() + floor)).to(x.device, x.dtype)
        return filter_real(x, factors[key])

    return precondition
