"""Strips of a frame along a line of space's image: straight there, curved on the frame as the lens curves it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.tracking.camera import Camera


@dataclass(frozen=True, eq=False)
class Line:
    """A line on the plane z = 1, with places (t along, u across) in units of a pixel at the centre.

    Attributes:
        origin: [2], where t = u = 0.
        along: [2], unit vector.
        scale: Pixels per unit of the plane.
    """

    origin: Tensor
    along: Tensor
    scale: float

    @property
    def across(self) -> Tensor:
        """[2], unit vector to positive u."""
        return torch.stack([-self.along[1], self.along[0]])

    def plane(self, t: Tensor, u: Tensor) -> Tensor:
        """Points [..., 2] on the plane z = 1 of places (t, u)."""
        return self.origin + (t[..., None] * self.along + u[..., None] * self.across) / self.scale

    def place(self, plane: Tensor) -> tuple[Tensor, Tensor]:
        """Places (t, u) of points [..., 2] on the plane z = 1."""
        offset = (plane - self.origin) * self.scale
        return offset @ self.along, offset @ self.across

    def moved(self, offset: Tensor, slope: Tensor, about: float = 0.0) -> "Line":
        """The line u = offset + slope (t - about), with t = 0 where ``about`` was."""
        turned = self.along + slope * self.across
        origin = self.plane(torch.as_tensor(about, dtype=self.origin.dtype), offset)
        return Line(origin, turned / turned.norm(), self.scale)

    @staticmethod
    def through(camera: Camera, pixels: Tensor) -> "Line":
        """The line from the first to the second of two pixels [2, 2], t = 0 in their middle; NaN outside the lens."""
        plane = camera.undistort(pixels)
        return Line.between(camera, plane)

    @staticmethod
    def between(camera: Camera, plane: Tensor) -> "Line":
        """As ``through`` for two points [2, 2] on the plane z = 1."""
        scale = float(camera.matrix.diagonal()[:2].detach().mean())
        gap = plane[1] - plane[0]
        return Line(plane.mean(0), gap / gap.norm(), scale)


class Sampler:
    """Reads one frame uint8 [3, H, W] at pixels between pixels, in linear light."""

    def __init__(self, frame: Tensor, light: Tensor):
        self.frame, self.flat, self.light = frame, frame.reshape(3, -1), light
        self.height, self.width = frame.shape[-2:]

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels [..., 2] lie on the frame; NaN does not."""
        x, y = pixels.unbind(-1)
        return (x >= 0) & (y >= 0) & (x <= self.width - 1) & (y <= self.height - 1)

    def nearest(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Levels uint8 [3, ...] of the pixels nearest to [..., 2], and which are on the frame."""
        inside = self.inside(pixels)
        whole = pixels.nan_to_num(-1).round().long()
        index = whole[..., 1].clamp(0, self.height - 1) * self.width + whole[..., 0].clamp(0, self.width - 1)
        return self.flat[:, index.reshape(-1)].reshape(3, *index.shape), inside

    def __call__(self, pixels: Tensor) -> Tensor:
        """Light float32 [3, ...] at pixels [..., 2], bilinear among four; the border's where they leave the frame.

        The four are turned into light before they are mixed, and only they are: no frame of floats is made.
        """
        x, y = pixels.nan_to_num(0).unbind(-1)
        x, y = x.clamp(0, self.width - 1), y.clamp(0, self.height - 1)
        column, row = x.long().clamp(max=self.width - 2), y.long().clamp(max=self.height - 2)
        right, below = (x - column).to(torch.float32), (y - row).to(torch.float32)
        index = (row * self.width + column).reshape(-1)
        corners = torch.stack([index, index + 1, index + self.width, index + self.width + 1])
        light = self.light[self.flat[:, corners.reshape(-1)].long()].reshape(3, 4, *x.shape)
        top = torch.lerp(light[:, 0], light[:, 1], right)
        return torch.lerp(top, torch.lerp(light[:, 2], light[:, 3], right), below)
