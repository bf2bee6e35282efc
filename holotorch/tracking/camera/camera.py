"""Camera: a pinhole with radial and tangential distortion, and the curve from light to 8-bit levels."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks

_MISSED_PX = 1e-9  # pixels: largest error of an undistorted point after distorting it again
_STEEP = 20.0  # largest distance from the axis on the plane z = 1: tan of 87 degrees


@dataclass(frozen=True, eq=False)
class Camera:
    """Projection of points in front of a camera to its image, and the inverse.

    The camera frame is x right, y down, z forward, in metres. Pixels are (x, y), and (0, 0) is the centre of the top
    left pixel.

    Attributes:
        matrix: [3, 3] float64 with fx, fy, cx, cy in pixels; no skew. Differentiable, as ``distortion`` is.
        distortion: [5] float64: k1, k2, p1, p2, k3 in OpenCV's order.
        tone: Tone curve: "srgb", "linear", or an increasing table [256] of the light, 0 to 1, of each 8-bit level.
        size: (H, W) of the frames for which the parameters are valid. Trackers refuse frames of another size, since
            their poses would be wrong but plausible. None accepts every size.

    Raises:
        TypeError, ValueError: Impossible parameters.

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
        kept = given * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]], dtype=torch.float64, device=given.device)
        if not bool((given == kept).all()) or given[2, 2] != 1 or given[0, 0] <= 0 or given[1, 1] <= 0:
            raise ValueError(f"matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0, got {given.tolist()}")
        if self.size is not None:
            object.__setattr__(self, "size", tuple(checks.whole("size", side, 1) for side in self.size))
        if isinstance(self.tone, str):
            if self.tone not in ("srgb", "linear"):
                raise ValueError(f"tone must be 'srgb', 'linear' or a table of 256 values, got {self.tone!r}")
        else:
            table = torch.as_tensor(self.tone).to(torch.float64)
            if table.shape != (256,) or not bool((table.diff() > 0).all()) or table[0] < 0 or table[-1] > 1:
                raise ValueError("a tone table must have 256 values that rise from >= 0 to <= 1, one for each level")
            object.__setattr__(self, "tone", table)

    def need_size(self, frames: Tensor) -> None:
        """Raise ValueError for frames [..., H, W] of another size than that of the camera."""
        if self.size is not None and tuple(frames.shape[-2:]) != self.size:
            (h, w), (height, width) = self.size, frames.shape[-2:]
            raise ValueError(
                f"the camera is for frames of {w} x {h} px, got {width} x {height}: scale or move its matrix likewise"
            )

    @cached_property
    def valid_radius(self) -> float:
        """Largest distance from the axis on the plane z = 1 at which the distortion is invertible, 20 at most."""
        k1, k2, _, _, k3 = self.distortion.tolist()
        # The distorted radius r (1 + k1 r^2 + k2 r^4 + k3 r^6) increases up to its first stationary point.
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1])
        turning = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
        return min(_STEEP, math.sqrt(min(turning, default=math.inf)))

    def project(self, points: Tensor) -> Tensor:
        """Pixels [..., 2] of points [..., 3] in metres; NaN behind the camera and beyond ``valid_radius``."""
        if points.shape[-1:] != (3,) or not points.is_floating_point():
            raise ValueError(f"points must be floating, of shape [..., 3], got {points.dtype}, {list(points.shape)}")
        with torch.no_grad():
            plane = points[..., :2] / points[..., 2:]
            inside = (points[..., 2:] > 0) & (plane.square().sum(-1, keepdim=True) <= self.valid_radius**2)
        # Insert NaN last: in the computation it would make the gradients of all points NaN.
        kept = torch.where(inside, points, torch.tensor([0, 0, 1]).to(points))
        return torch.where(inside, self.distort(kept[..., :2] / kept[..., 2:]), torch.nan)

    def distort(self, plane: Tensor) -> Tensor:
        """Pixels [..., 2] of points [..., 2] on the plane z = 1, in float64."""
        x, y = plane.to(torch.float64).unbind(-1)
        k1, k2, p1, p2, k3 = self.distortion.to(plane.device)
        matrix = self.matrix.to(plane.device)
        xx, yy, xy = x * x, y * y, 2 * x * y
        square = xx + yy
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        u = x * radial + p1 * xy + p2 * (square + 2 * xx)
        v = y * radial + p2 * xy + p1 * (square + 2 * yy)
        # All x are contiguous in memory, then all y, which speeds up later operations.
        return torch.stack([u * matrix[0, 0] + matrix[0, 2], v * matrix[1, 1] + matrix[1, 2]]).movedim(0, -1)

    def undistort(self, pixels: Tensor) -> Tensor:
        """Points [..., 2] on the plane z = 1 of pixels [..., 2], in float64; NaN where the distortion has no inverse.

        Differentiable with respect to the pixels and the parameters of the camera.
        """
        if pixels.shape[-1:] != (2,):
            raise ValueError(f"pixels must be of shape [..., 2], got {list(pixels.shape)}")
        if not pixels.numel():
            return pixels.to(torch.float64)
        given = pixels.reshape(1, -1, 2).to(torch.float64)
        matrix = self.matrix.to(given.device)
        with torch.no_grad():
            # Newton steps from the undistorted pixel. Distorting the result again shows whether they converged.
            plane = ((given - matrix[:2, 2]) / matrix.diagonal()[:2]).nan_to_num(torch.inf).clamp(-_STEEP, _STEEP)
            plane, lost = self._settled(plane, given, 4)
            if bool(lost.any()):  # the steps may diverge where the distortion is strong but invertible
                plane, lost = self._settled(torch.where(lost, self._radial(given), plane), given, 8)
        if pixels.requires_grad or self.matrix.requires_grad or self.distortion.requires_grad:
            plane = plane - self._newton(
                plane, given
            )  # a step of zero length with the derivative of the inverse function
        return torch.where(lost, torch.nan, plane).reshape(pixels.shape)

    def _settled(self, plane: Tensor, pixels: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """``plane`` [1, n, 2] after Newton steps, and which points [1, n, 1] did not converge."""
        for _ in range(steps):
            plane = (plane - self._newton(plane, pixels)).clamp(-_STEEP, _STEEP)
        missed = (self.distort(plane) - pixels).abs().amax(-1, keepdim=True)
        return plane, ~(missed <= _MISSED_PX) | (plane.square().sum(-1, keepdim=True) > self.valid_radius**2)

    def _radial(self, pixels: Tensor) -> Tensor:
        """Points [1, n, 2] of ``pixels`` by bisection over the radius, without the tangential distortion."""
        k1, k2, _, _, k3 = self.distortion.to(pixels.device)
        matrix = self.matrix.to(pixels.device)
        distorted = (pixels - matrix[:2, 2]) / matrix.diagonal()[:2]
        radius = distorted.norm(dim=-1, keepdim=True)
        low, high = torch.zeros_like(radius), torch.full_like(radius, self.valid_radius)
        for _ in range(50):
            middle = (low + high) / 2
            square = middle.square()
            below = middle * (1 + square * (k1 + square * (k2 + square * k3))) < radius
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (distorted / radius.clamp(min=1e-12) * low).nan_to_num(0.0)

    def _newton(self, plane: Tensor, pixels: Tensor) -> Tensor:
        """Newton step, to be subtracted from ``plane`` [1, n, 2]."""
        missed = self.distort(plane) - pixels
        (xx, xy), (yx, yy) = (row.unbind(-1) for row in self.slopes(plane).detach().unbind(-2))
        u, v = missed.unbind(-1)
        across = xx * yy - xy * yx
        least = 1e-9 * self.matrix[0, 0].detach() * self.matrix[1, 1].detach()
        across = torch.where(across.abs() > least, across, torch.inf)
        return torch.stack([yy * u - xy * v, xx * v - yx * u], -1).div(across[..., None]).nan_to_num(0.0)

    def slopes(self, plane: Tensor) -> Tensor:
        """[..., 2, 2] derivatives of ``distort`` in pixels by the point on the plane z = 1, at ``plane`` [..., 2]."""
        (k1, k2, p1, p2, k3), (x, y) = self.distortion.to(plane.device), plane.unbind(-1)
        square = x * x + y * y
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        slope = 2 * (k1 + square * (2 * k2 + 3 * square * k3))
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        scale = self.matrix.diagonal()[:2, None].to(plane.device)
        return torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2) * scale

    def linear(self, levels: Tensor) -> Tensor:
        """Light from 0 to 1 of levels from 0 to 255, uint8 or floating; the same shape, float32 at least."""
        if not levels.is_floating_point():
            return self.table(levels.device)[levels.long()]
        if isinstance(self.tone, Tensor):
            table = self.tone.to(levels)
            low = levels.clamp(0, 255).floor().clamp(max=254)
            at = low.nan_to_num(0).long()
            return table[at] + (levels.clamp(0, 255) - low) * (table[at + 1] - table[at])
        share = levels / 255
        if self.tone == "linear":
            return share
        return srgb_to_light(share)

    def levels(self, light: Tensor) -> Tensor:
        """Levels from 0 to 255, not rounded, of light that is clipped to 0 to 1; the inverse of ``linear``."""
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
        """Light of each of the 256 levels, float32 [256]."""
        return self.linear(torch.arange(256, dtype=torch.float64)).to(device, torch.float32)


def srgb_to_light(share: Tensor) -> Tensor:
    """Linear light of sRGB values, both from 0 to 1 and of any shape; IEC 61966-2-1."""
    return torch.where(share <= 0.04045, share / 12.92, ((share.clamp(min=0.04) + 0.055) / 1.055) ** 2.4)
