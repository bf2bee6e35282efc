"""HeatCycle: the phases of frames that follow each other so fast that heat of earlier frames remains."""

from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.learning import PreciseModule, without_graph
from holotorch.core.operator import LinearOperator
from holotorch.core.precision import at_least_single, without_autocast


class HeatCycle(PreciseModule):
    """Phases of a cycle of F frames that is repeated endlessly, [..., F * M, C, H, W], from heater phases of F frames.

    Heaters are constant during a frame. The phase of a pixel relaxes exponentially, with one time constant, towards the
    phase S_f = P(X_f) that the crosstalk P gives in the steady state:

        T(t) = S_f + (T(0) - S_f) exp(-t / tau) within frame f.

    In the periodic state, T at the beginning of frame f is the sum over k = 1 .. F of
    (1 - a) a^(k - 1) / (1 - a^F) S_(f - k) with a = exp(-frame_time / tau). This is exact; no steps of time are
    simulated. The operator is linear, and its weights are positive and sum to 1: a limit on the phases S_f also bounds
    T. Used in place of the crosstalk in ``PECProblem`` with ``frames``, it corrects the cycle as a whole.

    A single time constant is a conservative model: where heat also flows sideways, fine patterns decay faster
    than coarse ones.

    Args:
        crosstalk: Real linear operator P on heater phases [..., C, H, W] with an ``adjoint``, such as
            ``ThermalCrosstalk``.
        frame_time: Duration of a frame in seconds.
        time_constant: tau in seconds: a number, or [H, W] for each pixel. An ``nn.Parameter`` is learned.
        moments: Times at which the laser shines, as fractions of the frame in 0 .. 1; the end of the frame by default.
            With M of them the result has M phases for each frame, whose intensities are to be averaged; a laser that is
            always on is sampled at (m + 0.5) / M.
        learnable: Make the time constant a Parameter.

    Raises:
        TypeError: A number of a wrong type.
        ValueError: A time that is not positive, moments outside of 0 .. 1, or a time constant with a gradient that is
            no Parameter; in a call: a phase without an axis of frames.
    """

    time_constant: Tensor

    def __init__(
        self,
        crosstalk: LinearOperator,
        frame_time: float,
        time_constant: float | Tensor,
        *,
        moments: Sequence[float] = (1.0,),
        learnable: bool = False,
    ):
        super().__init__()
        without_graph("time_constant", time_constant)
        self.crosstalk = crosstalk
        self.frame_time = checks.positive("frame_time", frame_time, "seconds")
        self.moments = tuple(checks.finite("moments", moment) for moment in moments)
        if not self.moments or not all(0 <= moment <= 1 for moment in self.moments):
            raise ValueError(f"moments must be fractions of a frame in 0 .. 1, at least one, got {moments!r}")
        is_tensor = isinstance(time_constant, Tensor)
        value = time_constant.detach() if is_tensor else torch.tensor(time_constant, dtype=torch.float64)
        if value.ndim not in (0, 2) or not bool(((value > 0) & torch.isfinite(value)).all()):
            raise ValueError("time_constant must be positive and finite in seconds, a number or [H, W]")
        parameter = isinstance(time_constant, torch.nn.Parameter)
        self.record("time_constant", time_constant if parameter else value.to(torch.float64), learnable=learnable)

    def forward(self, phase: Tensor) -> Tensor:
        """Phases [..., F * M, C, H, W] in rad at all moments of the cycle, for heater phases [..., F, C, H, W]."""
        self._check(phase)
        phase = at_least_single(phase)
        return self._mixed(self.crosstalk(phase), self._weights(phase))

    def adjoint(self, phase: Tensor) -> Tensor:
        """Apply the transpose to ``phase`` [..., F * M, C, H, W]; the result is [..., F, C, H, W]."""
        self._check(phase)
        if phase.shape[-4] % len(self.moments):
            raise ValueError(f"phase must have {len(self.moments)} moments a frame, got {phase.shape[-4]} phases")
        phase = at_least_single(phase)
        weights = self._weights(phase, phase.shape[-4] // len(self.moments))
        return self.crosstalk.adjoint(self._mixed(phase, weights.transpose(0, 1)))

    def _check(self, phase: Tensor) -> None:
        checks.real("phase", phase)
        if phase.ndim < 4:
            raise ValueError(f"phase must end in (F, C, H, W), got {tuple(phase.shape)}")

    def _weights(self, like: Tensor, frames: int | None = None) -> Tensor:
        """Weight of each frame in each phase of the cycle, [F * M, F] or [F * M, F, H, W]."""
        frames = like.shape[-4] if frames is None else frames
        rate = self.frame_time / self.time_constant.to(like.device, torch.float64)  # per frame, [] or [H, W]
        index = torch.arange(frames, device=like.device)
        ago = (index[:, None] - index - 1) % frames  # frames between the end of one frame and the beginning of another
        ago = ago.reshape(frames, frames, *[1] * rate.ndim)
        # exp and expm1 keep their digits for time constants far longer than the cycle.
        before = torch.exp(-rate * ago) * torch.expm1(-rate) / torch.expm1(-rate * frames)
        now = torch.eye(frames, dtype=torch.float64, device=like.device).reshape(ago.shape)
        left = [torch.exp(-rate * moment) for moment in self.moments]
        weights = torch.stack([now * (1 - part) + before * part for part in left], 1)
        return weights.flatten(0, 1).to(like.dtype)

    @staticmethod
    def _mixed(phases: Tensor, weights: Tensor) -> Tensor:
        pixel = "yx" if weights.ndim == 4 else ""
        with without_autocast(phases):
            return torch.einsum(f"mf{pixel},...fcyx->...mcyx", weights, phases)

    def extra_repr(self) -> str:
        """Times, for ``print(module)``."""
        return f"frame_time={self.frame_time}, moments={self.moments}"
