"""The pose of a straight tool from where known points of it lie along one line of the image: three unknowns."""

import math

import torch
from torch import Tensor

from holotorch.tracking.status import Pose, Status
from holotorch.tracking.strips import Line

_STEPS = 2  # after a linear start that is right but for the noise, a thousandth or less; each squares what is left


def pose_on_line(
    line: Line, t: Tensor, positions: Tensor, deviation: Tensor, offset_sd: float, slope_sd: float
) -> Pose:
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

    Returns:
        One pose; INCONSISTENT where none in front of the camera is near the points.
    """
    middle, mean = t.mean(), positions.mean()
    far, long = t - middle, positions - mean
    reach, length = far.abs().max(), long.abs().max()
    x, s, weight = far / reach, long / length, reach / deviation
    ones, rest = torch.ones_like(x), x * weight
    h, seen, depth = x.new_zeros(3), x, ones
    for _ in range(1 + _STEPS):
        slopes = torch.stack([ones, s, -s * seen], -1) * (weight / depth)[:, None]
        h = h + torch.linalg.solve_ex(slopes.mT @ slopes, slopes.mT @ rest).result
        depth = 1 + h[2] * s
        seen = (h[0] + h[1] * s) / depth
        rest = (x - seen) * weight
    chi_square = rest.square().sum()
    if not (float(depth.min()) > 0 and math.isfinite(float(chi_square))):
        return Pose.refused(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
    slopes = torch.stack([ones, s, -s * seen], -1) * (weight / depth)[:, None]
    # Points of space are p e1 + q e2, up to one scale: tip and direction. A line that is not quite where it was found
    # moves them to the side.
    (h0, h1, h2), (x0, y0), (ax, ay) = h.tolist(), line.plane(middle).tolist(), (line.along / line.scale).tolist()
    wide, unit, start = float(reach), 1 / float(length), -float(mean) / float(length)
    axes = t.new_tensor([[wide * ax, wide * ay, 0.0], [x0, y0, 1.0], [-ay, ax, 0.0]])
    (p, q), (along, deep) = (h0 + h1 * start, 1 + h2 * start), (h1 * unit, h2 * unit)
    raw = t.new_tensor([[p, q, 0.0], [along, deep, 0.0]]) @ axes
    # How they move with h, and with the line's offset and slope.
    tip = [[1.0, 0.0, 0.0], [start, 0.0, 0.0], [0.0, start, 0.0], [0.0, 0.0, q], [0.0, 0.0, p * wide]]
    direction = [[0.0, 0.0, 0.0], [unit, 0.0, 0.0], [0.0, unit, 0.0], [0.0, 0.0, deep], [0.0, 0.0, along * wide]]
    moved = t.new_tensor([tip, direction]) @ axes  # [2, 5, 3]
    scale = raw[1].norm()
    pose = raw / scale
    moved = (moved - (moved[1] @ pose[1])[:, None] * pose[:, None]) / scale
    own = torch.diag(t.new_tensor([0.0, 0.0, 0.0, offset_sd**2, slope_sd**2]))
    own[:3, :3] = torch.linalg.inv_ex(slopes.mT @ slopes).inverse
    lever = moved.mT.reshape(6, 5)
    status = Status.OK if len(t) > 3 else Status.UNVERIFIED
    return Pose(pose[0], pose[1], lever @ own @ lever.mT, chi_square, t.new_tensor(len(t) - 3.0), status)
