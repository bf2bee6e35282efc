"""The pose of a straight tool from where known points of it lie along one line of the image: three unknowns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.strips import Line
from holotorch.tracking.pose.status import Pose

_STEPS = 2  # after a linear start that is right but for the noise, a thousandth or less; each squares what is left


_Three = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class LinePose:
    """A pose as :class:`holotorch.tracking.pose.status.Pose` has it, in NumPy.

    Attributes:
        tip: [3] in metres.
        direction: [3], unit vector.
        covariance: [6, 6] of both.
        chi_square: Of the points' places along the line.
    """

    tip: np.ndarray
    direction: np.ndarray
    covariance: np.ndarray
    chi_square: float

    @property
    def tip_sd(self) -> float:
        """In metres, over all three axes."""
        return float(np.sqrt(self.covariance.diagonal()[:3].sum()))


def pose_on_line(
    line: Line,
    t: Sequence[float],
    positions: Sequence[float],
    deviation: Sequence[float],
    offset_sd: float,
    slope_sd: float,
    shared_sd: float = 0.0,
    *,
    rough: bool = False,
) -> LinePose | None:
    """Pose of a tool whose image is ``line``; the part of :func:`solve_pose` that is left where the line is known.

    Tool and camera span a plane, whose image is the line. On it a point s from the tool's middle is seen at
    t = (h0 + h1 s) / (1 + h2 s): weighted least squares for h, linear first, then Gauss-Newton. That the tool's length
    is known gives the scale. The line's own deviations tilt the plane; both parts are independent.

    Args:
        line: On the plane z = 1.
        t: [N] places along it, in units of a pixel at the centre; N >= 3.
        positions: [N] distances from the tip in metres.
        deviation: [N] standard deviations of t.
        offset_sd: Of the line at the mean of t, in the same unit.
        slope_sd: Of the line, in radians; independent of the offset.
        shared_sd: Of what moves all points alike along the line, beside ``deviation``.
        rough: Without the covariance, which costs as much as the rest: noughts in its place.

    Returns:
        The pose, or None where none in front of the camera is near the points.
    """
    # In plain numbers: of so few points, the calls into NumPy would cost several times as much.
    middle, mean = sum(t) / len(t), sum(positions) / len(t)
    far, long = [value - middle for value in t], [value - mean for value in positions]
    wide, length = max(map(abs, far)), max(map(abs, long))
    if not wide > 0:
        return None
    each = zip(far, long, deviation, strict=True)
    points = [(x / wide, s / length, wide / sd if sd else math.inf) for x, s, sd in each]
    h = (0.0, 0.0, 0.0)
    for _ in range(1 + _STEPS):
        normal, slope, _, _ = _terms(points, h)
        step = _solved(normal, slope)
        h = (h[0] + step[0], h[1] + step[1], h[2] + step[2])
    normal, _, chi_square, least = _terms(points, h)
    if not (least > 0 and math.isfinite(chi_square)):
        return None
    (h0, h1, h2), unit, start = h, 1 / length, -mean / length
    axes = _axes(line, middle, wide)
    (p, q), (along, deep) = (h0 + h1 * start, 1 + h2 * start), (h1 * unit, h2 * unit)
    if rough:
        tip, direction = np.array([[p, q, 0.0], [along, deep, 0.0]]) @ axes
        size = math.sqrt(float(direction @ direction))
        return LinePose(tip / size, direction / size, np.zeros((6, 6)), chi_square) if size > 0 else None
    # Tip and direction, how they move with h, and with the line's offset and slope.
    tip = [[p, q, 0.0], [1.0, 0.0, 0.0], [start, 0.0, 0.0], [0.0, start, 0.0], [0.0, 0.0, q], [0.0, 0.0, p * wide]]
    direction = [
        [along, deep, 0.0],
        [0.0, 0.0, 0.0],
        [unit, 0.0, 0.0],
        [0.0, unit, 0.0],
        [0.0, 0.0, deep],
        [0.0, 0.0, along * wide],
    ]
    raw = np.array([tip, direction]) @ axes  # [2, 6, 3]
    raw /= np.sqrt(raw[1, 0] @ raw[1, 0])
    pose, moved = raw[:, 0], raw[:, 1:]
    moved = moved - (moved[1] @ pose[1])[:, None] * pose[:, None]
    own = np.zeros((5, 5))  # covariance of h, and of the line's offset and slope
    for column, right in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
        own[:3, column] = _solved(normal, right)
    shared = shared_sd / wide * np.array([1.0, h2, 0.0, 0.0, 0.0])
    own += np.diag([0.0, 0.0, 0.0, offset_sd**2, slope_sd**2]) + shared * shared[:, None]
    lever = moved.swapaxes(1, 2).reshape(6, 5)
    covariance = lever @ own @ lever.T
    return LinePose(pose[0], pose[1], covariance, chi_square) if np.isfinite(covariance).all() else None


def _axes(line: Line, middle: float, wide: float) -> np.ndarray:
    """Axes e1, e2, e3 (rows) in which points of space are p e1 + q e2 up to one scale; e3 is across the line.

    A line that is not quite where it was measured moves points along e3.
    """
    onward = line.along / line.scale
    place = line.origin + middle * onward
    return np.array(
        [
            [wide * onward.real, wide * onward.imag, 0.0],
            [place.real, place.imag, 1.0],
            [-onward.imag, onward.real, 0.0],
        ]
    )


def _terms(points: list[tuple[float, float, float]], h: _Three) -> tuple[list[float], _Three, float, float]:
    """Normal matrix (its six entries), slope, sum of weighted squares, and the least depth; x where h is nought."""
    h0, h1, h2 = h
    started = h1 != 0
    a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = chi = 0.0
    least = math.inf
    for x, s, weight in points:
        depth = 1 + h2 * s
        least = min(least, depth)
        seen = (h0 + h1 * s) / depth if depth else math.inf
        scaled = weight / depth if depth else math.inf
        rest = (x - seen) * weight
        one, two = scaled * s, -scaled * s * (seen if started else x)
        a00 += scaled * scaled
        a01 += scaled * one
        a02 += scaled * two
        a11 += one * one
        a12 += one * two
        a22 += two * two
        b0 += scaled * rest
        b1 += one * rest
        b2 += two * rest
        chi += rest * rest
    return [a00, a01, a02, a11, a12, a22], (b0, b1, b2), chi, least


def _solved(normal: list[float], right: _Three) -> _Three:
    """Of a symmetric 3 x 3 system, by Cramer's rule; NaN where it has no one answer."""
    a, b, c, d, e, f = normal
    df, ce, be = d * f - e * e, c * e - b * f, b * e - c * d
    whole = a * df + b * ce + c * be
    if not whole > 0:
        return (math.nan, math.nan, math.nan)
    af, bc, ad = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = right
    return (df * x + ce * y + be * z) / whole, (ce * x + af * y + bc * z) / whole, (be * x + bc * y + ad * z) / whole


def on_host(pose: Pose) -> LinePose | None:
    """Its tip and direction in NumPy, whatever device it is on; None where they are not finite."""
    place, onward = (value.numpy(force=True).astype(np.float64) for value in (pose.tip, pose.direction))
    known = all(map(math.isfinite, (*place.tolist(), *onward.tolist())))
    return LinePose(place, onward, np.zeros((6, 6)), 0.0) if known else None
