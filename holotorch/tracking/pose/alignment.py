"""Pose of a camera relative to a headset, from poses of one tool that both have measured."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks, quantities

TOOL_LENGTH = 0.127  # metres from the tip to the middle of the bands: the two points of an alignment in the thesis
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
    """

    headset_from_camera: Tensor
    residuals: Tensor
    leave_one_out: Tensor


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
            "leaves the turn about the tool open"
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
                "which leaves the turn about the tool nearly open; hold the tool in different directions, 45 degrees "
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
    return Alignment(fitted, residuals, torch.stack(leave_one_out))


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
