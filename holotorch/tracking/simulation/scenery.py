"""Backgrounds for synthetic frames, each from its seed: uint8 [3, H, W], RGB, as a camera would show them."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.simulation.render import Colour, Occluder

SKIN, WHITE_GLOVE, BLUE_GLOVE = (205, 150, 120), (226, 228, 230), (70, 130, 200)
_CLUTTER = 260  # things on a cluttered table of 1920 x 1080
_ROW = (0.9, 2.5)  # a paper is this many times as long as wide; bands are far thinner


def desk(size: tuple[int, int], seed: int, colour: Colour = (150, 138, 120)) -> Tensor:
    """A plain table: one colour, a little uneven and grained."""
    rng = np.random.default_rng(seed)
    shade = 1 + 0.06 * _clouds(rng, size, 500) + 0.02 * _clouds(rng, size, 4, stretch=25)
    return _levels(np.asarray(colour, np.float32) * shade[..., None])


def drape(size: tuple[int, int], seed: int, colour: Colour = (40, 70, 190)) -> Tensor:
    """A surgical cloth with folds, in the blue of the third band of the thesis's catheter unless told otherwise."""
    rng = np.random.default_rng(seed)
    down, right = np.mgrid[: size[0], : size[1]].astype(np.float32)
    turn = rng.uniform(0, math.pi)
    across = right * math.cos(turn) + down * math.sin(turn)
    # Folds: ridges along one direction, bent by slow noise; light from one side falls on their slopes.
    ridge = across / rng.uniform(40, 80) + _clouds(rng, size, 600)
    fold = 0.7 * np.sin(ridge) + 0.3 * np.sin(2.3 * ridge + _clouds(rng, size, 300))
    weave = 0.03 * rng.standard_normal(size, dtype=np.float32)
    shade = (
        0.85
        + 0.22 * fold
        + 0.08 * _clouds(rng, size, 400)
        + 0.02 * _clouds(rng, size, 60)
        + cv2.GaussianBlur(weave, (0, 0), 0.8)
    )
    white = 12 * np.clip(fold, 0, None)  # crests lose some of their colour
    return _levels(np.asarray(colour, np.float32) * np.clip(shade, 0.3, 1.5)[..., None] + white[..., None])


def skin(size: tuple[int, int], seed: int, colour: Colour = SKIN) -> Tensor:
    """Skin close up: soft light, blotches, pores."""
    rng = np.random.default_rng(seed)
    shade = 0.95 + 0.07 * _clouds(rng, size, 700) + 0.015 * _clouds(rng, size, 5)
    blotch = 4 * _clouds(rng, size, 120)[..., None] * np.array([0.6, -1, -0.8], np.float32)
    return _levels(np.asarray(colour, np.float32) * shade[..., None] + blotch)


def texture(size: tuple[int, int], seed: int) -> Tensor:
    """Something like a photograph: shapes of strong colours at all scales, with light, shadow and grain."""
    rng = np.random.default_rng(seed)
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)  # its finest blobs are 19 pixels
    light, hue, strength = (_scales(rng, half) for _ in range(3))
    angle = (1.5 * hue + rng.uniform(0, 7))[..., None] + np.array([0, 2 * math.pi / 3, -2 * math.pi / 3], np.float32)
    colour = 0.55 + 0.22 * (1 + np.tanh(strength))[..., None] * np.cos(angle)
    image = np.clip(240 / (1 + np.exp(-1.2 * light - 0.3))[..., None] * colour, 0, 255).astype(np.float32)
    return _levels(cv2.resize(image, size[::-1]) + 4 * rng.standard_normal((*size, 1), dtype=np.float32))


def photograph(image: Tensor, size: tuple[int, int], seed: int = 0) -> Tensor:
    """A photograph, uint8 [3, h, w], scaled to cover ``size`` and cropped somewhere, perhaps mirrored.

    Raises:
        ValueError: Another shape or dtype.
    """
    if not isinstance(image, Tensor) or image.dtype != torch.uint8 or image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"a photograph must be uint8 [3, h, w], got {getattr(image, 'shape', type(image))}")
    rng = np.random.default_rng(seed)
    picture = np.ascontiguousarray(image.cpu().numpy().transpose(1, 2, 0))
    scale = max(size[0] / picture.shape[0], size[1] / picture.shape[1]) * rng.uniform(1, 1.3)
    wide, high = (max(math.ceil(scale * side), size[1 - i]) for i, side in enumerate(picture.shape[1::-1]))
    picture = cv2.resize(picture, (wide, high), interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    top, left = (int(rng.integers(0, spare + 1)) for spare in (high - size[0], wide - size[1]))
    picture = picture[top : top + size[0], left : left + size[1]]
    return _tensor(picture[:, ::-1] if rng.random() < 0.5 else picture)


def papers(size: tuple[int, int], seed: int, colours: Sequence[Colour]) -> Tensor:
    """Sheets of these colours on a table, some strewn, some in a row, edge to edge, in this very order."""
    rng = np.random.default_rng(seed)
    image = _array(desk(size, seed))
    scale = size[1] / 1920
    for _ in range(int(rng.integers(2, 9))):
        side = rng.uniform(25, 160) * scale
        colour = colours[int(rng.integers(len(colours)))] if rng.random() < 0.8 else rng.integers(30, 240, 3)
        _sheet(image, rng.uniform(0, 1, 2) * size[::-1], rng.uniform(0, 7), (side, side * rng.uniform(*_ROW)), colour)
    turn, wide = rng.uniform(0, 2 * math.pi), rng.uniform(18, 70) * scale
    long = wide * rng.uniform(*_ROW)
    step = np.array([math.cos(turn), math.sin(turn)]) * long
    start = np.asarray(size[::-1]) * rng.uniform(0.35, 0.65, 2) - step * (len(colours) - 1) / 2
    for place, colour in enumerate(colours):
        _sheet(image, start + place * step, turn, (long * 1.01, wide), colour)
    return _finish(image)


def clutter(size: tuple[int, int], seed: int, colours: Sequence[Colour], amount: float = 1.0) -> Tensor:
    """Hundreds of small things, most in shades of these colours: sticks, dots, scraps, each of one colour.

    ``amount`` multiplies their number.
    """
    rng = np.random.default_rng(seed)
    image = _array(desk(size, seed, (120, 120, 115)))
    scale = size[1] / 1920
    for _ in range(int(_CLUTTER * amount)):
        base = np.array(colours[int(rng.integers(len(colours)))]) if rng.random() < 0.75 else rng.integers(20, 235, 3)
        colour = np.clip(base * rng.uniform(0.6, 1.2) + rng.uniform(-15, 15, 3), 0, 255)
        centre, turn = rng.uniform(0, 1, 2) * size[::-1], rng.uniform(0, 7)
        kind = rng.random()
        if kind < 0.45:
            sides = rng.uniform(30, 260) * scale, rng.uniform(3, 12) * scale
        else:
            sides = rng.uniform(6, 60) * scale, rng.uniform(6, 60) * scale
        if kind < 0.8:
            _sheet(image, centre, turn, sides, colour)
        else:
            middle = tuple(round(16 * float(value)) for value in centre)
            cv2.circle(image, middle, round(8 * sides[0]), tuple(map(float, colour)), -1, cv2.LINE_AA, 4)
    return _finish(image)


def finger(
    start: tuple[float, float], end: tuple[float, float], radius: float, colour: Colour = SKIN
) -> tuple[Occluder, ...]:
    """A finger from its tip to its root in pixels, lighter along its middle: :class:`Occluder` for a ``Look``."""
    checks.positive("radius", radius, "pixels")
    parts = []
    for i in range(6):
        red, green, blue = (round(value * (0.72 + 0.05 * i)) for value in colour)
        parts.append(Occluder.capsule(start, end, radius * (1 - i / 8), (red, green, blue)))
    return tuple(parts)


def hand(at: tuple[float, float], turn: float, finger_px: float, colour: Colour = WHITE_GLOVE) -> tuple[Occluder, ...]:
    """A hand with its finger tips around ``at``, in pixels; its arm leaves towards ``turn`` in radians.

    ``finger_px`` is the radius of a finger.
    """
    along, beside = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    parts: list[Occluder] = []

    def stroke(first: tuple[float, float], last: tuple[float, float], radius: float) -> None:
        ends = [np.asarray(at) + finger_px * (one * along + two * beside) for one, two in (first, last)]
        parts.extend(finger(tuple(ends[0]), tuple(ends[1]), finger_px * radius, colour))  # type: ignore[arg-type]

    stroke((11, 0), (60, 0), 3.6)
    stroke((10, -1.5), (11, 1.5), 3.9)
    for place, back in ((-3.2, 1.4), (-1.1, 0.0), (1.1, 0.4), (3.2, 2.6)):
        stroke((back, place), (9, 0.9 * place), 1.0)
    stroke((5, 6.4), (10, 3.5), 1.15)
    return tuple(parts)


def _clouds(rng: np.random.Generator, size: tuple[int, int], scale: float, stretch: float = 1.0) -> np.ndarray:
    """Smooth noise, float32 [H, W], standard deviation about 1 before smoothing, blobs of ``scale`` pixels."""
    rows, columns = math.ceil(size[0] / scale) + 3, math.ceil(size[1] / (scale * stretch)) + 3
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    wide, high = round(columns * scale * stretch), round(rows * scale)
    # Resampled straight to the window, which begins one blob in.
    move = np.array([[columns / wide, 0, 1], [0, rows / high, 1]])
    return cv2.warpAffine(coarse, move, size[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def _scales(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """Clouds of six sizes, the smaller the weaker."""
    return np.sum([_clouds(rng, size, 300 / 2**i) / 1.6**i for i in range(6)], axis=0)


def _sheet(
    image: np.ndarray, centre: np.ndarray, turn: float, sides: tuple[float, float], colour: Sequence[float] | np.ndarray
) -> None:
    """A rectangle in place; ``sides`` are its lengths along ``turn`` and across it."""
    along, beside = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    corners = [centre + a * sides[0] / 2 * along + b * sides[1] / 2 * beside for a, b in ((1, 1), (1, -1), (-1, -1))]
    corners.append(centre - sides[0] / 2 * along + sides[1] / 2 * beside)
    points = np.round(16 * np.array(corners)).astype(np.int32)
    cv2.fillPoly(image, [points], tuple(float(value) for value in colour), cv2.LINE_AA, 4)


def _array(image: Tensor) -> np.ndarray:
    return np.ascontiguousarray(image.numpy().transpose(1, 2, 0))


def _finish(image: np.ndarray) -> Tensor:
    """The lens's blur over what was drawn sharp."""
    return _tensor(cv2.GaussianBlur(image, (0, 0), 0.8))


def _levels(values: np.ndarray) -> Tensor:
    values += 0.5
    return _tensor(np.clip(values, 0, 255, out=values).astype(np.uint8))


def _tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
