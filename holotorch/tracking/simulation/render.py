"""Renders synthetic frames of a catheter with exact truth: camera rays, light, blur, tone curve and noise."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation.cast import Rays, Tube, cast, light_of, tube_of
from holotorch.tracking.simulation.exposure import sensed

Colour = tuple[int, int, int]
_FINE = 4  # samples along a pixel's side before the blur; a sample on an edge has 8 rays
_TILE = 96  # largest side in pixels of a tile; tiles are cast and blurred one at a time
_LARGEST = 8192  # largest side of a frame in pixels


@dataclass(frozen=True)
class Occluder:
    """Flat polygon in front of the catheter: corners (x, y) in pixels (drawn up to 0.2 larger) and sRGB colour."""

    corners: tuple[tuple[float, float], ...]
    colour: Colour

    def __post_init__(self) -> None:
        if len(self.corners) < 3:
            raise ValueError(f"an occluder needs at least 3 corners (x, y) in pixels, got {len(self.corners)}")
        if not all(len(corner) == 2 and all(abs(value) < 1e5 for value in corner) for corner in self.corners):
            raise ValueError(f"corners must be pairs (x, y) of finite pixels below 1e5, got {self.corners}")
        _colour("colour", self.colour)

    @staticmethod
    def capsule(start: tuple[float, float], end: tuple[float, float], radius: float, colour: Colour) -> "Occluder":
        """Line segment with round ends, such as a finger; ``start``, ``end`` and ``radius`` in pixels."""
        checks.positive("radius", radius, "pixels")
        along = math.atan2(end[1] - start[1], end[0] - start[0])
        angles = [along + math.pi * (0.5 + i / 16) for i in range(17)]
        first = [(start[0] + radius * math.cos(a), start[1] + radius * math.sin(a)) for a in angles]
        last = [(end[0] - radius * math.cos(a), end[1] - radius * math.sin(a)) for a in angles]
        return Occluder((*first, *last), colour)


@dataclass(frozen=True, eq=False)
class Look:
    """Appearance of a frame and its image errors; everything except the catheter's pose.

    Attributes:
        background: Image uint8 [3, H, W] of the scene without the catheter, already blurred by the lens, or one colour.
        gain: Factor on all light, as from the exposure.
        light: Direction towards the light in the camera's coordinates; its length does not matter. Its strength is such
            that a surface that faces the camera appears in its own colour, with a factor of at most four.
        ambient: Share of the light that comes equally from all directions, 0 to 1.
        ramp: Relative change of all light from the centre of the frame to its right and to its lower border.
        highlight: Brightness of the specular reflection of the tube; 1 is that of white paper.
        highlight_width: Standard deviation of the specular lobe in radians.
        tube: Colour of the tube outside the bands.
        opacity: Opacity of the tube outside the bands at normal incidence, 0 to 1; it is higher at oblique incidence.
        blur_px: Standard deviation of the lens's Gaussian point spread function in pixels.
        motion_px: Path (x, y) of catheter and occluders over the background during the exposure, in pixels, at constant
            speed. The true pose is that in the middle.
        noise_dn: Standard deviation of white Gaussian noise in 8-bit levels, added after the tone curve.
        video: Whether each 2 x 2 pixels share the chroma of one of them (4:2:0), as decoders of webcams give it.
        jpeg_quality: JPEG quality, 1 to 100, with smoothed chroma at half resolution (4:2:0); None for no compression.
        occluders: Polygons in front of the catheter, each in front of the previous ones; they are not shaded.

    Raises:
        TypeError, ValueError: Values outside these ranges.
    """

    background: Tensor | Colour = (120, 120, 120)
    gain: float = 1.0
    light: tuple[float, float, float] = (-0.4, -0.8, -0.6)
    ambient: float = 0.4
    ramp: tuple[float, float] = (0.0, 0.0)
    highlight: float = 0.2
    highlight_width: float = 0.15
    tube: Colour = (228, 228, 222)
    opacity: float = 0.35
    blur_px: float = 0.7
    motion_px: tuple[float, float] = (0.0, 0.0)
    noise_dn: float = 2.5
    video: bool = False
    jpeg_quality: int | None = None
    occluders: tuple[Occluder, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.background, Tensor):
            if self.background.dtype != torch.uint8 or self.background.ndim != 3 or self.background.shape[0] != 3:
                shape = list(self.background.shape)
                raise ValueError(f"background must be uint8 [3, H, W], got {self.background.dtype} {shape}")
        else:
            _colour("background", self.background)
        _colour("tube", self.tube)
        checks.positive("gain", self.gain)
        checks.positive("highlight_width", self.highlight_width, "radians")
        for name, most in (("ambient", 1), ("opacity", 1), ("highlight", 100), ("blur_px", 50), ("noise_dn", 255)):
            if not 0 <= checks.finite(name, getattr(self, name)) <= most:
                raise ValueError(f"{name} must be from 0 to {most}, got {getattr(self, name)!r}")
        for name, count, most in (("light", 3, math.inf), ("ramp", 2, 1), ("motion_px", 2, 200)):
            values = getattr(self, name)
            if len(values) != count or not sum(map(abs, values)) < most:
                raise ValueError(f"{name} must be {count} finite numbers, below {most} in all, got {values!r}")
        if not any(self.light):
            raise ValueError("light must point somewhere, got (0, 0, 0)")
        if self.jpeg_quality is not None and not 1 <= checks.whole("jpeg_quality", self.jpeg_quality, 1) <= 100:
            raise ValueError(f"jpeg_quality must be from 1 to 100 or None, got {self.jpeg_quality}")


def render(
    catheter: Catheter | None,
    camera: Camera,
    tip: Tensor | None,
    direction: Tensor | None,
    size: tuple[int, int],
    look: Look | None = None,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Render a synthetic RGB frame, uint8 [3, H, W], of a catheter at a pose, on the CPU.

    The rays of each pixel's samples are undistorted and intersected exactly with the cylinder, so that outline,
    curvature of rings and foreshortening are correct. Light adds up linearly. Motion, the lens's point spread, the
    sensor's square pixels, tone curve, noise, rounding and compression follow in this order. The covered share of a
    pixel is the share of its rays that hit the tube, of 128 rays on an edge.

    Args:
        catheter: Catheter; None for a scene without one, which ignores ``tip`` and ``direction``.
        camera: Camera with intrinsics for frames of ``size``.
        tip: [3] tip in metres, in the camera frame.
        direction: Unit vector [3] from the tip to the rear.
        size: (H, W) in pixels.
        look: Appearance and image errors; None for the defaults.
        generator: Random generator of the noise, on the CPU.

    Raises:
        TypeError, ValueError: Wrong shapes, NaN, ``direction`` is not a unit vector, or the tube is too close to the
            camera.
    """
    look = look or Look()
    levels = mean_levels(catheter, camera, (tip, direction), size, look)
    return torch.from_numpy(sensed(levels, look.noise_dn, look.video, look.jpeg_quality, generator))


def mean_levels(
    catheter: Catheter | None,
    camera: Camera,
    pose: tuple[Tensor | None, Tensor | None],
    size: tuple[int, int],
    look: Look,
) -> np.ndarray:
    """Levels float32 [3, H, W] of the frame that :func:`render` makes, before noise, rounding and compression.

    ``pose`` is (tip, direction). The other arguments and the errors are those of :func:`render`.
    """
    height, width = (checks.whole("size", side, 8) for side in size)
    if max(size) > _LARGEST:
        raise ValueError(f"size must be at most {_LARGEST} pixels along a side, got {size}")
    if isinstance(look.background, Tensor) and look.background.shape[1:] != (height, width):
        raise ValueError(f"background must be [3, {height}, {width}] as size says, got {list(look.background.shape)}")
    tube = None
    if catheter is not None:
        tube = tube_of(
            catheter,
            *pose,
            light=look.light,
            ambient=look.ambient,
            highlight=(look.highlight, look.highlight_width),
            colour=look.tube,
            opacity=look.opacity,
        )
    frame = _backdrop(look, camera, (height, width))
    if tube is not None or look.occluders:
        _draw(frame, look, camera, tube)
    return frame


def _backdrop(look: Look, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """Levels of the background, float32 [3, H, W], before rounding."""
    light = look.gain * camera.table().cpu()
    image = _image(look, size).numpy().reshape(-1, size[1])
    if not any(look.ramp):
        table = camera.levels(light).to(torch.float32).numpy()
        return cv2.LUT(image, table.reshape(1, 256)).reshape(3, *size)
    lit = cv2.LUT(image, light.numpy().reshape(1, 256)).reshape(3, *size) * _ramp(look, size)
    # Tone curve as a table of 65536 entries, a twentieth of a level apart where sRGB is steepest.
    table = camera.levels(torch.linspace(0, 1, 65536, dtype=torch.float64)).to(torch.float32).numpy()
    return table[(np.clip(lit, 0, 1) * 65535 + 0.5).astype(np.uint16)]


def _image(look: Look, size: tuple[int, int]) -> Tensor:
    if isinstance(look.background, Tensor):
        return look.background.detach().cpu().contiguous()
    return torch.tensor(look.background, dtype=torch.uint8)[:, None, None].expand(3, *size).contiguous()


def _ramp(look: Look, size: tuple[int, int]) -> np.ndarray:
    """Factor of ``look.ramp`` on the light, float32 [H, W]."""
    down, right = (np.linspace(-1, 1, side, dtype=np.float32) for side in size)
    return 1 + look.ramp[0] * right + look.ramp[1] * down[:, None]


def _draw(frame: np.ndarray, look: Look, camera: Camera, tube: Tube | None) -> None:
    """Draw tube and occluders into levels [3, H, W], in place, in tiles that cover the pixels they affect."""
    size = (frame.shape[1], frame.shape[2])
    pad = math.ceil(4 * look.blur_px + math.hypot(*look.motion_px) / 2) + 1
    mask = np.zeros([side + 2 * pad for side in size], np.uint8) if tube is None else tube.outline(camera, size, pad)
    rays = Rays.of(camera, mask, pad)
    for occluder in look.occluders:
        cv2.fillPoly(mask, [_corners(occluder, pad, 1)], 255, cv2.LINE_8, 4)
    # Pixels of the frame that the blur and motion of the masked pixels reach.
    touched = cv2.dilate(mask, np.ones((2 * pad + 1, 2 * pad + 1), np.uint8))[pad:-pad, pad:-pad]
    image, ramp = _image(look, size), _ramp(look, size) if any(look.ramp) else None
    for tile in _tiles(touched):
        y, x = tile
        window = slice(y.start, y.stop + 2 * pad), slice(x.start, x.stop + 2 * pad)
        fine = np.zeros([_FINE * (side.stop - side.start) for side in window] + [4], np.float32)
        if tube is not None and (rays.index[window] >= 0).any():
            fine = cast(tube, rays, window, _FINE)
        for occluder in look.occluders:
            _cover(fine, occluder, (x.start - pad, y.start - pad))
        if any(look.motion_px):
            fine = cv2.filter2D(fine, -1, _streak(look.motion_px), borderType=cv2.BORDER_CONSTANT)
        rows, columns = (_lens(look.blur_px, side.stop - side.start, pad) for side in tile)
        seen = np.tensordot(rows, fine, 1).transpose(1, 0, 2)  # [columns, h, 4]
        seen = np.tensordot(columns, seen, 1).transpose(2, 1, 0)  # [4, h, w]
        behind = camera.linear(image[:, y, x]).cpu().numpy()
        light = look.gain * (seen[:3] + (1 - seen[3]) * behind)
        if ramp is not None:
            light = light * ramp[tile]
        frame[:, y, x] = camera.levels(torch.from_numpy(light)).cpu().numpy()


def _tiles(touched: np.ndarray) -> Iterator[tuple[slice, slice]]:
    """Rectangles of at most _TILE pixels a side that cover all marked pixels."""
    for top in range(0, touched.shape[0], _TILE):
        band = touched[top : top + _TILE]
        for left in range(0, touched.shape[1], _TILE):
            x, y, width, height = cv2.boundingRect(band[:, left : left + _TILE])
            if width:
                yield slice(top + y, top + y + height), slice(left + x, left + x + width)


def _corners(occluder: Occluder, shift: float, scale: int) -> np.ndarray:
    """Corners in sixteenths of a sample for cv2, shifted by ``shift`` pixels; a pixel has ``scale`` samples a side."""
    return np.round(((np.asarray(occluder.corners) + shift + 0.5) * scale - 0.5) * 16).astype(np.int32)


def _cover(fine: np.ndarray, occluder: Occluder, origin: tuple[int, int]) -> None:
    """Draw an occluder over light and cover [h, w, 4] of a window with first pixel ``origin`` (x, y), in place."""
    corners = _corners(occluder, 0.0, _FINE) - 16 * _FINE * np.array(origin, np.int32)
    low, high = corners.min(0) // 16 - 1, corners.max(0) // 16 + 3
    part = fine[max(low[1], 0) : max(high[1], 0), max(low[0], 0) : max(high[0], 0)]
    if part.size:
        over = np.zeros(part.shape[:2], np.uint8)
        cv2.fillPoly(over, [corners - 16 * np.maximum(low, 0)], 255, cv2.LINE_AA, 4)
        light, rim = np.array([*light_of(occluder.colour), 1], np.float32), (over > 0) & (over < 255)
        cover = over[rim][:, None] / np.float32(255)
        part[over == 255] = light
        part[rim] = (1 - cover) * part[rim] + cover * light


def _streak(motion: tuple[float, float]) -> np.ndarray:
    """Centred kernel, of sum 1, of a straight path at constant speed; ``motion`` in pixels, kernel in fine samples."""
    side = math.ceil(_FINE * max(map(abs, motion)) / 2) + 1
    kernel = np.zeros((2 * side + 1, 2 * side + 1), np.float32)
    steps = 8 * side
    for share in (np.arange(steps) + 0.5) / steps - 0.5:
        x, y = (side + _FINE * share * step for step in motion)
        column, row = math.floor(x), math.floor(y)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            kernel[row + down, column + right] += (1 - abs(x - column - right)) * (1 - abs(y - row - down)) / steps
    return kernel


@lru_cache(maxsize=256)
def _lens(blur_px: float, count: int, pad: int) -> np.ndarray:
    """Matrix float32 [count, (count + 2 pad) _FINE] of point spread and square pixels along one axis; rows sum to 1."""
    half = _FINE * pad
    spread = np.exp(-0.5 * (np.arange(-half, half + 1) / (_FINE * max(blur_px, 1e-6))) ** 2)
    kernel = np.convolve(spread / spread.sum(), np.full(_FINE, 1 / _FINE))  # 2 half + _FINE values
    rows = np.zeros((count, (count + 2 * pad) * _FINE), np.float32)
    for row in range(count):
        rows[row, row * _FINE : row * _FINE + len(kernel)] = kernel
    return rows


def _colour(name: str, value: tuple[int, ...]) -> None:
    if len(value) != 3 or not all(isinstance(one, int) and 0 <= one <= 255 for one in value):
        raise ValueError(f"{name} must be three 8-bit levels (red, green, blue), got {value!r}")
