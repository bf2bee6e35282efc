"""Ray casting of a tube with bands: the part of the tube that each ray hits, and the light that it reflects."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera, srgb_to_light
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation.look import Look

# A lattice of 8 points in the unit square, which have 8 different coordinates along each axis.
_LATTICE = (np.stack([np.arange(8), 3 * np.arange(8) % 8], -1) + 0.5) / 8
# Shift of the lattice from each sample to the next (R2 sequence).
_LATTICE_SHIFT = np.array([0.7548776662466927, 0.5698402909980532])


def light_of(colour: tuple[int, int, int]) -> np.ndarray:
    """Linear light [3], 0 to 1, of an 8-bit sRGB triple."""
    return srgb_to_light(torch.tensor(colour, dtype=torch.float64) / 255).numpy()


class Tube:
    """A finite cylinder with coloured bands in front of a camera.

    Arguments and exceptions are those of :func:`holotorch.tracking.simulation.render.render`.
    """

    def __init__(self, catheter: Catheter, tip: Tensor | None, direction: Tensor | None, look: Look):
        vectors = []
        for name, value in (("tip", tip), ("direction", direction)):
            if not isinstance(value, Tensor) or value.shape != (3,) or not value.is_floating_point():
                got = repr(getattr(value, "shape", value))
                raise TypeError(f"{name} must be a floating tensor of shape [3], got {got}")
            checks.all_finite(name, value)
            vectors.append(value.detach().to("cpu", torch.float64).numpy())
        self.tip, axis = vectors
        if abs(np.linalg.norm(axis) - 1) > 1e-4:
            raise ValueError(f"direction must be a unit vector, got length {np.linalg.norm(axis):g}; divide by it")
        self.direction = axis / np.linalg.norm(axis)
        nearest = self.tip + np.clip(-self.tip @ self.direction, 0, catheter.length) * self.direction
        if np.linalg.norm(nearest) < 10 * catheter.radius:
            raise ValueError(f"the tube comes within {np.linalg.norm(nearest):.3g} m of the camera; keep 10 radii away")
        self.radius, self.length, self.edges = catheter.radius, catheter.length, np.asarray(catheter.edges)
        self.look = look
        # Light and transparency of the parts: before the first band, the bands, behind the last band.
        colours = (look.tube, *catheter.colours, look.tube)
        self.colours = np.stack([light_of(colour) for colour in colours]).astype(np.float32)  # [N + 1, 3]
        clear = 1 - look.opacity
        self.transparency = np.array([clear, *(0 for _ in catheter.colours), clear], np.float32)  # [N + 1]
        self.light = np.asarray(look.light, dtype=np.float64) / np.linalg.norm(look.light)
        facing = look.ambient + (1 - look.ambient) * max(0.0, -float(self.light[2]))
        self.strength = 1 / max(facing, 0.25)  # a surface that faces the camera has a light of 1

    def shine(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light times opacity and opacity, float32 [..., 4], and visible part, uint8 [...], of rays (x, y, 1) [..., 2].

        The part is 0 where a ray misses the tube or is NaN, else 1 + the index of the part in ``colours``.
        """
        x, y = rays[..., 0], rays[..., 1]
        tip, axis, radius = self.tip, self.direction, self.radius

        def dot(vector: np.ndarray) -> np.ndarray:
            return x * vector[0] + y * vector[1] + vector[2]

        with np.errstate(invalid="ignore", divide="ignore"):
            along, square, ahead = dot(axis), x * x + y * y + 1, float(tip @ axis)
            across = square - along * along
            # The discriminant of the quadratic equation for the depth, in a form without cancellation.
            root = np.sqrt(across * radius**2 - dot(np.cross(tip, axis)) ** 2)  # NaN: the ray misses the cylinder
            depth = (dot(tip) - along * ahead - root) / across
            position = depth * along - ahead  # metres from the tip
            hit = (depth > 0) & (position >= 0) & (position <= self.length)
            size = np.sqrt(square)
            facing = root / (radius * size)
            lit = (depth * dot(self.light) - tip @ self.light - position * (axis @ self.light)) / radius
            if ahead > 0 or ahead < -self.length:  # one of the flat ends faces the camera
                end = 0.0 if ahead > 0 else self.length
                depth = (ahead + end) / along
                centre = tip + end * axis
                off = (depth * x - centre[0]) ** 2 + (depth * y - centre[1]) ** 2 + (depth - centre[2]) ** 2
                flat = ~hit & (depth > 0) & (off <= radius**2)
                position = np.where(flat, end, position)
                facing = np.where(flat, np.abs(along) / size, facing)
                lit = np.where(flat, math.copysign(1.0, -ahead) * (axis @ self.light), lit)
                hit |= flat
        result, part = np.zeros((*hit.shape, 4), np.float32), np.zeros(hit.shape, np.uint8)
        index = np.searchsorted(self.edges, position[hit], side="right")
        part[hit] = index + 1
        cosines = (value[hit].astype(np.float32) for value in (facing, lit, dot(self.light) / size))
        result[hit] = self._shade(index, *cosines)
        return result, part

    def _shade(self, part: np.ndarray, facing: np.ndarray, lit: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Premultiplied light and opacity, float32 [n, 4], of rays that hit the tube.

        ``facing``, ``lit`` and ``light`` are cosines of angles: between the normal and the direction to the camera,
        between the normal and the direction to the light, and between the ray and the direction to the light.
        """
        look = self.look
        halfway = (lit + facing) / np.sqrt(np.maximum(2 - 2 * light, 1e-6))
        gloss = np.exp((np.minimum(halfway, 1) ** 2 - 1) / (2 * look.highlight_width**2))
        # The path through the wall is longer at oblique incidence.
        opacity = 1 - self.transparency[part] ** (1 / np.maximum(facing, 0.05))
        shade = self.strength * opacity * (look.ambient + (1 - look.ambient) * np.maximum(lit, 0))
        result = np.empty((len(part), 4), np.float32)
        result[:, :3] = self.colours[part] * shade[:, None] + (look.highlight * gloss * (lit > 0))[:, None]
        result[:, 3] = opacity
        return result

    def outline(self, camera: Camera, size: tuple[int, int], pad: int) -> np.ndarray:
        """Mask, uint8 [H + 2 pad, W + 2 pad]: 255 at the image of the tube and in a margin around it, else 0."""
        mask = np.zeros((size[0] + 2 * pad, size[1] + 2 * pad), np.uint8)
        axis = self.tip + np.linspace(0, self.length, 256)[:, None] * self.direction
        beside = np.cross(self.tip, self.direction)
        if np.linalg.norm(beside) < 1e-6:  # the tube points at the camera: any normal is suitable
            beside = np.cross(self.direction, np.eye(3)[np.argmin(np.abs(self.direction))])
        beside *= self.radius / np.linalg.norm(beside)
        over = np.cross(self.direction, beside)
        rings = np.stack([axis, axis + beside, axis - beside, axis + over, axis - over])
        pixels = camera.project(torch.from_numpy(rings)).detach().numpy()
        # The image of a ring is an ellipse; two conjugate half axes a, b bound its radius by sqrt(a^2 + b^2).
        wide = 1.05 * np.linalg.norm(pixels[1::2] - pixels[0], axis=(0, -1)) + 1
        for start, end, half in zip(pixels[0, :-1] + pad, pixels[0, 1:] + pad, wide, strict=False):
            if np.abs([*start, *end, half]).max() < 1e6:  # NaN behind the camera
                first, last = ([round(16 * float(value)) for value in point] for point in (start, end))
                cv2.line(mask, first, last, 255, min(2 * math.ceil(half), 32767), cv2.LINE_8, 4)
        return mask


class Rays:
    """Rays (x, y, 1) of the pixels where ``mask`` [H + 2 pad, W + 2 pad] of the padded frame is not 0.

    Within a pixel, the distortion is taken to be linear; for a webcam this is accurate to 2e-5 pixels.

    Attributes:
        index: int32 [H + 2 pad, W + 2 pad], index of the pixel among the n pixels of the mask; -1 for other pixels.
    """

    def __init__(self, camera: Camera, mask: np.ndarray, pad: int):
        pixels = cv2.findNonZero(mask)
        x, y = np.asarray([] if pixels is None else pixels, dtype=np.intp).reshape(-1, 2).T
        self.index = np.full(mask.shape, -1, np.int32)
        self.index[y, x] = np.arange(len(y))
        centre = np.stack([x, y], -1) - float(pad)
        points = np.stack([centre, centre + [0.5, 0], centre + [0, 0.5]])
        plane = camera.undistort(torch.from_numpy(points)).detach().numpy()
        self._centre, self._right, self._down = plane[0], 2 * (plane[1] - plane[0]), 2 * (plane[2] - plane[0])

    def at(self, index: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Rays [..., 2] at ``offset`` [..., 2] (x, y) in pixels from the centres of pixels ``index`` [...]."""
        return self._centre[index] + self._right[index] * offset[..., :1] + self._down[index] * offset[..., 1:]


def cast(tube: Tube, rays: Rays, window: tuple[slice, slice], fine: int) -> np.ndarray:
    """Premultiplied light and opacity, float32 [h fine, w fine, 4], of a window of the padded frame.

    Each pixel has fine^2 samples. A sample is one ray, or the mean of 8 rays where a neighbouring sample shows another
    part of the tube or none.
    """
    index = rays.index[window]
    height, width = index.shape
    y, x = np.nonzero(index >= 0)
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    offset = np.stack(np.meshgrid(steps, steps), -1)  # [row, column, (x, y)]
    light = np.zeros((height, fine, width, fine, 4), np.float32)
    part = np.zeros((height, fine, width, fine), np.uint8)
    light[y, :, x], part[y, :, x] = tube.shine(rays.at(index[y, x][:, None, None], offset))
    light, part = light.reshape(height * fine, width * fine, 4), part.reshape(height * fine, width * fine)
    neighbours = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    border = cv2.dilate(part, neighbours) != cv2.erode(part, neighbours)
    border &= np.repeat(np.repeat(index >= 0, fine, 0), fine, 1)
    y, x = np.nonzero(border)
    corner = np.stack([x % fine, y % fine], -1) / fine - 0.5
    # Samples count from the corner of the frame, so that the rays of a sample do not depend on the window.
    column, row = x + fine * window[1].start, y + fine * window[0].start
    first, second = _LATTICE_SHIFT
    shift = np.stack([column * first + row * second, column * second + row * first], -1)[:, None]
    offset = corner[:, None] + (_LATTICE + shift) % 1 / fine
    light[y, x] = tube.shine(rays.at(index[y // fine, x // fine][:, None], offset))[0].mean(1)
    return light
