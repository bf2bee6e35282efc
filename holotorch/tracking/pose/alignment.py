"""Pose of a camera relative to a headset, from poses of one tool that both have measured; poses in its frame."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from holotorch.core import checks, quantities
from holotorch.tracking.pose.status import Pose

TOOL_LENGTH = 0.127  # metres from the tip to the middle of the bands: the two points of an alignment in the thesis
# Distance in metres between both points at which the errors of a hand, 1 mm at the tip and 1 degree in direction, have
# the same weight: 1 mm / 1 degree. Tips elsewhere are then more accurate than with the points of the thesis.
HAND_LENGTH = 0.057
SAME_DIRECTION = math.radians(10)  # angle between tools below which they count as parallel


@dataclass(frozen=True, eq=False)
class Alignment:
    """A rigid map between the frames of camera and headset, and its residuals.

    Attributes:
        headset_from_camera: float64 [4, 4]: ``p_headset = headset_from_camera @ p_camera``, in metres.
        residuals: [n] root mean square distance in metres between the two mapped and the two measured points of
            each alignment.
        leave_one_out: [n] residual of each alignment for the map fitted to all others, which predicts the error of a
            new alignment. Infinite where the others do not determine a map.
        covariance: float64 [6, 6] of the map in the headset's frame, (turn about its origin in radians, shift in
            metres), without gradient. It is estimated from the residuals, for alignments with errors in the position
            of the tool and in its direction, and widened for their small number.
    """

    headset_from_camera: Tensor
    residuals: Tensor
    leave_one_out: Tensor
    covariance: Tensor


def tool_points(tip: Tensor, direction: Tensor, length: float = TOOL_LENGTH) -> Tensor:
    """Points [..., 2, 3] in metres: the ``tip`` [..., 3] of a tool, and the point ``length`` metres behind the tip.

    ``direction`` [..., 3] leads from the tip to the rear and need not be normalised.
    """
    checks.quantity(quantities.TOOL_LENGTH, length)
    for name, value in (("tip", tip), ("direction", direction)):
        if not isinstance(value, Tensor) or not value.is_floating_point() or value.shape[-1:] != (3,):
            raise ValueError(f"{name} must be a floating tensor [..., 3], got {getattr(value, 'shape', value)}")
        checks.all_finite(name, value)
    checks.quantities(quantities.POSITION, tip, "tip")
    size = direction.norm(dim=-1, keepdim=True)
    if bool((size.detach() < 1e-6).any()):
        raise ValueError("direction must not be a null vector")
    return torch.stack([tip, tip + length * direction / size], -2).to(torch.float64)


def headset_from_camera(camera: Tensor, headset: Tensor) -> Alignment:
    """Fit the rigid map from points of a tool in the frame of the camera to those in the frame of the headset.

    The roll of a straight tool about its axis is not observable, so that a single alignment, or several parallel ones,
    do not determine the map. Departure from the thesis: Eqs. 3.1 and 3.2 use a single alignment, which results in a
    median error of 103 mm at other poses.

    Args:
        camera: [n, 2, 3] two points of the tool in each of n >= 3 alignments, in metres; see :func:`tool_points`.
        headset: [n, 2, 3] the same points in the headset's frame, which must be right-handed.

    Returns:
        The map and its residuals, differentiable with respect to both arguments.

    Raises:
        TypeError, ValueError: Wrong shapes or types, fewer than 3 alignments, all parallel to within 10 degrees, tools
            of different lengths, or a headset with a left-handed frame. The message says what to do.

    Source: Kabsch (1976) in float64, no scale; the sign of the determinant as in Umeyama (1991).
    """
    points = []
    for name, value in (("camera", camera), ("headset", headset)):
        checks.real(name, value)
        if value.ndim != 3 or value.shape[1:] != (2, 3):
            raise ValueError(f"{name} must be of shape [n, 2, 3], two points for each alignment, got {value.shape}")
        checks.quantities(quantities.POSITION, value, name)
        points.append(value.to(torch.float64))
    source, target = points
    if len(source) != len(target):
        raise ValueError(f"camera and headset must hold the same alignments, got {len(source)} and {len(target)}")
    if len(source) < 3:
        raise ValueError(
            f"an alignment needs 3 poses of the tool or more, not parallel to each other, got {len(source)}; one "
            "does not determine the rotation about the tool"
        )
    first, second = ((part[:, 1] - part[:, 0]).detach().norm(dim=-1) for part in points)
    worst = int((first - second).abs().argmax())
    if bool((first - second).abs()[worst] > 0.02):  # metres; tremor of the hand causes less
        raise ValueError(
            f"the two points must be equally far apart in both frames, got {first[worst]:.3f} and "
            f"{second[worst]:.3f} m in alignment {worst}; are both in metres, and the same points?"
        )
    for name, part in zip(("camera", "headset"), points, strict=True):
        if (spread := _spread(part)) < SAME_DIRECTION:
            raise ValueError(
                f"the alignments are parallel to within {math.degrees(spread):.1f} degrees in the {name}'s frame, "
                "which hardly determines the rotation about the tool; hold the tool in directions that are 45 degrees "
                "apart or more"
            )
    fitted = rigid_map(source, target)
    residuals = _residuals(fitted, source, target)
    improper = _residuals(rigid_map(source, target, -1.0), source, target)
    rms, mirrored = (value.detach().square().mean().sqrt() for value in (residuals, improper))
    if rms > 5e-3 and mirrored < 0.5 * rms:
        raise ValueError(
            "the headset's points are mirror images of the camera's: its frame is left-handed (as Unity's is); change "
            "the sign of one of its axes"
        )
    leave_one_out = [residuals.new_tensor(math.inf)] * len(source)
    for i in range(len(source)):
        others = torch.arange(len(source), device=source.device) != i
        if _spread(source[others]) >= SAME_DIRECTION:
            leave_one_out[i] = _residuals(rigid_map(source[others], target[others]), source[i], target[i])
    return Alignment(fitted, residuals, torch.stack(leave_one_out), _covariance(fitted.detach(), source, target))


def in_frame(pose: Pose, matrix: Tensor, covariance: Tensor | None = None) -> Pose:
    """A pose, or a batch of poses, of the camera's frame in another frame, such as a headset's.

    Args:
        pose: In the frame of the camera; refusals stay refusals.
        matrix: Rigid map [4, 4] from the camera to the other frame, in metres.
        covariance: [6, 6] of ``matrix`` as in ``Alignment``, which is added to that of the pose. All poses share this
            error, so a mean over many of them does not become more accurate than it.
    """
    matrix = matrix.to(pose.tip)
    rotation = matrix[:3, :3]
    tip, direction = pose.tip @ rotation.mT + matrix[:3, 3], pose.direction @ rotation.mT
    both = torch.block_diag(rotation, rotation)
    total = both @ pose.covariance @ both.mT
    if covariance is not None:
        zero = torch.zeros_like(rotation)
        by_turn = torch.cat([-_crossing(tip), -_crossing(direction)], -2)
        by_shift = torch.cat([torch.eye(3, dtype=tip.dtype, device=tip.device), zero], -2).expand_as(by_turn)
        change = torch.cat([by_turn, by_shift], -1)
        total = total + change @ covariance.to(tip) @ change.mT
    return replace(pose, tip=tip, direction=direction, covariance=total)


def _covariance(fitted: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """Covariance of ``Alignment``: two variances explain the residuals, of the position and of the direction.

    With the residuals r = M e of the errors e, and Cov(e) = a S_a + b S_b, the expected squares of the residuals of the
    tip, and of the difference of both points, are linear in a and b.
    """
    source, target = source.detach(), target.detach()
    count, mapped = len(source), source @ fitted[:3, :3].mT + fitted[:3, 3]
    points = mapped.reshape(-1, 3)
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    jacobian = torch.cat([-_crossing(points), eye.expand(len(points), 3, 3)], -1).reshape(-1, 6)
    inverse = torch.linalg.inv(jacobian.mT @ jacobian)
    left_over = torch.eye(len(jacobian), dtype=points.dtype, device=points.device) - jacobian @ inverse @ jacobian.mT
    axes = torch.nn.functional.normalize(mapped[:, 1] - mapped[:, 0], dim=-1)
    across = eye - axes[:, :, None] * axes[:, None]
    zero = torch.zeros_like(eye)
    place = torch.cat([torch.cat([eye, eye], 1)] * 2, 0)
    causes = [
        torch.block_diag(*[place] * count),
        torch.block_diag(*(torch.cat([torch.cat([zero, zero], 1), torch.cat([zero, each], 1)], 0) for each in across)),
    ]
    tip = torch.block_diag(*[torch.block_diag(eye, zero)] * count)
    difference = torch.block_diag(*[torch.cat([torch.cat([eye, -eye], 1), torch.cat([-eye, eye], 1)], 0)] * count)
    residual = (target - mapped).reshape(-1)
    spread = [left_over @ cause @ left_over for cause in causes]
    expected = torch.stack([torch.stack([(each * cause).sum() for cause in spread]) for each in (tip, difference)])
    observed = torch.stack([residual @ each @ residual for each in (tip, difference)])
    variances = torch.linalg.solve(expected, observed)
    if bool((variances < 0).any()):  # one variance suffices
        other = int(variances.argmax())
        variances = torch.zeros_like(variances)
        variances[other] = observed.sum() / expected[:, other].sum()
    both = variances[0] * causes[0] + variances[1] * causes[1]
    freedom = 5 * count - 6
    return inverse @ jacobian.mT @ both @ jacobian @ inverse * (freedom / (freedom - 2))


def _crossing(vectors: Tensor) -> Tensor:
    """Matrices [..., 3, 3] whose product with u is the cross product of ``vectors`` [..., 3] and u."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _spread(points: Tensor) -> float:
    """Largest angle in radians between the directions of a tool in two alignments, given by points [n, 2, 3]."""
    return widest_angle(torch.nn.functional.normalize((points[:, 1] - points[:, 0]).detach(), dim=-1))


def widest_angle(directions: Tensor) -> float:
    """Largest angle in radians, at most pi / 2, between two of the lines along unit vectors [n, 3]."""
    crossed = torch.linalg.cross(*torch.broadcast_tensors(directions[:, None], directions[None])).norm(dim=-1)
    return float(torch.atan2(crossed, (directions @ directions.mT).abs()).max())


def rigid_map(source: Tensor, target: Tensor, sign: float = 1.0) -> Tensor:
    """Least-squares rigid map [4, 4] of points [..., 3] (Kabsch 1976); with a ``sign`` of -1, the best improper map."""
    a, b = source.reshape(-1, 3), target.reshape(-1, 3)
    u, _, vh = torch.linalg.svd((b - b.mean(0)).mT @ (a - a.mean(0)))
    handedness = sign * torch.linalg.det(u.detach() @ vh.detach()).sign()
    one = torch.ones_like(handedness)
    rotation = u @ torch.diag(torch.stack([one, one, handedness])) @ vh
    translation = b.mean(0) - rotation @ a.mean(0)
    last = torch.tensor([[0.0, 0, 0, 1]], dtype=rotation.dtype, device=rotation.device)
    return torch.cat([torch.cat([rotation, translation[:, None]], 1), last])


def _residuals(matrix: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """Root mean square distances [...] of the two points [..., 2, 3] of each alignment after the map."""
    mapped = source @ matrix[:3, :3].mT + matrix[:3, 3]
    return (mapped - target).square().sum(-1).mean(-1).clamp(min=1e-30).sqrt()
