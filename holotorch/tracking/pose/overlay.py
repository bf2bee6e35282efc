"""Drawing of a pose on its frame: axis, band edges, and the visible or hidden tip with its uncertainty."""

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
_GREEN, _ORANGE, _RED, _WHITE = (60, 230, 90), (255, 170, 30), (255, 70, 60), (255, 255, 255)


def overlay(pixels: Tensor, pose: Pose, camera: Camera, catheter: Catheter) -> Tensor:
    """A copy of the RGB frame ``pixels``, uint8 [3, H, W], with the pose drawn on it, or with the reason of a refusal.

    The line is the axis from the tip to the rear end. Ticks across it are the band edges, the cross is the tip, and the
    ellipse around the cross is the image of its 95 % confidence region. Raises TypeError or ValueError for a frame of
    another type or shape, and for a batch of poses.
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
        _draw_catheter(canvas, pose, camera, catheter, colour, unit)
        x, y, z = (1e3 * pose.tip.detach()).tolist()
        headline = f"{pose.status.name}: tip {x:.1f} {y:.1f} {z:.1f} mm, sd {1e3 * float(pose.tip_sd.detach()):.2f} mm"
        headline += " + calibration"
    else:
        headline = f"{pose.status.name}: no pose ({pose.status.stage})"
    _draw_text(canvas, [headline, pose.reason], colour, unit)
    return torch.from_numpy(np.stack(cv2.split(canvas))).to(pixels.device)


class Undistorter:
    """Removes the distortion of a camera from its frames: their pixels are then those of the camera's ``matrix`` alone.

    Pixels beyond the frame are black. The maps are made at the first frame of a size. Source: OpenCV's remap, bilinear.
    """

    def __init__(self, camera: Camera):
        self._matrix = camera.matrix.detach().cpu().numpy()
        self._distortion = camera.distortion.detach().cpu().numpy()
        self._maps: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def __call__(self, pixels: Tensor) -> Tensor:
        """A frame, uint8 [3, H, W], without distortion."""
        height, width = pixels.shape[-2:]
        if (width, height) not in self._maps:
            arguments = self._matrix, self._distortion, None, self._matrix, (width, height), cv2.CV_16SC2
            self._maps[width, height] = cv2.initUndistortRectifyMap(*arguments)
        image = cv2.remap(cv2.merge(list(pixels.cpu().numpy())), *self._maps[width, height], cv2.INTER_LINEAR)
        return torch.from_numpy(np.stack(cv2.split(image)))


def ellipse_px(pose: Pose, camera: Camera) -> tuple[Tensor, Tensor]:
    """Image of the tip [2] in pixels, and its covariance [2, 2] in pixels squared; NaN where there is no image."""
    tip = pose.tip.detach().cpu()
    step = 1e-6 * tip[2].abs()  # metres: central differences
    steps = step * torch.eye(3, dtype=torch.float64)
    jacobian = (camera.project(tip + steps) - camera.project(tip - steps)).T / (2 * step)
    return camera.project(tip), jacobian @ pose.covariance[:3, :3].detach().cpu() @ jacobian.T


def _draw_catheter(
    canvas: np.ndarray, pose: Pose, camera: Camera, catheter: Catheter, colour: tuple[int, int, int], unit: int
) -> None:
    tip, direction = pose.tip.detach().cpu(), pose.direction.detach().cpu()
    along = torch.linspace(0, catheter.length, 65, dtype=torch.float64)
    # The axis is a thin line, so that the bands remain visible.
    _draw_line(canvas, camera.project(tip + along[:, None] * direction), colour, max(1, unit // 2))
    edges = tip + catheter.positions[:, None] * direction
    across = torch.linalg.cross(direction.expand_as(edges), edges)  # perpendicular to the axis and to the ray
    across = across / across.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    for edge, side in zip(edges, 4 * catheter.radius * across, strict=True):
        _draw_line(canvas, camera.project(torch.stack([edge - side, edge + side])), _WHITE, unit)
    centre, covariance = ellipse_px(pose, camera)
    for step in 6.0 * unit * torch.eye(2):
        _draw_line(canvas, torch.stack([centre - step, centre + step]), colour, unit)
    if bool(covariance.isfinite().all()):
        values, axes = torch.linalg.eigh(covariance)
        angle = torch.linspace(0, 2 * torch.pi, 73, dtype=torch.float64)
        ellipse = torch.stack([angle.cos(), angle.sin()], -1) * (ELLIPSE * values.clamp(min=0)).sqrt()
        _draw_line(canvas, centre + ellipse @ axes.T, colour, unit)


def _draw_line(canvas: np.ndarray, points: Tensor, colour: tuple[int, int, int], unit: int) -> None:
    """Draw a line through pixels [n, 2], with gaps where they are NaN or far outside the frame."""
    near = points.isfinite().all(-1) & (points.abs().amax(-1) < 20 * max(canvas.shape[:2]))
    sixteenths = (points.nan_to_num(0.0) * 16).round()
    segments = torch.stack([sixteenths[:-1], sixteenths[1:]], 1)[near[:-1] & near[1:]]
    cv2.polylines(canvas, list(segments.numpy().astype(np.int32)), False, colour, unit, cv2.LINE_AA, 4)


def _draw_text(canvas: np.ndarray, lines: list[str], colour: tuple[int, int, int], unit: int) -> None:
    """Write lines of text at the top left, wrapped at the width of the frame."""
    face, size, row = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit, 20 * unit
    for line in lines:
        text = line.encode("ascii", "replace").decode()  # the font has only ASCII characters
        width = cv2.getTextSize(text, face, size, unit)[0][0]
        characters = max(8, int(len(text) * (canvas.shape[1] - 20 * unit) / max(width, 1)))
        for part in textwrap.wrap(text, characters):
            for x, y in ((-unit, 0), (0, -unit), (unit, 0), (0, unit)):  # a dark outline for bright backgrounds
                cv2.putText(canvas, part, (10 * unit + x, row + y), face, size, (0, 0, 0), unit, cv2.LINE_AA)
            cv2.putText(canvas, part, (10 * unit, row), face, size, colour, unit, cv2.LINE_AA)
            row += 20 * unit
