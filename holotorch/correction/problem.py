"""PECProblem: the squared difference between the image of a thermally coupled array and the wanted image."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor


class PECProblem(nn.Module):
    """Loss g(X) = || U(X) - I ||^2 with U(X) = | F(exp(i P(X))) |^2, one value per hologram and colour.

    The unknown X are heater phases in rad, [..., C, H, W]. With ``frames`` they are [..., F, C, H, W], and the F frames
    of a colour share one loss. Solvers read from :attr:`unknown_axes` which axes of X belong to one loss; a function
    that wraps a problem needs the same attribute.

    Args:
        crosstalk: Real linear operator P on heater phases [..., H, W], such as ``ThermalCrosstalk``.
        propagator: Complex linear operator F on fields [..., C, H, W], to [..., C, *image].
        target: Wanted intensity I, real [C, *image], >= 0. If F is unitary, I must be scaled to mean 1 per channel,
            the mean of U by Parseval's theorem. The image is [H, W], or [D, H, W] for a propagator to several depths,
            such as ``DepthStack``.
        mask: Weights >= 0 of U - I that broadcast to the target; 0 where the image is unconstrained, such as outside a
            signal region.
        scale_free: Compare s U with I instead, where s = <U, I> / <U, U> is the best scale of each hologram and colour.
            Use it if light may leave the window or the mask.
        amplitude: Compare sqrt(U) with sqrt(I) instead; this loss has a nonzero gradient where U is dark.
        frames: X has an axis of F frames that are shown one after another; U is the mean of their intensities.
        limit: Phase P(X) in rad above which a penalty is added, a number or [C]. The penalty alone does not enforce the
            limit; ``penalty_schedule`` with ``limit_peak_phase`` does.
        limit_weight: Weight >= 0 of the penalty || max(P(X) - limit, 0) ||^2.
        power_weight: Weight >= 0 of the sum of X, which is proportional to the heating power and is added to the loss.

    Raises:
        TypeError: ``target`` is not a real tensor.
        ValueError: A target that is not [C, *image], not finite, negative somewhere or black in a channel; a mask that
            is negative somewhere or 0 in all of a channel; a negative weight; in a call: a phase of another shape.

    Source: thesis Eqs. 4.9, 4.10 (Fourier) and 4.50, 4.51 (Fresnel; the transfer function is misplaced in print).
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
        if target.ndim < 3:
            raise ValueError(f"target must have axes (C, *image), as (C, H, W) has, got {tuple(target.shape)}")
        check_target(target, mask)
        for channel, mean in enumerate(target.flatten(1).mean(1).tolist()):
            if mean == 0:
                raise ValueError(f"target channel {channel} is black: there is no light to form, leave it out")
        self.crosstalk, self.propagator, self.scale_free = crosstalk, propagator, scale_free
        self.amplitude, self.frames = amplitude, frames
        self.limit_weight = checks.nonnegative("limit_weight", limit_weight)
        self.power_weight = checks.nonnegative("power_weight", power_weight)
        self.register_buffer("target", target, persistent=False)
        self.register_buffer("mask", mask, persistent=False)
        if limit is not None:
            limit = torch.as_tensor(limit, dtype=target.dtype).reshape(-1, 1, 1)
            if not (limit > 0).all():
                raise ValueError("limit must be above zero in rad")
            checks.all_finite("limit", limit)
            if len(limit) not in (1, len(target)):
                raise ValueError(f"limit must be a number or one per channel, {len(target)}, got {len(limit)}")
        self.register_buffer("limit", limit, persistent=False)

    @property
    def unknown_axes(self) -> tuple[int, ...]:
        """Axes of the unknown that belong to one loss, counted from the end."""
        return (-4, -2, -1) if self.frames else (-2, -1)

    def forward(self, phase: Tensor) -> Tensor:
        """Loss [..., C] of heater phases in rad, real [..., C, H, W], or [..., F, C, H, W] with ``frames``."""
        spread = self.crosstalk(phase)
        loss = self.misfit(self._image(spread))
        if self.limit is not None and self.limit_weight:
            loss = loss + self.limit_weight * self._total((spread - self.limit).clamp(min=0).square())
        if self.power_weight:
            loss = loss + self.power_weight * self._total(phase)
        return loss

    def intensity(self, phase: Tensor) -> Tensor:
        """U(X), real [..., C, *image]."""
        return self._image(self.crosstalk(phase))

    def misfit(self, formed: Tensor) -> Tensor:
        """Squared difference [..., C] of an intensity [..., C, *image] and the target, as the options define it."""
        if formed.shape[-self.target.ndim :] != self.target.shape:
            wanted = "end in (C, H, W)" if self.target.ndim == 3 else "give an image that ends in (C, *image)"
            raise ValueError(f"phase must {wanted} = {tuple(self.target.shape)}, got {tuple(formed.shape)}")
        target = self.target.to(formed.dtype)
        if self.amplitude:
            # The addend keeps the gradient of the root bounded where U is 0.
            formed, target = (formed + torch.finfo(formed.dtype).tiny).sqrt(), target.sqrt()
        if self.mask is not None:
            mask = self.mask.to(formed.dtype)
            formed, target = formed * mask, target * mask
        first = 1 - self.target.ndim  # first axis of the image
        if self.scale_free:
            # The derivative of the loss with respect to s is zero, so s is treated as a constant.
            scale = best_scale(formed.detach(), target, first)
            formed = formed * scale.reshape(*scale.shape, *[1] * -first)
        return (formed - target).square().flatten(first).sum(-1)

    def _total(self, values: Tensor) -> Tensor:
        """Sum [..., C] of values shaped as the unknown over the axes that belong to one loss."""
        return values.movedim(-4, -3).flatten(-3).sum(-1) if self.frames else values.flatten(-2).sum(-1)

    def _image(self, spread: Tensor) -> Tensor:
        """U, real [..., C, *image], of phases after spreading."""
        if self.frames and spread.ndim < 4:
            raise ValueError(f"phase must end in (F, C, H, W), as frames=True has it, got {tuple(spread.shape)}")
        image = intensity(self.propagator(phasor(spread)))
        return image.mean(-1 - self.target.ndim) if self.frames else image


def check_target(target: Tensor, mask: Tensor | None) -> None:
    """Raise unless ``target`` is a valid intensity, and ``mask`` None or valid weights for it."""
    checks.real("target", target)
    checks.all_finite("target", target)
    if target.min() < 0:
        raise ValueError(f"target is an intensity and must be >= 0, got a minimum of {target.min().item():g}")
    if mask is None:
        return
    checks.all_finite("mask", mask)
    sizes = zip(mask.shape[::-1], target.shape[::-1], strict=False)
    fits = mask.ndim <= target.ndim and all(n in (1, size) for n, size in sizes)
    if not fits or (mask.numel() and mask.min() < 0):
        raise ValueError(
            f"mask must be >= 0 and broadcast to the target {tuple(target.shape)}, got {tuple(mask.shape)}"
        )
    empty = ~mask.expand(target.shape).flatten(1).any(1)
    if bool(empty.any()):
        raise ValueError(f"mask is zero everywhere in channel {int(empty.nonzero()[0])}: nothing is left to compare")


def best_scale(formed: Tensor, target: Tensor, first: int = -2) -> Tensor:
    """Scale s that minimises || s formed - target || over the axes from ``first`` on; 1 where ``formed`` is black."""
    power = formed.square().flatten(first).sum(-1)
    lit = power > 0
    return torch.where(lit, (formed * target).flatten(first).sum(-1) / torch.where(lit, power, 1), 1)
