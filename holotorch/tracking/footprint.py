"""What a pose makes of the catheter on a line of its image: how wide it is there, and how its rings bulge."""

import torch
from torch import Tensor

from holotorch.tracking.catheter import Catheter
from holotorch.tracking.status import Pose
from holotorch.tracking.strips import Line


def width_px(pose: Pose, catheter: Catheter, line: Line) -> tuple[float, float]:
    """Of the tube's image at t = 0 in pixels across the line, and its change per pixel.

    2 r / (z sqrt(1 - n_z^2)) on the plane z = 1, n the unit normal of the plane through axis and camera: what is
    seen aside of the image's middle is seen at a slant.
    """
    ends = pose.tip + catheter.positions.to(pose.tip.device)[[0, -1], None] * pose.direction
    t, _ = line.place(ends[:, :2] / ends[:, 2:])
    normal = torch.linalg.cross(pose.tip, pose.direction)
    slant = normal.norm() / normal[:2].norm()
    near, far = (2 * catheter.radius * line.scale * slant / ends[:, 2]).tolist()
    taper = (far - near) / float(t[1] - t[0])
    return near - taper * float(t[0]), taper


def bulge_px(pose: Pose, catheter: Catheter, line: Line) -> Tensor:
    """How far along the line [N], in pixels, the front of each ring's image lies from that of its centre."""
    toward = (pose.tip @ pose.direction) * pose.direction - pose.tip
    centres = pose.tip + catheter.positions.to(pose.tip.device)[:, None] * pose.direction
    points = torch.stack([centres, centres + catheter.radius * toward / toward.norm()])
    t, _ = line.place(points[..., :2] / points[..., 2:])
    return t[1] - t[0]
