"""Random surroundings of the second synthetic world, as linear light float32 [H, W, 3]."""

import colorsys
import math

import cv2
import numpy as np

Rgb = tuple[float, float, float]


def linear(colour: tuple[float, float, float] | np.ndarray) -> np.ndarray:
    """Linear light of sRGB values from 0 to 1."""
    value = np.asarray(colour, np.float32)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def of_hue(hue: float, saturation: float, value: float) -> Rgb:
    """Linear RGB of a hue (1 is the whole circle), saturation and value (0 to 1) of sRGB."""
    red, green, blue = linear(colorsys.hsv_to_rgb(hue % 1, saturation, value)).tolist()
    return red, green, blue


def any_colour(rng: np.random.Generator) -> Rgb:
    """A random colour, from grey to strong, dark to light."""
    return of_hue(rng.random(), rng.uniform(0, 1), rng.uniform(0.15, 0.95))


def smooth_noise(rng: np.random.Generator, size: tuple[int, int], period: float) -> np.ndarray:
    """Noise float32 [H, W] of unit variance with blobs of ``period`` pixels."""
    rows, columns = (math.ceil(side / period) + 4 for side in size)
    coarse = rng.standard_normal((rows, columns)).astype(np.float32)
    fine = cv2.resize(coarse, (math.ceil(columns * period), math.ceil(rows * period)), interpolation=cv2.INTER_CUBIC)
    top, left = (int(rng.integers(0, max(1, have - side))) for have, side in zip(fine.shape, size, strict=True))
    return fine[top : top + size[0], left : left + size[1]]


def plain(rng: np.random.Generator, size: tuple[int, int], colour: Rgb) -> np.ndarray:
    """A matte surface: slow shading and grain."""
    shade = (
        1 + 0.08 * smooth_noise(rng, size, rng.uniform(200, 700)) + 0.03 * smooth_noise(rng, size, rng.uniform(2, 8))
    )
    return np.maximum(shade, 0.2)[..., None] * np.asarray(colour, np.float32)


def cloth(rng: np.random.Generator, size: tuple[int, int], colour: Rgb) -> np.ndarray:
    """Folded fabric: bent ridges lit from one side, with a weave."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    angle = rng.uniform(0, math.pi)
    phase = (x * math.cos(angle) + y * math.sin(angle)) / rng.uniform(25, 110)
    phase += rng.uniform(0.5, 2.5) * smooth_noise(rng, size, rng.uniform(250, 600))
    ridges = np.cos(phase) + 0.35 * np.cos(2.6 * phase + smooth_noise(rng, size, 300))
    shade = 1 + rng.uniform(0.05, 0.3) * ridges + 0.04 * smooth_noise(rng, size, 2.5)
    return np.clip(shade, 0.25, 1.8)[..., None] * np.asarray(colour, np.float32)


def skin(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """Skin of any tone."""
    tone = of_hue(rng.uniform(8, 32) / 360, rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.95))
    light = plain(rng, size, tone)
    flush = 0.12 * smooth_noise(rng, size, rng.uniform(60, 200))
    return light * (1 + flush[..., None] * np.array([0.4, -0.6, -0.4], np.float32))


def skin_on_drape(rng: np.random.Generator, size: tuple[int, int], drape: Rgb) -> np.ndarray:
    """A field of skin within a cloth, with a curved border."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    angle, side = rng.uniform(0, 2 * math.pi), math.hypot(*size)
    border = (x - size[1] / 2) * math.cos(angle) + (y - size[0] / 2) * math.sin(angle)
    border += 0.08 * side * smooth_noise(rng, size, rng.uniform(300, 700)) - rng.uniform(-0.2, 0.2) * side
    share = np.clip(border / 2 + 0.5, 0, 1)[..., None]
    return share * skin(rng, size) + (1 - share) * cloth(rng, size, drape)


def gauze(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """White woven gauze with stains of blood."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    period, angle = rng.uniform(4, 14), rng.uniform(0, math.pi)
    bend = 3 * smooth_noise(rng, size, 150)
    u = x * math.cos(angle) + y * math.sin(angle) + bend
    v = -x * math.sin(angle) + y * math.cos(angle) + bend
    weave = 0.5 + 0.25 * (np.cos(2 * math.pi * u / period) + np.cos(2 * math.pi * v / period))
    light = (0.35 + 0.45 * weave * (1 + 0.1 * smooth_noise(rng, size, 200)))[..., None] * np.ones(3, np.float32)
    stain = np.clip(smooth_noise(rng, size, rng.uniform(80, 250)) - rng.uniform(0.5, 2.0), 0, 1)[..., None]
    return light * (1 - stain) + stain * np.asarray(of_hue(rng.uniform(-0.02, 0.02), 0.85, 0.5), np.float32)


def steel(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """Brushed metal that mirrors a room: streaks, bright and dark bands, tints of objects around it."""
    angle = rng.uniform(0, math.pi)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    across = x * math.cos(angle) + y * math.sin(angle)
    mirror = 0.3 + 0.2 * np.sin(across / rng.uniform(40, 250) + 1.2 * smooth_noise(rng, size, 400))
    streaks = cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), 12, sigmaY=0.6)
    light = np.maximum(mirror + 0.25 * streaks, 0.03)[..., None] * np.ones(3, np.float32)
    tint = np.clip(smooth_noise(rng, size, 350), 0, 1)[..., None]
    return light * (1 - 0.6 * tint) + 0.6 * tint * light * 2 * np.asarray(any_colour(rng), np.float32)


def monitor(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A screen with windows, curves and text in strong colours."""
    picture = np.full((*size, 3), rng.uniform(0.01, 0.1), np.float32)
    for _ in range(int(rng.integers(3, 10))):
        left, top = rng.integers(0, size[1]), rng.integers(0, size[0])
        right, low = left + rng.integers(60, 700), top + rng.integers(40, 450)
        colour = np.asarray(any_colour(rng)) * rng.uniform(0.3, 1.2)
        cv2.rectangle(picture, (int(left), int(top)), (int(right), int(low)), colour.tolist(), -1)
        for row in range(int(top) + 12, int(low) - 6, int(rng.integers(14, 30))):
            shade = any_colour(rng)
            for column in range(int(left) + 8, int(right) - 40, 34):
                if rng.random() < 0.7:
                    cv2.rectangle(picture, (column, row), (column + int(rng.integers(8, 28)), row + 5), shade, -1)
    for _ in range(int(rng.integers(2, 7))):
        columns = np.arange(0, size[1], 6)
        curve = size[0] * rng.random() + rng.uniform(5, 80) * np.sin(columns / rng.uniform(20, 200) + rng.uniform(0, 6))
        points = np.stack([columns, curve], -1).round().astype(np.int32)
        cv2.polylines(picture, [points], False, any_colour(rng), int(rng.integers(2, 7)), cv2.LINE_AA)
    return picture


def photograph(rng: np.random.Generator, size: tuple[int, int], images: tuple[np.ndarray, ...]) -> np.ndarray:
    """Part of one of the photographs, uint8 [h, w, 3], turned by quarter turns and scaled to cover the frame."""
    image = np.rot90(images[int(rng.integers(len(images)))], int(rng.integers(4)))
    scale = max(size[0] / image.shape[0], size[1] / image.shape[1]) * rng.uniform(1.0, 1.6)
    whole = (math.ceil(image.shape[1] * scale), math.ceil(image.shape[0] * scale))
    image = cv2.resize(np.ascontiguousarray(image), whole, interpolation=cv2.INTER_CUBIC)
    top, left = (int(rng.integers(0, have - side + 1)) for have, side in zip(image.shape[:2], size, strict=True))
    return linear(image[top : top + size[0], left : left + size[1]] / np.float32(255))
