"""Pose of a straight tool whose image lies on a known line, from the images of known points along the line."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.strips import Line
from holotorch.tracking.pose.status import Pose

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class LinePose:
    """A pose as in :class:`holotorch.tracking.pose.status.Pose`, in NumPy arrays.

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
        """Standard deviation of the tip in metres, the root of the sum of the variances of all three axes."""
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
    """Pose of a tool from the coordinates along ``line`` of its points; the fast counterpart of :func:`solve_pose`.

    A point of the tool at a distance s from the mean of ``positions`` has the coordinate t = (h0 + h1 s) / (1 + h2 s)
    along the line. Weighted least squares determine h, by a linear solution and two Gauss-Newton steps; the distances
    give the scale. Errors of the line are independent of those of h.

    Args:
        line: Image of the axis of the tool on the plane z = 1.
        t: [N] coordinates along the line, in pixels at the principal point; N >= 3.
        positions: [N] distances of the points from the tip in metres.
        deviation: [N] standard deviations of t, in the unit of t.
        offset_sd: Standard deviation of the line's offset at the mean of t, in the unit of t.
        slope_sd: Standard deviation of the line's slope in radians, whose error is independent of that of the offset.
        shared_sd: Standard deviation of an additional error of t that is the same for all points, in the unit of t.
        rough: Whether to skip the covariance, which takes half of the time, and return zeros for it.

    Returns:
        The pose, or None where no pose in front of the camera fits the points.
    """
    # Python floats, since NumPy would take several times as long for so few points. They are centred and scaled.
    middle, mean = sum(t) / len(t), sum(positions) / len(t)
    offsets, levers = [value - middle for value in t], [value - mean for value in positions]
    extent, length = max(map(abs, offsets)), max(map(abs, levers))
    if not extent > 0:
        return None
    each = zip(offsets, levers, deviation, strict=True)
    points = [(x / extent, s / length, extent / sd if sd else math.inf) for x, s, sd in each]
    h = (0.0, 0.0, 0.0)
    for _ in range(3):  # the linear solution has a relative error of at most 1e-3, which each further step squares
        normal, gradient, _, _ = _normal_equations(points, h)
        step = _solve(normal, gradient)
        h = (h[0] + step[0], h[1] + step[1], h[2] + step[2])
    normal, _, chi_square, least_depth = _normal_equations(points, h)
    if not (least_depth > 0 and math.isfinite(chi_square)):
        return None
    # Tip and direction are combinations of the first two axes, up to a common scale. An error of the line moves them
    # along the third axis.
    (h0, h1, h2), step = h, line.along / line.scale
    origin = line.origin + middle * step
    unit, start = 1 / length, -mean / length
    axes = np.array(
        [[extent * step.real, extent * step.imag, 0.0], [origin.real, origin.imag, 1.0], [-step.imag, step.real, 0.0]]
    )
    (p, q), (along, deep) = (h0 + h1 * start, 1 + h2 * start), (h1 * unit, h2 * unit)
    pose = np.array([[p, q, 0.0], [along, deep, 0.0]]) @ axes
    size = math.sqrt(float(pose[1] @ pose[1]))
    if not size > 0:
        return None
    pose = pose / size
    if rough:
        return LinePose(pose[0], pose[1], np.zeros((6, 6)), chi_square)
    # Derivatives of tip and direction [2, 5, 3] with respect to h0, h1, h2, and the offset and slope of the line.
    tip = [[1.0, 0.0, 0.0], [start, 0.0, 0.0], [0.0, start, 0.0], [0.0, 0.0, q], [0.0, 0.0, p * extent]]
    direction = [[0.0, 0.0, 0.0], [unit, 0.0, 0.0], [0.0, unit, 0.0], [0.0, 0.0, deep], [0.0, 0.0, along * extent]]
    slopes = np.array([tip, direction]) @ axes / size
    slopes -= (slopes[1] @ pose[1])[:, None] * pose[:, None]  # the direction keeps unit length
    inner = np.diag([0.0, 0.0, 0.0, offset_sd**2, slope_sd**2])  # covariance of h, offset and slope
    inner[:3, :3] = [_solve(normal, row) for row in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    shared = shared_sd / extent * np.array([1.0, h2, 0.0, 0.0, 0.0])
    jacobian = slopes.swapaxes(1, 2).reshape(6, 5)
    covariance = jacobian @ (inner + shared * shared[:, None]) @ jacobian.T
    return LinePose(pose[0], pose[1], covariance, chi_square) if np.isfinite(covariance).all() else None


def _normal_equations(points: list[Vector], h: Vector) -> tuple[list[float], Vector, float, float]:
    """Upper triangle of the normal matrix, gradient, chi-square and least depth 1 + h2 s at h; linear for h = 0.

    ``points`` are (t, s, 1 / standard deviation of t).
    """
    h0, h1, h2 = h
    a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = chi = 0.0
    least = math.inf
    for t, s, weight in points:  # written out, since sums over generators would take several times as long
        depth = 1 + h2 * s
        least = min(least, depth)
        image, scaled = ((h0 + h1 * s) / depth, weight / depth) if depth else (math.inf, math.inf)
        rest = (t - image) * weight
        one, two = scaled * s, -scaled * s * (image if h1 else t)
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


def _solve(normal: list[float], right: Vector) -> Vector:
    """Solution of a symmetric 3 x 3 system by Cramer's rule; NaN for a determinant that is not positive."""
    a, b, c, d, e, f = normal
    df, ce, be = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * df + b * ce + c * be
    if not det > 0:
        return (math.nan, math.nan, math.nan)
    af, bc, ad = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = right
    return (df * x + ce * y + be * z) / det, (ce * x + af * y + bc * z) / det, (be * x + bc * y + ad * z) / det


def on_host(pose: Pose) -> LinePose | None:
    """Tip and direction of a pose on any device, with zero covariance; None where they are not finite."""
    tip, direction = (value.numpy(force=True).astype(np.float64) for value in (pose.tip, pose.direction))
    finite = all(map(math.isfinite, (*tip.tolist(), *direction.tolist())))
    return LinePose(tip, direction, np.zeros((6, 6)), 0.0) if finite else None
