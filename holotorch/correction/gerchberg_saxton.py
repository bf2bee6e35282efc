"""Gerchberg-Saxton phase retrieval, optionally with crosstalk and deconvolution of the phase (iterative PEC)."""

from collections.abc import Callable

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor, wrapped
from holotorch.core.learning import fixed
from holotorch.core.operator import LinearOperator
from holotorch.correction.deconvolution import Crosstalk, deconvolve
from holotorch.correction.problem import check_target
from holotorch.correction.run import Callback, Solution


def gerchberg_saxton(
    propagator: LinearOperator,
    target: Tensor,
    start: Tensor,
    *,
    max_steps: int = 100,
    crosstalk: Callable[[Tensor], Tensor] | None = None,
    deconvolution: Callable[[Tensor, Tensor | None], Tensor] | None = None,
    mask: Tensor | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Phases whose propagated intensity resembles ``target``, by alternating the two amplitude constraints.

    Without ``crosstalk`` this is the classical algorithm; its result on an array with crosstalk is the case "no
    correction". With ``crosstalk`` P, each pass propagates exp(i P(phase of A)), where A is the field propagated back
    from the image. This is the basic iterative PEC of Persson et al. and Gemayel et al. (thesis Sec. 4.4.3.3). With a
    ``deconvolution`` as well it is the thesis's Algorithm 1, :func:`iterative_pec`.

    Args:
        propagator: Operator on fields [..., C, H, W] with ``adjoint``; also one to several depths with ``image_axes``
            = 3, such as ``DepthStack``, whose images all constrain the one hologram (multi-plane phase retrieval).
        target: Wanted intensity, real [C, H, W] or [C, D, H, W], mean 1 per channel; its square root is the amplitude
            constraint.
        start: Random phase phi_0 of the image in rad, real, of the shape of the target after batch axes (Algorithm 1).
        max_steps: Number of passes after the initial one.
        crosstalk: Operator on phases, or None.
        deconvolution: Function (wanted, last) that returns heater phases: ``wanted`` is the phase wanted after
            spreading, in [0, 2 pi), ``last`` the last heater phases, None at first. If None, ``wanted`` is used.
        mask: 1 in the signal region, 0 in the background, where the field is not constrained (Eqs. 4.7, 4.8).
        callback: Called with the solution so far after every pass.

    Returns:
        Solution whose ``x`` are heater phases, in [0, 2 pi) without a ``deconvolution``. The losses are
        || T - |V| ||^2 of each pass within the mask, where T is the target amplitude and V the propagated field.
        ``converged`` is always False, as there is no stop rule.
    """
    axes: int = getattr(propagator, "image_axes", 2)
    check_target(target, mask, axes)
    for name, value in (("start", start), ("target", target), ("mask", mask)):
        fixed(name, value, f"the iterations have no derivative; give {name}.detach()")
    checks.all_finite("start", start)
    checks.whole("max_steps", max_steps, 1)
    checks.field("start", start, tuple(target.shape), complex_valued=False)
    amplitude = target.to(start.dtype).sqrt()
    image = amplitude * phasor(start)  # field in the image plane
    phase, losses = start, []
    weight = torch.ones_like(amplitude) if mask is None else mask.to(amplitude.dtype).expand_as(amplitude)

    def state() -> Solution:
        steps = torch.full_like(losses[0], len(losses) - 1, dtype=torch.int64)
        never = torch.zeros_like(steps, dtype=torch.bool)
        return Solution(phase, torch.stack(losses), steps, never, never, len(losses))

    with torch.no_grad():
        for step in range(max_steps + 1):
            phase_of_image = wrapped(torch.angle(propagator.adjoint(image)))
            phase = phase_of_image if deconvolution is None else deconvolution(phase_of_image, phase if step else None)
            spread = phase if crosstalk is None else crosstalk(phase)
            formed = propagator(phasor(spread))
            magnitude = intensity(formed).sqrt()
            losses.append((weight * (amplitude - magnitude)).square().flatten(-axes).sum(-1))
            constrained = amplitude * torch.where(magnitude > 0, formed / torch.where(magnitude > 0, magnitude, 1), 1)
            image = weight * constrained + (1 - weight) * formed
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
    """Iterative PEC (IPEC), thesis Algorithm 1: Gerchberg-Saxton that deconvolves the phase in every pass.

    With a Fresnel propagator this is the iterative Fresnel PEC (IFPEC) of the thesis, and with a ``DepthStack`` its
    multi-plane form (Sec. 4.4.5.4). Arguments and result are those of
    :func:`gerchberg_saxton`. The deconvolution is :func:`deconvolve` with ``inner_steps``, starting at the wanted
    phase.
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
