"""A pose drawn on its frame: axis, band edges, and the tip, visible or hidden, with its uncertainty."""

import math
import textwrap

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.status import Pose, Status

ELLIPSE = -2 * math.log(0.05)  # 95 % quantile of chi-square with 2 degrees of freedom
_FINE = 4  # fractional bits of OpenCV's drawing coordinates
_TINY = 1e-6  # of the depth: step of the derivatives of the projection
_GREEN, _ORANGE, _RED, _WHITE = (60, 230, 90), (255, 170, 30), (255, 70, 60), (255, 255, 255)


def overlay(pixels: Tensor, pose: Pose, camera: Camera, catheter: Catheter) -> Tensor:
    """A copy of the frame with the pose drawn on it, or with the reason why there is none.

    The line is the axis from the tip to the rear end. Ticks across it are the band edges, the cross is the tip, and the
    ellipse around the cross is the image of its 95 % confidence region.

    Args:
        pixels: uint8 [3, H, W], RGB.
        pose: Pose of one catheter.
        camera: Camera that took the frame.
        catheter: Catheter with this pose.

    Returns:
        uint8 [3, H, W] on the device of ``pixels``.

    Raises:
        TypeError, ValueError: The frame has another type or shape, or ``pose`` is a batch.
    """
    if pixels.dtype != torch.uint8:
        raise TypeError(f"pixels must be uint8, got {pixels.dtype}")
    if pixels.ndim != 3 or pixels.shape[0] != 3 or 0 in pixels.shape:
        raise ValueError(f"pixels must be one frame of shape [3, H, W], got {list(pixels.shape)}")
    if not isinstance(pose.status, Status):
        raise ValueError("pose must be that of one catheter; draw each of a batch on its own frame")
    canvas = cv2.merge(list(pixels.cpu().numpy()))
    unit = max(1, round(min(canvas.shape[:2]) / 500))
    colour = {Status.OK: _GREEN, Status.UNVERIFIED: _ORANGE}.get(pose.status, _RED)
    if pose.answered:
        _catheter(canvas, pose, camera, catheter, colour, unit)
    _text(canvas, _words(pose), colour, unit)
    return torch.from_numpy(np.stack(cv2.split(canvas))).to(pixels.device)


def ellipse_px(pose: Pose, camera: Camera) -> tuple[Tensor, Tensor]:
    """Image of the tip [2] in pixels and of its covariance [2, 2] in pixels squared; NaN outside the camera."""
    tip = pose.tip.detach().cpu()
    steps = _TINY * tip[2].abs() * torch.eye(3, dtype=torch.float64)
    ahead, behind = camera.project(tip + steps), camera.project(tip - steps)
    slopes = (ahead - behind).T / (2 * _TINY * tip[2].abs())
    return camera.project(tip), slopes @ pose.covariance[:3, :3].detach().cpu() @ slopes.T


def _catheter(
    canvas: np.ndarray, pose: Pose, camera: Camera, catheter: Catheter, colour: tuple[int, int, int], unit: int
) -> None:
    tip, direction = pose.tip.detach().cpu(), pose.direction.detach().cpu()
    along = torch.linspace(0, catheter.length, 65, dtype=torch.float64)
    # A thin line, so that the bands remain visible.
    _line(canvas, camera.project(tip + along[:, None] * direction), colour, max(1, unit // 2))
    edges = tip + catheter.positions[:, None] * direction
    across = torch.linalg.cross(direction.expand_as(edges), edges)  # perpendicular to the axis and to the ray
    across = across / across.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    for edge, side in zip(edges, 4 * catheter.radius * across, strict=True):
        _line(canvas, camera.project(torch.stack([edge - side, edge + side])), _WHITE, unit)
    spot, covariance = ellipse_px(pose, camera)
    arm = 6.0 * unit
    for step in (torch.tensor([arm, 0.0]), torch.tensor([0.0, arm])):
        _line(canvas, torch.stack([spot - step, spot + step]), colour, unit)
    if bool(covariance.isfinite().all()):
        values, axes = torch.linalg.eigh(covariance)
        turn = torch.linspace(0, 2 * torch.pi, 73, dtype=torch.float64)
        circle = torch.stack([turn.cos(), turn.sin()], -1)
        outline = circle * (ELLIPSE * values.clamp(min=0)).sqrt()
        _line(canvas, spot + outline @ axes.T, colour, unit)


def _line(canvas: np.ndarray, points: Tensor, colour: tuple[int, int, int], unit: int) -> None:
    """Draw [n, 2] pixels as a line that is open where a point is NaN or far outside."""
    near = points.isfinite().all(-1) & (points.abs().amax(-1) < 20 * max(canvas.shape[:2]))
    spots = (points.nan_to_num(0.0) * (1 << _FINE)).round()
    for first in range(len(points) - 1):
        if bool(near[first] & near[first + 1]):
            start, end = ([int(value) for value in spots[index].tolist()] for index in (first, first + 1))
            cv2.line(canvas, start, end, colour, unit, cv2.LINE_AA, _FINE)


def _words(pose: Pose) -> list[str]:
    assert isinstance(pose.status, Status)
    if not pose.answered:
        return [f"{pose.status.name}: no pose ({pose.status.stage})", pose.reason]
    x, y, z = (1e3 * pose.tip.detach()).tolist()
    sd = 1e3 * float(pose.tip_sd.detach())
    return [f"{pose.status.name}: tip {x:.1f} {y:.1f} {z:.1f} mm, sd {sd:.2f} mm", pose.reason]


def _text(canvas: np.ndarray, lines: list[str], colour: tuple[int, int, int], unit: int) -> None:
    face, size, row = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit, 20 * unit
    for line in lines:
        text = line.encode("ascii", "replace").decode()  # the font has only ASCII characters
        wide = cv2.getTextSize(text, face, size, unit)[0][0]
        room = max(8, int(len(text) * (canvas.shape[1] - 20 * unit) / max(wide, 1)))
        for part in textwrap.wrap(text, room):
            for shift in (-unit, unit):  # a dark outline makes it legible on any background
                for place in ((10 * unit + shift, row), (10 * unit, row + shift)):
                    cv2.putText(canvas, part, place, face, size, (0, 0, 0), unit, cv2.LINE_AA)
            cv2.putText(canvas, part, (10 * unit, row), face, size, colour, unit, cv2.LINE_AA)
            row += 20 * unit
