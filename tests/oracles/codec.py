"""What 4:2:0 codecs do to a picture, and edges in it, in numpy and OpenCV, without torch and without holotorch."""

import cv2
import numpy as np
from oracles import strips

SHARES = np.array([0.299, 0.587, 0.114])  # of red, green and blue levels in luma, ITU-R BT.601


def i420(picture: np.ndarray) -> np.ndarray:
    """Levels uint8 [H, W, 3] as uncompressed video keeps them: luma of each pixel, one colour for four."""
    return cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), cv2.COLOR_YUV2RGB_I420)


def jpeg(picture: np.ndarray, quality: int = 95) -> np.ndarray:
    """Levels uint8 [H, W, 3] from a JPEG with 4:2:0; its reader smooths the colours between pixels."""
    half = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, half]
    made, file = cv2.imencode(".jpg", picture[..., ::-1], settings)
    read = cv2.imdecode(file, cv2.IMREAD_COLOR)
    assert made and read is not None
    return read[..., ::-1]


def light_of(levels) -> np.ndarray:
    """sRGB's inverse, 0 to 1."""
    share = np.asarray(levels, float) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def levels_of(light) -> np.ndarray:
    """SRGB levels, 0 to 255, not rounded."""
    light = np.clip(light, 0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def luma(place, blur, before, after, count, levels=levels_of) -> np.ndarray:
    """[E, count] of edges between two colours (levels), blurred in light, at ``place`` [E]."""
    low, high = (_light(colour, 1, levels) for colour in (before, after))
    return levels(strips.edge(place, blur, low, high, count))[:, :, 0] @ SHARES


def bound(blur, before, after, count, rows, noise, levels=levels_of) -> float:
    """Deviation below which no unbiased place from the luma alone is: independent ``noise`` in each channel's levels.

    Levels and blur known; of rows that have the same edge.
    """
    ahead, back = (luma(np.array([place]), blur, before, after, count, levels) for place in (0.05, -0.05))
    slope = (ahead - back) / 0.1
    return float(noise * np.sqrt((SHARES**2).sum()) / np.sqrt(rows * (slope * slope).sum()))


def edges(place, blur, before, after, count, rows, noise, rng, levels=levels_of) -> np.ndarray:
    """Levels uint8 [E, count, rows, 3] of edges: luma in its place, colours half a pixel on and one for two pixels."""
    low, high = (_light(colour, rows, levels) for colour in (before, after))
    own, far = (levels(strips.edge(np.asarray(place) + aside, blur, low, high, count)) for aside in (0.0, 0.5))
    own = own + noise * rng.normal(size=own.shape)
    colour = far - (far @ SHARES)[..., None]
    last = count // 2 * 2
    colour[:, :last] = ((colour[:, :last:2] + colour[:, 1:last:2]) / 2).repeat(2, 1)
    return np.clip(np.round((own @ SHARES)[..., None] + colour), 0, 255).astype(np.uint8)


def _light(colour, rows, levels):
    """[rows, 3] of a colour, by the inverse of ``levels``: sRGB's, or a straight line's."""
    return np.tile(light_of(colour) if levels is levels_of else np.array(colour) / 255, (rows, 1))
