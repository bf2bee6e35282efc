"""PECProblem: how far the image of a thermally coupled array is from the wanted one."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor


class PECProblem(nn.Module):
    """g(X) = || U(X) - I ||^2 with U(X) = | F(exp(i P(X))) |^2, one value per hologram and colour.

    Args:
        crosstalk: Real linear operator P on heater phases [..., C, H, W], such as ``ThermalCrosstalk``.
        propagator: Complex linear operator F on fields [..., C, H, W].
        target: Wanted intensity I, real [C, H, W], >= 0 and scaled to mean 1 per channel. A unitary F keeps the mean
            at 1 (Parseval), so that no scale between U and I is left open.
        scale_free: Compare s U with I instead, s = <U, I> / <U, U> the best scale of each hologram and colour. For
            propagators that let light leave the window; report the efficiency beside the result.

    Raises:
        TypeError: ``target`` is not a real tensor.
        ValueError: ``target`` is not [C, H, W], not finite, negative somewhere, or black in a channel; in a call: a
            phase of another shape.

    Source: thesis Eqs. 4.9, 4.10 (Fourier) and 4.50, 4.51 (Fresnel; there H stands inside the transform by mistake).
    """

    target: Tensor

    def __init__(
        self,
        crosstalk: Callable[[Tensor], Tensor],
        propagator: Callable[[Tensor], Tensor],
        target: Tensor,
        *,
        scale_free: bool = False,
    ):
        super().__init__()
        checks.real("target", target)
        checks.all_finite("target", target)
        if target.ndim != 3:
            raise ValueError(f"target must have axes (C, H, W), got {tuple(target.shape)}")
        if target.min() < 0:
            raise ValueError(f"target is an intensity and must be >= 0, got a minimum of {target.min().item():g}")
        for channel, mean in enumerate(target.mean((-2, -1)).tolist()):
            if mean == 0:
                raise ValueError(f"target channel {channel} is black: there is no light to form, leave it out")
        self.crosstalk, self.propagator, self.scale_free = crosstalk, propagator, scale_free
        self.register_buffer("target", target, persistent=False)

    def forward(self, phase: Tensor) -> Tensor:
        """Loss [..., C] for heater phases in rad, real [..., C, H, W]."""
        formed = self.intensity(phase)
        if formed.shape[-3:] != self.target.shape:
            raise ValueError(f"phase must end in (C, H, W) = {tuple(self.target.shape)}, got {tuple(phase.shape)}")
        target = self.target.to(formed.dtype)
        if self.scale_free:
            # s minimises the loss, so its own derivative is zero and need not be followed.
            formed = formed * best_scale(formed.detach(), target)[..., None, None]
        return (formed - target).square().sum((-2, -1))

    def intensity(self, phase: Tensor) -> Tensor:
        """U(X), real [..., C, H, W]."""
        return intensity(self.propagator(phasor(self.crosstalk(phase))))


def best_scale(formed: Tensor, target: Tensor) -> Tensor:
    """The scale s of ``formed`` [..., H, W] for which || s formed - target || is least; 1 for a black ``formed``."""
    power = formed.square().sum((-2, -1))
    lit = power > 0
    return torch.where(lit, (formed * target).sum((-2, -1)) / torch.where(lit, power, 1), 1)
