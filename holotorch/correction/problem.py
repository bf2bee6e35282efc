"""PECProblem: the squared difference between the image of a thermally coupled array and the target image."""

import math
import warnings
from collections.abc import Callable

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor
from holotorch.core.learning import fixed, without_graph

_DIM, _BRIGHT = 0.5, 1.05  # means of a target outside of which it was hardly meant for an array of mean 1
FRAMES_AT_ONCE = 1 << 23  # pixels of all frames above which each is propagated by itself, which then takes no longer


class PECProblem(nn.Module):
    """Loss g(X) = || U(X) - I ||^2 with U(X) = | F(exp(i P(X))) |^2, one value per hologram and colour.

    The unknown X are heater phases in rad, [..., C, H, W]. With ``frames`` they are [..., F, C, H, W], and the F frames
    of a colour share one loss. Solvers read from :attr:`unknown_axes` which axes of X belong to one loss; a function
    that wraps a problem needs the same attribute.

    Args:
        crosstalk: Real linear operator P on heater phases [..., H, W], such as ``ThermalCrosstalk``.
        propagator: Complex linear operator F on fields [..., C, H, W], to [..., C, *image]. If its result is real, it
            is an intensity already, such as that on the retina of an observer.
        target: Wanted intensity I, real [..., C, *image], >= 0, whose leading axes are those of a batch of phases. If F
            is unitary, I must be scaled to mean 1 per channel, the mean of U by Parseval's theorem. The image is
            [H, W], or [D, H, W] for a propagator to several depths with ``image_axes`` = 3, such as ``DepthStack``.
            None for a target that is given in each call.
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
        smoothness_weight: Weight >= 0 of the sum of squared differences of X between neighbours, added to the loss.
        light_weight: Weight >= 0 of the fraction of the emitted light that misses the image, times the sum of the
            target. For several images, such as those at several foci, it is the mean. The images must have the pixel
            size of the array, as those of propagators with a single pitch have.
        laser: With ``frames``, the relative power >= 0 of the laser in each frame and colour, [F, C], 1 by default;
            U is the mean of the intensities times these powers. An ``nn.Parameter`` is learned by an optimiser of
            parameters; the solvers keep it.

    Raises:
        TypeError: ``target`` is not a real tensor, or ``propagator`` is a ``ThermalCrosstalk``.
        ValueError: A target that is not [..., C, *image], not finite, negative somewhere or black in a channel; a mask
            that is negative somewhere or 0 in all of a channel; a negative weight; in a call: a phase or a target of
            another shape, or no target at all. The values of a target given in a call are not checked.

    Warns:
        SamplingWarning: ``target`` is brighter than the light of the array, or less than half as bright, and nothing
            scales it.

    Source: thesis Eqs. 4.9, 4.10 (Fourier) and 4.50, 4.51 (Fresnel; the transfer function is misplaced in print).
    """

    target: Tensor  # None if each call gives one
    mask: Tensor | None
    limit: Tensor | None
    laser: Tensor | None

    def __init__(
        self,
        crosstalk: Callable[[Tensor], Tensor],
        propagator: Callable[[Tensor], Tensor],
        target: Tensor | None = None,
        *,
        mask: Tensor | None = None,
        scale_free: bool = False,
        amplitude: bool = False,
        frames: bool = False,
        limit: float | Tensor | None = None,
        limit_weight: float = 1.0,
        power_weight: float = 0.0,
        smoothness_weight: float = 0.0,
        light_weight: float = 0.0,
        laser: Tensor | None = None,
    ):
        super().__init__()
        if hasattr(propagator, "lost_heat"):  # what ThermalCrosstalk has
            got = type(propagator).__name__
            raise TypeError(f"propagator must map fields to images, got {got}, which is the first argument")
        self.image_axes: int = getattr(propagator, "image_axes", 2)
        if target is not None:
            self._check_axes(target)
            fixed("target", target, "give it in the call, problem(phase, target)")
            check_target(target, mask, self.image_axes)
            black = (target.flatten(-self.image_axes).mean(-1) == 0).nonzero()
            if len(black):
                *item, channel = black[0].tolist()
                of = f" of item {tuple(item)}" if item else ""
                raise ValueError(f"target channel {channel}{of} is black: there is no light to form, leave it out")
            if mask is None and not scale_free:
                _warn_of_brightness(target.flatten(-self.image_axes).mean(-1))
        fixed("mask", mask, "it is constant; give mask.detach()")
        self.crosstalk, self.propagator, self.scale_free = crosstalk, propagator, scale_free
        self.amplitude, self.frames = amplitude, frames
        self.limit_weight = checks.nonnegative("limit_weight", limit_weight)
        self.power_weight = checks.nonnegative("power_weight", power_weight)
        self.smoothness_weight = checks.nonnegative("smoothness_weight", smoothness_weight)
        self.light_weight = checks.nonnegative("light_weight", light_weight)
        self._set_laser(laser)
        self.register_buffer("target", target, persistent=False)
        self.register_buffer("mask", mask, persistent=False)
        if limit is not None:
            fixed("limit", limit, "it is constant; give limit.detach()")
            limit = torch.as_tensor(limit, dtype=torch.float64).reshape(-1, 1, 1)
            limit = limit if target is None else limit.to(target.device)
            if not (limit > 0).all():
                raise ValueError("limit must be above zero in rad")
            checks.all_finite("limit", limit)
            channels = len(limit) if target is None else target.shape[-1 - self.image_axes]
            if len(limit) not in (1, channels):
                raise ValueError(f"limit must be a number or one per channel, {channels}, got {len(limit)}")
        self.register_buffer("limit", limit, persistent=False)

    @property
    def unknown_axes(self) -> tuple[int, ...]:
        """Axes of the unknown that belong to one loss, counted from the end."""
        return (-4, -2, -1) if self.frames else (-2, -1)

    def forward(self, phase: Tensor, target: Tensor | None = None) -> Tensor:
        """Loss [..., C] of heater phases in rad, real [..., C, H, W], or [..., F, C, H, W] with ``frames``.

        ``target``, real [..., C, *image], may carry a gradient; by default it is that of the constructor.
        """
        spread = self.crosstalk(phase)
        image = self._image(spread)
        loss = self.misfit(image, target)
        if self.limit is not None and self.limit_weight:
            above = spread - self.limit.to(spread.dtype)
            loss = loss + self.limit_weight * self._total(above.clamp(min=0).square())
        if self.power_weight:
            loss = loss + self.power_weight * self._total(phase)
        if self.smoothness_weight:
            steps = self._total(phase.diff(dim=-1).square()) + self._total(phase.diff(dim=-2).square())
            loss = loss + self.smoothness_weight * steps
        if self.light_weight:
            reference = self.target if target is None else target
            images = math.prod(image.shape[-self.image_axes : -2])
            arrives = image.flatten(-self.image_axes).sum(-1) / (images * math.prod(phase.shape[-2:]))
            loss = loss + self.light_weight * reference.flatten(-self.image_axes).sum(-1) * (1 - arrives)
        return loss

    def intensity(self, phase: Tensor) -> Tensor:
        """U(X), real [..., C, *image]."""
        return self._image(self.crosstalk(phase))

    def misfit(self, formed: Tensor, target: Tensor | None = None) -> Tensor:
        """Squared difference [..., C] of an intensity [..., C, *image] and the target, as the options define it."""
        target = self.target if target is None else target
        if target is None:
            raise ValueError("target must be given, to PECProblem or in the call, got none")
        self._check_axes(target)
        axes = 1 + self.image_axes
        if formed.shape[-axes:] != target.shape[-axes:]:
            ends = "(C, H, W)" if axes == 3 else "(C, *image)"
            raise ValueError(
                f"target must end in {ends} = {tuple(formed.shape[-axes:])}, as the image that the phase forms, got "
                f"{tuple(target.shape)}"
            )
        one, other = tuple(formed.shape[:-axes]), tuple(target.shape[:-axes])
        # torch.broadcast_shapes loads a computer algebra system first, in half a second.
        if any(a != b and 1 not in (a, b) for a, b in zip(reversed(one), reversed(other), strict=False)):
            raise ValueError(f"phase and target must have leading axes that broadcast, got {one} and {other}")
        target = target.to(formed.dtype)
        if self.amplitude:
            # The addend keeps the gradient of the root bounded where U is 0.
            formed, target = (formed + torch.finfo(formed.dtype).tiny).sqrt(), target.sqrt()
        if self.mask is not None:
            mask = self.mask.to(formed.dtype)
            formed, target = formed * mask, target * mask
        first = -self.image_axes
        if self.scale_free:
            # The derivative of the loss with respect to s is zero, but its second derivatives are not.
            scale = best_scale(formed, target, first)
            formed = formed * scale.reshape(*scale.shape, *[1] * -first)
        return (formed - target).square().flatten(first).sum(-1)

    def _total(self, values: Tensor) -> Tensor:
        """Sum [..., C] of values shaped as the unknown over the axes that belong to one loss."""
        return values.movedim(-4, -3).flatten(-3).sum(-1) if self.frames else values.flatten(-2).sum(-1)

    def _image(self, spread: Tensor) -> Tensor:
        """U, real [..., C, *image], of phases after spreading."""
        if self.frames and spread.ndim < 4:
            raise ValueError(f"phase must end in (F, C, H, W), as frames=True has it, got {tuple(spread.shape)}")
        divided = getattr(self.propagator, "divides_frames", False)  # among processes, from all frames at once
        if self.frames and self.laser is None and spread.numel() > FRAMES_AT_ONCE and not divided:
            # In turn, since fields and what their transforms need take several times the memory of the phases.
            images = [self._images(frame).mean(-2 - self.image_axes) for frame in spread.split(1, -4)]
            return sum(images[1:], images[0]) / len(images)
        image = self._images(spread)
        if not self.frames:
            return image
        axis = image.ndim - 2 - self.image_axes
        if self.laser is not None:
            # A frame may have several images, one for each moment at which its laser shines.
            if image.shape[axis] % len(self.laser):
                raise ValueError(f"phase must have the frames of laser, {len(self.laser)}, got {image.shape[axis]}")
            powers = self.laser.to(image.dtype).repeat_interleave(image.shape[axis] // len(self.laser), 0)
            image = image * powers.reshape(*powers.shape, *[1] * self.image_axes)
        return image.mean(axis)

    def _images(self, spread: Tensor) -> Tensor:
        """Intensities that fields of these phases after spreading form, each by itself."""
        try:
            image = self.propagator(phasor(spread))
        except ValueError as error:  # of a field of another shape, which is that of the phase that was given
            if not (message := str(error)).startswith("field must end in"):
                raise
            raise ValueError(message.replace("field", "phase", 1)) from None
        return intensity(image) if image.is_complex() else image

    def _set_laser(self, laser: Tensor | None) -> None:
        if laser is None:
            self.register_buffer("laser", None)
            return
        without_graph("laser", laser)
        checks.real("laser", laser)
        checks.all_finite("laser", laser.detach())
        if laser.ndim != 2 or not self.frames or bool((laser.detach() < 0).any()):
            raise ValueError(
                f"laser must be powers >= 0, [F, C], of a problem with frames=True, got {tuple(laser.shape)} with "
                f"frames={self.frames}"
            )
        if isinstance(laser, nn.Parameter):
            self.laser = laser
        else:
            self.register_buffer("laser", laser)

    def _check_axes(self, target: Tensor) -> None:
        """Raise unless ``target`` is real and has the axes of a channel and an image."""
        checks.real("target", target)
        if target.ndim < 1 + self.image_axes:
            axes = "(..., C, *image), as (C, H, W) has" if self.image_axes == 2 else "(..., C, D, H, W)"
            raise ValueError(f"target must have axes {axes}, got {tuple(target.shape)}")


def check_target(target: Tensor, mask: Tensor | None, image_axes: int = 2) -> None:
    """Raise unless ``target`` [..., C, *image] is a valid intensity, and ``mask`` None or valid weights for it."""
    checks.real("target", target)
    checks.all_finite("target", target)
    if target.numel() and target.min() < 0:
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
    empty = ~(mask.expand(target.shape) != 0).flatten(-image_axes).any(-1)
    if bool(empty.any()):
        raise ValueError(
            f"mask is zero everywhere in channel {int(empty.nonzero()[0][-1])}: nothing is left to compare"
        )


def _warn_of_brightness(means: Tensor) -> None:
    """Warn if no array, whose pixels each emit light of 1, forms an image of these means [..., C]."""
    dimmest, brightest = means.min().item(), means.max().item()
    if dimmest < _DIM or brightest > _BRIGHT:
        warnings.warn(
            f"target has a mean of {dimmest if dimmest < _DIM else brightest:.3g} in a channel, but the light of an "
            "array has a mean of 1 (less where some of it leaves the image): divide the target by its mean in each "
            "channel, or give scale_free=True",
            checks.SamplingWarning,
            stacklevel=3,
        )


def best_scale(formed: Tensor, target: Tensor, first: int = -2) -> Tensor:
    """Scale s that minimises || s formed - target || over the axes from ``first`` on; 1 where ``formed`` is black."""
    power = formed.square().flatten(first).sum(-1)
    lit = power > 0
    return torch.where(lit, (formed * target).flatten(first).sum(-1) / torch.where(lit, power, 1), 1)
