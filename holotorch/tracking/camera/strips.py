"""Straight lines on the plane z = 1 and samples of a frame along their images, which the lens distortion curves."""

import cmath
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.camera.numpy_lens import Lens, Points


@dataclass(frozen=True)
class Line:
    """A line on the plane z = 1, with coordinates t along it and u across it, in pixels at the principal point.

    Points and vectors of the plane are complex numbers x + i y.

    Attributes:
        origin: Point at t = u = 0.
        along: Unit vector along the line.
        scale: Pixels at the principal point per unit of the plane z = 1.
    """

    origin: complex
    along: complex
    scale: float

    def plane(self, t: np.ndarray | float, u: np.ndarray | float = 0.0) -> Points:
        """Points on the plane z = 1 at coordinates t and u, which broadcast against each other."""
        return self.origin + (t + 1j * np.asarray(u)) * (self.along / self.scale)

    def pixels(self, lens: Lens, t: np.ndarray, u: np.ndarray) -> Points:
        """Pixels [T, U] at coordinates t [T] and u [U], by quadratic interpolation across the line, which is fast.

        Its error is proportional to the third power of the largest u: 0.001 pixels for u = 30, k1 = -0.12 and a focal
        length of 1400 pixels.
        """
        half_width, step = max(1.0, float(np.abs(u).max())), self.along / self.scale
        half = u / (2 * half_width)
        square = 2 * half * half
        lagrange = np.array([square - half, 1 - 2 * square, square + half])
        side = 1j * half_width * step
        nodes = np.array([self.origin - side, self.origin, self.origin + side])
        return lens.distort(t[:, None] * step + nodes) @ lagrange

    def place(self, plane: Points) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates t and u of points on the plane z = 1."""
        offset = (plane - self.origin) * (self.along.conjugate() * self.scale)
        return offset.real, offset.imag

    def along_at(self, plane: complex) -> float:
        """Coordinate t of one point on the plane z = 1."""
        return ((plane - self.origin) * self.along.conjugate()).real * self.scale

    def moved(self, offset: float, slope: float) -> "Line":
        """The line u = offset + slope t in the coordinates of this line, with its origin at t = 0."""
        along = self.along * complex(1.0, slope)
        return Line(complex(self.plane(0.0, offset)), along / abs(along), self.scale)

    @staticmethod
    def between(lens: Lens, start: complex, end: complex) -> "Line":
        """The line from one point of the plane z = 1 to another, with its origin halfway; NaN if both are equal."""
        gap = complex(end) - complex(start)
        return Line((complex(start) + complex(end)) / 2, gap / abs(gap) if gap else complex(cmath.nan), lens.scale)


_REMAP_LIMIT = 32767  # pixels: OpenCV's remap accepts only images and maps with fewer rows and columns than this


class Sampler:
    """Samples of a frame at fractional pixels x + i y, as 8-bit levels or as light.

    Args:
        frame: uint8 [3, H, W], RGB, on any device and with any strides; H and W are 4 or more.
        light: float32 [256] light of each level.
    """

    def __init__(self, frame: Tensor, light: np.ndarray):
        self.frame, self.light = frame, light
        self.height, self.width = frame.shape[-2:]
        # A flat view of the frame's memory is the fastest to index, for frames of any strides.
        strides = _, self._down, self._right = frame.stride()
        extent = sum((n - 1) * step for n, step in zip(frame.shape, strides, strict=True))
        self._memory = frame.as_strided((extent + 1,), (1,))
        self._host = self._memory.numpy() if frame.device.type == "cpu" else None
        self._colours, self._four, self._sixteen = _neighbours(*strides)
        # OpenCV's remap is ten times as fast, but needs interleaved colours in memory, as cameras provide them.
        fits = self._host is not None and strides[::2] == (1, 3) and max(self.height, self.width) < _REMAP_LIMIT
        self._image = frame.numpy().transpose(1, 2, 0) if fits else None
        self._last = np.array([[self.width - 1.0], [self.height - 1.0]])  # (x, y) of the last pixel
        self._before_last = self._last.astype(np.intp) - 1

    def inside(self, pixels: Points) -> np.ndarray:
        """Whether pixels x + i y lie between the centres of the border pixels of the frame; False for NaN."""
        x, y = pixels.real, pixels.imag
        return (x >= 0) & (y >= 0) & (x <= self.width - 1) & (y <= self.height - 1)

    def patch(self, x: int, y: int, side: int) -> np.ndarray:
        """Levels, uint8 [3, side, side], of the square with first pixel (x, y), which must lie within the frame."""
        if self._image is not None:
            return self._image[y : y + side, x : x + side].transpose(2, 0, 1)
        return self.frame[:, y : y + side, x : x + side].cpu().numpy()

    def _clipped(self, pixels: Points) -> np.ndarray:
        """Coordinates (x, y) [2, n] of pixels, clipped to the frame."""
        xy = np.empty((2, pixels.size))
        xy[0], xy[1] = pixels.real.ravel(), pixels.imag.ravel()
        return np.fmin(np.fmax(xy, 0.0, out=xy), self._last, out=xy)

    def _light(self, neighbours: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Light [..., n] of pixels at offsets ``neighbours`` [...] in memory from pixels ``whole`` (x, y) [2, n]."""
        index = np.add.outer(neighbours, whole[1] * self._down + whole[0] * self._right)
        return cv2.LUT(self._levels(index).reshape(neighbours.size, -1), self.light).reshape(index.shape)

    def _levels(self, index: np.ndarray) -> np.ndarray:
        """Levels at indices of the memory, of any shape."""
        if self._host is not None:
            return self._host.take(index)
        where = torch.from_numpy(index.ravel()).to(self._memory.device)
        return self._memory.index_select(0, where).cpu().numpy().reshape(index.shape)

    def nearest(self, pixels: Points) -> np.ndarray:
        """Levels, uint8 [T, U, 3], of the pixels nearest to x + i y [T, U]; black outside the frame."""
        if self._image is not None:
            # OpenCV distributes rows over threads, whose start takes too long. A map of one row avoids them.
            wide = pixels.size if pixels.size < _REMAP_LIMIT else pixels.shape[-1]
            positions = pixels.astype(np.complex64).view(np.float32).reshape(-1, wide, 2)
            levels = cv2.remap(self._image, positions, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
            return levels.reshape(*pixels.shape, 3)
        x, y = np.rint(pixels.real), np.rint(pixels.imag)
        inside = (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)
        index = np.where(inside, y * self._down + x * self._right, 0).astype(np.intp)
        return self._levels(index[..., None] + self._colours) * inside[..., None]

    def __call__(self, pixels: Points) -> np.ndarray:
        """Light, float32 [3, ...], at pixels [...] by bilinear interpolation; outside the frame, that of the border."""
        xy = self._clipped(pixels)
        whole = np.minimum(xy.astype(np.intp), self._before_last)
        fraction = (xy - whole).astype(np.float32)
        light = self._light(self._four, whole)  # [3, 4, n]
        rows = light[:, ::2] + fraction[0] * (light[:, 1::2] - light[:, ::2])
        return (rows[:, 0] + fraction[1] * (rows[:, 1] - rows[:, 0])).reshape(3, *pixels.shape)

    def sharp(self, pixels: np.ndarray) -> np.ndarray:
        """As a call, but by cubic convolution (Keys 1981), which preserves fine detail better."""
        xy = self._clipped(pixels)
        whole = xy.astype(np.intp)
        np.minimum(np.maximum(whole, 1, out=whole), self._before_last - 1, out=whole)
        weights = _cubic_weights((xy - whole).astype(np.float32))  # [4, 2, n]
        light = self._light(self._sixteen, whole)  # [3, 4, 4, n]
        light *= weights[:, 0]
        rows = light.sum(2)
        rows *= weights[:, 1]
        return rows.sum(1).reshape(3, *pixels.shape)


@lru_cache(maxsize=16)
def _neighbours(colour: int, down: int, right: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets in memory from a pixel's red level to the levels of 1 [3], 2 x 2 [3, 4] and 4 x 4 pixels [3, 4, 4]."""
    colours, lines = colour * np.arange(3), np.arange(-1, 3)
    four = np.add.outer(colours, [0, right, down, down + right])
    return colours, four, np.add.outer(colours, np.add.outer(lines * down, lines * right))


def _cubic_weights(position: np.ndarray) -> np.ndarray:
    """Weights [4, ...] of the samples at -1, 0, 1 and 2 for a position from 0 to 1; Keys (1981), Eq. 4."""
    square = position * position
    cube = square * position
    weights = np.empty((4, *position.shape), dtype=position.dtype)
    weights[0], weights[3] = square - (cube + position) / 2, (cube - square) / 2
    weights[2] = (4 * square - 3 * cube + position) / 2
    np.subtract(1, weights[0] + weights[2] + weights[3], out=weights[1])
    return weights
