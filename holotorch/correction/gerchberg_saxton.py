"""Gerchberg-Saxton phase retrieval: plain, with the crosstalk in its loop, and with its deconvolution (IPEC)."""

from collections.abc import Callable

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor, wrapped
from holotorch.core.operator import LinearOperator
from holotorch.correction.deconvolution import Crosstalk, deconvolve
from holotorch.correction.run import Callback, Solution

Deconvolution = Callable[[Tensor, Tensor | None], Tensor]


def gerchberg_saxton(
    propagator: LinearOperator,
    target: Tensor,
    start: Tensor,
    *,
    max_steps: int = 100,
    crosstalk: Callable[[Tensor], Tensor] | None = None,
    deconvolution: Deconvolution | None = None,
    mask: Tensor | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Phases whose propagated intensity resembles ``target``, by alternating the two amplitude constraints.

    Without ``crosstalk`` this is the classical algorithm, and showing its result on a coupled array is the case "no
    correction". With it, each pass spreads the phase before it propagates: the basic iterative PEC of Persson et al.
    and Gemayel et al., which has no deconvolution (thesis Sec. 4.4.3.3, B = S exp(i P(phs(A)))). With both it is the
    thesis's Algorithm 1, see :func:`iterative_pec`.

    Args:
        propagator: Operator on fields [..., C, H, W] with ``adjoint``.
        target: Wanted intensity, real [C, H, W], mean 1 per channel; its root is the amplitude constraint.
        start: Random far-field phase phi_0 in rad, real [..., C, H, W] (Algorithm 1).
        max_steps: Passes through the loop.
        crosstalk: Operator on phases, or None.
        deconvolution: From the phase wanted after spreading, in [0, 2 pi), and the heater phases of the last pass (None
            in the first) to the new ones; None leaves them as they are.
        mask: 1 in the signal region, 0 in the background, where the light stays as it comes (Eqs. 4.7, 4.8).
        callback: Sees the state after every pass.

    Returns:
        Solution whose ``x`` are heater phases in [0, 2 pi), or what ``deconvolution`` gave, and whose losses are
        || T - |C| ||^2 of each pass, T the target amplitude, within the mask; ``converged`` is False throughout, as no
        stop rule is used.
    """
    checks.real("target", target)
    checks.all_finite("target", target)
    checks.all_finite("start", start)
    checks.whole("max_steps", max_steps, 1)
    checks.field("start", start, tuple(target.shape), complex_valued=False)
    if target.min() < 0:
        raise ValueError(f"target is an intensity and must be >= 0, got a minimum of {target.min().item():g}")
    if mask is not None:
        checks.weights("mask", mask, tuple(target.shape))
    amplitude = target.to(start.dtype).sqrt()
    far = amplitude * phasor(start)
    phase, losses = start, []
    weight = torch.ones_like(amplitude) if mask is None else mask.to(amplitude.dtype).expand_as(amplitude)

    def state() -> Solution:
        steps = torch.full_like(losses[0], len(losses) - 1, dtype=torch.int64)
        never = torch.zeros_like(steps, dtype=torch.bool)
        return Solution(phase, torch.stack(losses), steps, never, never, len(losses))

    with torch.no_grad():
        for step in range(max_steps + 1):
            wanted = wrapped(torch.angle(propagator.adjoint(far)))
            phase = wanted if deconvolution is None else deconvolution(wanted, phase if step else None)
            spread = phase if crosstalk is None else crosstalk(phase)
            formed = propagator(phasor(spread))
            magnitude = intensity(formed).sqrt()
            losses.append((weight * (amplitude - magnitude)).square().sum((-2, -1)))
            aimed = amplitude * torch.where(magnitude > 0, formed / torch.where(magnitude > 0, magnitude, 1), 1)
            far = weight * aimed + (1 - weight) * formed
            if callback and step:
                callback(state())
    return state()


def iterative_pec(
    propagator: LinearOperator,
    crosstalk: Crosstalk,
    target: Tensor,
    start: Tensor,
    *,
    max_steps: int = 30,
    inner_steps: int = 30,
    mask: Tensor | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Iterative PEC, thesis Algorithm 1: Gerchberg-Saxton that deconvolves the phase in every pass.

    With a Fresnel propagator it is the thesis's IFPEC.

    Args:
        propagator: Operator on fields [..., C, H, W] with ``adjoint``.
        crosstalk: P; the deconvolution is non-negative, by ``inner_steps`` of :func:`deconvolve` from the wanted phase.
        target: Wanted intensity, real [C, H, W], mean 1 per channel.
        start: Random far-field phase phi_0 in rad, real [..., C, H, W].
        max_steps: Passes; each costs ``inner_steps`` applications of P and of its transpose.
        inner_steps: Iterations of each deconvolution.
        mask: Signal region, as in :func:`gerchberg_saxton`.
        callback: Sees the state after every pass.
    """
    return gerchberg_saxton(
        propagator,
        target,
        start,
        max_steps=max_steps,
        crosstalk=crosstalk,
        deconvolution=lambda wanted, _: deconvolve(crosstalk, wanted, max_steps=inner_steps),
        mask=mask,
        callback=callback,
    )
