"""Geometry of flat, curved and headset displays: conversion between directions in degrees, metres and pixels.

The eye is at the origin and fixates straight ahead, along z. A direction is (elevation, azimuth) in degrees: the
elevation above the horizontal plane, positive upwards, and the azimuth within that plane, positive to the right. Pixels
and metres on a screen are (y, x) with y downwards. The centre of the top left pixel is (0, 0) in pixels, and the middle
of the display is (0, 0) in metres.
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
    """Angle in degrees between a direction and the fixation point, accurate at all angles."""
    return separation(elevation_deg, azimuth_deg, 0.0, 0.0)


def separation(elevation_deg: Any, azimuth_deg: Any, other_elevation_deg: Any, other_azimuth_deg: Any) -> Tensor:
    """Angle in degrees between two directions, which broadcast. Its gradient at 0 is 0.

    Uses the half-angle formula, because the arc cosine would lose half of the digits near 0.
    """
    directions = (elevation_deg, azimuth_deg, other_elevation_deg, other_azimuth_deg)
    e1, a1, e2, a2 = (angles.as_tensor("angles", value).deg2rad() for value in directions)
    half = torch.sin((e1 - e2) / 2).square() + e1.cos() * e2.cos() * torch.sin((a1 - a2) / 2).square()
    # 0 and 1 are replaced before the square roots, one of which has an infinite gradient at each of them.
    inside = (half > 0) & (half < 1)
    safe = torch.where(inside, half, 0.5)
    angle = 2 * torch.atan2(safe.sqrt(), (1 - safe).sqrt())
    return torch.where(inside, angle, (half > 0).to(angle) * math.pi).rad2deg()


@dataclass(frozen=True)
class Display:
    """Base class of all displays. ``shape`` is (H, W) in pixels.

    The methods take numbers or tensors that broadcast to [...]. Pairs are returned as two tensors [...].
    """

    shape: tuple[int, int]

    def __post_init__(self):
        if not isinstance(self.shape, tuple) or len(self.shape) != 2:
            raise TypeError(f"shape must be (H, W) in pixels, got {self.shape!r}")
        for side in self.shape:
            checks.whole("shape", side, 1)

    def angles(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """(elevation, azimuth) in degrees of points on the display surface, also beyond the edge of the display."""
        raise NotImplementedError

    def pixels(self, elevation_deg: Any, azimuth_deg: Any) -> tuple[Tensor, Tensor]:
        """(y, x) in pixels of directions, also beyond the edge; NaN for directions that do not meet the surface.

        ValueError for elevations beyond 90 or azimuths beyond 180 deg.
        """
        raise NotImplementedError

    def pixels_per_degree(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """Pixels per degree of eye rotation along (y, x) at points of the display, as exact derivatives."""
        raise NotImplementedError

    def eccentricity(self, y_px: Any, x_px: Any) -> Tensor:
        """Angle in degrees between the fixation point and points of the display."""
        return eccentricity_of(*self.angles(y_px, x_px))

    def eccentricity_map(self, *, dtype: torch.dtype = torch.float64) -> Tensor:
        """Eccentricity of every pixel centre in degrees, [H, W]."""
        y, x = (torch.arange(side, dtype=torch.float64) for side in self.shape)
        return self.eccentricity(y[:, None], x[None, :]).to(dtype)

    def shows(self, elevation_deg: Any, azimuth_deg: Any) -> Tensor:
        """Whether a direction meets a pixel of the display; bool."""
        y, x = self.pixels(elevation_deg, azimuth_deg)
        return angles.within(y, -0.5, self.shape[0] - 0.5) & angles.within(x, -0.5, self.shape[1] - 0.5)

    def width_px(self, azimuth_deg: Any, size_deg: Any) -> Tensor:
        """Width in pixels of a pattern of ``size_deg`` centred at an azimuth on the horizon."""
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
    """A screen of ``size`` (height, width) along its surface, ``distance`` from the eye to its middle, in metres."""

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
        """(y, x) in metres from the middle, along the surface."""
        y, x = self._middle(y_px, x_px)
        return y * self.pitch[0], x * self.pitch[1]

    def pixels_at(self, y_m: Any, x_m: Any) -> tuple[Tensor, Tensor]:
        """(y, x) in pixels of points in metres from the middle, along the surface."""
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

        With u = p / |p|, a step ds along the tangent t at the point p changes the direction by (t - (t.u) u) ds / |p|.
        """
        point, right = self._surface(*self.metres(y_px, x_px))

        def along(tangent: Tensor, pitch: float) -> Tensor:
            across = torch.linalg.cross(point, tangent.expand_as(point)).square().sum(-1).sqrt()
            return math.radians(1) * point.square().sum(-1) / (across * pitch)

        return along(point.new_tensor([0.0, 1.0, 0.0]), self.pitch[0]), along(right, self.pitch[1])

    def _surface(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points [..., 3] at metres (y, x) on the surface, and their unit tangents to the right, as (x, y, z)."""
        raise NotImplementedError

    def _intersection(self, up: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Whether rays at (elevation, azimuth) in radians meet the surface, and where: (y, x) in metres along it."""
        raise NotImplementedError


@dataclass(frozen=True)
class FlatScreen(_Screen):
    """A monitor, or the virtual image of a headset with rectilinear projection (an ideal lens)."""

    @classmethod
    def spanning(cls, shape: tuple[int, int], field_deg: tuple[float, float], distance: float = 1.0) -> "FlatScreen":
        """The flat screen that covers a field of view (vertical, horizontal), each below 180 deg."""
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
    """Part of an upright cylinder of ``radius`` metres, concave towards the eye; its middle is straight ahead.

    ``size`` is (height, arc length). The eye may be off the axis of the cylinder. A ray from an eye outside the
    cylinder intersects it twice; the farther point counts.
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
        offset = self.distance - self.radius  # distance from the eye to the axis of the cylinder
        root = self.radius**2 - offset**2 * side.sin().square()
        visible = (root > 0) & (up.abs() < math.pi / 2)
        distance = offset * side.cos() + torch.where(visible, root, 1).sqrt()  # in the horizontal plane
        visible = visible & (distance > 0)
        x, y = distance * side.sin(), -distance * torch.where(visible, up, 0).tan()
        return visible, y, self.radius * torch.atan2(x, distance * side.cos() - offset)


@dataclass(frozen=True)
class Headset(Display):
    """A headset with ``resolution`` pixels per degree along each radius from the middle (f-theta projection).

    FlatScreen describes headsets with rectilinear projection.
    """

    resolution: float

    def __post_init__(self):
        super().__post_init__()
        checks.positive("resolution", self.resolution, "pixels per degree")
        if max(self.field_deg) > 360 * (1 + 1e-12):
            raise ValueError(f"a headset's field must be at most 360 degrees, got {max(self.field_deg):g}")

    @property
    def field_deg(self) -> tuple[float, float]:
        """See :class:`Display`; may exceed 180 deg vertically, although elevations are limited to 90 deg."""
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
        """See :class:`Display`; NaN for the direction straight behind the eye, whose image is a circle."""
        up, side = _directions(elevation_deg, azimuth_deg)
        x, y = up.cos() * side.sin(), -up.sin()
        sine = _norm(y, x)
        angle = torch.atan2(sine, up.cos() * side.cos()).rad2deg()
        # 0 is replaced before the division, whose gradient would be NaN.
        share = angle * self.resolution / torch.where(sine > 0, sine, 1)
        share = torch.where(sine > 0, share, self.resolution * math.degrees(1))
        share = torch.where((sine < 1e-12) & (angle > 90), math.nan, share)
        return self._from_middle(y * share, x * share)

    def pixels_per_degree(self, y_px: Any, x_px: Any) -> tuple[Tensor, Tensor]:
        """See :class:`Display`: ``resolution`` along a radius, and r / sin r times as many along a circle.

        r is the eccentricity in radians.
        """
        y, x = self._middle(y_px, x_px)
        radius = _norm(y, x)
        angle = (radius / self.resolution).deg2rad()
        around = torch.where(radius > 0, angle.sin() / torch.where(radius > 0, angle, 1), 1)
        safe = torch.where(radius > 0, radius, 1)
        cosine, sine = torch.where(radius > 0, x / safe, 1), y / safe
        rotation_x = torch.hypot(cosine, sine * around)  # eye rotation, relative to that of a radial step
        rotation_y = torch.hypot(sine, cosine * around)
        return self.resolution / rotation_y, self.resolution / rotation_x


def _directions(elevation_deg: Any, azimuth_deg: Any) -> tuple[Tensor, Tensor]:
    """(elevation, azimuth) in radians, broadcast. ValueError for elevations beyond 90 or azimuths beyond 180 deg."""
    up, side = angles.as_tensor("elevation_deg", elevation_deg), angles.as_tensor("azimuth_deg", azimuth_deg)
    angles.require(up.abs() <= 90, "elevation_deg must be within -90 .. 90 degrees", up)
    angles.require(side.abs() <= 180, "azimuth_deg must be within -180 .. 180 degrees", side)
    up, side = torch.broadcast_tensors(up.deg2rad(), side.deg2rad())
    return up, side


def _norm(y: Tensor, x: Tensor) -> Tensor:
    """Norm of (y, x), with gradient 0 at 0."""
    square = y.square() + x.square()
    return torch.where(square > 0, torch.where(square > 0, square, 1).sqrt(), 0)
