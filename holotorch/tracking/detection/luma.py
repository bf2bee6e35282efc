"""Fits of edges and axes in luma and chroma, for frames with subsampled chroma (4:2:0 video, JPEG, webcams).

Codecs store luma (a weighted sum of gamma-encoded levels) for each pixel, but chroma only once per two or four pixels,
often displaced by half a pixel. A fit to all channels is then wrong by up to a pixel; a fit to luma is not, where the
colours on both sides of an edge differ in luma.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np

from holotorch.tracking.camera.numpy_lens import Points
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection.axis_fit import fit_axis
from holotorch.tracking.detection.fits import EdgeFit, fit_edges, normal_step
from holotorch.tracking.detection.stations import (
    Axis,
    Stations,
    best_contrast,
    converged,
    moved,
    tube_and_background,
    variance_of,
)

_LUMA = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue levels in luma, ITU-R BT.601
_LEVELS = np.arange(256.0)
_LEVEL_SD = 2.5  # assumed standard deviation of a pixel's level; fits rescale it by their residuals
_PATCH = 24  # side in pixels of the patches in which the resolution of chroma is estimated
_SHARED = 0.25  # largest ratio of the squared changes of chroma in even columns to those in odd ones, or vice versa
# Largest (second / first differences)^2 of chroma over that of luma, all squared, at which chroma is coarse: of
# horizontal differences, and of both directions. Of 360 synthetic frames without a codec 358 had more.
_SMOOTH = 0.28, 0.33
_CHROMA_AXES = (np.eye(3)[[2, 0]] - _LUMA) * [[0.564], [0.713]]  # chroma from levels, ITU-R BT.601
_CLEAR = 0.1  # deviation in pixels up to which an edge is clear in luma
_STEP = 0.3  # largest difference of a clear edge's step of luma from that of its colours, as a fraction of the latter
_AGREES = 0.5  # largest difference in pixels of a position from weak luma from that of the other channels
_CONTRAST = 20.0  # least difference of a band's luma from that on both sides for which luma determines the axis
_SAME = 1.0, 2.0  # largest distance in pixels of an axis from luma, and of one from chroma, from the previous one
# Standard deviation in pixels by which decoders displace chroma, divided by the factor of the tracker's error floors on
# all deviations of an axis.
_DISPLACED = 0.08
_ASIDE = 0.25  # standard deviation in pixels of the error that coarse chroma adds to the position of an edge


def coarse_colours(sampler: Sampler, pixels: Points) -> bool:
    """Whether chroma has a lower resolution than luma near the pixels x + i y [n].

    The frame must have at least 24 x 24 pixels. If a decoder has repeated halved chroma, chroma changes only between
    pairs of columns. If it has interpolated chroma smoothly, the second differences of chroma are small in relation to
    its first ones, while luma has the sharpness of the lens, and noise.
    """
    patches = np.empty((3, len(pixels), _PATCH, _PATCH), dtype=np.float32)
    for n, pixel in enumerate(pixels.tolist()):
        room = (pixel.real, sampler.width - _PATCH), (pixel.imag, sampler.height - _PATCH)
        x, y = (int(min(max(v - _PATCH // 2, 0), most)) for v, most in room)
        patches[:, n] = sampler.patch(x - x % 2, y, _PATCH)  # all patches begin at even columns
    chroma, luma = (np.tensordot(shares.astype(np.float32), patches, 1) for shares in (_CHROMA_AXES, _LUMA[None]))
    steps = np.square(np.diff(chroma)).reshape(-1, _PATCH - 1).sum(0)
    within, between = float(steps[::2].sum()), float(steps[1::2].sum())
    shared = min(within, between) < _SHARED * max(within, between)
    sharpness = np.array([[_sharpness(values, axis) for axis in (-1, -2)] for values in (chroma, luma)])
    across, both = sharpness[:, 0], sharpness.sum(1)
    return shared or any(
        second**2 * luma_first < most * first**2 * luma_second
        for ((first, second), (luma_first, luma_second)), most in ((across, _SMOOTH[0]), (both, _SMOOTH[1]))
    )


def _sharpness(values: np.ndarray, axis: int) -> tuple[float, float]:
    """Sums of the squares of the first and of the second differences of values along an axis."""
    step = np.diff(values, axis=axis)
    return float(np.square(step).sum()), float(np.square(np.diff(step, axis=axis)).sum())


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


def fit_coarse_axis(
    stations: Stations, axis: Axis, curve: np.ndarray, width: tuple[float, float], known: float
) -> Axis:
    """The ``axis`` from fits to chroma and to luma, which are weighted by their covariances.

    Smeared chroma beside a tube that is lit from one side moves a fit to linear light by half a pixel. Chroma alone
    hardly depends on the light across the tube, so that its fit is precise, but decoders may displace chroma. Luma is
    not displaced; its fit is less precise, and impossible where the tube is as bright as its surroundings.

    Args:
        stations: Samples across the bands.
        axis: Fit of all channels to ``stations``; the result where chroma determines no axis.
        curve: [256] light of each level, increasing.
        width: Expected width at t = 0 in pixels, and taper per pixel.
        known: Relative standard deviation of this width.
    """
    levels = np.interp(stations.light, curve, _LEVELS)  # [3, S, U]
    ends = np.array([[1.0, stations.t.min()], [1.0, stations.t.max()]])

    def fitted(values: np.ndarray, variance: Callable, some: np.ndarray, near: np.ndarray, most: float):
        """Offset, slope and covariance from ``values`` [C, S, U]; None if over ``most`` pixels away from ``near``."""
        band = np.unique(stations.band[some], return_inverse=True)[1]
        given = best_contrast(values[:, some], axis.width, band, stations.samples, variance)
        fit = fit_axis(*given[:2], stations.t[some], band, *given[2:], width, axis.blur, known)
        same = float(np.abs(ends @ (fit.sides[:2] - near)).max()) < most
        return (fit.sides[:2], fit.covariance[:2, :2]) if converged(fit) and same else None

    middle, covariance = axis.fit.sides[:2], axis.fit.covariance[:2, :2]
    chroma, everywhere = np.tensordot(_CHROMA_AXES, levels, 1), np.ones(len(stations.t), dtype=bool)
    middle, covariance = fitted(chroma, _equal, everywhere, middle, _SAME[1]) or (middle, covariance)
    covariance = covariance + np.diag([_DISPLACED**2, 0.0])
    luma = np.tensordot(_LUMA, levels, 1)
    light, some = np.interp(luma, _LEVELS, curve)[None], _stands_out(luma, stations.band, axis.width)
    if some.any() and (other := fitted(light, variance_of, some, middle, _SAME[0])):
        gain = covariance @ np.linalg.inv(covariance + other[1])
        middle, covariance = middle + gain @ (other[0] - middle), covariance - gain @ covariance
    return moved(stations, axis, middle, covariance)


def _equal(levels: np.ndarray) -> np.ndarray:
    return np.full_like(levels, _LEVEL_SD**2)


def _stands_out(luma: np.ndarray, band: np.ndarray, width: float) -> np.ndarray:
    """[S] whether the luma [S, U] of each station's band differs from that on both sides of a tube of ``width``."""
    tube, background = tube_and_background(luma.shape[1], width)
    one = np.arange(luma.shape[1]) < luma.shape[1] // 2
    if not background.any():  # a tube that seems as wide as the samples
        return np.zeros(len(luma), dtype=bool)
    own, left, right = (luma[:, part].mean(1) for part in (tube, background & one, background & ~one))
    member = band[:, None] == band
    differs = [np.abs(member @ (own - side)) / member.sum(1) > _CONTRAST for side in (left, right)]
    return differs[0] & differs[1]


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
    shares = change @ _CHROMA_AXES.T @ _CHROMA_AXES
    return shares / np.maximum(np.sqrt((shares * shares).sum(-1, keepdims=True)), 1e-9)
