"""Rays that meet a banded tube: which part of it each one sees, and the light that comes back along it."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera, srgb_to_light
from holotorch.tracking.pose.catheter import Catheter

# A lattice of 8 points in the unit square: each axis meets 8 different values, where a 3 x 3 grid would offer 3.
_LATTICE = (np.stack([np.arange(8), 3 * np.arange(8) % 8], -1) + 0.5) / 8
_TURN = np.array([0.7548776662466927, 0.5698402909980532])  # shifts it from one place to the next, evenly (R2 sequence)
_DARKEST = 0.25  # light on a surface that faces the camera, below which no camera makes up for it


def light_of(colour: tuple[int, int, int]) -> np.ndarray:
    """Linear light [3], 0 to 1, of an 8-bit sRGB triple."""
    return srgb_to_light(torch.tensor(colour, dtype=torch.float64) / 255).numpy()


@dataclass(frozen=True, eq=False)
class Tube:
    """A finite cylinder in front of a camera, and how it shines.

    Attributes:
        tip: [3] in metres, camera frame.
        direction: Unit vector [3] from the tip to the rear.
        radius: In metres.
        length: In metres.
        edges: [N] in metres from the tip.
        colours: Linear light, float32 [N + 1, 3], of its parts: before the first band, the bands, behind the last.
        clear: [N + 1], share of the background that shines through the same parts.
        light: Unit vector [3] towards the light.
        ambient: Share of the light that comes from everywhere.
        level: Of all light: 1 over that on a surface which faces the camera, so that it shows its own colour.
        highlight: Light of the gloss.
        highlight_width: Standard deviation of its lobe in radians.
    """

    tip: np.ndarray
    direction: np.ndarray
    radius: float
    length: float
    edges: np.ndarray
    colours: np.ndarray
    clear: np.ndarray
    light: np.ndarray
    ambient: float
    level: float
    highlight: float
    highlight_width: float

    def shine(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light and cover, float32 [..., 4], and the part that is seen, uint8 [...], of rays (x, y, 1) as [..., 2].

        The part is 0 where a ray passes by (or is NaN), else 1 + its row in ``colours``. Light is that of the part
        alone, to be added to what is left of the background, 1 - cover.
        """
        x, y = rays[..., 0], rays[..., 1]
        tip, axis, radius = self.tip, self.direction, self.radius

        def dot(vector: np.ndarray) -> np.ndarray:
            return x * vector[0] + y * vector[1] + vector[2]

        with np.errstate(invalid="ignore", divide="ignore"):
            along, square, ahead = dot(axis), x * x + y * y + 1, float(tip @ axis)
            across = square - along * along
            # The quadratic's discriminant without cancellation: b^2 - a |A|^2 = -(v . (A x d))^2 across the axis.
            root = np.sqrt(across * radius**2 - dot(np.cross(tip, axis)) ** 2)  # NaN: passes by
            depth = (dot(tip) - along * ahead - root) / across
            place = depth * along - ahead
            hit = (depth > 0) & (place >= 0) & (place <= self.length)
            size = np.sqrt(square)
            facing = root / (radius * size)
            lit = (depth * dot(self.light) - tip @ self.light - place * (axis @ self.light)) / radius
            if ahead > 0 or ahead < -self.length:  # one of the flat ends is turned to the camera
                end = 0.0 if ahead > 0 else self.length
                depth = (ahead + end) / along
                centre = tip + end * axis
                off = (depth * x - centre[0]) ** 2 + (depth * y - centre[1]) ** 2 + (depth - centre[2]) ** 2
                flat = ~hit & (depth > 0) & (off <= radius**2)
                place = np.where(flat, end, place)
                facing = np.where(flat, np.abs(along) / size, facing)
                lit = np.where(flat, math.copysign(1.0, -ahead) * (axis @ self.light), lit)
                hit |= flat
        seen, part = np.zeros((*hit.shape, 4), np.float32), np.zeros(hit.shape, np.uint8)
        which = np.searchsorted(self.edges, place[hit], side="right")
        part[hit] = which + 1
        seen[hit] = self._shade(
            which, *(value[hit].astype(np.float32) for value in (facing, lit, dot(self.light) / size))
        )
        return seen, part

    def _shade(self, part: np.ndarray, facing: np.ndarray, lit: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Light and cover, float32 [n, 4], of rays that meet a part.

        ``facing``, ``lit`` and ``light`` are cosines: of the normal with the way back, of the normal with the way to
        the light, and of the ray with the way to the light.
        """
        halfway = (lit + facing) / np.sqrt(np.maximum(2 - 2 * light, 1e-6))
        gloss = np.exp((np.minimum(halfway, 1) ** 2 - 1) / (2 * self.highlight_width**2))
        # The way through a wall that is seen at a slant is longer.
        cover = 1 - self.clear[part] ** (1 / np.maximum(facing, 0.05))
        shade = self.level * cover * (self.ambient + (1 - self.ambient) * np.maximum(lit, 0))
        seen = np.empty((len(part), 4), np.float32)
        seen[:, :3] = self.colours[part] * shade[:, None] + (self.highlight * gloss * (lit > 0))[:, None]
        seen[:, 3] = cover
        return seen

    def outline(self, camera: Camera, size: tuple[int, int], pad: int) -> np.ndarray:
        """Pixels that may see the tube: uint8 [H + 2 pad, W + 2 pad], 0 or 255, wider than its image on all sides."""
        mask = np.zeros((size[0] + 2 * pad, size[1] + 2 * pad), np.uint8)
        axis = self.tip + np.linspace(0, self.length, 256)[:, None] * self.direction
        beside = np.cross(self.tip, self.direction)
        if np.linalg.norm(beside) < 1e-6:  # it points at the camera: any normal will do
            beside = np.cross(self.direction, np.eye(3)[np.argmin(np.abs(self.direction))])
        beside *= self.radius / np.linalg.norm(beside)
        over = np.cross(self.direction, beside)
        rings = np.stack([axis, axis + beside, axis - beside, axis + over, axis - over])
        pixels = camera.project(torch.from_numpy(rings)).detach().numpy()
        # The image of a ring is an ellipse within the root of the squares of any two conjugate half axes.
        wide = 1.05 * np.linalg.norm(pixels[1::2] - pixels[0], axis=(0, -1)) + 1
        for start, end, half in zip(pixels[0, :-1] + pad, pixels[0, 1:] + pad, wide, strict=False):
            if np.abs([*start, *end, half]).max() < 1e6:  # not NaN: behind the camera or too far aside
                first, last = ([round(16 * float(value)) for value in point] for point in (start, end))
                cv2.line(mask, first, last, 255, min(2 * math.ceil(half), 32767), cv2.LINE_8, 4)
        return mask


def tube_of(
    catheter: Catheter,
    tip: Tensor | None,
    direction: Tensor | None,
    *,
    light: tuple[float, float, float],
    ambient: float,
    highlight: tuple[float, float],
    colour: tuple[int, int, int],
    opacity: float,
) -> Tube:
    """A catheter at a pose as a :class:`Tube`; ``highlight`` is (light, width), ``colour`` that outside the bands.

    Raises:
        TypeError, ValueError: No vectors of 3 finite numbers, a direction that is no unit vector, or a tube that comes
            so close to the camera that its image has no bounds.
    """
    vectors = []
    for name, value in (("tip", tip), ("direction", direction)):
        if not isinstance(value, Tensor) or value.shape != (3,) or not value.is_floating_point():
            raise TypeError(f"{name} must be a floating tensor of shape [3], got {getattr(value, 'shape', value)!r}")
        checks.all_finite(name, value)
        vectors.append(value.detach().to("cpu", torch.float64).numpy())
    place, axis = vectors
    if abs(np.linalg.norm(axis) - 1) > 1e-4:
        raise ValueError(f"direction must be a unit vector, got length {np.linalg.norm(axis):g}; divide by it")
    axis = axis / np.linalg.norm(axis)
    nearest = place + np.clip(-place @ axis, 0, catheter.length) * axis
    if np.linalg.norm(nearest) < 10 * catheter.radius:
        raise ValueError(f"the tube comes within {np.linalg.norm(nearest):.3g} m of the camera; keep 10 radii away")
    toward = np.asarray(light, dtype=np.float64) / np.linalg.norm(light)
    facing = ambient + (1 - ambient) * max(0.0, -float(toward[2]))
    return Tube(
        place,
        axis,
        catheter.radius,
        catheter.length,
        np.asarray(catheter.edges),
        np.stack([light_of(one) for one in (colour, *catheter.colours, colour)]).astype(np.float32),
        np.array([1 - opacity, *(0 for _ in catheter.colours), 1 - opacity], np.float32),
        toward,
        ambient,
        1 / max(facing, _DARKEST),
        *highlight,
    )


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of pixels: through the centre, and how they change from a pixel to the next on the right and below.

    Distortion bends so little within a pixel that a straight line is good to 2e-5 pixels.
    """

    index: np.ndarray  # int32, over the padded frame: row in the arrays below, -1 for none
    centre: np.ndarray  # [n, 2]
    right: np.ndarray
    down: np.ndarray

    @staticmethod
    def of(camera: Camera, mask: np.ndarray, pad: int) -> "Rays":
        """Those of the pixels that ``mask`` of the padded frame marks."""
        found = cv2.findNonZero(mask)
        x, y = np.asarray([] if found is None else found, dtype=np.intp).reshape(-1, 2).T
        index = np.full(mask.shape, -1, np.int32)
        index[y, x] = np.arange(len(y))
        centre = np.stack([x, y], -1) - float(pad)
        pixels = np.stack([centre, centre + [0.5, 0], centre + [0, 0.5]])
        plane = camera.undistort(torch.from_numpy(pixels)).detach().numpy()
        return Rays(index, plane[0], 2 * (plane[1] - plane[0]), 2 * (plane[2] - plane[0]))

    def at(self, row: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Rays [..., 2] at an ``offset`` [..., 2] in pixels, (x, y), from the centres of pixels ``row`` [...]."""
        return self.centre[row] + self.right[row] * offset[..., :1] + self.down[row] * offset[..., 1:]


def cast(tube: Tube, rays: Rays, window: tuple[slice, slice], fine: int) -> np.ndarray:
    """Light and cover, float32 [h fine, w fine, 4], of a window of the padded frame, ``fine`` samples a pixel's side.

    One ray for each sample, 8 where its neighbours see other parts of the tube.
    """
    index = rays.index[window]
    height, width = index.shape
    y, x = np.nonzero(index >= 0)
    place = (np.arange(fine) + 0.5) / fine - 0.5
    offset = np.stack(np.meshgrid(place, place), -1)  # [row, column, (x, y)]
    light = np.zeros((height, fine, width, fine, 4), np.float32)
    part = np.zeros((height, fine, width, fine), np.uint8)
    light[y, :, x], part[y, :, x] = tube.shine(rays.at(index[y, x][:, None, None], offset))
    light, part = light.reshape(height * fine, width * fine, 4), part.reshape(height * fine, width * fine)
    around = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    rim = cv2.dilate(part, around) != cv2.erode(part, around)
    rim &= np.repeat(np.repeat(index >= 0, fine, 0), fine, 1)
    y, x = np.nonzero(rim)
    corner = np.stack([x % fine, y % fine], -1) / fine - 0.5
    # Counted from the frame's corner: the same place has the same rays whatever the window.
    across, down = x + fine * window[1].start, y + fine * window[0].start
    turn = np.stack([across * _TURN[0] + down * _TURN[1], across * _TURN[1] + down * _TURN[0]], -1)[:, None]
    offset = corner[:, None] + (_LATTICE + turn) % 1 / fine
    seen, _ = tube.shine(rays.at(index[y // fine, x // fine][:, None], offset))
    light[y, x] = seen.mean(1)
    return light
