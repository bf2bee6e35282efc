"""Gerchberg-Saxton phase retrieval, plain or with the crosstalk in its loop."""

from collections.abc import Callable

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor, wrapped
from holotorch.core.operator import LinearOperator
from holotorch.correction.run import Callback, Solution


def gerchberg_saxton(
    propagator: LinearOperator,
    target: Tensor,
    start: Tensor,
    *,
    max_steps: int = 100,
    crosstalk: Callable[[Tensor], Tensor] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Phases whose propagated intensity resembles ``target``, by alternating the two amplitude constraints.

    Without ``crosstalk`` this is the classical algorithm, and showing its result on a coupled array is the case "no
    correction". With it, each pass spreads the phase before it propagates: the basic iterative PEC of Persson et al.
    and Gemayel et al., which has no deconvolution (thesis Sec. 4.4.3.3, B = S exp(i P(phs(A)))).

    Args:
        propagator: Operator on fields [..., C, H, W] with ``adjoint``.
        target: Wanted intensity, real [C, H, W], mean 1 per channel; its root is the amplitude constraint.
        start: Random far-field phase phi_0 in rad, real [..., C, H, W] (Algorithm 1).
        max_steps: Passes through the loop.
        crosstalk: Operator on phases, or None.
        callback: Sees the state after every pass.

    Returns:
        Solution whose ``x`` are heater phases in [0, 2 pi) and whose losses are || T - |C| ||^2 of each pass, T the
        target amplitude; ``converged`` is False throughout, as no stop rule is used.
    """
    checks.real("target", target)
    checks.all_finite("target", target)
    checks.all_finite("start", start)
    checks.whole("max_steps", max_steps, 1)
    checks.field("start", start, tuple(target.shape), complex_valued=False)
    if target.min() < 0:
        raise ValueError(f"target is an intensity and must be >= 0, got a minimum of {target.min().item():g}")
    amplitude = target.to(start.dtype).sqrt()
    far = amplitude * phasor(start)
    phase, losses = start, []

    def state() -> Solution:
        steps = torch.full_like(losses[0], len(losses) - 1, dtype=torch.int64)
        never = torch.zeros_like(steps, dtype=torch.bool)
        return Solution(phase, torch.stack(losses), steps, never, never, len(losses))

    with torch.no_grad():
        for step in range(max_steps + 1):
            phase = wrapped(torch.angle(propagator.adjoint(far)))
            spread = phase if crosstalk is None else crosstalk(phase)
            formed = propagator(phasor(spread))
            magnitude = intensity(formed).sqrt()
            losses.append((amplitude - magnitude).square().sum((-2, -1)))
            far = amplitude * torch.where(magnitude > 0, formed / torch.where(magnitude > 0, magnitude, 1), 1)
            if callback and step:
                callback(state())
    return state()
