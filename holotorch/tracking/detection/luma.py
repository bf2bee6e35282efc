"""Edges in the luma of frames that a codec has taken the colours' resolution from: 4:2:0 video, JPEG, webcams.

Codecs keep each pixel's luma, a sum of gamma's levels, but one colour for two or four pixels, often half a pixel aside.
What all channels say of an edge is then off by up to a pixel; its luma still shows where it is.
"""

import dataclasses

import numpy as np

from holotorch.tracking.camera.numpy_lens import Points
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection.fits import EdgeFit, fit_edges, normal_step

_LUMA = np.array([0.299, 0.587, 0.114])  # of red, green and blue levels in luma, ITU-R BT.601
_MIXES = np.stack([_LUMA, np.array([1.0, 0.0, 0.0]) - _LUMA]).astype(np.float32)  # luma, and red less luma
_LEVEL_SD = 2.5  # of a pixel's level; fits correct it by what they leave
_PATCH, _COARSE = 24, 0.6  # pixels, and of luma's change
_ASIDE = 0.25  # pixels: standard deviation of where an edge of coarse colours lies


def coarse_colours(sampler: Sampler, pixels: Points) -> np.ndarray:
    """Whether near pixels x + i y [n] of a frame of at least 24 x 24 colours have fewer pixels than luma: bool [n].

    Noise that is each channel's own changes red less luma 1.3 times as much from pixel to pixel as luma. Where a codec
    has halved the colours' resolution, pixels that share a colour change less than those that do not, or, smoothed,
    all of them bend less.
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
    """Of sizes over the last two axes; of an even number the one above the middle."""
    flat = np.abs(values).reshape(*values.shape[:-2], -1)
    middle = flat.shape[-1] // 2
    flat.partition(middle)
    return flat[..., middle]


def fit_luma(
    fit: EdgeFit, light: np.ndarray, shown: np.ndarray, curve: np.ndarray, t: np.ndarray | None = None
) -> tuple[EdgeFit, EdgeFit]:
    """Places of edges by luma, where it tells them better than all channels did.

    Blur acts on light and luma is a sum of levels: an edge's luma is no error function, but follows from the light on
    both sides, which colours' lost resolution leaves alone.

    Args:
        fit: Of all channels, to ``light``.
        light: [E, T, U, 3] samples, red, green and blue, 0 to 1.
        shown: [E, T, U], how much each sample counts, 0 to 1.
        curve: [256] light of each level, rising.
        t: [T], where the samples lie, as of :func:`fit_edges`.

    Returns:
        ``fit`` with place, blur and deviation, in samples, of luma or, where they are surer, of all channels; the
        deviation of these widened. And the fit of luma alone, whose steps say how light changes across a tube, where
        coarse colours are smeared; it tells nothing of edges that are by all channels.
    """
    rows = shown.sum(1)[..., None]
    low, step = ((value * rows).sum(1) / np.maximum(rows.sum(1), 1e-9) for value in (fit.levels, fit.steps))  # [E, 3]

    levels = np.arange(256.0)
    steep = np.gradient(levels) / np.gradient(curve.astype(np.float64))  # of levels over light

    def shape(t: np.ndarray, place: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        rise, *slopes = np.moveaxis(normal_step(t, place, sigma)[..., None], 1, 0)  # [E, T, 1] each
        here = low[:, None] + step[:, None] * rise  # [E, T, 3]
        each = np.interp(here, curve, steep) * step[:, None] @ _LUMA
        return np.stack([np.interp(here, curve, levels) @ _LUMA, *(each * slope[..., 0] for slope in slopes)], 1)

    luma = np.interp(light, curve, levels) @ _LUMA
    weight = shown[..., None] / (_LEVEL_SD**2 * float(_LUMA @ _LUMA))
    found = fit_edges(luma[..., None], np.broadcast_to(weight, (*shown.shape, 1)), float(np.median(fit.blur)), shape, t)
    # All channels may be off together, too, by half a pixel of the colours' and farther where they are far apart.
    worse = np.hypot(fit.apart * fit.deviation, _ASIDE)
    better = found.deviation < worse
    fit = dataclasses.replace(fit, deviation=worse)
    surer = {
        name: np.where(better, getattr(found, name), getattr(fit, name)) for name in ("place", "deviation", "blur")
    }
    return dataclasses.replace(fit, **surer), dataclasses.replace(found, told=found.told * better[:, None, None])
