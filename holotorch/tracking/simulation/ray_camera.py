"""A second renderer of a catheter: each pixel is the mean of rays through the lens during the exposure.

:mod:`~holotorch.tracking.simulation.render` draws the catheter on a finer grid and filters it. Here every pixel traces
rays that are drawn from its square, the point spread function and the exposure, so that blur, defocus, motion and a
rolling shutter need no kernels. The two share no code, and neither uses the model of a tracker.
"""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from scipy.special import ndtr
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter

_SAMPLES = 256  # rays of a pixel near the bands: the standard deviation of their levels is then 0.6
_FEW = 32  # rays of a pixel near the rest of the catheter
_BESIDE = 0.015  # metres beyond the bands with many rays
_CHUNK = 4096  # pixels that share well-spread points
_BLOCK = 1 << 15  # rays traced at a time: with all that follows from them, they fit into the cache


@dataclass(frozen=True)
class Light:
    """Directional light: unit vector towards it in the camera's coordinates, and linear RGB."""

    direction: tuple[float, float, float]
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class Rod:
    """A flat shape with round ends and the shading of a cylinder, such as a finger, an instrument or a cable.

    Attributes:
        start, end: Ends (x, y) of its axis in pixels.
        radius: In pixels.
        colour: Linear RGB reflectance.
        gloss: Brightness of a highlight along its axis.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    radius: float
    colour: tuple[float, float, float]
    gloss: float = 0.0

    def paint(self, x: np.ndarray, y: np.ndarray, softness: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Cover [...], 0 or 1 or with a Gaussian edge of ``softness`` pixels, and light [..., 3], at pixels x, y."""
        along = np.subtract(self.end, self.start)
        long = max(float(np.hypot(*along)), 1e-6)
        ux, uy = along / long
        dx, dy = x - self.start[0], y - self.start[1]
        place = np.clip(dx * ux + dy * uy, 0, long)
        distance = np.hypot(dx - place * ux, dy - place * uy)
        share = np.clip(distance / self.radius, 0, 1)
        slope = np.sqrt(1 - share**2)  # cosine between the surface's normal and the line of sight
        light = (0.35 + 0.65 * slope)[..., None] * np.asarray(self.colour, np.float32)
        light = light + self.gloss * np.exp(-0.5 * ((share - 0.25) / 0.08) ** 2)[..., None]
        if softness is None:
            return distance < self.radius, light
        depth = (self.radius - distance) / (math.sqrt(2) * softness)
        return 0.5 + 0.5 * torch.erf(torch.from_numpy(np.asarray(depth))).numpy(), light


@dataclass(frozen=True, eq=False)
class Shot:
    """Everything that one frame depends on. Light and reflectance are linear; lengths are in metres unless named px.

    Attributes:
        camera: Intrinsics and tone curve.
        background: float32 [H, W, 3], light of the scene without catheter.
        catheter: The tool in the frame, or None.
        tip, direction: float64 [3]: tip and unit vector to the rear, in the middle of the exposure of the row in which
            the middle of the bands is imaged.
        lights: Directional lights on the catheter.
        ambient: Linear RGB of the light from all sides.
        gloss: Brightness of the highlights on the catheter.
        sharpness: Exponent of the highlights (Blinn and Phong).
        clear: Reflectance of the tube outside its bands.
        opacity: Share of the background that the clear tube hides at normal incidence.
        tints: [N, 3] factors on the reflectance of each band: ink and white balance.
        stain: (start, end, angle, width): a stain of blood from ``start`` to ``end`` along the axis, ``width`` radians
            wide around ``angle``; None for none.
        before: Objects in front of the catheter, each in front of the previous one.
        blur_px: Standard deviation of the lens's Gaussian spread.
        disc_px: Radius of the disc of a defocused lens.
        motion: Displacement [3] of the catheter during the exposure of a row, at constant speed.
        rolling: Displacement [3] of the catheter between the exposures of the first and the last row (rolling shutter).
        gain: Factors [3] on all light: exposure and white balance.
        shot_noise, read_noise: The noise's variance in linear light is shot_noise * light + read_noise^2.
        video: Whether chroma is averaged over 2 x 2 pixels and interpolated between them (4:2:0).
        jpeg: JPEG quality, or None.
    """

    camera: Camera
    background: np.ndarray
    catheter: Catheter | None = None
    tip: np.ndarray | None = None
    direction: np.ndarray | None = None
    lights: tuple[Light, ...] = (Light((-0.3, -0.6, -0.74), (0.7, 0.7, 0.7)),)
    ambient: tuple[float, float, float] = (0.35, 0.35, 0.35)
    gloss: float = 0.15
    sharpness: float = 40.0
    clear: tuple[float, float, float] = (0.75, 0.75, 0.7)
    opacity: float = 0.3
    tints: np.ndarray = field(default_factory=lambda: np.ones((1, 3)))
    stain: tuple[float, float, float, float] | None = None
    before: tuple[Rod, ...] = ()
    blur_px: float = 0.7
    disc_px: float = 0.0
    motion: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rolling: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    shot_noise: float = 2e-4
    read_noise: float = 3e-3
    video: bool = False
    jpeg: int | None = None


def take(shot: Shot, seed: int) -> Tensor:
    """Frame uint8 [3, H, W] of a shot; ``seed`` determines the noise and the rays."""
    rng = np.random.default_rng([seed, 1])
    light = _spread(shot.background, shot)
    if shot.catheter is not None:
        _trace(light, shot, rng)
    _cover_rest(light, shot)
    light *= np.asarray(shot.gain, np.float32)
    light += rng.standard_normal(light.shape, dtype=np.float32) * np.sqrt(
        np.maximum(light, 0) * shot.shot_noise + shot.read_noise**2
    )
    levels = shot.camera.levels(torch.from_numpy(light)).numpy()
    frame = np.clip(levels + 0.5, 0, 255).astype(np.uint8)
    if shot.video:
        frame = _half_chroma(frame)
    if shot.jpeg is not None:
        _, data = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, shot.jpeg])
        frame = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1]
    return torch.from_numpy(np.ascontiguousarray(frame.transpose(2, 0, 1)))


def insert(shot: Shot, seed: int) -> Tensor:
    """The background as it is, uint8 [3, H, W], with the catheter rendered into it.

    For a background that is a photograph: it has the lens's blur and the noise already, and only the pixels of the
    catheter get them. Gain and codecs of the shot are not applied.
    """
    rng = np.random.default_rng([seed, 1])
    light = shot.background.astype(np.float32, copy=True)
    _trace(light, shot, rng)
    changed = (light != shot.background).any(-1, keepdims=True)
    noise = rng.standard_normal(light.shape, dtype=np.float32)
    light += changed * noise * np.sqrt(np.maximum(light, 0) * shot.shot_noise + shot.read_noise**2)
    levels = shot.camera.levels(torch.from_numpy(light)).numpy()
    return torch.from_numpy(np.clip(levels + 0.5, 0, 255).astype(np.uint8).transpose(2, 0, 1).copy())


def _spread(light: np.ndarray, shot: Shot) -> np.ndarray:
    """The background through the lens."""
    blurred = cv2.GaussianBlur(light, (0, 0), max(shot.blur_px, 0.3))
    if shot.disc_px > 0.5:
        side = math.ceil(shot.disc_px)
        down, right = np.mgrid[-side : side + 1, -side : side + 1]
        disc = np.clip(shot.disc_px + 0.5 - np.hypot(down, right), 0, 1).astype(np.float32)
        blurred = cv2.filter2D(blurred, -1, disc / disc.sum())
    return blurred


@dataclass(frozen=True, eq=False)
class _Lens:
    """The spread of light over a pixel and the lens's Gaussian: ``share`` of the light up to ``offset``, in pixels."""

    share: np.ndarray
    offset: np.ndarray

    @classmethod
    def of(cls, blur_px: float) -> "_Lens":
        offset = np.linspace(-6 * blur_px - 0.5, 6 * blur_px + 0.5, 4001)
        spread = ndtr((offset + 0.5) / blur_px) - ndtr((offset - 0.5) / blur_px)
        return cls(np.cumsum(spread) - spread / 2, offset)


def _points(rng: np.random.Generator, count: int, samples: int, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """Well-spread points [D, S] in 0 to 1, which all pixels use, and the shift of each of ``count`` pixels, [D, n, 1].

    Points in fewer dimensions are spread more evenly: the sum of pixel square and lens Gaussian is one variable; disc
    and time are drawn only if present.
    """
    dimensions = 2 + 2 * (shot.disc_px > 0) + any(shot.motion)
    engine = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=int(rng.integers(2**31)))
    points = engine.draw(samples, dtype=torch.float64).numpy()
    return points.T, np.moveaxis(rng.random((count, 1, dimensions)), -1, 0)


def _offsets(points: np.ndarray, shifts: np.ndarray, lens: _Lens, shot: Shot) -> tuple[np.ndarray, ...]:
    """Rays of n pixels: x and y in pixels from the pixel's centre, and time -0.5 to 0.5, each [n, S]."""
    points = points[:, None] + shifts
    points -= points >= 1
    beside, below = (np.interp(each * lens.share[-1], lens.share, lens.offset) for each in points[:2])
    if shot.disc_px > 0:
        radius, angle = shot.disc_px * np.sqrt(points[2]), 2 * math.pi * points[3]
        beside += radius * np.cos(angle)
        below += radius * np.sin(angle)
    return beside, below, points[-1] - 0.5 if any(shot.motion) else np.zeros_like(beside)


def _near(shot: Shot, size: tuple[int, int], start: float, end: float) -> np.ndarray:
    """Mask uint8 [H, W] of the pixels that the catheter may cover from ``start`` to ``end``, in metres from the tip."""
    assert shot.catheter is not None and shot.tip is not None and shot.direction is not None
    positions = np.linspace(start, end, 100)[:, None]
    axis = shot.tip + positions * shot.direction
    pixels = shot.camera.project(torch.from_numpy(axis)).numpy()
    focal = float(shot.camera.matrix[0, 0])
    mask = np.zeros(size, np.uint8)
    moved = 0.5 * np.linalg.norm(np.abs(shot.motion) + np.abs(shot.rolling))
    for first, last, depth in zip(pixels[:-1], pixels[1:], axis[:-1, 2], strict=True):
        if np.isfinite([*first, *last]).all() and np.abs([*first, *last]).max() < 1e5:
            half = 1.2 * focal * (shot.catheter.radius + moved) / depth + 3.5 * shot.blur_px + shot.disc_px + 1.5
            ends = [tuple(round(float(value)) for value in end) for end in (first, last)]
            cv2.line(mask, ends[0], ends[1], 255, 2 * math.ceil(half))
    return mask


def _trace(light: np.ndarray, shot: Shot, rng: np.random.Generator) -> None:
    """Add the catheter and what is in front of it to the light, in place, for the pixels near the catheter."""
    size = light.shape[:2]
    tool = shot.catheter
    assert tool is not None
    whole, bands = (
        _near(shot, size, 0.0, tool.length),
        _near(shot, size, tool.edges[0] - _BESIDE, tool.edges[-1] + _BESIDE),
    )
    centre = (tool.edges[0] + tool.edges[-1]) / 2
    middle = shot.camera.project(torch.from_numpy(shot.tip + centre * shot.direction))  # type: ignore[operator]
    parts = [(part, _SAMPLES) for part in _chunks(bands)] + [(part, _FEW) for part in _chunks(whole & ~bands)]
    lens = _Lens.of(shot.blur_px)
    for part, samples in parts:
        points, shifts = _points(rng, len(part), samples, shot)
        around = part[:, None] + np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
        plane = shot.camera.undistort(torch.from_numpy(around)).numpy()
        for first in range(0, len(part), _BLOCK // samples):
            block = slice(first, first + _BLOCK // samples)
            offsets = _offsets(points, shifts[:, block], lens, shot)
            _trace_pixels(light, shot, part[block], plane[block], offsets, float(middle[1]))


def _trace_pixels(
    light: np.ndarray, shot: Shot, pixels: np.ndarray, plane: np.ndarray, offsets: tuple[np.ndarray, ...], middle: float
) -> None:
    """Trace the rays of ``pixels`` (x, y) [n, 2]; ``offsets`` are those of :func:`_offsets`.

    ``plane`` [n, 5, 2] are their directions, those half a pixel to the right, left, below and above; ``middle`` is the
    row of the middle of the bands.
    """
    right, down = plane[:, 1] - plane[:, 2], plane[:, 3] - plane[:, 4]  # distortion is linear within a pixel
    beside, below, time = offsets
    rays = [plane[:, :1, k] + beside * right[:, k, None] + below * down[:, k, None] for k in (0, 1)]
    x, y = pixels[:, None, 0] + beside, pixels[:, None, 1] + below
    late = (y - middle) / light.shape[0]
    moved = np.zeros((3, 1, 1))
    if any(shot.motion) or any(shot.rolling):
        moved = np.stack([time * a + late * b for a, b in zip(shot.motion, shot.rolling, strict=True)])
    colour, cover = _tube(shot, np.stack([*rays, np.ones_like(x)]), moved)
    for rod in shot.before:
        over, paint = rod.paint(x, y)
        colour[over], cover[over] = paint[over], 1.0
    columns, rows = pixels.T
    light[rows, columns] = colour.mean(1) + (1 - cover.mean(1))[:, None] * light[rows, columns]


def _chunks(mask: np.ndarray) -> list[np.ndarray]:
    """Pixels (x, y) of a mask in parts [n, 2] of limited size."""
    nonzero = cv2.findNonZero(mask)
    pixels = np.asarray([] if nonzero is None else nonzero, np.intp).reshape(-1, 2)
    return [pixels[first : first + _CHUNK] for first in range(0, len(pixels), _CHUNK)]


def _tube(shot: Shot, ray: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Light [n, S, 3] of the tube along rays [3, n, S], of tips shifted by ``moved`` [3, n or 1, S or 1], and cover."""
    tool = shot.catheter
    assert tool is not None and shot.direction is not None and shot.tip is not None
    # Coordinates are the first axis: NumPy is several times as slow over a last axis of three.
    axis, tip = (np.asarray(each)[:, None, None] for each in (shot.direction, shot.tip))
    ray = ray / np.sqrt(_dot(ray, ray))
    back = -(tip + moved)  # from the tip to the camera
    ray_along, back_along = _dot(ray, axis), _dot(back, axis)
    ray_across = ray - ray_along * axis
    back_across = np.broadcast_to(back - back_along * axis, ray.shape)
    a = np.maximum(_dot(ray_across, ray_across), 1e-12)
    b = _dot(ray_across, back_across)
    root = b**2 - a * (_dot(back_across, back_across) - tool.radius**2)
    depth = (-b - np.sqrt(np.maximum(root, 0))) / a
    place = back_along + depth * ray_along
    hit = (root > 0) & (depth > 0) & (place >= 0) & (place <= tool.length)
    colour, cover = np.zeros((*hit.shape, 3), np.float32), np.zeros(hit.shape, np.float32)
    if not hit.any():
        return colour, cover
    normal = (back_across[:, hit] + depth[hit] * ray_across[:, hit]) / tool.radius
    albedo, printed = _reflectance(shot, place[hit], normal)
    light, solid = _shaded(shot, ray[:, hit], normal, albedo, printed)
    colour[hit], cover[hit] = light.T, solid
    return colour, cover


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Products of vectors, whose coordinates are the first axis."""
    return one[0] * other[0] + (one[1] * other[1] + one[2] * other[2])


def _reflectance(shot: Shot, place: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance [3, k] of the tube at ``place`` [k], in metres from the tip, and whether it is printed there."""
    tool, axis = shot.catheter, shot.direction
    assert tool is not None and axis is not None
    band = np.searchsorted(np.asarray(tool.edges), place, side="right")
    inks = np.asarray(tool.colours) / 255
    inks = np.where(inks <= 0.04045, inks / 12.92, ((inks + 0.055) / 1.055) ** 2.4) * shot.tints
    albedo = np.stack([np.asarray(shot.clear), *inks, np.asarray(shot.clear)]).T[:, band]
    printed = (band > 0) & (band < len(tool.edges))
    if shot.stain is not None:
        start, end, angle, width = shot.stain
        side = np.cross(axis, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        around = np.arctan2(_dot(normal, np.cross(axis, side)), _dot(normal, side))
        near = np.abs((around - angle + math.pi) % (2 * math.pi) - math.pi) < width
        stained = near & (place > start) & (place < end)
        albedo = np.where(stained, np.array([0.12, 0.008, 0.008])[:, None], albedo)
    return albedo, printed


def _shaded(
    shot: Shot, ray: np.ndarray, normal: np.ndarray, albedo: np.ndarray, printed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Light [3, k] along rays [3, k] to a surface of the tube, and its cover [k]."""
    lit = np.broadcast_to(np.asarray(shot.ambient)[:, None], albedo.shape).copy()
    gloss = np.zeros_like(lit)
    for lamp in shot.lights:
        towards, tone = np.asarray(lamp.direction), np.asarray(lamp.colour)[:, None]
        towards = (towards / np.linalg.norm(towards))[:, None]
        cosine = np.maximum(_dot(normal, towards), 0)
        halfway = towards - ray
        halfway /= np.sqrt(_dot(halfway, halfway))
        lit += cosine * tone
        shine = np.maximum(_dot(normal, halfway), 0) ** shot.sharpness * (cosine > 0)
        gloss += shot.gloss * shine * tone
    facing = np.maximum(-_dot(normal, ray), 0.05)
    solid = np.where(printed, 1.0, 1 - (1 - shot.opacity) ** (1 / facing))
    return solid * albedo * lit + gloss, solid


def _cover_rest(light: np.ndarray, shot: Shot) -> None:
    """Draw the objects in front of the catheter on pixels that are not near the catheter, in place."""
    if not shot.before:
        return
    done = np.zeros(light.shape[:2], bool)
    if shot.catheter is not None:
        done = _near(shot, light.shape[:2], 0.0, shot.catheter.length) > 0
    soft = math.hypot(shot.blur_px, shot.disc_px / 2, 0.29)
    paint_rods(light, shot.before, soft, ~done)


def paint_rods(light: np.ndarray, rods: tuple[Rod, ...], soft: float, where: np.ndarray | None = None) -> None:
    """Draw rods over light [H, W, 3], in place, with edges of ``soft`` pixels, only where ``where`` [H, W] is true."""
    height, width = light.shape[:2]
    for rod in rods:
        extent = rod.radius + 4 * soft + 1
        left, right = (
            int(np.clip(f(rod.start[0], rod.end[0]) + s * extent, 0, width)) for f, s in ((min, -1), (max, 1))
        )
        top, low = (int(np.clip(f(rod.start[1], rod.end[1]) + s * extent, 0, height)) for f, s in ((min, -1), (max, 1)))
        if left >= right or top >= low:
            continue
        y, x = np.mgrid[top:low, left:right].astype(np.float32)
        cover, colour = rod.paint(x, y, soft)
        if where is not None:
            cover = cover * where[top:low, left:right]
        part = light[top:low, left:right]
        part += cover[..., None].astype(np.float32) * (colour.astype(np.float32) - part)


def _half_chroma(frame: np.ndarray) -> np.ndarray:
    """Levels [H, W, 3] with full luma and chroma averaged over 2 x 2 pixels, then interpolated."""
    planes = cv2.cvtColor(frame, cv2.COLOR_RGB2YCrCb)
    size = planes.shape[1::-1]
    chroma = cv2.resize(planes[..., 1:], ((size[0] + 1) // 2, (size[1] + 1) // 2), interpolation=cv2.INTER_AREA)
    planes[..., 1:] = cv2.resize(chroma, size, interpolation=cv2.INTER_LINEAR)
    return cv2.cvtColor(planes, cv2.COLOR_YCrCb2RGB)
