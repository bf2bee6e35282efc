"""LBFGS: projected, preconditioned, limited-memory quasi-Newton steps for many items at once."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft2, filter_real
from holotorch.correction.run import Box, Callback, Objective, Run, Solution, State, check_stop_rule, nonnegative

# Line search: the least share of the decrease predicted by the slope that a step must give (Armijo's condition, Nocedal
# and Wright, Eq. 3.4), the factor on the length of a refused step, and the shortest length, relative to the first.
_ARMIJO, _SHRINK, _SHORTEST = 1e-4, 0.5, 2.0**-12


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS within a box; each item of a batch has a separate memory, step length and stop.

    Elements on a bound whose descent direction leaves the box are held. The others take the quasi-Newton step and are
    projected; the step is halved until the loss falls enough (Bertsekas 1982). The initial inverse Hessian is
    ``precondition``, scaled. Products with the memory are computed for all items at once from inner products of the
    stored vectors, so that a step costs a few passes over them, whatever the number of items.

    Attributes:
        memory: Number of stored pairs of a step and its change of gradient. For holograms more than 3 do not help, and
            at strong crosstalk they converge more slowly (``holotorch chart pec``).
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
        """Minimise ``objective`` within the box ``project``, from ``start``; otherwise as :meth:`APG.__call__`."""
        run = Run(objective, start, project, self.max_steps, self.tolerance, self.patience, resume)
        gradient = run.extra.get("gradient", run.gradient)
        memory = _Memory(self.memory, run)
        flat = (*memory.s.shape[:1], -1)
        while run.step < self.max_steps and run.active.any():
            free = self._free(run.x, gradient, project)
            steepest = free * gradient
            guess = self._preconditioned(steepest)
            rows = memory.direction(*(run.rows(part).reshape(flat) for part in (steepest, guess)))
            direction = free * run.from_rows(rows)
            ascending = ~(run.total(direction * gradient) < 0)
            if ascending.any():
                # The memory no longer describes the loss, for example after a change of the held elements: forget it.
                memory.forget(ascending.reshape(-1))
                direction = torch.where(run.each(ascending), -free * guess, direction)
            largest = run.rows(direction.abs()).amax(-1)
            first_length = self.first / largest.clamp(min=torch.finfo(largest.dtype).tiny)
            length = torch.where(memory.empty.reshape(run.loss.shape), first_length, 1.0)
            x, loss, after, failed = self._search(run, project, direction, gradient, length)
            # A step that fails with a memory may succeed without it; a step that fails without a memory has stalled.
            stalled = failed & memory.empty.reshape(run.loss.shape)
            change = after - gradient
            if failed.any():
                memory.forget(failed.reshape(-1))
            pair = x - run.x, change, self._preconditioned(change)
            memory.add(*(run.rows(part).reshape(flat) for part in pair))
            run.advance(x, loss, stalled)
            gradient = after if run.active.all() else torch.where(run.each(run.active), after, gradient)
            if callback:
                callback(run.solution(gradient=gradient, **memory.state()))
        return run.solution(gradient=gradient, **memory.state())

    def _preconditioned(self, x: Tensor) -> Tensor:
        return x if self.precondition is None else self.precondition(x)

    @staticmethod
    def _free(x: Tensor, gradient: Tensor, box: Box) -> Tensor:
        """1 where an element may move, 0 where it lies on a bound that a step downhill would cross."""
        lower, upper = (torch.as_tensor(bound, dtype=x.dtype, device=x.device) for bound in (box.lower, box.upper))
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        return (~held).to(x.dtype)

    def _search(self, run: Run, project: Box, direction: Tensor, gradient: Tensor, length: Tensor):
        """Halve the step of each item until its loss falls enough.

        Every trial computes the gradient too, as most first trials are accepted.
        """
        slack = 8 * torch.finfo(run.x.dtype).eps * run.loss
        accepted, failed = ~run.active, torch.zeros_like(run.active)
        shortest = length * _SHORTEST
        best, best_loss, best_gradient = run.x, run.loss, gradient
        while True:
            x = project(run.x + run.each(length) * direction)
            loss, after = run.value_and_gradient(x)
            wanted = _ARMIJO * run.total(gradient * (x - run.x))
            enough = ~accepted & (loss <= run.loss + wanted + slack)
            if enough.all():  # the most common case: all items accept the first trial
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
    """The last m steps s, changes of gradient y, and z = H0 y of every item, oldest first; never changed in place.

    A pair without positive curvature along s is stored as zeros for that item, and has no effect.
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
        """Whether an item has no pair, [items]."""
        return (self.sy.diagonal(dim1=-2, dim2=-1) == 0).all(-1)

    def forget(self, which: Tensor) -> None:
        """Drop all pairs of the items [items]."""
        for name in ("s", "y", "z", "sy", "yz"):
            setattr(self, name, torch.where(which[:, None, None], 0, getattr(self, name)))
        self.scale = torch.where(which, 1, self.scale)

    def add(self, step: Tensor, change: Tensor, preconditioned: Tensor) -> None:
        """Keep one more pair, all [items, length], and drop the oldest."""
        curvature = (step * change).sum(-1)
        # Below 1e-8 of the product of their lengths, float32 rounding decides the sign of the inner product.
        convex = curvature > 1e-8 * (step.square().sum(-1) * change.square().sum(-1)).sqrt()
        new = [part[:, None].masked_fill(~convex[:, None, None], 0) for part in (step, change, preconditioned)]
        self.s, self.y, self.z = (
            torch.cat([old[:, 1:], part], 1) for old, part in zip((self.s, self.y, self.z), new, strict=True)
        )
        column, row = (self.s @ new[1].mT).double(), (new[0] @ self.y.mT).double()
        self.sy = _bordered(self.sy, column, row)
        column = (self.y @ new[2].mT).double()
        self.yz = _bordered(self.yz, column, column.mT)
        newest = column[:, -1, 0]
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
        of_s, of_z, scale = (part.to(gradient.dtype) for part in (v.mT, (scale * u).mT, scale[:, 0]))
        return (of_z @ self.z - of_s @ self.s)[:, 0] - scale * preconditioned


_MEMORY = ("s", "y", "z", "sy", "yz", "scale")


def _bordered(square: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Matrices [items, m, m] that lose their first row and column and gain a last column and row, [m] each."""
    inner = torch.cat([square[:, 1:, 1:], column[:, :-1]], -1)
    return torch.cat([inner, row], -2)


def spread_preconditioner(kernel: Tensor, floor: float = 0.1) -> Callable[[Tensor], Tensor]:
    """Approximate inverse Hessian for unknowns that a ``kernel`` spreads: 1 / (|K|^2 / max |K|^2 + floor) in frequency.

    The kernel attenuates high frequencies of the unknown, and with them the gradient; this operator restores the step
    there. The convolution is taken as periodic, which is accurate enough for an initial inverse Hessian.

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
            # Taps beyond the edge of a small array wrap around.
            taps = torch.zeros(height, width, dtype=torch.float64)
            for i, row in enumerate(kernel.tolist()):
                for j, tap in enumerate(row):
                    taps[(i - kernel.shape[0] // 2) % height, (j - kernel.shape[1] // 2) % width] += tap
            power = fft2(taps.to(torch.complex128))[:, : width // 2 + 1].abs().square()
            factors.clear()
            factors[key] = (1 / (power / power.max() + floor)).to(x.device, x.dtype)
        return filter_real(x, factors[key])

    return precondition
