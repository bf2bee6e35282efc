"""Pose of a catheter in front of a camera with its covariance, or the reason why there is none."""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor


class Status(enum.IntEnum):
    """Result of tracking in one frame: a pose, or the reason why the first failing stage refused one."""

    OK = 0
    UNVERIFIED = 1  # a pose from three edges, which no further edge verifies, or one that the tube goes beyond
    BAD_FRAME = 2  # the frame is unreadable, of the wrong size, or without contrast
    NO_CATHETER = 3  # nothing thin and long has the colours of the bands
    BANDS_MISSING = 4  # fewer than two neighbouring bands are visible
    NO_AXIS = 5  # the bands do not lie on a straight line
    TOO_NARROW = 6  # no pixel shows one colour alone
    EDGES_UNCLEAR = 7  # fewer than three edges between colours
    OUT_OF_FRAME = 8  # an edge lies at the border of the image
    OUTSIDE_CAMERA = 9  # the catheter lies where the distortion is not invertible
    INCONSISTENT = 10  # no pose explains the edges
    UNCERTAIN = 11  # the pose is too uncertain to be used

    @property
    def answered(self) -> bool:
        """Whether there is a pose."""
        return self <= Status.UNVERIFIED

    @property
    def stage(self) -> str:
        """Stage that decided the status, one of "frame", "colour", "axis", "edges", "camera" or "pose"."""
        return _STAGES[self]


THREE_EDGES = "three edges determine a pose and leave nothing to check it with"  # reason of an UNVERIFIED pose
# Reason of an UNVERIFIED pose, too.
BEYOND_TIP = "the tube goes on beyond the tip, which is then wrong, or another object lies there"
# In the order of Status.
_STAGES = ("pose", "pose", "frame", "colour", "colour", "axis", "axis", "edges", "edges", "camera", "pose", "pose")


class Refusal(Exception):
    """Raised by a stage that fails.

    Attributes:
        status, reason: Status and reason of the refused pose.
        turned: Whether the bands may appear in the reversed order.
        final: Whether the bands were measured, so that a search elsewhere in the frame is of no use.
        crossed: Edges beside which something lies across the tube, if edges contradict each other.
    """

    def __init__(
        self,
        status: Status,
        reason: str,
        *,
        turned: bool = False,
        final: bool = False,
        crossed: tuple[int, ...] = (),
    ):
        super().__init__(reason)
        self.status, self.reason, self.turned, self.final, self.crossed = status, reason, turned, final, crossed


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of one catheter, or a batch of poses with leading axis [...], in the frame of the camera.

    In this frame, x points right, y down and z forward. Where there is no pose, ``tip``, ``direction``, ``covariance``
    and ``chi_square`` are NaN.

    Attributes:
        tip: [..., 3] in metres.
        direction: [..., 3], unit vector from the tip to the rear.
        covariance: [..., 6, 6] of (tip, direction) in m^2, m and 1; of rank 5. It includes errors of the edges in the
            frame, but not those of the calibration and of the positions of the edges on the catheter. These are the
            same in all frames, and shift a pose by more than its standard deviation even for a good calibration (rms
            0.04 px).
        chi_square: [...] sum of the squared residuals of the edges, each divided by its variance.
        freedom: [...] degrees of freedom of ``chi_square``.
        status: Status of the pose, or a tuple of statuses for a batch.
        reason: One sentence: the reason for a refusal, or a warning; empty if there is neither.
    """

    tip: Tensor
    direction: Tensor
    covariance: Tensor
    chi_square: Tensor
    freedom: Tensor
    status: Status | tuple[Status, ...]
    reason: str = ""

    @staticmethod
    def refused(status: Status, reason: str) -> Pose:
        """A refusal: no pose, with its status and reason."""
        if status.answered:
            raise ValueError(f"{status.name} is no refusal")
        nan = (torch.full(shape, torch.nan, dtype=torch.float64) for shape in ((3,), (3,), (6, 6), ()))
        return Pose(*nan, freedom=torch.zeros((), dtype=torch.float64), status=status, reason=reason)

    @property
    def answered(self) -> bool:
        """Whether there is a pose; ValueError for a batch."""
        if not isinstance(self.status, Status):
            raise ValueError("a batch of poses has a status for each; ask pose[i].answered")
        return self.status.answered

    @property
    def tip_sd(self) -> Tensor:
        """Standard deviation of the tip in metres [...], the root of the sum of the variances of all three axes."""
        return self.covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()

    @property
    def camera_from_tool(self) -> Tensor:
        """Rigid map [..., 4, 4] that takes the origin to the tip and, by the smallest rotation, z to the direction."""
        x, y, z = self.direction.unbind(-1)
        square = x * x + y * y
        opposite = (z < 0) & (square < 1e-30)  # no unique smallest rotation: by 180 degrees about x
        # 1 / (1 + z), without cancellation for z near -1.
        factor = torch.where(z < 0, (1 - z) / torch.where(opposite | (z >= 0), 1.0, square), 1 / (1 + z.clamp(min=0)))
        xx, xy = torch.where(opposite, 1.0, 1 - x * x * factor), torch.where(opposite, 0.0, -x * y * factor)
        yy = torch.where(opposite, -1.0, 1 - y * y * factor)
        columns = torch.stack([xx, xy, -x], -1), torch.stack([xy, yy, -y], -1), self.direction, self.tip
        matrix = torch.stack(columns, -1)
        last = torch.tensor([0.0, 0, 0, 1], dtype=matrix.dtype, device=matrix.device).expand(*matrix.shape[:-2], 1, 4)
        return torch.cat([matrix, last], -2)

    def point(self, along: float | Tensor) -> Tensor:
        """Point [..., 3] of the axis, ``along`` metres behind the tip."""
        distance = torch.as_tensor(along, dtype=self.tip.dtype, device=self.tip.device)
        return self.tip + distance[..., None] * self.direction

    def __len__(self) -> int:
        return len(self.tip) if self.tip.ndim > 1 else 1

    def __iter__(self) -> Iterator[Pose]:
        return iter((self,)) if isinstance(self.status, Status) else map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> Pose:
        """One pose of a batch."""
        if isinstance(self.status, Status):
            raise IndexError("this is one pose, not a batch")
        tensors = (self.tip, self.direction, self.covariance, self.chi_square, self.freedom)
        return Pose(*(value[index] for value in tensors), status=self.status[index], reason=self.reason)
