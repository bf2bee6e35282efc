"""Smoothing of poses by the One-Euro filter, and prediction to the time of display."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import TOOL_LENGTH
from holotorch.tracking.pose.status import Pose, Status


class OneEuro:
    """Low-pass filter whose cutoff rises with speed: little jitter at rest, little lag in motion; for one catheter.

    With alpha = dt / (dt + tau) and tau = 1 / (2 pi cutoff), the smoothed tip x' becomes x' + alpha (x - x'), and the
    direction moves by the fraction alpha along the great circle to the new one. The cutoff of both is ``min_cutoff +
    beta * speed``, where the speed is that of the tip or of the point ``arm`` behind it, whichever is larger.

    For a steady motion, the smoothed pose is ``lag`` seconds late, where lag' = (1 - alpha) (lag + dt) converges to
    tau. With the defaults and 60 frames per second, white jitter at rest falls to a third, and the lag is 80 ms at rest
    and 13 ms at 50 mm/s.

    The filter restarts after a refusal, a gap above ``longest_gap``, or a rotation of 90 degrees or more from the
    smoothed pose to the next, such as an exchange of tip and rear. It returns the first pose unchanged.

    Args:
        min_cutoff: Cutoff at rest, in Hz.
        beta: Increase of the cutoff with speed, in Hz per m/s; 0 for a fixed cutoff.
        derivative_cutoff: Cutoff of the filter for the speed, in Hz.
        longest_gap: Longest time between poses that the filter bridges, in seconds.
        arm: Distance from the tip to the second point, in metres; about that of the bands.

    Raises:
        TypeError, ValueError: A parameter that is not a finite number or not above 0; beta may be 0.

    Source: Casiez, Roussel and Vogel, "1 Euro Filter", CHI 2012, Algorithm 1. Departure from it: the speed is that of
    the measured poses, since the difference between a measured and a smoothed pose would include the lag.
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
        self.beta = checks.nonnegative("beta", beta, "Hz per m/s")
        self.derivative_cutoff = checks.positive("derivative_cutoff", derivative_cutoff, "Hz")
        self.longest_gap = checks.positive("longest_gap", longest_gap, "seconds")
        self.arm = checks.quantity(TOOL_LENGTH, arm, "arm")
        self.reset()

    def reset(self) -> None:
        """Forget all poses."""
        self.lag = 0.0
        self._captured = -math.inf
        self._raw: Pose | None = None
        self._smooth: Pose | None = None
        self._rate: Tensor | None = None  # [2, 3]: velocity of the tip in m/s, angular velocity in rad/s
        self._rate_covariance: Tensor | None = None

    def __call__(self, pose: Pose, captured: float) -> Pose:
        """Smooth a pose whose frame was captured at ``captured`` seconds; a refusal is returned unchanged.

        The covariance C' of the previous result and C of the pose give (1 - alpha) C' + alpha C, an upper bound for any
        correlation of their errors.

        Raises:
            TypeError: A batch of poses.
            ValueError: NaN in a pose, or a capture time that is not later than the last one.
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
        rate = torch.stack([pose.tip - raw.tip, _rotation_vector(raw.direction, pose.direction)]) / dt
        self._update_rate(rate, (pose.covariance + raw.covariance) / dt**2, dt)
        alpha = dt / (dt + 1 / (2 * math.pi * self.cutoff))
        smooth = replace(
            pose,
            tip=before.tip + alpha * (pose.tip - before.tip),
            direction=_rotated(before.direction, alpha * _rotation_vector(before.direction, pose.direction)),
            covariance=(1 - alpha) * before.covariance + alpha * pose.covariance,
        )
        self.lag = (1 - alpha) * (self.lag + dt)
        self._captured, self._raw, self._smooth = captured, pose, smooth
        return smooth

    @property
    def cutoff(self) -> float:
        """Cutoff in Hz at the current speed."""
        if self._rate is None or self._smooth is None:
            return self.min_cutoff
        tip, rotation = self._rate
        behind = tip + self.arm * torch.linalg.cross(rotation, self._smooth.direction)
        return self.min_cutoff + self.beta * max(float(tip.norm()), float(behind.norm()))

    def predict(self, when: float, *, longest: float = 0.1, acceleration: float = 0.3) -> Pose:
        """Extrapolate the last smoothed pose to the time of display ``when`` at the filtered speed.

        The extrapolation is over h = when - captured + lag seconds, which is exact for a steady motion. Two covariances
        are added to that of the pose: that of the speed times h^2, and that of the displacement by an acceleration a
        that the filtered speed follows with delay, h (h / 2 + 1 / (2 pi derivative_cutoff)) a.

        Args:
            when: Time in seconds on the clock of ``captured``.
            longest: Largest difference between ``when`` and the last capture, in seconds.
            acceleration: Standard deviation of the acceleration of the tip and of the point ``arm`` behind it in m/s^2:
                0.3 for slow careful work, 2 for a hand that swings by 5 cm once a second.

        Returns:
            A pose; or a refusal (UNCERTAIN) beyond ``longest``, or without two poses since the last restart.
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
        delay = 1 / (2 * math.pi * self.derivative_cutoff)
        displacement = checks.positive("acceleration", acceleration, "m/s^2") * abs(span) * (abs(span) / 2 + delay)
        direction = _rotated(pose.direction, span * self._rate[1])
        tangent = torch.eye(3).to(direction) - torch.outer(direction, direction)
        growth = torch.block_diag(torch.eye(3).to(direction), tangent / self.arm**2) * displacement**2
        covariance = pose.covariance + span**2 * self._rate_covariance + growth
        return replace(pose, tip=pose.tip + span * self._rate[0], direction=direction, covariance=covariance)

    def _update_rate(self, rate: Tensor, covariance: Tensor, dt: float) -> None:
        if self._rate is None or self._rate_covariance is None:
            self._rate, self._rate_covariance = rate, covariance
            return
        alpha = dt / (dt + 1 / (2 * math.pi * self.derivative_cutoff))
        self._rate = self._rate + alpha * (rate - self._rate)
        # An upper bound: errors of consecutive differences partly cancel, since they share a pose.
        self._rate_covariance = (1 - alpha) ** 2 * self._rate_covariance + alpha**2 * covariance


def _rotation_vector(start: Tensor, end: Tensor) -> Tensor:
    """Rotation vector [3] (axis times angle) of the smallest rotation from one unit vector to the other."""
    normal = torch.linalg.cross(start, end)
    sine = normal.norm()
    return normal * (torch.atan2(sine, start @ end) / sine.clamp(min=1e-300))


def _rotated(vector: Tensor, rotation: Tensor) -> Tensor:
    """A unit vector rotated by a rotation vector (Rodrigues' formula, differentiable), and normalised."""
    cycles = rotation.norm() / (2 * math.pi)
    first = torch.linalg.cross(rotation, vector)
    second = torch.linalg.cross(rotation, first)
    rotated = vector + torch.sinc(2 * cycles) * first + torch.sinc(cycles) ** 2 / 2 * second
    return torch.nn.functional.normalize(rotated, dim=0)
