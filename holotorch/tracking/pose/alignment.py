"""Pose of a camera on a headset, from poses of one tool that both have measured."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks, quantities

TOOL_LENGTH = 0.127  # metres: distance of the two points of an alignment in the thesis, tip and middle of the bands
_FEWEST = 3  # least number of alignments
_SAME_DIRECTION = math.radians(10)  # angle between tools below which they count as parallel
_LENGTHS_DIFFER = 0.02  # metres: largest difference of the tool's length in both frames, by tremor of the hand


@dataclass(frozen=True, eq=False)
class Alignment:
    """A rigid map between the frames of camera and headset, and its residuals.

    Attributes:
        headset_from_camera: float64 [4, 4]: ``p_headset = headset_from_camera @ p_camera``, metres.
        residuals: [n] root mean square distances in metres of the two points of each alignment after the map.
        leave_one_out: [n] the same for the map fitted without that alignment, which predicts the error of a new one.
            Infinite where the other alignments do not determine a map.
    """

    headset_from_camera: Tensor
    residuals: Tensor
    leave_one_out: Tensor


def tool_points(tip: Tensor, direction: Tensor, length: float = TOOL_LENGTH) -> Tensor:
    """[..., 2, 3]: a tool's tip and the point ``length`` metres behind it; ``direction`` [..., 3] is normalised."""
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

    The roll of a straight tool is not observable, so that one alignment, or several parallel ones, do not determine the
    rotation about it. Therefore the fit needs three or more. (Eqs. 3.1 and 3.2 of the thesis use one alignment, which
    gives a median error of 103 mm elsewhere.)

    Args:
        camera: [n, 2, 3] two points of the tool in each alignment, in metres; :func:`tool_points` of its pose.
        headset: The same points in the headset's frame, which must be right-handed.

    Returns:
        The map, differentiable with respect to both arguments, with its residuals.

    Raises:
        ValueError: Fewer than 3 alignments, all parallel to within 10 degrees, tools of different lengths, or a headset
            with a left-handed frame. The message says what to do.

    Source: Kabsch (1976) in float64, no scale; the sign of the determinant as in Umeyama (1991).
    """
    points = []
    for name, value in (("camera", camera), ("headset", headset)):
        if not isinstance(value, Tensor) or not value.is_floating_point():
            raise TypeError(f"{name} must be a floating tensor, got {getattr(value, 'dtype', type(value).__name__)}")
        if value.ndim != 3 or value.shape[1:] != (2, 3):
            raise ValueError(f"{name} must be of shape [n, 2, 3], two points for each alignment, got {value.shape}")
        checks.quantities(quantities.POSITION, value, name)
        points.append(value.to(torch.float64))
    source, target = points
    if len(source) != len(target):
        raise ValueError(f"camera and headset must hold the same alignments, got {len(source)} and {len(target)}")
    if len(source) < _FEWEST:
        raise ValueError(
            f"an alignment needs {_FEWEST} poses of the tool or more, not parallel to each other, got {len(source)}; "
            "one leaves the turn about the tool open"
        )
    lengths = [(part[:, 1] - part[:, 0]).detach().norm(dim=-1) for part in points]
    differing = (lengths[0] - lengths[1]).abs()
    worst = int(differing.argmax())
    if bool(differing[worst] > _LENGTHS_DIFFER):
        raise ValueError(
            f"the two points must be equally far apart in both frames, got {lengths[0][worst]:.3f} and "
            f"{lengths[1][worst]:.3f} m in alignment {worst}; are both in metres, and the same points?"
        )
    for name, part in zip(("camera", "headset"), points, strict=True):
        spread = _spread(part.detach())
        if spread < _SAME_DIRECTION:
            raise ValueError(
                f"the alignments are parallel to within {math.degrees(spread):.1f} degrees in the {name}'s frame, "
                "which leaves the turn about the tool nearly open; hold the tool in different directions, 45 degrees "
                "apart or more"
            )
    fitted = rigid_map(source, target)
    residuals = _residuals(fitted, source, target)
    rms = residuals.detach().square().mean().sqrt()
    mirrored = _residuals(rigid_map(source, target, -1.0), source, target).detach().square().mean().sqrt()
    if rms > 5e-3 and mirrored < 0.5 * rms:
        raise ValueError(
            "the headset's points are mirror images of the camera's: its frame is left-handed (as Unity's is); change "
            "the sign of one of its axes"
        )
    alone = []
    for i in range(len(source)):
        rest = torch.arange(len(source), device=source.device) != i
        if _spread(source[rest].detach()) < _SAME_DIRECTION:
            alone.append(source.new_tensor(math.inf))
            continue
        alone.append(_residuals(rigid_map(source[rest], target[rest]), source[i : i + 1], target[i : i + 1])[0])
    return Alignment(fitted, residuals, torch.stack(alone))


def _spread(points: Tensor) -> float:
    """Largest angle between two of the tools, as lines."""
    return widest_angle(torch.nn.functional.normalize(points[:, 1] - points[:, 0], dim=-1))


def widest_angle(directions: Tensor) -> float:
    """Largest angle in radians between two of the lines along unit vectors [n, 3], at most pi / 2."""
    crossed = torch.linalg.cross(*torch.broadcast_tensors(directions[:, None], directions[None])).norm(dim=-1)
    return float(torch.atan2(crossed, (directions @ directions.mT).abs()).max())


def rigid_map(source: Tensor, target: Tensor, sign: float = 1.0) -> Tensor:
    """[4, 4] least-squares rigid map of points [..., 3] (Kabsch 1976); ``sign`` -1 gives the best improper one."""
    a, b = source.reshape(-1, 3), target.reshape(-1, 3)
    u, _, vh = torch.linalg.svd((b - b.mean(0)).mT @ (a - a.mean(0)))
    handedness = sign * torch.linalg.det(u.detach() @ vh.detach()).sign()
    rotation = u @ torch.diag(torch.stack([torch.ones_like(handedness), torch.ones_like(handedness), handedness])) @ vh
    shift = b.mean(0) - rotation @ a.mean(0)
    last = torch.tensor([[0.0, 0, 0, 1]], dtype=rotation.dtype, device=rotation.device)
    return torch.cat([torch.cat([rotation, shift[:, None]], 1), last])


def _residuals(matrix: Tensor, source: Tensor, target: Tensor) -> Tensor:
    moved = source @ matrix[:3, :3].mT + matrix[:3, 3]
    return (moved - target).square().sum(-1).mean(-1).clamp(min=1e-30).sqrt()
