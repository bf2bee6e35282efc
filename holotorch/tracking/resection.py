"""The pose of a straight tool from where known points of it lie along one line of the image: three unknowns."""

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
    h, seen, depth = x.new_zeros(3), x, torch.ones_like(x)
    rest = x * weight
    for _ in range(1 + _STEPS):
        slopes = torch.stack([torch.ones_like(s), s, -s * seen], -1) * (weight / depth)[:, None]
        h = h + torch.linalg.solve_ex(slopes.mT @ slopes, slopes.mT @ rest).result
        depth = 1 + h[2] * s
        seen = (h[0] + h[1] * s) / depth
        rest = (x - seen) * weight
    if not bool((depth > 0).all() & torch.isfinite(rest).all()):
        return Pose.refused(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
    slopes = torch.stack([torch.ones_like(s), s, -s * seen], -1) * (weight / depth)[:, None]
    # Points of space are p e1 + q e2: of tip and direction, each row (p, q), up to one scale.
    unit, start = 1 / length, -mean / length
    zero = torch.zeros_like(unit)
    aside = torch.cat([line.across / line.scale, zero[None]])
    axes = torch.stack(
        [
            torch.cat([reach * line.along / line.scale, zero[None]]),
            torch.cat([line.origin + middle * line.along / line.scale, torch.ones_like(zero)[None]]),
        ]
    )
    p, q = torch.stack([h[0] + h[1] * start, h[1] * unit]), torch.stack([1 + h[2] * start, h[2] * unit])
    raw = torch.stack([p, q], -1) @ axes  # [2, 3]: tip and direction
    # How they move with h, and with the line's offset and slope.
    levers = torch.stack([torch.stack([torch.ones_like(unit), start, start]), torch.stack([zero, unit, unit])])
    moved = torch.cat(
        [
            levers[..., None] * axes[[0, 0, 1]],
            torch.stack([q, p * reach], -1)[..., None] * aside,
        ],
        1,
    )  # [2, 5, 3]
    scale = raw[1].norm()
    pose = raw / scale
    moved = (moved - (moved[1] @ pose[1])[:, None] * pose[:, None]) / scale
    spread = torch.linalg.inv_ex(slopes.mT @ slopes).inverse
    own = torch.block_diag(spread, torch.diag(torch.tensor([offset_sd, slope_sd], dtype=t.dtype).square().to(t.device)))
    lever = moved.transpose(1, 2).reshape(6, 5)
    covariance = lever @ own @ lever.mT
    freedom = len(t) - 3
    status = Status.OK if freedom else Status.UNVERIFIED
    return Pose(pose[0], pose[1], covariance, rest.square().sum(), zero + freedom, status)
