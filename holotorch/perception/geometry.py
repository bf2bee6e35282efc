"""Flat screens, curved screens and headsets: conversion between directions in degrees, metres and pixels.

The eye is at the origin and fixates straight ahead, along z. A direction is (elevation, azimuth) in degrees. Elevation
is the angle above the horizontal plane; azimuth is measured within this plane, positive to the right. A position on a
display is (y, x) with y downwards. In pixels, (0, 0) is the centre of the top left pixel; in metres, (0, 0) is the
middle of the display.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import DEPTH, SCREEN
from holotorch.perception import angles


def eccentricity_of(elevation_deg: Any, azimuth_deg: Any) -> Tensor:
    """Angle in degrees between a direction and the fixation point; see :func:`separation`."""
    return separation(elevation_deg, azimuth_deg, 0.0, 0.0)


def separation(elevation_deg: Any, azimuth_deg: Any, other_elevation_deg: Any, other_azimuth_deg: Any) -> Tensor:
    """Angle in degrees between two directions, whose tensors broadcast. Its gradient is 0 at 0 and at 180 deg.

    The half-angle formula keeps full precision at small angles, where the arc cosine loses half of the digits.
    """
    directions = (elevation_deg, azimuth_deg, other_elevation_deg, other_azimuth_deg)
    e1, a1, e2, a2 = (angles.as_tensor("angles", value).deg2rad() for value in directions)
    half = torch.sin((e1 - e2) / 2).square() + e1.cos() * e2.cos() * torch.sin((a1 - a2) / 2).square()
    # sqrt(half) has an infinite gradient at 0, and sqrt(1 - half) at 1; both values are replaced first.
    inside = (half > 0) & (half < 1)
    safe = torch.where(inside, half, 0.5)
    angle = 2 * torch.atan2(safe.sqrt(), (1 - safe).sqrt())
    return torch.where(inside, angle, (half > 0).to(angle) * math.pi).rad2deg()


@dataclass(frozen=True)
class Display:
    """Base class of all displays. ``shape`` is (H, W) in pixels.

    The methods take numbers or tensors that broadcast to [...]. A pair such as (y, x) is returned as two tensors [...].
    """

    shape: tuple[int, int]

    def __post_init__(self):
        if not isinstance(self.shape, tuple) or len(self.shape) != 2:
            raise TypeError(f"shape must be (H, W) in pixels, got {self.shape!r}")
        for side in self.shape:
            checks.whole("shape", side, 1)

    def angles(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """Directions (elevation, azimuth) in degrees of points on the display surface, also beyond its edges."""
        raise NotImplementedError

    def pixels(self, elevation_deg: Any, azimuth_deg: Any) -> tuple[Tensor, Tensor]:
        """Positions (y, x) in pixels at which directions meet the display surface; NaN where they do not meet it.

        Positions may lie beyond the edges. ValueError for an elevation beyond 90 deg or an azimuth beyond 180 deg.
        """
        raise NotImplementedError

    def pixels_per_degree(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """Pixels along (y, x) per degree of visual angle at points of the display, from analytic derivatives."""
        raise NotImplementedError

    def eccentricity(self, y_px: Any, x_px: Any) -> Tensor:
        """Angle in degrees between the fixation point and points of the display."""
        return eccentricity_of(*self.angles(y_px, x_px))

    def eccentricity_map(self) -> Tensor:
        """Eccentricity of every pixel centre in degrees, float64 [H, W]."""
        y, x = (torch.arange(side, dtype=torch.float64) for side in self.shape)
        return self.eccentricity(y[:, None], x[None, :])

    def shows(self, elevation_deg: Any, azimuth_deg: Any) -> Tensor:
        """Whether each direction meets a pixel of the display; bool [...]."""
        y, x = self.pixels(elevation_deg, azimuth_deg)
        return angles.within(y, -0.5, self.shape[0] - 0.5) & angles.within(x, -0.5, self.shape[1] - 0.5)

    def width_px(self, azimuth_deg: Any, size_deg: Any) -> Tensor:
        """Width in pixels of a pattern on the horizon that spans ``size_deg`` of azimuth around ``azimuth_deg``."""
        middle, half = angles.as_tensor("azimuth_deg", azimuth_deg), angles.size(size_deg) / 2
        level = torch.zeros_like(middle)
        return self.pixels(level, middle + half)[1] - self.pixels(level, middle - half)[1]

    @property
    def field_deg(self) -> tuple[float, float]:
        """Field of view (vertical, horizontal) in degrees from edge to edge, through the middle of the display."""
        height, width = self.shape
        middle = (height - 1) / 2, (width - 1) / 2
        top, bottom = self.angles([-0.5, height - 0.5], middle[1])[0].tolist()
        left, right = self.angles(middle[0], [-0.5, width - 0.5])[1].tolist()
        return top - bottom, right - left

    def _middle(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        y, x = angles.as_tensor("y_px", y_px, "pixels"), angles.as_tensor("x_px", x_px, "pixels")
        return torch.broadcast_tensors(y - (self.shape[0] - 1) / 2, x - (self.shape[1] - 1) / 2)

    def _from_middle(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        return y + (self.shape[0] - 1) / 2, x + (self.shape[1] - 1) / 2


@dataclass(frozen=True)
class _Screen(Display):
    """A screen of ``size`` (height, width) metres along its surface; its middle is ``distance`` metres from the eye."""

    size: tuple[float, float]
    distance: float

    def __post_init__(self):
        super().__post_init__()
        for side in checks.pair("size", self.size, "metres"):
            checks.quantity(SCREEN, side, "size")
        checks.quantity(DEPTH, self.distance, "distance")

    @property
    def pitch(self) -> tuple[float, float]:
        """Pixel pitch (y, x) in metres."""
        return self.size[0] / self.shape[0], self.size[1] / self.shape[1]

    def metres(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """Convert positions (y, x) from pixels to metres along the surface, from the middle of the screen."""
        y, x = self._middle(y_px, x_px)
        return y * self.pitch[0], x * self.pitch[1]

    def pixels_at(self, y_m: Any, x_m: Any) -> tuple[Tensor, Tensor]:
        """Convert positions (y, x) from metres along the surface, from the middle of the screen, to pixels."""
        y, x = angles.as_tensor("y_m", y_m, "metres"), angles.as_tensor("x_m", x_m, "metres")
        return self._from_middle(*torch.broadcast_tensors(y / self.pitch[0], x / self.pitch[1]))

    def angles(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`."""
        x, y, z = self._surface(*self.metres(y_px, x_px))[0].unbind(-1)
        return torch.atan2(-y, torch.hypot(x, z)).rad2deg(), torch.atan2(x, z).rad2deg()

    def pixels(self, elevation_deg: Any, azimuth_deg: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`."""
        visible, y, x = self._intersection(*_directions(elevation_deg, azimuth_deg))
        y, x = self.pixels_at(y, x)
        return torch.where(visible, y, math.nan), torch.where(visible, x, math.nan)

    def pixels_per_degree(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`.

        A step ds from the point p along the unit tangent t changes the direction by |p x t| ds / |p|^2 radians.
        """
        point, right = self._surface(*self.metres(y_px, x_px))

        def along(tangent: Tensor, pitch: float) -> Tensor:
            across = torch.linalg.cross(point, tangent.expand_as(point)).square().sum(-1).sqrt()
            return math.radians(1) * point.square().sum(-1) / (across * pitch)

        return along(point.new_tensor([0.0, 1.0, 0.0]), self.pitch[0]), along(right, self.pitch[1])

    def _surface(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points at (y, x) metres on the surface, and their unit tangents to the right; both (x, y, z) [..., 3]."""
        raise NotImplementedError

    def _intersection(self, up: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Whether rays at (elevation, azimuth) in radians meet the surface, and the (y, x) in metres where they do."""
        raise NotImplementedError


@dataclass(frozen=True)
class FlatScreen(_Screen):
    """A monitor, or the virtual image of a headset whose lens has no distortion (rectilinear projection)."""

    @classmethod
    def spanning(cls, shape: tuple[int, int], field_deg: tuple[float, float], distance: float = 1.0) -> "FlatScreen":
        """The flat screen at ``distance`` metres with a field of view (vertical, horizontal), each below 180 deg."""
        for side in checks.pair("field_deg", field_deg, "degrees"):
            if not 0 < side < 180:
                raise ValueError(f"field_deg must be within 0 .. 180 degrees for a flat screen, got {side:g}")
        height, width = (2 * distance * math.tan(math.radians(side) / 2) for side in field_deg)
        return cls(shape, (height, width), distance)

    def _surface(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        point = torch.stack([x, y, torch.full_like(x, self.distance)], -1)
        return point, point.new_tensor([1.0, 0.0, 0.0])

    def _intersection(self, up: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        in_front = (side.abs() < math.pi / 2) & (up.abs() < math.pi / 2)
        up, side = torch.where(in_front, up, 0), torch.where(in_front, side, 0)
        return in_front, -self.distance * up.tan() / side.cos(), self.distance * side.tan()


@dataclass(frozen=True)
class CurvedScreen(_Screen):
    """A screen on a vertical cylinder of ``radius`` metres, concave towards the eye; its middle is straight ahead.

    ``size`` is (height, arc length) in metres. The eye may be off the axis of the cylinder. If the eye is outside the
    cylinder, a ray intersects the cylinder twice, and the farther intersection is used.
    """

    radius: float

    def __post_init__(self):
        super().__post_init__()
        checks.quantity(SCREEN, self.radius, "radius")
        if self.size[1] > 2 * math.pi * self.radius * (1 + 1e-12):
            raise ValueError(f"the arc must be at most a full turn of {self.radius:g} m radius, got {self.size[1]:g} m")

    def _surface(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        angle = x / self.radius
        ahead = self.distance - self.radius + self.radius * angle.cos()
        right = torch.stack([angle.cos(), torch.zeros_like(angle), -angle.sin()], -1)
        return torch.stack([self.radius * angle.sin(), y, ahead], -1), right

    def _intersection(self, up: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        offset = self.distance - self.radius  # from the eye to the axis of the cylinder, along z
        root = self.radius**2 - offset**2 * side.sin().square()
        visible = (root > 0) & (up.abs() < math.pi / 2)
        distance = offset * side.cos() + torch.where(visible, root, 1).sqrt()  # in the horizontal plane
        visible = visible & (distance > 0)
        x, y = distance * side.sin(), -distance * torch.where(visible, up, 0).tan()
        return visible, y, self.radius * torch.atan2(x, distance * side.cos() - offset)


@dataclass(frozen=True)
class Headset(Display):
    """A headset with f-theta projection: ``resolution`` is in pixels per degree along each radius from the middle.

    For rectilinear projection, use FlatScreen.
    """

    resolution: float

    def __post_init__(self):
        super().__post_init__()
        checks.positive("resolution", self.resolution, "pixels per degree")
        if max(self.field_deg) > 360 * (1 + 1e-12):
            raise ValueError(f"a headset's field must be at most 360 degrees, got {max(self.field_deg):g}")

    @property
    def field_deg(self) -> tuple[float, float]:
        """See :class:`Display`. The vertical field may exceed 180 deg; it then includes directions behind the eye."""
        return self.shape[0] / self.resolution, self.shape[1] / self.resolution

    def angles(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`."""
        y, x = self._middle(y_px, x_px)
        radius = _norm(y, x)
        angle = (radius / self.resolution).deg2rad()
        share = torch.where(radius > 0, angle.sin() / radius, math.radians(1 / self.resolution))
        up = (-y * share).clamp(-1, 1).asin()
        return up.rad2deg(), torch.atan2(x * share, angle.cos()).rad2deg()

    def pixels(self, elevation_deg: Any, azimuth_deg: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`. NaN for the direction straight behind the eye, which corresponds to a whole circle."""
        up, side = _directions(elevation_deg, azimuth_deg)
        x, y = up.cos() * side.sin(), -up.sin()
        sine = _norm(y, x)
        angle = torch.atan2(sine, up.cos() * side.cos()).rad2deg()
        # sine = 0 is replaced by 1, because 0 / 0 would have a NaN gradient even where it is not selected.
        share = angle * self.resolution / torch.where(sine > 0, sine, 1)
        share = torch.where(sine > 0, share, self.resolution * math.degrees(1))
        share = torch.where((sine < 1e-12) & (angle > 90), math.nan, share)
        return self._from_middle(y * share, x * share)

    def pixels_per_degree(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`.

        At r radians from the middle, it is ``resolution`` along the radius and ``resolution`` r / sin r across it.
        """
        y, x = self._middle(y_px, x_px)
        radius = _norm(y, x)
        angle = (radius / self.resolution).deg2rad()
        around = torch.where(radius > 0, angle.sin() / torch.where(radius > 0, angle, 1), 1)
        safe = torch.where(radius > 0, radius, 1)
        cosine, sine = torch.where(radius > 0, x / safe, 1), y / safe
        rotation_x = torch.hypot(cosine, sine * around)  # visual angle per pixel along x / along the radius
        rotation_y = torch.hypot(sine, cosine * around)
        return self.resolution / rotation_y, self.resolution / rotation_x


def _directions(elevation_deg: Any, azimuth_deg: Any) -> tuple[Tensor, Tensor]:
    """Elevation and azimuth in radians, broadcast. ValueError beyond 90 deg of elevation or 180 deg of azimuth."""
    up, side = angles.as_tensor("elevation_deg", elevation_deg), angles.as_tensor("azimuth_deg", azimuth_deg)
    angles.require(up.abs() <= 90, "elevation_deg must be within -90 .. 90 degrees", up)
    angles.require(side.abs() <= 180, "azimuth_deg must be within -180 .. 180 degrees", side)
    up, side = torch.broadcast_tensors(up.deg2rad(), side.deg2rad())
    return up, side


def _norm(y: Tensor, x: Tensor) -> Tensor:
    """Length of the vector (y, x), with gradient 0 at (0, 0)."""
    square = y.square() + x.square()
    return torch.where(square > 0, torch.where(square > 0, square, 1).sqrt(), 0)
