"""PECProblem: how far the image of a thermally coupled array is from the wanted one."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor


class PECProblem(nn.Module):
    """g(X) = || U(X) - I ||^2 with U(X) = | F(exp(i P(X))) |^2, one value per hologram and colour.

    Args:
        crosstalk: Real linear operator P on heater phases [..., H, W], such as ``ThermalCrosstalk``.
        propagator: Complex linear operator F on fields [..., C, H, W], to [..., C, *image].
        target: Wanted intensity I, real [C, *image], >= 0 and scaled to mean 1 per channel where F keeps the light, as
            a unitary one does (Parseval), so that no scale between U and I is left open. The image is [H, W], or
            [D, H, W] for a propagator to several depths, such as ``DepthStack``.
        mask: Weights >= 0 that broadcast to the target, 0 where anything may be: beside a signal region, or out of
            focus at a depth. They multiply U - I, so that the root of a weight map weighs the squared error.
        scale_free: Compare s U with I instead, s = <U, I> / <U, U> the best scale of each hologram and colour. For
            light that may leave the window or the mask; report the efficiency beside the result.
        amplitude: Compare sqrt(U) with sqrt(I) instead, whose gradient does not vanish where U is dark.
        frames: The unknown is [..., C, F, H, W], F frames shown in turn, and U the mean of their intensities. Heater
            phases elsewhere, such as a run's ``phase.npy``, are [F, C, H, W]; where F = C no shape can tell the two
            orders apart, so go from one to the other by :meth:`unknown` and :meth:`heater_phase` only.
        limit: In rad, a number or [C]: from here on P(X), the temperature that the chip really reaches, is penalised. A
            penalty alone does not keep it: ``limited`` with ``below`` does.
        limit_weight: Weight >= 0 of the penalty || max(P(X) - limit, 0) ||^2 that is added.
        power_weight: Weight >= 0 of the sum of X, the heating power, that is added.

    Raises:
        TypeError: ``target`` is not a real tensor.
        ValueError: ``target`` is not [C, *image], not finite, negative somewhere, or black in a channel; a mask that is
            negative or leaves nothing of a channel; a negative weight; in a call: a phase of another shape.

    Source: thesis Eqs. 4.9, 4.10 (Fourier) and 4.50, 4.51 (Fresnel; there H stands inside the transform by mistake).
    """

    target: Tensor
    mask: Tensor | None
    limit: Tensor | None

    def __init__(
        self,
        crosstalk: Callable[[Tensor], Tensor],
        propagator: Callable[[Tensor], Tensor],
        target: Tensor,
        *,
        mask: Tensor | None = None,
        scale_free: bool = False,
        amplitude: bool = False,
        frames: bool = False,
        limit: float | Tensor | None = None,
        limit_weight: float = 1.0,
        power_weight: float = 0.0,
    ):
        super().__init__()
        checks.real("target", target)
        checks.all_finite("target", target)
        if target.ndim < 3:
            raise ValueError(f"target must have axes (C, *image), as (C, H, W) has, got {tuple(target.shape)}")
        if target.min() < 0:
            raise ValueError(f"target is an intensity and must be >= 0, got a minimum of {target.min().item():g}")
        for channel, mean in enumerate(target.flatten(1).mean(1).tolist()):
            if mean == 0:
                raise ValueError(f"target channel {channel} is black: there is no light to form, leave it out")
        if mask is not None:
            checks.weights("mask", mask, tuple(target.shape))
        self.crosstalk, self.propagator, self.scale_free = crosstalk, propagator, scale_free
        self.amplitude, self.frames = amplitude, frames
        self.limit_weight = checks.nonnegative("limit_weight", limit_weight)
        self.power_weight = checks.nonnegative("power_weight", power_weight)
        self.register_buffer("target", target, persistent=False)
        self.register_buffer("mask", mask, persistent=False)
        if limit is not None:
            # One value per channel, against [C, H, W] or [C, F, H, W].
            limit = torch.as_tensor(limit, dtype=target.dtype).reshape(-1, *[1] * (3 if frames else 2))
            if not (limit > 0).all():
                raise ValueError("limit must be above zero in rad")
            checks.all_finite("limit", limit)
            if len(limit) not in (1, len(target)):
                raise ValueError(f"limit must be a number or one per channel, {len(target)}, got {len(limit)}")
        self.register_buffer("limit", limit, persistent=False)

    def forward(self, phase: Tensor) -> Tensor:
        """Loss [..., C] for heater phases in rad, real [..., C, H, W], or [..., C, F, H, W] with ``frames``."""
        spread = self.crosstalk(phase)
        loss = self.misfit(self._image(spread))
        behind = -3 if self.frames else -2
        if self.limit is not None and self.limit_weight:
            loss = loss + self.limit_weight * (spread - self.limit).clamp(min=0).square().flatten(behind).sum(-1)
        if self.power_weight:
            loss = loss + self.power_weight * phase.flatten(behind).sum(-1)
        return loss

    def intensity(self, phase: Tensor) -> Tensor:
        """U(X), real [..., C, *image]."""
        return self._image(self.crosstalk(phase))

    def unknown(self, phase: Tensor) -> Tensor:
        """The unknown that :meth:`forward` takes, of heater phases: with ``frames`` of [..., F, C, H, W].

        Raises:
            ValueError: With ``frames``, C is not that of the target.
        """
        if not self.frames:
            return phase
        if phase.ndim < 4 or phase.shape[-3] != len(self.target):
            wanted = f"(F, C, H, W) with C = {len(self.target)}"
            raise ValueError(f"heater phases must end in {wanted}, got {tuple(phase.shape)}")
        return phase.movedim(-3, -4)

    def heater_phase(self, unknown: Tensor) -> Tensor:
        """Heater phases, with ``frames`` [..., F, C, H, W], of the unknown; inverse of :meth:`unknown`."""
        if not self.frames:
            return unknown
        if unknown.ndim < 4 or unknown.shape[-4] != len(self.target):
            wanted = f"(C, F, H, W) with C = {len(self.target)}"
            raise ValueError(f"the unknown must end in {wanted}, got {tuple(unknown.shape)}")
        return unknown.movedim(-3, -4)

    def misfit(self, formed: Tensor) -> Tensor:
        """Distance [..., C] of an intensity [..., C, *image] from the target."""
        if formed.shape[-self.target.ndim :] != self.target.shape:
            wanted = "end in (C, H, W)" if self.target.ndim == 3 else "give an image that ends in (C, *image)"
            raise ValueError(f"phase must {wanted} = {tuple(self.target.shape)}, got {tuple(formed.shape)}")
        target = self.target.to(formed.dtype)
        if self.amplitude:
            # The root of U + tiny has a gradient that stays bounded where U is 0.
            formed, target = (formed + torch.finfo(formed.dtype).tiny).sqrt(), target.sqrt()
        if self.mask is not None:
            mask = self.mask.to(formed.dtype)
            formed, target = formed * mask, target * mask
        behind = 1 - self.target.ndim
        if self.scale_free:
            # s minimises the loss, so its own derivative is zero and need not be followed.
            scale = best_scale(formed.detach(), target, behind)
            formed = formed * scale.reshape(*scale.shape, *[1] * -behind)
        return (formed - target).square().flatten(behind).sum(-1)

    def _image(self, spread: Tensor) -> Tensor:
        if not self.frames:
            return intensity(self.propagator(phasor(spread)))
        if spread.ndim < 4:
            raise ValueError(f"phase must end in (C, F, H, W), as frames=True has it, got {tuple(spread.shape)}")
        # Fields keep their channel before the picture: frames go in front of it, and are averaged there.
        formed = intensity(self.propagator(phasor(self.heater_phase(spread))))
        return formed.mean(-1 - self.target.ndim)


def best_scale(formed: Tensor, target: Tensor, behind: int = -2) -> Tensor:
    """The scale s of ``formed`` with the least || s formed - target || over the axes from ``behind`` on; 1 if black."""
    power = formed.square().flatten(behind).sum(-1)
    lit = power > 0
    return torch.where(lit, (formed * target).flatten(behind).sum(-1) / torch.where(lit, power, 1), 1)
