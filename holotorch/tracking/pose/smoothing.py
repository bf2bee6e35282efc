"""Steadier and timelier poses: the One-Euro filter, and prediction to the time of display."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import TOOL_LENGTH
from holotorch.tracking.pose.status import Pose, Status


class OneEuro:
    """A low-pass whose cutoff rises with speed: steady at rest, quick in motion. One object follows one catheter.

    With alpha = dt / (dt + tau), tau = 1 / (2 pi cutoff), the tip becomes x' + alpha (x - x'), and the direction moves
    by the share alpha along the great circle to the new one. Both share a cutoff, hence a lag, or a moving catheter
    would seem bent: ``min_cutoff + beta * speed``, speed the larger of the tip's and of the point ``arm`` behind it.
    Departure from the paper: the speed is that of the measured poses, not from the last smoothed to the new one,
    which would count the lag as speed.

    Lag: behind a steady motion the answer is :attr:`lag` seconds late. It follows lag' = (1 - alpha) (lag + dt), which
    is exact for any steps and ends at tau: 1 / (2 pi cutoff), 80 ms at 2 Hz and 8 ms at 20 Hz. With the
    defaults and 60 frames per second: a third of white jitter at rest, 13 ms late at 50 mm/s.

    Nothing is carried across a refusal, a gap above ``longest_gap`` or a turn of 90 degrees or more from the smoothed
    pose to the next, as when tip and rear are exchanged: the next pose passes unchanged, as the first.

    Args:
        min_cutoff: In Hz, at rest.
        beta: In Hz per m/s; 0 gives a plain low-pass.
        derivative_cutoff: In Hz, of the speed.
        longest_gap: In seconds.
        arm: In metres from the tip, about that of the bands.

    Raises:
        TypeError, ValueError: A parameter that is not a finite number, not above 0, or a negative beta.

    Source: Casiez, Roussel and Vogel, "1 Euro Filter", CHI 2012, Algorithm 1.
    """

    def __init__(
        self,
        min_cutoff: float = 2.0,
        beta: float = 200.0,
        *,
        derivative_cutoff: float = 3.0,
        longest_gap: float = 0.25,
        arm: float = 0.127,
    ):
        self.min_cutoff = checks.positive("min_cutoff", min_cutoff, "Hz")
        self.beta = checks.finite("beta", beta, "Hz per m/s")
        if self.beta < 0:
            raise ValueError(f"beta must not be negative, got {beta!r}")
        self.derivative_cutoff = checks.positive("derivative_cutoff", derivative_cutoff, "Hz")
        self.longest_gap = checks.positive("longest_gap", longest_gap, "seconds")
        self.arm = checks.quantity(TOOL_LENGTH, arm, "arm")
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self.lag = 0.0
        self._captured = -math.inf
        self._raw: Pose | None = None
        self._smooth: Pose | None = None
        self._rate: Tensor | None = None  # [2, 3]: of the tip in m/s, of the rotation in rad/s
        self._rate_covariance: Tensor | None = None

    def __call__(self, pose: Pose, captured: float) -> Pose:
        """The smoothed pose for one that the camera took at ``captured`` seconds; a refusal comes back as it is.

        The covariance is the same mixture, (1 - alpha) C' + alpha C: no less than that of the mixed errors, however
        they are correlated. Smoothing removes jitter, not bias, so it is not taken to make a pose more right.

        Raises:
            TypeError: A batch.
            ValueError: NaN in an answered pose, or poses that do not come in the order of capture.
        """
        captured = checks.finite("captured", captured, "seconds")
        if not isinstance(pose.status, Status) or pose.tip.shape != (3,):
            raise TypeError(f"the filter follows one catheter, got tips {list(pose.tip.shape)}; index the batch")
        if captured <= self._captured:
            raise ValueError(f"poses must come in the order of capture, got {captured!r} after {self._captured!r} s")
        dt = captured - self._captured
        if not pose.status.answered:
            self.reset()
            self._captured = captured
            return pose
        for name in ("tip", "direction", "covariance"):
            checks.all_finite(name, getattr(pose, name))
        before, raw = self._smooth, self._raw
        if before is None or raw is None or dt > self.longest_gap or before.direction @ pose.direction <= 0:
            self.reset()
            self._captured, self._raw, self._smooth = captured, pose, pose
            return pose
        rotation = _rotation(raw.direction, pose.direction)
        self._learn(torch.stack([pose.tip - raw.tip, rotation]) / dt, (pose.covariance + raw.covariance) / dt**2, dt)
        alpha = dt / (dt + 1 / (2 * math.pi * self.cutoff))
        covariance = (1 - alpha) * before.covariance + alpha * pose.covariance
        turn = alpha * _rotation(before.direction, pose.direction)
        tip = before.tip + alpha * (pose.tip - before.tip)
        smooth = replace(pose, tip=tip, direction=_turned(before.direction, turn), covariance=covariance)
        self.lag = (1 - alpha) * (self.lag + dt)
        self._captured, self._raw, self._smooth = captured, pose, smooth
        return smooth

    @property
    def cutoff(self) -> float:
        """In Hz, for the speed now known; 1 / (2 pi cutoff) is the lag at which a steady motion ends."""
        if self._rate is None or self._smooth is None:
            return self.min_cutoff
        tip, turn = self._rate
        behind = tip + self.arm * torch.linalg.cross(turn, self._smooth.direction)
        return self.min_cutoff + self.beta * max(float(tip.norm()), float(behind.norm()))

    def predict(self, when: float, *, longest: float = 0.1, acceleration: float = 0.3) -> Pose:
        """The pose at ``when`` seconds, the time of display: the last one carried on at its filtered speed.

        The lag is made up for too, so a steady motion is predicted without error. The covariance grows by that of the
        speed times h^2, and by the way that an unknown acceleration leads in h = when - captured + lag while the speed
        follows it 1 / (2 pi derivative_cutoff) late.

        Args:
            when: By the clock of ``captured``.
            longest: In seconds from the capture; beyond, the answer is a refusal.
            acceleration: Standard deviation in m/s^2, of the tip and of the point ``arm`` behind it: 0.3 for slow
                careful work, 2 for a hand that swings 5 cm once a second.

        Returns:
            A pose, or a refusal (UNCERTAIN) after a refusal, after the first pose of a sequence, whose speed is not
            known, and beyond ``longest``.
        """
        when = checks.finite("when", when, "seconds")
        ahead = when - self._captured
        if self._smooth is None or self._rate is None or self._rate_covariance is None:
            known = "no pose" if self._smooth is None else "one pose only"
            return Pose.refused(Status.UNCERTAIN, f"{known} since the last refusal or gap, so no speed to predict with")
        if abs(ahead) > checks.positive("longest", longest, "seconds"):
            text = f"display is {ahead * 1e3:.0f} ms from the last frame, more than {longest * 1e3:.0f} ms"
            return Pose.refused(Status.UNCERTAIN, text)
        span, pose = ahead + self.lag, self._smooth
        late = 1 / (2 * math.pi * self.derivative_cutoff)
        way = checks.positive("acceleration", acceleration, "m/s^2") * abs(span) * (abs(span) / 2 + late)
        direction = _turned(pose.direction, span * self._rate[1])
        tangent = torch.eye(3).to(direction) - torch.outer(direction, direction)
        growth = torch.block_diag(torch.eye(3).to(direction), tangent / self.arm**2) * way**2
        covariance = pose.covariance + span**2 * self._rate_covariance + growth
        return replace(pose, tip=pose.tip + span * self._rate[0], direction=direction, covariance=covariance)

    def _learn(self, rate: Tensor, covariance: Tensor, dt: float) -> None:
        if self._rate is None or self._rate_covariance is None:
            self._rate, self._rate_covariance = rate, covariance
            return
        alpha = dt / (dt + 1 / (2 * math.pi * self.derivative_cutoff))
        self._rate = self._rate + alpha * (rate - self._rate)
        # Neighbouring differences share a pose with opposite signs: independent ones vary more.
        self._rate_covariance = (1 - alpha) ** 2 * self._rate_covariance + alpha**2 * covariance


def _rotation(start: Tensor, end: Tensor) -> Tensor:
    """Axis times angle [3] that turns one unit vector into the other by the shorter way."""
    normal = torch.linalg.cross(start, end)
    sine = normal.norm()
    if sine < 1e-12:
        return torch.zeros_like(normal)
    return normal * (torch.atan2(sine, start @ end) / sine)


def _turned(vector: Tensor, rotation: Tensor) -> Tensor:
    """A unit vector turned by axis times angle (Rodrigues), of length 1 again."""
    angle = rotation.norm()
    if angle < 1e-12:
        return vector
    axis = rotation / angle
    across = torch.linalg.cross(axis, vector) * torch.sin(angle)
    turned = vector * torch.cos(angle) + across + axis * (axis @ vector) * (1 - torch.cos(angle))
    return turned / turned.norm()
