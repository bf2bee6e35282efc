"""Uncertainty of a pose from a rolling shutter: a tool that moves while the rows of a frame are read one after another.

A single frame does not show this motion: it turns the image of the tool and stretches it, as another pose does.
"""

import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera

READOUT = 2.5e-4  # metres: motion of a hand at 10 mm/s while a webcam reads a frame in 25 ms
_STEP = 1e-3  # metres: step of the difference that gives the rows per metre


def readout_covariance(
    camera: Camera, tip: Tensor, direction: Tensor, positions: Tensor, height: int, motion: float
) -> Tensor:
    """Covariance [B, 6, 6] of tip and direction that an unknown motion during the readout of a frame adds.

    The pose is that at the time when the row of the middle between the first and the last point is read.

    Args:
        camera: Camera that took the frame.
        tip: [B, 3] in metres.
        direction: [B, 3] unit vectors from the tip to the rear.
        positions: [N] distances in metres from the tip, increasing, of the points that the pose is fitted to.
        height: Rows of the frame.
        motion: Standard deviation in metres, along each axis, of the motion between the first and the last row.
    """
    centre = tip + (middle := (positions[0] + positions[-1]) / 2) * direction
    ends = centre[:, None] + direction[:, None] * direction.new_tensor([[-_STEP], [_STEP]])
    late = camera.project(ends)[..., 1].diff(dim=-1) / (2 * _STEP * height)  # share of the readout per metre, [B, 1]
    # The image of a motion along the tube's image, but at the same depth, is that of a shorter distance; the images of
    # the other parts, across the tube and along the line of sight, are those of turns.
    image = direction - direction[:, 2:] / centre[:, 2:] * centre
    normal = torch.nn.functional.normalize(torch.linalg.cross(centre, direction), dim=-1)
    parts = torch.linalg.inv_ex(torch.stack([image, normal, centre], -1)).inverse * late[..., None]
    turn = torch.stack([normal, centre], -1) @ parts[:, 1:]
    longer = direction[:, None] @ turn
    turn = turn - direction[..., None] * longer  # the direction keeps unit length, for which all is scaled
    lever = torch.cat([-centre[..., None] * (parts[:, :1] + longer) - middle * turn, turn], 1)
    return motion**2 * lever @ lever.mT
