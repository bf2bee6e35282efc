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

    def plane(self, t: Tensor, u: Tensor | float = 0.0) -> Tensor:
        """Points [..., 2] on the plane z = 1 of places (t, u), which broadcast."""
        (x, y), (ax, ay) = self.origin, self.along / self.scale
        return planar(x + t * ax - u * ay, y + t * ay + u * ax)

    def pixels(self, camera: Camera, t: Tensor, u: Tensor) -> Tensor:
        """Pixels [T, U, 2] of places t [T], u [U] some tens of pixels from the line.

        Three lines along are distorted, and a parabola across laid through them. What it misses is odd in u and rises
        with its third power: a thousandth of a pixel at 30, of a lens with k1 = -0.12 and a focal length of 1400.
        """
        far = u.abs().max().clamp(min=1.0)
        near, middle, other = camera.distort(self.plane(t, torch.stack([-far, 0 * far, far])[:, None]))  # [T, 2] each
        share = u / far
        bent = torch.stack([middle, (other - near) / 2, (other + near) / 2 - middle], -1)  # [T, 2, 3]
        return (bent @ torch.stack([torch.ones_like(share), share, share * share])).mT

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


def planar(x: Tensor, y: Tensor) -> Tensor:
    """Points [..., 2] whose x lie side by side in memory, and whose y do: each is then quickly worked on."""
    return torch.stack([x, y]).movedim(0, -1)


class Sampler:
    """Reads one frame uint8 [3, H, W] at pixels between pixels, in linear light."""

    def __init__(self, frame: Tensor, light: Tensor):
        self.frame, self.light = frame, light
        self.height, self.width = frame.shape[-2:]
        # One row of memory, whichever way colours lie in it: the quickest to pick from.
        reach = sum((n - 1) * step for n, step in zip(frame.shape, frame.stride(), strict=True))
        self.memory = frame.as_strided((reach + 1,), (1,))
        self.colours = torch.arange(3, device=frame.device)[:, None] * frame.stride(0)

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels [..., 2] lie on the frame; NaN does not."""
        x, y = pixels.unbind(-1)
        return (x >= 0) & (y >= 0) & (x <= self.width - 1) & (y <= self.height - 1)

    def _levels(self, row: Tensor, column: Tensor) -> Tensor:
        """uint8 [3, ...] of whole pixels on the frame."""
        _, down, right = self.frame.stride()
        index = row * down + column * right
        return self.memory.index_select(0, (self.colours + index.flatten()).flatten()).view(3, *index.shape)

    def nearest(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Levels uint8 [3, ...] of the pixels nearest to [..., 2], and which are on the frame."""
        x, y = pixels.nan_to_num(-1).round().long().unbind(-1)
        return self._levels(y.clamp(0, self.height - 1), x.clamp(0, self.width - 1)), self.inside(pixels)

    def __call__(self, pixels: Tensor) -> Tensor:
        """Light float32 [3, ...] at pixels [..., 2], bilinear among four; the border's where they leave the frame.

        The four are turned into light before they are mixed, and only they are: no frame of floats is made.
        """
        x, y = pixels.nan_to_num(0).unbind(-1)
        x, y = x.clamp(0, self.width - 1), y.clamp(0, self.height - 1)
        column, row = x.long().clamp(max=self.width - 2), y.long().clamp(max=self.height - 2)
        right, below = (x - column).to(torch.float32), (y - row).to(torch.float32)
        steps = torch.tensor([0, 1], device=row.device).view(2, *[1] * row.ndim)
        levels = self._levels(row + steps[:, None], column + steps)  # [3, 2, 2, ...]
        light = self.light.index_select(0, levels.flatten().int()).view(levels.shape)
        top, bottom = torch.lerp(light[:, :, 0], light[:, :, 1], right).unbind(1)
        return torch.lerp(top, bottom, below)
