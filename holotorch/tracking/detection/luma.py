"""Fits of edges in luma, for frames with subsampled chroma (4:2:0 video, JPEG, webcams).

Codecs store luma (a weighted sum of gamma-encoded levels) for each pixel, but chroma only once per two or four pixels,
often displaced by half a pixel. A fit to all channels is then wrong by up to a pixel; a fit to luma is not, where the
colours on both sides of an edge differ in luma.
"""

import dataclasses
from functools import partial

import numpy as np

from holotorch.tracking.camera.numpy_lens import Points
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection.fits import EdgeFit, fit_edges, normal_step

_LUMA = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue levels in luma, ITU-R BT.601
_MIXES = np.stack([_LUMA, np.array([1.0, 0.0, 0.0]) - _LUMA]).astype(np.float32)  # luma, and red minus luma
_LEVELS = np.arange(256.0)
_LEVEL_SD = 2.5  # assumed standard deviation of a pixel's level; fits rescale it by their residuals
_PATCH = 24  # side in pixels of the patches in which the resolution of chroma is estimated
_COARSE = 0.6  # largest ratio of the changes of red minus luma to the changes of luma at which chroma is coarse
_CHROMA = np.array([0.564, 0.713])  # factors of blue and red minus luma in chroma, ITU-R BT.601
_CLEAR = 0.1  # deviation in pixels up to which an edge is clear in luma
_STEP = 0.3  # largest difference of a clear edge's step of luma from that of its colours, as a fraction of the latter
_AGREES = 0.5  # largest difference in pixels of a position from weak luma from that of the other channels
_ASIDE = 0.25  # standard deviation in pixels of the error that coarse chroma adds to the position of an edge


def coarse_colours(sampler: Sampler, pixels: Points) -> np.ndarray:
    """Whether chroma has a lower resolution than luma near each of the pixels x + i y [n]: bool [n].

    The frame must have at least 24 x 24 pixels. With independent noise in each channel, red minus luma changes 1.4
    times as much between neighbouring pixels as luma. If a codec has halved the resolution of chroma, red minus luma
    changes less within pairs of pixels that share their chroma than between pairs. If the decoder has interpolated
    chroma smoothly, the second differences of red minus luma are smaller than those of luma.
    """
    patches = np.empty((3, len(pixels), _PATCH, _PATCH), dtype=np.float32)
    for n, pixel in enumerate(pixels.tolist()):
        room = (pixel.real, sampler.width - _PATCH), (pixel.imag, sampler.height - _PATCH)
        x, y = (int(min(max(v - _PATCH // 2, 0), most)) for v, most in room)
        patches[:, n] = sampler.patch(x, y, _PATCH)
    both = (_MIXES @ patches.reshape(3, -1)).reshape(2, *patches.shape[1:])
    step = both[..., 1:] - both[..., :-1]
    bent, red = _median(step[..., 1:] - step[..., :-1])
    even, odd, luma = (_median(some) for some in (step[1, ..., ::2], step[1, ..., 1::2], step[0]))
    shared = np.minimum(even, odd) < _COARSE * np.minimum(np.maximum(even, odd), luma)
    return shared | (red < _COARSE * bent)


def _median(values: np.ndarray) -> np.ndarray:
    """Median (the upper one for an even count) of the absolute values over the last two axes."""
    flat = np.abs(values).reshape(*values.shape[:-2], -1)
    middle = flat.shape[-1] // 2
    flat.partition(middle)
    return flat[..., middle]


def fit_luma(
    fit: EdgeFit, light: np.ndarray, shown: np.ndarray, curve: np.ndarray, t: np.ndarray | None = None
) -> tuple[EdgeFit, EdgeFit]:
    """Fit edges to luma, and use its positions where they are more precise than those of all channels.

    An edge between colours of similar luma is hardly visible in luma: a fit to it follows noise, and its deviation is
    too small. There the position is that of all channels, or of chroma alone if the channels disagree.

    Args:
        fit: Fit of all channels to ``light``.
        light: [E, T, U, 3] samples of linear red, green and blue, 0 to 1.
        shown: [E, T, U] weight of each sample, 0 to 1.
        curve: [256] light of each level, increasing.
        t: [T] positions of the samples, as in :func:`fit_edges`.

    Returns:
        First, ``fit`` with position, blur and deviation from luma for edges where luma is more precise, and a larger
        deviation for the other edges. Second, the fit to luma alone, whose steps describe how the light varies across a
        tube even where coarse chroma is smeared, and whose ``told`` is 0 for the other edges.
    """
    rows = shown.sum(1)[..., None]
    low, step = ((value * rows).sum(1) / np.maximum(rows.sum(1), 1e-9) for value in (fit.levels, fit.steps))  # [E, 3]
    mixed = partial(_fit_mixture, light, shown, low, step, curve, float(np.median(fit.blur)), t)
    luma = mixed(np.broadcast_to(_LUMA, low.shape))
    before, after = (np.interp(light, curve, _LEVELS) for light in (low, low + step))
    chroma = mixed(_chroma_direction(after - before))
    # Positions from coarse chroma may be wrong by up to half a chroma pixel, and by more if the channels disagree.
    deviation = np.hypot(fit.apart * fit.deviation, _ASIDE)
    fit = dataclasses.replace(fit, deviation=deviation)
    fit = _replaced(fit, dataclasses.replace(chroma, deviation=np.hypot(chroma.deviation, _ASIDE)))
    size = (luma.steps * rows).sum((1, 2)) / np.maximum(rows.sum((1, 2)), 1e-9)  # of luma's step, over the expected one
    clear = (luma.deviation < _CLEAR) & (np.abs(size - 1) < _STEP)
    # Luma that is not clear has only the value of another look at what the other channels show.
    agrees = np.abs(luma.place - fit.place) < _AGREES
    weak = np.where(agrees, np.hypot(luma.deviation, _ASIDE), np.inf)
    luma = dataclasses.replace(luma, deviation=np.where(clear, luma.deviation, weak))
    better = (luma.deviation < fit.deviation)[:, None, None]
    return _replaced(fit, luma), dataclasses.replace(luma, told=luma.told * better)


def _replaced(fit: EdgeFit, other: EdgeFit) -> EdgeFit:
    """The ``fit`` with position, blur and deviation of the ``other`` for edges where that has the smaller deviation."""
    better = other.deviation < fit.deviation
    names = "place", "deviation", "blur"
    return dataclasses.replace(fit, **{n: np.where(better, getattr(other, n), getattr(fit, n)) for n in names})


def _fit_mixture(
    light: np.ndarray,
    shown: np.ndarray,
    low: np.ndarray,
    step: np.ndarray,
    curve: np.ndarray,
    blur: float,
    t: np.ndarray | None,
    shares: np.ndarray,
) -> EdgeFit:
    """Fit of edges to a sum of the channels' levels with ``shares`` [E, 3], such as luma.

    Blur acts on linear light, and the sum is of gamma-encoded levels, so that the profile of a blurred edge is not an
    error function. It is computed from the light ``low`` [E, 3] before the edge and its ``step`` [E, 3], which chroma
    subsampling does not change. Its fitted steps are relative to this profile. Other arguments as in :func:`fit_luma`.
    """
    steep = np.gradient(_LEVELS) / np.gradient(
        curve.astype(np.float64)
    )  # derivative of the level with respect to light

    def shape(t: np.ndarray, place: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        rise, *slopes = np.moveaxis(normal_step(t, place, sigma)[..., None], 1, 0)  # [E, T, 1] each
        here = low[:, None] + step[:, None] * rise  # [E, T, 3]
        each = (np.interp(here, curve, steep) * (step * shares)[:, None]).sum(-1)
        value = (np.interp(here, curve, _LEVELS) * shares[:, None]).sum(-1)
        return np.stack([value, *(each * slope[..., 0] for slope in slopes)], 1)

    mixture = (np.interp(light, curve, _LEVELS) * shares[:, None, None]).sum(-1, keepdims=True)
    power = np.maximum((shares * shares).sum(-1), 1e-9)[:, None, None, None]
    return fit_edges(mixture, shown[..., None] / (_LEVEL_SD**2 * power), blur, shape, t)


def _chroma_direction(change: np.ndarray) -> np.ndarray:
    """Shares [E, 3] of the channels in the chroma that ``change`` [E, 3] of their levels changes most; unit vectors."""
    axes = np.eye(3)[[2, 0]] - _LUMA  # blue and red minus luma, of which codecs store multiples
    axes *= _CHROMA[:, None]
    shares = change @ axes.T @ axes
    return shares / np.maximum(np.sqrt((shares * shares).sum(-1, keepdims=True)), 1e-9)
