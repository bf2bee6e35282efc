"""Camera: a pinhole with radial and tangential distortion, and a tone curve from light to 8-bit levels."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks

MAX_ERROR_PX = 1e-9  # largest error in pixels of a point that is undistorted and distorted again
_MAX_RADIUS = 20.0  # largest distance from the axis on the plane z = 1: tan of 87 degrees


@dataclass(frozen=True, eq=False)
class Camera:
    """Projection of points in front of a camera to its image, and the inverse.

    The camera frame is x right, y down, z forward, in metres. Pixels are (x, y), and (0, 0) is the centre of the top
    left pixel.

    Attributes:
        matrix: float64 [3, 3] with fx, fy, cx, cy in pixels; no skew. It may carry a gradient, as ``distortion`` may.
        distortion: float64 [5]: k1, k2, p1, p2, k3, in OpenCV's order.
        tone: "srgb", "linear", or an increasing table [256] of the light, 0 to 1, of each 8-bit level.
        size: (H, W) of the frames for which the parameters are valid. Trackers refuse frames of another size, since
            their poses would be wrong but plausible. None accepts every size.

    Raises:
        TypeError, ValueError: A parameter of another type, shape or range.

    Source: Brown (1966) for the distortion; IEC 61966-2-1 for sRGB.
    """

    matrix: Tensor
    distortion: Tensor
    tone: str | Tensor = "srgb"
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        for name, shape in (("matrix", (3, 3)), ("distortion", (5,))):
            value = torch.as_tensor(getattr(self, name)).to(torch.float64)
            if value.shape != shape:
                raise ValueError(f"{name} must be of shape {list(shape)}, got {list(value.shape)}")
            checks.all_finite(name, value)
            object.__setattr__(self, name, value)
        given = self.matrix.detach()
        skewed = bool(given[[0, 1, 2, 2], [1, 0, 0, 1]].any())
        if skewed or given[2, 2] != 1 or given[0, 0] <= 0 or given[1, 1] <= 0:
            raise ValueError(f"matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0, got {given.tolist()}")
        if self.size is not None:
            object.__setattr__(self, "size", tuple(checks.whole("size", side, 1) for side in self.size))
        if not isinstance(self.tone, str):
            table = torch.as_tensor(self.tone).to(torch.float64)
            if table.shape != (256,) or not bool((table.diff() > 0).all()) or table[0] < 0 or table[-1] > 1:
                raise ValueError("a tone table must have 256 values that rise from >= 0 to <= 1, one for each level")
            object.__setattr__(self, "tone", table)
        elif self.tone not in ("srgb", "linear"):
            raise ValueError(f"tone must be 'srgb', 'linear' or a table of 256 values, got {self.tone!r}")

    def need_size(self, frames: Tensor) -> None:
        """Raise ValueError for frames [..., H, W] of another size than that of the camera."""
        if self.size is not None and tuple(frames.shape[-2:]) != self.size:
            (h, w), (height, width) = self.size, frames.shape[-2:]
            raise ValueError(
                f"the camera is for frames of {w} x {h} px, got {width} x {height}: scale or move its matrix likewise"
            )

    @cached_property
    def valid_radius(self) -> float:
        """Distance from the axis on the plane z = 1 up to which the distortion is invertible, at most 20."""
        k1, k2, _, _, k3 = self.distortion.tolist()
        # The distorted radius r (1 + k1 r^2 + k2 r^4 + k3 r^6) increases up to its first stationary point.
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1])
        stationary = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
        return min(_MAX_RADIUS, math.sqrt(min(stationary, default=math.inf)))

    def project(self, points: Tensor) -> Tensor:
        """Pixels [..., 2] of points [..., 3] in metres; NaN behind the camera and outside ``valid_radius``."""
        if points.shape[-1:] != (3,) or not points.is_floating_point():
            raise ValueError(f"points must be floating, of shape [..., 3], got {points.dtype}, {list(points.shape)}")
        with torch.no_grad():
            plane = points[..., :2] / points[..., 2:]
            inside = (points[..., 2:] > 0) & (plane.square().sum(-1, keepdim=True) <= self.valid_radius**2)
        # NaN is inserted last, since in the computation it would make the gradients of all points NaN.
        kept = torch.where(inside, points, torch.tensor([0, 0, 1]).to(points))
        return torch.where(inside, self.distort(kept[..., :2] / kept[..., 2:]), torch.nan)

    def distort(self, plane: Tensor) -> Tensor:
        """Pixels, float64 [..., 2], of points [..., 2] on the plane z = 1."""
        x, y = plane.to(torch.float64).unbind(-1)
        _, _, p1, p2, _ = self.distortion.to(plane.device)
        matrix = self.matrix.to(plane.device)
        xx, yy, xy = x * x, y * y, 2 * x * y
        square = xx + yy
        radial = self._radial_factor(square)
        u = x * radial + p1 * xy + p2 * (square + 2 * xx)
        v = y * radial + p2 * xy + p1 * (square + 2 * yy)
        # In memory all x come first and then all y, which makes later operations faster.
        return torch.stack([u * matrix[0, 0] + matrix[0, 2], v * matrix[1, 1] + matrix[1, 2]]).movedim(0, -1)

    def _radial_factor(self, square: Tensor) -> Tensor:
        """Distorted divided by undistorted radius, without tangential distortion, for squared undistorted radii."""
        k1, k2, _, _, k3 = self.distortion.to(square.device)
        return 1 + square * (k1 + square * (k2 + square * k3))

    def undistort(self, pixels: Tensor) -> Tensor:
        """Points on the plane z = 1, float64 [..., 2], of pixels [..., 2]; NaN where the distortion has no inverse.

        Differentiable with respect to the pixels and the parameters of the camera.
        """
        if pixels.shape[-1:] != (2,):
            raise ValueError(f"pixels must be of shape [..., 2], got {list(pixels.shape)}")
        if not pixels.numel():
            return pixels.to(torch.float64)
        given = pixels.reshape(1, -1, 2).to(torch.float64)
        matrix = self.matrix.to(given.device)
        with torch.no_grad():
            distorted = (given - matrix[:2, 2]) / matrix.diagonal()[:2]
            plane, failed = self._newton(distorted.nan_to_num(torch.inf).clamp(-_MAX_RADIUS, _MAX_RADIUS), given, 4)
            if bool(failed.any()):  # Newton's method may diverge where the distortion is strong
                plane, failed = self._newton(torch.where(failed, self._bisect(distorted), plane), given, 8)
        if pixels.requires_grad or self.matrix.requires_grad or self.distortion.requires_grad:
            plane = plane - self._newton_step(plane, given)  # a step of zero with the derivative of the inverse
        return torch.where(failed, torch.nan, plane).reshape(pixels.shape)

    def _newton(self, plane: Tensor, pixels: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """``plane`` [1, n, 2] after Newton steps, and which points [1, n, 1] did not converge to a valid one."""
        for _ in range(steps):
            plane = (plane - self._newton_step(plane, pixels)).clamp(-_MAX_RADIUS, _MAX_RADIUS)
        error = (self.distort(plane) - pixels).abs().amax(-1, keepdim=True)
        return plane, ~(error <= MAX_ERROR_PX) | (plane.square().sum(-1, keepdim=True) > self.valid_radius**2)

    def _newton_step(self, plane: Tensor, pixels: Tensor) -> Tensor:
        """Step of Newton's method, to be subtracted from ``plane`` [1, n, 2]; zero where the Jacobian is singular."""
        u, v = (self.distort(plane) - pixels).unbind(-1)
        (xx, xy), (yx, yy) = (row.unbind(-1) for row in self.slopes(plane).detach().unbind(-2))
        determinant = xx * yy - xy * yx
        least = 1e-9 * self.matrix[0, 0].detach() * self.matrix[1, 1].detach()
        determinant = torch.where(determinant.abs() > least, determinant, torch.inf)
        return torch.stack([yy * u - xy * v, xx * v - yx * u], -1).div(determinant[..., None]).nan_to_num(0.0)

    def _bisect(self, distorted: Tensor) -> Tensor:
        """Undistorted points [1, n, 2] by bisection over their radius, without tangential distortion."""
        radius = distorted.norm(dim=-1, keepdim=True)
        low, high = torch.zeros_like(radius), torch.full_like(radius, self.valid_radius)
        for _ in range(50):
            middle = (low + high) / 2
            below = middle * self._radial_factor(middle.square()) < radius
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (distorted / radius.clamp(min=1e-12) * low).nan_to_num(0.0)

    def slopes(self, plane: Tensor) -> Tensor:
        """Jacobian matrices [..., 2, 2] of :meth:`distort`, in pixels, at points [..., 2] on the plane z = 1."""
        (k1, k2, p1, p2, k3), (x, y) = self.distortion.to(plane.device), plane.unbind(-1)
        square = x * x + y * y
        radial = self._radial_factor(square)
        slope = 2 * (k1 + square * (2 * k2 + 3 * square * k3))
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        scale = self.matrix.diagonal()[:2, None].to(plane.device)
        return torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2) * scale

    def linear(self, levels: Tensor) -> Tensor:
        """Light from 0 to 1 of levels from 0 to 255, of any shape; float32 for levels in uint8, else in their dtype."""
        if not levels.is_floating_point():
            return self.table(levels.device)[levels.long()]
        if isinstance(self.tone, Tensor):
            table = self.tone.to(levels)
            low = levels.clamp(0, 255).floor().clamp(max=254)
            at = low.nan_to_num(0).long()
            return table[at] + (levels.clamp(0, 255) - low) * (table[at + 1] - table[at])
        return levels / 255 if self.tone == "linear" else srgb_to_light(levels / 255)

    def levels(self, light: Tensor) -> Tensor:
        """Inverse of :meth:`linear`: levels from 0 to 255, not rounded, of light, which is clipped to 0 to 1."""
        light = light.clamp(0, 1)
        if isinstance(self.tone, Tensor):
            table = self.tone.to(light)
            above = torch.searchsorted(table, light.contiguous()).clamp(1, 255)
            low, high = table[above - 1], table[above]
            return (above - 1 + (light - low) / (high - low)).clamp(0, 255)
        if self.tone == "linear":
            return 255 * light
        return 255 * torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=1e-3) ** (1 / 2.4) - 0.055)

    def table(self, device: torch.device | None = None) -> Tensor:
        """Light of each 8-bit level, float32 [256]."""
        return self.linear(torch.arange(256, dtype=torch.float64)).to(device, torch.float32)


def srgb_to_light(share: Tensor) -> Tensor:
    """Linear light of sRGB values, both from 0 to 1 and of any shape (IEC 61966-2-1)."""
    return torch.where(share <= 0.04045, share / 12.92, ((share.clamp(min=0.04) + 0.055) / 1.055) ** 2.4)
