"""Pose of a straight tool from the positions of known points along a known line of the image: three unknowns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.strips import Line
from holotorch.tracking.pose.status import Pose

_STEPS = 2  # Gauss-Newton steps after the linear start, whose relative error is 1e-3 or less; each step squares it

_Three = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class LinePose:
    """A pose as in :class:`holotorch.tracking.pose.status.Pose`, as NumPy arrays.

    Attributes:
        tip: [3] in metres.
        direction: [3], unit vector from the tip to the rear.
        covariance: [6, 6] of tip and direction.
        chi_square: Chi-square of the positions along the line.
    """

    tip: np.ndarray
    direction: np.ndarray
    covariance: np.ndarray
    chi_square: float

    @property
    def tip_sd(self) -> float:
        """Standard deviation of the tip in metres, over all three axes."""
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
    """Pose of a tool whose image is ``line``: :func:`solve_pose` for a known line.

    The tool and the centre of the camera span a plane, whose image is the line. A point at s from the middle of the
    tool has the image t = (h0 + h1 s) / (1 + h2 s). Weighted least squares determine h: a linear solution, then
    Gauss-Newton steps. The known distances on the tool give the scale. The errors of the line tilt the plane, and are
    independent of those of h.

    Args:
        line: Line on the plane z = 1.
        t: [N] positions along the line, in units of a pixel at the principal point; N >= 3.
        positions: [N] distances from the tip in metres.
        deviation: [N] standard deviations of t.
        offset_sd: Standard deviation of the line's offset at the mean of t, in the unit of t.
        slope_sd: Standard deviation of the line's slope in radians; independent of the offset.
        shared_sd: Standard deviation of an error of t that all points share, in addition to ``deviation``.
        rough: Whether to omit the covariance, which takes half of the time; it is then zero.

    Returns:
        The pose, or None where no pose in front of the camera fits the points.
    """
    # Python floats: for so few points, calls of NumPy would take several times as long.
    middle, mean = sum(t) / len(t), sum(positions) / len(t)
    offsets, levers = [value - middle for value in t], [value - mean for value in positions]
    wide, length = max(map(abs, offsets)), max(map(abs, levers))
    if not wide > 0:
        return None
    each = zip(offsets, levers, deviation, strict=True)
    points = [(x / wide, s / length, wide / sd if sd else math.inf) for x, s, sd in each]
    h = (0.0, 0.0, 0.0)
    for _ in range(1 + _STEPS):
        normal, slope, _, _ = _terms(points, h)
        step = _solved(normal, slope)
        h = (h[0] + step[0], h[1] + step[1], h[2] + step[2])
    normal, _, chi_square, least = _terms(points, h)
    if not (least > 0 and math.isfinite(chi_square)):
        return None
    # Points in space are p e1 + q e2 up to one common scale, for both tip and direction. Errors of the line move them
    # along e3.
    (h0, h1, h2), step = h, line.along / line.scale
    origin = line.origin + middle * step
    unit, start = 1 / length, -mean / length
    axes = np.array(
        [[wide * step.real, wide * step.imag, 0.0], [origin.real, origin.imag, 1.0], [-step.imag, step.real, 0.0]]
    )
    (p, q), (along, deep) = (h0 + h1 * start, 1 + h2 * start), (h1 * unit, h2 * unit)
    if rough:
        tip, direction = np.array([[p, q, 0.0], [along, deep, 0.0]]) @ axes
        size = math.sqrt(float(direction @ direction))
        return LinePose(tip / size, direction / size, np.zeros((6, 6)), chi_square) if size > 0 else None
    # Tip and direction, and their derivatives by h (3), and by the offset and the slope of the line.
    tip = [[p, q, 0.0], [1.0, 0.0, 0.0], [start, 0.0, 0.0], [0.0, start, 0.0], [0.0, 0.0, q], [0.0, 0.0, p * wide]]
    rear = [[along, deep], [0.0, 0.0], [unit, 0.0], [0.0, unit]]
    direction = [*([x, y, 0.0] for x, y in rear), [0.0, 0.0, deep], [0.0, 0.0, along * wide]]
    raw = np.array([tip, direction]) @ axes  # [2, 6, 3]
    raw /= np.sqrt(raw[1, 0] @ raw[1, 0])
    pose, moved = raw[:, 0], raw[:, 1:]
    moved = moved - (moved[1] @ pose[1])[:, None] * pose[:, None]
    covariance = _covariance(moved, normal, shared_sd / wide * np.array([1.0, h2, 0.0, 0.0, 0.0]), offset_sd, slope_sd)
    return LinePose(pose[0], pose[1], covariance, chi_square) if np.isfinite(covariance).all() else None


def _covariance(
    moved: np.ndarray, normal: list[float], shared: np.ndarray, offset_sd: float, slope_sd: float
) -> np.ndarray:
    """[6, 6] of tip and direction, from their derivatives ``moved`` [2, 5, 3] by h and by the line's offset and slope.

    ``normal`` is the inverse covariance of h, ``shared`` [5] the standard deviation of the error common to all points.
    """
    own = np.zeros((5, 5))
    for column, right in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
        own[:3, column] = _solved(normal, right)
    own += np.diag([0.0, 0.0, 0.0, offset_sd**2, slope_sd**2]) + shared * shared[:, None]
    lever = moved.swapaxes(1, 2).reshape(6, 5)
    return lever @ own @ lever.T


def _terms(points: list[tuple[float, float, float]], h: _Three) -> tuple[list[float], _Three, float, float]:
    """Normal matrix (six entries), gradient, chi-square and least depth at h; the linear problem where h is zero."""
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
    """Solution of a symmetric 3 x 3 system by Cramer's rule; NaN where the matrix is not positive definite."""
    a, b, c, d, e, f = normal
    df, ce, be = d * f - e * e, c * e - b * f, b * e - c * d
    whole = a * df + b * ce + c * be
    if not whole > 0:
        return (math.nan, math.nan, math.nan)
    af, bc, ad = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = right
    return (df * x + ce * y + be * z) / whole, (ce * x + af * y + bc * z) / whole, (be * x + bc * y + ad * z) / whole


def on_host(pose: Pose) -> LinePose | None:
    """Tip and direction of a pose on any device as NumPy arrays; None where they are not finite."""
    place, onward = (value.numpy(force=True).astype(np.float64) for value in (pose.tip, pose.direction))
    known = all(map(math.isfinite, (*place.tolist(), *onward.tolist())))
    return LinePose(place, onward, np.zeros((6, 6)), 0.0) if known else None
