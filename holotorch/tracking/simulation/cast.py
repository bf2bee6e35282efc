"""Ray casting of a banded tube: the part of the tube that each ray hits, and the light that returns along the ray."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera, srgb_to_light
from holotorch.tracking.pose.catheter import Catheter

# A lattice of 8 points in the unit square with 8 different values along each axis, where a 3 x 3 grid has 3.
_LATTICE = (np.stack([np.arange(8), 3 * np.arange(8) % 8], -1) + 0.5) / 8
# Shift of the lattice from one sample to the next (R2 sequence).
_TURN = np.array([0.7548776662466927, 0.5698402909980532])
_DARKEST = 0.25  # the light on a surface that faces the camera is normalized to 1, unless it is below this


def light_of(colour: tuple[int, int, int]) -> np.ndarray:
    """Linear light [3], 0 to 1, of an 8-bit sRGB triple."""
    return srgb_to_light(torch.tensor(colour, dtype=torch.float64) / 255).numpy()


@dataclass(frozen=True, eq=False)
class Tube:
    """A finite cylinder in front of a camera, and how it reflects light.

    Attributes:
        tip: [3] tip in metres, in the camera frame.
        direction: Unit vector [3] from the tip to the rear.
        radius: Radius in metres.
        length: Length in metres.
        edges: [N] edges of the bands in metres from the tip.
        colours: float32 [N + 1, 3] linear light of the parts: before the first band, the bands, behind the last.
        clear: [N + 1] share of the background that is visible through each part.
        light: Unit vector [3] towards the light.
        ambient: Share of the light that comes equally from all directions.
        level: Factor on all light, by which a surface that faces the camera appears in its own colour.
        highlight: Brightness of the specular reflection.
        highlight_width: Standard deviation of the specular lobe in radians.
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
        """Light and cover, float32 [..., 4], and visible part, uint8 [...], of rays (x, y, 1), given as [..., 2].

        The part is 0 where a ray misses the tube (or is NaN), else 1 + its row in ``colours``. The light is that of
        the part alone, to be added to 1 - cover times the background.
        """
        x, y = rays[..., 0], rays[..., 1]
        tip, axis, radius = self.tip, self.direction, self.radius

        def dot(vector: np.ndarray) -> np.ndarray:
            return x * vector[0] + y * vector[1] + vector[2]

        with np.errstate(invalid="ignore", divide="ignore"):
            along, square, ahead = dot(axis), x * x + y * y + 1, float(tip @ axis)
            across = square - along * along
            # The quadratic's discriminant without cancellation: b^2 - a |A|^2 = -(v . (A x d))^2 across the axis.
            root = np.sqrt(across * radius**2 - dot(np.cross(tip, axis)) ** 2)  # NaN: the ray misses
            depth = (dot(tip) - along * ahead - root) / across
            place = depth * along - ahead
            hit = (depth > 0) & (place >= 0) & (place <= self.length)
            size = np.sqrt(square)
            facing = root / (radius * size)
            lit = (depth * dot(self.light) - tip @ self.light - place * (axis @ self.light)) / radius
            if ahead > 0 or ahead < -self.length:  # one of the flat ends faces the camera
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
        """Light and cover, float32 [n, 4], of rays that hit the tube.

        ``facing``, ``lit`` and ``light`` are cosines of angles: between the normal and the direction to the camera,
        between the normal and the direction to the light, and between the ray and the direction to the light.
        """
        halfway = (lit + facing) / np.sqrt(np.maximum(2 - 2 * light, 1e-6))
        gloss = np.exp((np.minimum(halfway, 1) ** 2 - 1) / (2 * self.highlight_width**2))
        # The path through the wall is longer at oblique incidence.
        cover = 1 - self.clear[part] ** (1 / np.maximum(facing, 0.05))
        shade = self.level * cover * (self.ambient + (1 - self.ambient) * np.maximum(lit, 0))
        seen = np.empty((len(part), 4), np.float32)
        seen[:, :3] = self.colours[part] * shade[:, None] + (self.highlight * gloss * (lit > 0))[:, None]
        seen[:, 3] = cover
        return seen

    def outline(self, camera: Camera, size: tuple[int, int], pad: int) -> np.ndarray:
        """Mask that contains the image of the tube with a margin: uint8 [H + 2 pad, W + 2 pad], 0 or 255."""
        mask = np.zeros((size[0] + 2 * pad, size[1] + 2 * pad), np.uint8)
        axis = self.tip + np.linspace(0, self.length, 256)[:, None] * self.direction
        beside = np.cross(self.tip, self.direction)
        if np.linalg.norm(beside) < 1e-6:  # it points at the camera: any normal is suitable
            beside = np.cross(self.direction, np.eye(3)[np.argmin(np.abs(self.direction))])
        beside *= self.radius / np.linalg.norm(beside)
        over = np.cross(self.direction, beside)
        rings = np.stack([axis, axis + beside, axis - beside, axis + over, axis - over])
        pixels = camera.project(torch.from_numpy(rings)).detach().numpy()
        # The image of a ring is an ellipse; two conjugate half axes a, b bound its radius by sqrt(a^2 + b^2).
        wide = 1.05 * np.linalg.norm(pixels[1::2] - pixels[0], axis=(0, -1)) + 1
        for start, end, half in zip(pixels[0, :-1] + pad, pixels[0, 1:] + pad, wide, strict=False):
            if np.abs([*start, *end, half]).max() < 1e6:  # else NaN: behind the camera or too far aside
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
    """Tube of a catheter at a pose; ``highlight`` is (brightness, width), ``colour`` is the colour outside the bands.

    Raises:
        TypeError, ValueError: ``tip`` or ``direction`` is not a vector of 3 finite numbers, ``direction`` is not a unit
            vector, or the tube comes within 10 radii of the camera.
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
    """Rays (x, y, 1) through pixel centres, and their changes to the next pixel on the right and below.

    Distortion is nearly linear within a pixel: this approximation is accurate to 2e-5 pixels.
    """

    index: np.ndarray  # int32 [H + 2 pad, W + 2 pad]: row in the arrays below, -1 for none
    centre: np.ndarray  # [n, 2]
    right: np.ndarray
    down: np.ndarray

    @staticmethod
    def of(camera: Camera, mask: np.ndarray, pad: int) -> "Rays":
        """Rays of the pixels where ``mask`` of the padded frame is not 0."""
        found = cv2.findNonZero(mask)
        x, y = np.asarray([] if found is None else found, dtype=np.intp).reshape(-1, 2).T
        index = np.full(mask.shape, -1, np.int32)
        index[y, x] = np.arange(len(y))
        centre = np.stack([x, y], -1) - float(pad)
        pixels = np.stack([centre, centre + [0.5, 0], centre + [0, 0.5]])
        plane = camera.undistort(torch.from_numpy(pixels)).detach().numpy()
        return Rays(index, plane[0], 2 * (plane[1] - plane[0]), 2 * (plane[2] - plane[0]))

    def at(self, row: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Rays [..., 2] at ``offset`` [..., 2] (x, y) in pixels from the centres of pixels ``row`` [...]."""
        return self.centre[row] + self.right[row] * offset[..., :1] + self.down[row] * offset[..., 1:]


def cast(tube: Tube, rays: Rays, window: tuple[slice, slice], fine: int) -> np.ndarray:
    """Light and cover, float32 [h fine, w fine, 4], of a window of the padded frame, fine^2 samples a pixel.

    Each sample is one ray, or the mean of 8 rays where a neighbouring sample shows another part of the tube.
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
    # Count from the corner of the frame, so that the rays of a sample do not depend on the window.
    across, down = x + fine * window[1].start, y + fine * window[0].start
    turn = np.stack([across * _TURN[0] + down * _TURN[1], across * _TURN[1] + down * _TURN[0]], -1)[:, None]
    offset = corner[:, None] + (_LATTICE + turn) % 1 / fine
    seen, _ = tube.shine(rays.at(index[y // fine, x // fine][:, None], offset))
    light[y, x] = seen.mean(1)
    return light
