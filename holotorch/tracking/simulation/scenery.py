"""Random backgrounds and hands for synthetic frames.

All backgrounds are RGB images uint8 [3, H, W] as taken by a camera, for a ``size`` (H, W) in pixels; the same ``seed``
gives the same image. Colours are 8-bit sRGB triples.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.simulation.look import Colour, Occluder

SKIN, WHITE_GLOVE, BLUE_GLOVE = (205, 150, 120), (226, 228, 230), (70, 130, 200)
_ASPECT = (0.9, 2.5)  # range of length / width of a sheet of paper; that of bands is far larger


def desk(size: tuple[int, int], seed: int, colour: Colour = (150, 138, 120)) -> Tensor:
    """A plain table of one colour with slight shading and grain."""
    rng = np.random.default_rng(seed)
    shade = 1 + 0.06 * _clouds(rng, size, 500) + 0.02 * _clouds(rng, size, 4, stretch=25)
    return _levels(np.asarray(colour, np.float32) * shade[..., None])


def drape(size: tuple[int, int], seed: int, colour: Colour = (40, 70, 190)) -> Tensor:
    """A surgical cloth with folds, by default in the blue of the third band of the thesis's catheter."""
    rng = np.random.default_rng(seed)
    down, right = np.mgrid[: size[0], : size[1]].astype(np.float32)
    angle = rng.uniform(0, math.pi)
    across = right * math.cos(angle) + down * math.sin(angle)
    # Parallel folds, bent by smooth noise, and lit from one side.
    ridge = across / rng.uniform(40, 80) + _clouds(rng, size, 600)
    fold = 0.7 * np.sin(ridge) + 0.3 * np.sin(2.3 * ridge + _clouds(rng, size, 300))
    weave = 0.03 * rng.standard_normal(size, dtype=np.float32)
    shade = 0.85 + 0.22 * fold + 0.08 * _clouds(rng, size, 400) + 0.02 * _clouds(rng, size, 60)
    shade = shade + cv2.GaussianBlur(weave, (0, 0), 0.8)
    white = 12 * np.clip(fold, 0, None)  # the crests of the folds are less saturated
    return _levels(np.asarray(colour, np.float32) * np.clip(shade, 0.3, 1.5)[..., None] + white[..., None])


def skin(size: tuple[int, int], seed: int, colour: Colour = SKIN) -> Tensor:
    """Close-up of skin with soft light, blotches and pores."""
    rng = np.random.default_rng(seed)
    shade = 0.95 + 0.07 * _clouds(rng, size, 700) + 0.015 * _clouds(rng, size, 5)
    blotch = 4 * _clouds(rng, size, 120)[..., None] * np.array([0.6, -1, -0.8], np.float32)
    return _levels(np.asarray(colour, np.float32) * shade[..., None] + blotch)


def texture(size: tuple[int, int], seed: int) -> Tensor:
    """Random shapes of strong colours at all scales, with light, shadow and grain, as a substitute for a photograph."""
    rng = np.random.default_rng(seed)
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)  # suffices, since the smallest shapes are 19 pixels wide
    # Clouds of six scales, whose amplitude falls with the scale.
    scales = [[_clouds(rng, half, 300 / 2**i) / 1.6**i for i in range(6)] for _ in range(3)]
    light, hue, strength = np.sum(scales, axis=1)
    angle = (1.5 * hue + rng.uniform(0, 7))[..., None] + np.array([0, 2 * math.pi / 3, -2 * math.pi / 3], np.float32)
    colour = 0.55 + 0.22 * (1 + np.tanh(strength))[..., None] * np.cos(angle)
    image = np.clip(240 / (1 + np.exp(-1.2 * light - 0.3))[..., None] * colour, 0, 255).astype(np.float32)
    return _levels(cv2.resize(image, size[::-1]) + 4 * rng.standard_normal((*size, 1), dtype=np.float32))


def photograph(image: Tensor, size: tuple[int, int], seed: int = 0) -> Tensor:
    """A photograph, uint8 [3, h, w], scaled to cover ``size``, cropped at random, and mirrored at random."""
    if not isinstance(image, Tensor) or image.dtype != torch.uint8 or image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"a photograph must be uint8 [3, h, w], got {getattr(image, 'shape', type(image))}")
    rng = np.random.default_rng(seed)
    picture = np.ascontiguousarray(image.cpu().numpy().transpose(1, 2, 0))
    scale = max(size[0] / picture.shape[0], size[1] / picture.shape[1]) * rng.uniform(1, 1.3)
    width, height = (max(math.ceil(scale * side), size[1 - i]) for i, side in enumerate(picture.shape[1::-1]))
    picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    top, left = (int(rng.integers(0, spare + 1)) for spare in (height - size[0], width - size[1]))
    picture = picture[top : top + size[0], left : left + size[1]]
    return _tensor(picture[:, ::-1] if rng.random() < 0.5 else picture)


def papers(size: tuple[int, int], seed: int, colours: Sequence[Colour]) -> Tensor:
    """Sheets of paper on a table: some at random in random or given colours, and a row in the order of ``colours``."""
    rng = np.random.default_rng(seed)
    image = _interleaved(desk(size, seed))
    scale = size[1] / 1920
    for _ in range(int(rng.integers(2, 9))):
        side = rng.uniform(25, 160) * scale
        colour = colours[int(rng.integers(len(colours)))] if rng.random() < 0.8 else rng.integers(30, 240, 3)
        centre, angle = rng.uniform(0, 1, 2) * size[::-1], rng.uniform(0, 7)
        _draw_rectangle(image, centre, angle, (side, side * rng.uniform(*_ASPECT)), colour)
    angle, width = rng.uniform(0, 2 * math.pi), rng.uniform(18, 70) * scale
    length = width * rng.uniform(*_ASPECT)
    step = np.array([math.cos(angle), math.sin(angle)]) * length
    start = np.asarray(size[::-1]) * rng.uniform(0.35, 0.65, 2) - step * (len(colours) - 1) / 2
    for i, colour in enumerate(colours):
        _draw_rectangle(image, start + i * step, angle, (length * 1.01, width), colour)
    return _blurred(image)


def clutter(size: tuple[int, int], seed: int, colours: Sequence[Colour], amount: float = 1.0) -> Tensor:
    """A table with 260 ``amount`` small sticks, discs and scraps, each of one colour, mostly similar to ``colours``."""
    rng = np.random.default_rng(seed)
    image = _interleaved(desk(size, seed, (120, 120, 115)))
    scale = size[1] / 1920
    for _ in range(int(260 * amount)):
        base = np.array(colours[int(rng.integers(len(colours)))]) if rng.random() < 0.75 else rng.integers(20, 235, 3)
        colour = np.clip(base * rng.uniform(0.6, 1.2) + rng.uniform(-15, 15, 3), 0, 255)
        centre, angle = rng.uniform(0, 1, 2) * size[::-1], rng.uniform(0, 7)
        kind = rng.random()
        lengths, widths = ((30, 260), (3, 12)) if kind < 0.45 else ((6, 60), (6, 60))
        sides = rng.uniform(*lengths) * scale, rng.uniform(*widths) * scale
        if kind < 0.8:
            _draw_rectangle(image, centre, angle, sides, colour)
        else:
            middle = tuple(round(16 * float(value)) for value in centre)
            cv2.circle(image, middle, round(8 * sides[0]), tuple(map(float, colour)), -1, cv2.LINE_AA, 4)
    return _blurred(image)


def finger(
    start: tuple[float, float], end: tuple[float, float], radius: float, colour: Colour = SKIN
) -> tuple[Occluder, ...]:
    """A finger from its tip ``start`` to its root ``end`` in pixels, lighter along its middle."""
    checks.positive("radius", radius, "pixels")
    parts = []
    for i in range(6):
        red, green, blue = (round(value * (0.72 + 0.05 * i)) for value in colour)
        parts.append(Occluder.capsule(start, end, radius * (1 - i / 8), (red, green, blue)))
    return tuple(parts)


def hand(at: tuple[float, float], turn: float, finger_px: float, colour: Colour = WHITE_GLOVE) -> tuple[Occluder, ...]:
    """A hand with finger tips around the pixel ``at`` (x, y) and fingers of radius ``finger_px`` in pixels.

    The arm extends from the hand at the angle ``turn`` in radians, from +x towards +y.
    """
    along, across = _axes(turn)
    # Arm, palm, fingers and thumb from one point to another, and their radii; in radii of a finger, along and across.
    strokes = [((11, 0), (60, 0), 3.6), ((10, -1.5), (11, 1.5), 3.9)]
    strokes += [((tip, b), (9, 0.9 * b), 1.0) for b, tip in ((-3.2, 1.4), (-1.1, 0.0), (1.1, 0.4), (3.2, 2.6))]
    strokes += [((5, 6.4), (10, 3.5), 1.15)]
    parts: list[Occluder] = []
    for *points, radius in strokes:
        start, end = ((np.asarray(at) + finger_px * (a * along + b * across)).tolist() for a, b in points)
        parts += finger((start[0], start[1]), (end[0], end[1]), finger_px * radius, colour)
    return tuple(parts)


def _clouds(rng: np.random.Generator, size: tuple[int, int], scale: float, stretch: float = 1.0) -> np.ndarray:
    """Normal deviates at a spacing of ``scale`` (x: ``scale * stretch``) pixels, interpolated to float32 [H, W]."""
    rows, columns = math.ceil(size[0] / scale) + 3, math.ceil(size[1] / (scale * stretch)) + 3
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    width, height = round(columns * scale * stretch), round(rows * scale)
    # The first deviate lies outside the image, so that interpolation does not depend on the border.
    matrix = np.array([[columns / width, 0, 1], [0, rows / height, 1]])
    return cv2.warpAffine(coarse, matrix, size[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def _axes(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (x, y) at an angle in radians and at a right angle to it."""
    return np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])


def _draw_rectangle(
    image: np.ndarray,
    centre: np.ndarray,
    angle: float,
    sides: tuple[float, float],
    colour: Sequence[float] | np.ndarray,
) -> None:
    """Draw a rectangle in place, whose first side is at ``angle`` in radians."""
    along, across = (side / 2 * axis for side, axis in zip(sides, _axes(angle), strict=True))
    corners = [centre + a * along + b * across for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    points = np.round(16 * np.array(corners)).astype(np.int32)
    cv2.fillPoly(image, [points], tuple(float(value) for value in colour), cv2.LINE_AA, 4)


def _interleaved(image: Tensor) -> np.ndarray:
    return np.ascontiguousarray(image.numpy().transpose(1, 2, 0))


def _blurred(image: np.ndarray) -> Tensor:
    """Image [3, H, W] after the blur of the lens."""
    return _tensor(cv2.GaussianBlur(image, (0, 0), 0.8))


def _levels(values: np.ndarray) -> Tensor:
    """Levels [H, W, 3], rounded and clipped, as an image [3, H, W]."""
    values += 0.5
    return _tensor(np.clip(values, 0, 255, out=values).astype(np.uint8))


def _tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
