"""Rendering of synthetic frames of a catheter at a known pose: rays, light, blur, tone curve and noise."""

import math
from collections.abc import Iterator
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation.cast import Rays, Tube, cast, light_of
from holotorch.tracking.simulation.exposure import sensed
from holotorch.tracking.simulation.look import Look, Occluder

_FINE = 4  # samples along the side of a pixel before the blur
_TILE = 96  # largest side in pixels of a tile; tiles are cast and blurred one at a time


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

    Undistorted rays are intersected exactly with the cylinder: 16 rays for each pixel, up to 128 at edges. Their light
    is averaged. Motion blur, the lens's point spread, the sensor's square pixels, tone curve, noise, rounding and
    compression follow in this order.

    Args:
        catheter: Catheter; None for a scene without a catheter, for which ``tip`` and ``direction`` are ignored.
        camera: Camera with intrinsics for frames of ``size``.
        tip: [3] tip in metres, in the camera frame.
        direction: Unit vector [3] from the tip to the rear.
        size: (H, W) in pixels, 8 to 8192.
        look: Appearance and image errors; None for the defaults.
        generator: Random generator of the noise, on the CPU.

    Raises:
        TypeError, ValueError: Wrong shapes, NaN, no unit vector, or a tube within 10 radii of the camera.
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
    """Levels, float32 [3, H, W], of the frame by :func:`render` before noise, rounding and compression.

    ``pose`` is (tip, direction). The other arguments and the exceptions are those of :func:`render`.
    """
    height, width = (checks.whole("size", side, 8) for side in size)
    if max(size) > 8192:
        raise ValueError(f"size must be at most 8192 pixels along a side, got {size}")
    if isinstance(look.background, Tensor) and look.background.shape[1:] != (height, width):
        raise ValueError(f"background must be [3, {height}, {width}] as size says, got {list(look.background.shape)}")
    tube = None if catheter is None else Tube(catheter, *pose, look)
    frame = _background_levels(look, camera, (height, width))
    if tube is not None or look.occluders:
        _draw(frame, look, camera, tube)
    return frame


def _background_levels(look: Look, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """Levels, float32 [3, H, W], of the frame without catheter and occluders, before rounding."""
    light = look.gain * camera.table().cpu()
    image = _background(look, size).numpy().reshape(-1, size[1])
    if not any(look.ramp):
        table = camera.levels(light).to(torch.float32).numpy()
        return cv2.LUT(image, table.reshape(1, 256)).reshape(3, *size)
    lit = cv2.LUT(image, light.numpy().reshape(1, 256)).reshape(3, *size) * _ramp(look, size)
    # Tone curve as a table of 65536 entries, which differ by 0.05 levels where sRGB is steepest.
    table = camera.levels(torch.linspace(0, 1, 65536, dtype=torch.float64)).to(torch.float32).numpy()
    return table[(np.clip(lit, 0, 1) * 65535 + 0.5).astype(np.uint16)]


def _background(look: Look, size: tuple[int, int]) -> Tensor:
    """The background as an image uint8 [3, H, W]."""
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
    rays = Rays(camera, mask, pad)
    for occluder in look.occluders:
        cv2.fillPoly(mask, [_corners(occluder, pad, 1)], 255, cv2.LINE_8, 4)
    # Pixels of the frame into which blur and motion spread the light of the masked pixels.
    affected = cv2.dilate(mask, np.ones((2 * pad + 1, 2 * pad + 1), np.uint8))[pad:-pad, pad:-pad]
    image, ramp = _background(look, size), _ramp(look, size) if any(look.ramp) else None
    for tile in _tiles(affected):
        y, x = tile
        window = slice(y.start, y.stop + 2 * pad), slice(x.start, x.stop + 2 * pad)
        fine = np.zeros([_FINE * (side.stop - side.start) for side in window] + [4], np.float32)
        if tube is not None and (rays.index[window] >= 0).any():
            fine = cast(tube, rays, window, _FINE)
        for occluder in look.occluders:
            _draw_occluder(fine, occluder, (x.start - pad, y.start - pad))
        if any(look.motion_px):
            fine = cv2.filter2D(fine, -1, _motion_kernel(look.motion_px), borderType=cv2.BORDER_CONSTANT)
        rows, columns = (_blur_matrix(look.blur_px, side.stop - side.start, pad) for side in tile)
        blurred = np.tensordot(rows, fine, 1).transpose(1, 0, 2)  # [columns, h, 4]
        blurred = np.tensordot(columns, blurred, 1).transpose(2, 1, 0)  # [4, h, w]
        behind = camera.linear(image[:, y, x]).cpu().numpy()
        light = look.gain * (blurred[:3] + (1 - blurred[3]) * behind)
        if ramp is not None:
            light = light * ramp[tile]
        frame[:, y, x] = camera.levels(torch.from_numpy(light)).cpu().numpy()


def _tiles(mask: np.ndarray) -> Iterator[tuple[slice, slice]]:
    """Rectangles (y, x) of at most _TILE pixels a side that contain all pixels where ``mask`` is not 0."""
    for top in range(0, mask.shape[0], _TILE):
        for left in range(0, mask.shape[1], _TILE):
            x, y, width, height = cv2.boundingRect(mask[top : top + _TILE, left : left + _TILE])
            if width:
                yield slice(top + y, top + y + height), slice(left + x, left + x + width)


def _corners(occluder: Occluder, shift: float, scale: int) -> np.ndarray:
    """Corners for cv2 in sixteenths of a sample, shifted by ``shift`` pixels; a pixel is ``scale`` samples wide."""
    return np.round(((np.asarray(occluder.corners) + shift + 0.5) * scale - 0.5) * 16).astype(np.int32)


def _draw_occluder(fine: np.ndarray, occluder: Occluder, origin: tuple[int, int]) -> None:
    """Draw an occluder over light and opacity [h, w, 4] of a window with first pixel ``origin`` (x, y), in place."""
    corners = _corners(occluder, 0.0, _FINE) - 16 * _FINE * np.array(origin, np.int32)
    low, high = corners.min(0) // 16 - 1, corners.max(0) // 16 + 3
    part = fine[max(low[1], 0) : max(high[1], 0), max(low[0], 0) : max(high[0], 0)]
    if part.size:
        mask = np.zeros(part.shape[:2], np.uint8)
        cv2.fillPoly(mask, [corners - 16 * np.maximum(low, 0)], 255, cv2.LINE_AA, 4)
        light, border = np.array([*light_of(occluder.colour), 1], np.float32), (mask > 0) & (mask < 255)
        opacity = mask[border][:, None] / np.float32(255)
        part[mask == 255] = light
        part[border] = (1 - opacity) * part[border] + opacity * light


def _motion_kernel(motion: tuple[float, float]) -> np.ndarray:
    """Centred kernel of sum 1, over samples, of a straight path (x, y) in pixels at constant speed."""
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
def _blur_matrix(blur_px: float, count: int, pad: int) -> np.ndarray:
    """Matrix, float32 [count, (count + 2 pad) _FINE], from samples to pixels by point spread and pixel integration."""
    half = _FINE * pad
    spread = np.exp(-0.5 * (np.arange(-half, half + 1) / (_FINE * max(blur_px, 1e-6))) ** 2)
    kernel = np.convolve(spread / spread.sum(), np.full(_FINE, 1 / _FINE))  # 2 half + _FINE values
    rows = np.zeros((count, (count + 2 * pad) * _FINE), np.float32)
    for row in range(count):
        rows[row, row * _FINE : row * _FINE + len(kernel)] = kernel
    return rows
