"""Strips of a frame along a line of space's image: straight there, curved on the frame as the lens curves it."""

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
    """A line on the plane z = 1, with coordinates t along it and u across, in units of a pixel at the principal point.

    Points of the plane are complex numbers x + i y. Coordinates of the line form complex numbers t + i u.

    Attributes:
        origin: Point of the plane at t = u = 0.
        along: Unit vector along the line.
        scale: Pixels per unit of the plane.
    """

    origin: complex
    along: complex
    scale: float

    def plane(self, t: np.ndarray | float, u: np.ndarray | float = 0.0) -> Points:
        """Points on the plane z = 1 at coordinates (t, u), which broadcast."""
        return self.origin + (t + 1j * np.asarray(u)) * (self.along / self.scale)

    def pixels(self, lens: Lens, t: np.ndarray, u: np.ndarray) -> Points:
        """Pixels [T, U] at coordinates t [T], u [U], for u of up to some tens of pixels.

        Three parallel lines are distorted exactly, and parabolas across interpolate between them. The error rises with
        the third power of u: 0.001 pixels at u = 30, for a lens with k1 = -0.12 and a focal length of 1400 pixels.
        """
        half_width, step = max(1.0, float(np.abs(u).max())), self.along / self.scale
        half = u / (2 * half_width)
        square = 2 * half * half
        weight = np.array([square - half, 1 - 2 * square, square + half])
        side = 1j * half_width * step
        three = np.array([self.origin - side, self.origin, self.origin + side])
        return lens.distort(t[:, None] * step + three) @ weight

    def place(self, plane: Points) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates t and u of points on the plane z = 1."""
        offset = (plane - self.origin) * (self.along.conjugate() * self.scale)
        return offset.real, offset.imag

    def along_at(self, plane: complex) -> float:
        """Coordinate t of one point on the plane z = 1."""
        return ((plane - self.origin) * self.along.conjugate()).real * self.scale

    def moved(self, offset: float, slope: float) -> "Line":
        """The line u = offset + slope t of this line's coordinates, with its origin at t = 0."""
        turned = self.along * complex(1.0, slope)
        return Line(complex(self.plane(0.0, offset)), turned / abs(turned), self.scale)

    @staticmethod
    def between(lens: Lens, start: complex, end: complex) -> "Line":
        """The line from one point of the plane z = 1 to another, with its origin in the middle; NaN for NaN."""
        gap = complex(end) - complex(start)
        return Line((complex(start) + complex(end)) / 2, gap / abs(gap) if gap else complex(cmath.nan), lens.scale)


_LONGEST = 32767  # pixels: OpenCV's remap accepts only shorter rows of images and maps


class Sampler:
    """Samples one frame at fractional pixels, as levels or as light.

    Args:
        frame: uint8 [3, H, W], RGB, on any device and with any strides; H and W are 4 or more.
        light: float32 [256] light of each level.
    """

    def __init__(self, frame: Tensor, light: np.ndarray):
        self.frame, self.light = frame, light
        self.height, self.width = frame.shape[-2:]
        # A flat view of the memory of the frame in any layout, which is the fastest to index.
        strides = colour, self._down, self._right = frame.stride()
        extent = sum((n - 1) * step for n, step in zip(frame.shape, strides, strict=True))
        self._memory = frame.as_strided((extent + 1,), (1,))
        self._host = self._memory.numpy() if frame.device.type == "cpu" else None
        self._colours, self._taps, self._around = _neighbours(*strides)
        # OpenCV is ten times as fast, but needs the interleaved memory layout of cameras.
        like = self._host is not None and strides[::2] == (1, 3) and max(self.height, self.width) < _LONGEST
        self._image = frame.numpy().transpose(1, 2, 0) if like else None
        self._last, self._before = _borders(self.width, self.height)

    def inside(self, pixels: Points) -> np.ndarray:
        """Whether pixels x + i y lie on the frame; NaN does not."""
        x, y = pixels.real, pixels.imag
        return (x >= 0) & (y >= 0) & (x <= self.width - 1) & (y <= self.height - 1)

    def patch(self, x: int, y: int, side: int) -> np.ndarray:
        """Levels uint8 [3, side, side] of the pixels from (x, y) on, which lie on the frame."""
        if self._image is not None:
            return self._image[y : y + side, x : x + side].transpose(2, 0, 1)
        return self.frame[:, y : y + side, x : x + side].cpu().numpy()

    def _clipped(self, pixels: Points) -> np.ndarray:
        """Real and imaginary parts [2, n] of pixels, clipped to the frame."""
        place = np.empty((2, pixels.size))
        place[0], place[1] = pixels.real.ravel(), pixels.imag.ravel()
        return np.fmin(np.fmax(place, 0.0, out=place), self._last, out=place)

    def _index(self, taps: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Indices [..., n] in memory of neighbours ``taps`` [...] of pixels [2, n]."""
        return np.add.outer(taps, whole[1] * self._down + whole[0] * self._right)

    def _levels(self, index: np.ndarray) -> np.ndarray:
        if self._host is not None:
            return self._host.take(index)
        where = torch.from_numpy(index.ravel()).to(self._memory.device)
        return self._memory.index_select(0, where).cpu().numpy().reshape(index.shape)

    def nearest(self, pixels: Points) -> np.ndarray:
        """Levels uint8 [T, U, 3] of the pixels nearest to x + i y [T, U]; black outside the frame."""
        if self._image is not None:
            # As a single row, since OpenCV distributes rows over threads, whose start takes longer than the work.
            wide = pixels.size if pixels.size < _LONGEST else pixels.shape[-1]
            positions = pixels.astype(np.complex64).view(np.float32).reshape(-1, wide, 2)
            levels = cv2.remap(self._image, positions, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
            return levels.reshape(*pixels.shape, 3)
        x, y = np.rint(pixels.real), np.rint(pixels.imag)
        inside = (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)
        index = np.where(inside, y * self._down + x * self._right, 0).astype(np.intp)
        return self._levels(index[..., None] + self._colours) * inside[..., None]

    def __call__(self, pixels: Points) -> np.ndarray:
        """Light float32 [3, ...] at pixels x + i y by bilinear interpolation; outside the frame that of its border.

        Only the four neighbours of each pixel are converted to light, before they are interpolated.
        """
        place = self._clipped(pixels)
        whole = np.minimum(place.astype(np.intp), self._before)
        share = (place - whole).astype(np.float32)
        index = self._index(self._taps, whole)  # [3, 4, n]
        light = cv2.LUT(self._levels(index).reshape(12, -1), self.light).reshape(index.shape)
        mixed = light[:, ::2] + share[0] * (light[:, 1::2] - light[:, ::2])
        return (mixed[:, 0] + share[1] * (mixed[:, 1] - mixed[:, 0])).reshape(3, *pixels.shape)

    def sharp(self, pixels: np.ndarray) -> np.ndarray:
        """As a call, but by cubic convolution (Keys 1981), which preserves fine detail better."""
        place = self._clipped(pixels)
        whole = place.astype(np.intp)
        np.minimum(np.maximum(whole, 1, out=whole), self._before - 1, out=whole)
        weights = _keys((place - whole).astype(np.float32))  # [4, 2, n]
        index = self._index(self._around, whole)  # [3, 4, 4, n]
        light = cv2.LUT(self._levels(index).reshape(48, -1), self.light).reshape(index.shape)
        light *= weights[:, 0]
        rows = light.sum(2)
        rows *= weights[:, 1]
        return rows.sum(1).reshape(3, *pixels.shape)


@lru_cache(maxsize=16)
def _borders(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (x, y) [2, 1] of the last pixel of a frame, and of the pixel before it in both directions."""
    last = np.array([[width - 1.0], [height - 1.0]])
    return last, last.astype(np.intp) - 1


@lru_cache(maxsize=16)
def _neighbours(colour: int, down: int, right: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets in memory from the first colour of a pixel: its colours [3], 4 neighbours [3, 4] and 16 [3, 4, 4]."""
    colours, lines = colour * np.arange(3), np.arange(-1, 3)
    four = np.add.outer(colours, [0, right, down, down + right])
    return colours, four, np.add.outer(colours, np.add.outer(lines * down, lines * right))


def _keys(share: np.ndarray) -> np.ndarray:
    """Weights [4, ...] of the samples at -1, 0, 1 and 2 for the position ``share``, 0 to 1; Keys (1981), Eq. 4."""
    square = share * share
    cube = square * share
    weights = np.empty((4, *share.shape), dtype=share.dtype)
    weights[0], weights[3] = square - (cube + share) / 2, (cube - square) / 2
    weights[2] = (4 * square - 3 * cube + share) / 2
    np.subtract(1, weights[0] + weights[2] + weights[3], out=weights[1])
    return weights
