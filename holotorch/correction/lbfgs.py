"""LBFGS: projected, preconditioned, limited-memory quasi-Newton steps for many independent losses at once."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft2, filter_real
from holotorch.correction.run import Box, Projection, Run, Solver, State

_ARMIJO = 1e-4  # least accepted decrease of the loss relative to its linear prediction (Nocedal and Wright, Eq. 3.4)
_SHRINK = 0.5  # factor on the length of a refused step
_SHORTEST = 2.0**-12  # shortest step relative to the first trial
_MEMORY = ("s", "y", "z", "sy", "yz", "scale")  # names of the tensors of _Memory


@dataclass(frozen=True)
class LBFGS(Solver):
    """L-BFGS within a box; each item of a batch has a separate memory and step length and stops separately.

    Elements of x on a bound are held if their descent direction leaves the box. The others take the quasi-Newton step
    and are projected; the step is halved until the loss falls enough (Bertsekas 1982). The initial inverse Hessian is
    ``precondition`` times a scalar. The step is computed for all items at once from inner products of the stored
    vectors, so that it needs only a few passes over these vectors, whatever the number of items.

    Attributes:
        memory: Number of stored pairs of a step and its change of gradient. A larger memory does not help for holograms
            and slows the convergence at strong crosstalk (``holotorch chart pec``).
        precondition: Symmetric positive linear operator on x, such as :func:`spread_preconditioner`; identity if None.
        first: Largest change of an element in the first step, in the unit of x.

    The other attributes, the call and the errors are those of :class:`Solver`.
    Source: Nocedal and Wright, Algorithm 7.4.
    """

    memory: int = 3
    precondition: Callable[[Tensor], Tensor] | None = None
    first: float = 0.5
    max_steps: int = 200
    tolerance: float = 1e-3
    patience: int = 10

    def __post_init__(self):
        super().__post_init__()
        checks.whole("memory", self.memory, 1)
        checks.positive("first", self.first)

    def _begin(self, run: Run) -> State:
        return {"gradient": run.gradient, **_Memory.empty_state(self.memory, run)}

    def _advance(self, run: Run, *, gradient: Tensor, **stored: Tensor) -> State:
        memory = _Memory(stored)
        flat = (*memory.s.shape[:1], -1)
        free = self._free(run.x, gradient, run.project)
        steepest = free * gradient
        guess = self._preconditioned(steepest)
        rows = memory.direction(*(run.rows(part).reshape(flat) for part in (steepest, guess)))
        direction = free * run.from_rows(rows)
        # A memory may no longer describe the loss, for example because other elements are held.
        ascending = ~(run.total(direction * gradient) < 0)
        direction = torch.where(run.expanded(ascending), -free * guess, direction)
        empty = ascending | memory.empty.reshape(run.loss.shape)
        largest = run.rows(direction.abs()).amax(-1)
        first_length = self.first / largest.clamp(min=torch.finfo(largest.dtype).tiny)
        length = torch.where(empty, first_length, 1.0)
        x, loss, after, failed, turned, any_active = self._search(run, direction, gradient, length, ascending)
        # A step that fails with a memory may succeed without it; an item whose step fails without a memory has stalled.
        stalled = failed & empty
        if turned:
            memory.forget((ascending | failed).reshape(-1))
        change = after - gradient
        pair = x - run.x, change, self._preconditioned(change)
        memory.add(*(run.rows(part).reshape(flat) for part in pair))
        run.advance(x, loss, stalled, any_active=any_active)
        gradient = torch.where(run.expanded(run.active), after, gradient)
        return {"gradient": gradient, **memory.state()}

    def _preconditioned(self, x: Tensor) -> Tensor:
        return x if self.precondition is None else self.precondition(x)

    @staticmethod
    def _free(x: Tensor, gradient: Tensor, box: Projection) -> Tensor:
        """1 where an element may move, 0 where it lies on a bound that a step along -gradient would cross."""
        if not isinstance(box, Box):
            raise TypeError(f"LBFGS needs a Box as project, got {type(box).__name__}")
        lower, upper = (torch.as_tensor(bound, dtype=x.dtype, device=x.device) for bound in (box.lower, box.upper))
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        return (~held).to(x.dtype)

    def _search(self, run: Run, direction: Tensor, gradient: Tensor, length: Tensor, ascending: Tensor):
        """Halve the step of each item until its loss falls enough.

        Every trial computes the gradient too, because most first trials are accepted. Returns x, losses, gradient,
        which items failed, whether any failed or was ``ascending``, and whether any remains active (None if not
        known).
        """
        slack = 8 * torch.finfo(run.x.dtype).eps * run.loss
        accepted, failed = ~run.active, torch.zeros_like(run.active)
        shortest = length * _SHORTEST
        best, best_loss, best_gradient = run.x, run.loss, gradient
        first = True
        while True:
            x = run.project(run.x + run.expanded(length) * direction)
            loss, after = run.value_and_gradient(x)
            decrease = _ARMIJO * run.total(gradient * (x - run.x))
            enough = ~accepted & (loss <= run.loss + decrease + slack)
            accepted = accepted | enough
            failed = ~accepted & (length <= shortest)
            left, others, turned, any_active = run.read(
                ~(accepted | failed), ~enough, ascending | failed, run.remaining(loss, failed)
            )
            if not others:  # usually in the first trial
                return x, loss, after, failed, turned, any_active
            moved = run.expanded(enough)
            best, best_gradient = torch.where(moved, x, best), torch.where(moved, after, best_gradient)
            best_loss = torch.where(enough, loss, best_loss)
            if not left:
                return best, best_loss, best_gradient, failed, turned, any_active if first else None
            length, first = torch.where(accepted, length, length * _SHRINK), False


class _Memory:
    """The last m steps s, changes of gradient y, and z = H0 y of every item, oldest first; H0 is the preconditioner.

    The inner products sy = s_i y_j and yz = y_i z_j are float64, since triangular systems are solved with them. A pair
    without positive curvature along s is stored as zeros for that item, and has no effect. Tensors are not modified.
    """

    def __init__(self, state: State):
        self.s, self.y, self.z, self.sy, self.yz, self.scale = (state[f"memory_{name}"] for name in _MEMORY)

    @staticmethod
    def empty_state(size: int, run: Run) -> State:
        """State of an empty memory for ``size`` pairs."""
        items, make = max(1, run.loss.numel()), run.x.new_zeros
        vectors = make(items, size, run.x.numel() // items)
        products = make(items, size, size, dtype=torch.float64)
        scale = make(items, dtype=torch.float64) + 1
        values = vectors, vectors, vectors, products, products, scale
        return {f"memory_{name}": value for name, value in zip(_MEMORY, values, strict=True)}

    def state(self) -> State:
        """Tensors by name, for ``Solution.state``."""
        return {f"memory_{name}": getattr(self, name) for name in _MEMORY}

    @property
    def empty(self) -> Tensor:
        """Whether each item has no pair, [items]."""
        return (self.sy.diagonal(dim1=-2, dim2=-1) == 0).all(-1)

    def forget(self, which: Tensor) -> None:
        """Drop all pairs of the items selected by ``which`` [items]."""
        for name in _MEMORY[:-1]:
            setattr(self, name, torch.where(which[:, None, None], 0, getattr(self, name)))
        self.scale = torch.where(which, 1, self.scale)

    def add(self, step: Tensor, change: Tensor, preconditioned: Tensor) -> None:
        """Add a pair with its preconditioned change, each [items, length], and drop the oldest pair."""
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
        """-H g from the gradients g [items, length] and H0 g, by the compact form of H (Byrd et al. 1994)."""
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


def _bordered(square: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Drop the first row and column of ``square`` [items, m, m]; append ``column`` [items, m, 1] and ``row``."""
    inner = torch.cat([square[:, 1:, 1:], column[:, :-1]], -1)
    return torch.cat([inner, row], -2)


def spread_preconditioner(kernel: Tensor, floor: float = 0.1) -> Callable[[Tensor], Tensor]:
    """Approximate inverse Hessian for unknowns that a ``kernel`` spreads: 1 / (|K|^2 / max |K|^2 + floor) in frequency.

    K is the transform of the kernel. The kernel attenuates high frequencies of the unknown and thus of the gradient;
    this operator amplifies them again. The convolution is treated as periodic, which is accurate enough here.

    Args:
        kernel: Real, [h, w], such as ``ThermalCrosstalk.kernel``.
        floor: Above 0; the amplification of the highest relative to the lowest frequency is at most
            (1 + floor) / floor.
    """
    checks.positive("floor", floor)
    factors: dict[tuple, Tensor] = {}

    def precondition(x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        key = (height, width, x.dtype, x.device)
        if key not in factors:
            # Taps wrap around if the kernel is larger than the array.
            i, j = ((torch.arange(n) - n // 2) % size for n, size in zip(kernel.shape, x.shape[-2:], strict=True))
            taps = torch.zeros(height, width, dtype=torch.complex128)
            taps = taps.index_put((i[:, None], j), kernel.detach().cpu().to(taps.dtype), accumulate=True)
            power = fft2(taps)[:, : width // 2 + 1].abs().square()
            factors.clear()
            factors[key] = (1 / (power / power.max() + floor)).to(x.device, x.dtype)
        return filter_real(x, factors[key])

    return precondition
