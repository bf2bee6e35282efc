"""Effects of a sensor and a codec on a frame: noise, rounding, chroma at half resolution, JPEG."""

from functools import lru_cache

import cv2
import numpy as np
import torch

_ROWS = 64  # rows processed at a time, so that they fit the processor's cache


@lru_cache(maxsize=1)
def _deviates() -> np.ndarray:
    """Normal deviates, drawn once for all frames; the noise of each row of a frame is a random section of them."""
    return torch.randn(1 << 21, generator=torch.Generator().manual_seed(20)).numpy()


def sensed(
    levels: np.ndarray, noise: float, video: bool, jpeg_quality: int | None, generator: torch.Generator | None
) -> np.ndarray:
    """Frame, uint8 [3, H, W], that sensor and codec produce from levels, float32 [3, H, W].

    ``noise`` is the standard deviation in levels; the other arguments are as in :class:`Look`.
    """
    frame = expose(levels, noise, generator)
    if video:
        frame = halve_colours(frame)
    return frame if jpeg_quality is None else compress(frame, jpeg_quality)


def expose(frame: np.ndarray, noise: float, generator: torch.Generator | None) -> np.ndarray:
    """uint8 [3, H, W]: the levels ``frame``, float32, plus white noise of standard deviation ``noise`` in levels."""
    flat = frame.reshape(-1, frame.shape[-1])
    rows = np.lib.stride_tricks.sliding_window_view(_deviates(), frame.shape[-1])
    start = torch.randint(len(rows), (len(flat),), generator=generator).numpy()
    levels = np.empty_like(flat, dtype=np.uint8)
    for first in range(0, len(flat), _ROWS):
        part = slice(first, first + _ROWS)
        cv2.addWeighted(flat[part], 1.0, rows[start[part]], noise, 0.0, levels[part], cv2.CV_8U)  # rounds and clips
    return levels.reshape(frame.shape)


def halve_colours(levels: np.ndarray) -> np.ndarray:
    """Levels [3, H, W] after chroma subsampling: each 2 x 2 pixels have the chroma of the upper left one."""
    height, width = levels.shape[1:]
    even = np.pad(levels, ((0, 0), (0, height % 2), (0, width % 2)), "edge").transpose(1, 2, 0)
    planes = cv2.cvtColor(np.ascontiguousarray(even), cv2.COLOR_RGB2YUV_I420)
    shared = cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420)[:height, :width]
    return np.ascontiguousarray(shared.transpose(2, 0, 1))


def compress(levels: np.ndarray, quality: int) -> np.ndarray:
    """Levels [3, H, W] after JPEG compression with a ``quality`` of 1 to 100 and chroma at half resolution."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(levels[::-1].transpose(1, 2, 0)), options)
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
    return np.ascontiguousarray(decoded[..., ::-1].transpose(2, 0, 1))
