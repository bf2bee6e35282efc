"""Where the middle of a straight tube lies and how wide it is, to hundredths of a pixel, with deviations.

In linear light, with the levels beside the tube projected out, station by station: variable projection (Golub and
Pereyra 1973). Samples weigh by their noise.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.special import erf

from holotorch.tracking.detection.fits import BLUNTEST, SHARPEST, median

_STEPS = 8
_SETTLED = 0.03  # pixels, of middle and blur: the step after is a third of it; gloss and shadow move a middle by more
_WIDENED = 0.15  # pixels, of width and taper: the step after is a fifth of it, and moves the middle by next to nothing
_FARTHEST = np.array([1.5, 1.5, 1.5, 1.5, 0.5])  # pixels in one step, of middle and width at both, and of blur
_SLICES = 8
_SHADINGS = (np.ones_like, lambda q: q, lambda q: np.sqrt(1 - q * q), lambda q: q**3)
_MEANS = (1.0, 0.0, math.pi / 4, 0.0)  # of the shadings over the tube
_SHARES = (1e3, 1.0, 1.0, 0.7)  # of a band's light: what each shading may amount to; the even one is free


@dataclass(frozen=True, eq=False)
class AxisFit:
    """Of a straight tube that is seen at stations along it.

    Attributes:
        unknown: What was found: middle and width (each at t = 0 and what ``reach`` adds to it), blur, and shadings.
        normal: Its inverse covariance, from the noise and from what is not known of the shading.
        reach: Of the stations from t = 0, in samples.
        contrast: Light of the tube less that on either side, over the larger of the two; medians.
        weight: [S], how much each station counts; near 0 where something else is seen.
        moving: Pixels by which the middle moved in the last step.
    """

    unknown: np.ndarray
    normal: np.ndarray
    reach: float
    contrast: tuple[float, float]
    weight: np.ndarray
    moving: float

    @property
    def sides(self) -> np.ndarray:
        """[4] offset and slope of the middle, width and taper: u = offset + slope t, width + taper t."""
        return self.unknown[:4] * self._scale

    @cached_property
    def covariance(self) -> np.ndarray:
        """[4, 4] of the sides."""
        covariance = _solved(self.normal, np.eye(len(self.normal), 4))[:4]
        return covariance * self._scale * self._scale[:, None]

    @property
    def _scale(self) -> np.ndarray:
        return np.array([1.0, 1.0 / self.reach, 1.0, 1.0 / self.reach])

    def given(self, width: tuple[float, float], known: float, before: float = math.inf) -> "AxisFit":
        """The same where width and taper come to be known, to a share of the width; to first order.

        With ``before`` they were known to that share already, and are no more.
        """
        more, away = np.zeros(len(self.unknown)), np.zeros(len(self.unknown))
        more[2:4] = (known * width[0]) ** -2 - (before * width[0]) ** -2
        away[2:4] = np.array([width[0], width[1] * self.reach]) - self.unknown[2:4]
        normal = self.normal + np.diag(more)
        return replace(self, unknown=self.unknown + _solved(normal, more * away), normal=normal)


def fit_axis(
    light: np.ndarray,
    weight: np.ndarray,
    t: np.ndarray,
    band: np.ndarray,
    level: np.ndarray,
    bright: np.ndarray,
    width: tuple[float, float],
    blur: float,
    known: float = 0.35,
    start: np.ndarray | None = None,
) -> AxisFit:
    """Blurred boxes whose two sides are straight lines along the tube, all stations at once.

    Beside a box each station has two levels of its own; in it each band has a shading: even, and rising across, round
    as Lambert's law gives, and cubic where part of the tube is in shadow. Their sizes are free within what light can
    do (a prior of a share of the band's light), so that where pixels do not tell, the covariance does.

    Args:
        light: [S, U] samples across, U odd; of one channel or a mix.
        weight: Inverse variances of the same shape.
        t: [S] places along, in samples.
        band: [S] which band a station is on, from 0.
        level: [bands] light of each band, as ``light``.
        bright: [bands] the same without the cancelling of channels in a mix, which gloss and shadow need not follow.
        width: Of the tube at t = 0 in samples, and its taper per sample, to begin with.
        blur: Standard deviation to begin with, in samples.
        known: Share of the width to which it and the taper are known beforehand. Shading and width are hard to tell
            apart; whoever knows the width finds the middle better.
        start: ``unknown`` of an earlier fit to the same stations, for all but width and taper.
    """
    light, weight = light.astype(np.float64), weight.astype(np.float64)[..., None]
    stations, count, bands, kinds = *light.shape, len(level), len(_SHADINGS)
    u, reach = np.arange(count) - (count - 1) / 2, max(1.0, float(np.abs(t).max()))
    member = (band[:, None] == np.arange(bands)).astype(np.float64)
    parts = _parts(t / reach, member)
    flat = parts[:, :-1, :-1].reshape(stations * (3 + kinds), -1)
    expected = np.zeros(flat.shape[1])
    expected[2:5] = width[0], width[1] * reach, blur
    unknown = _first(expected, level, start)
    shares = np.maximum(bright, 1e-9)[:, None] * np.array(_SHARES)
    prior = np.concatenate([[0.0, 0.0, *2 * [(known * width[0]) ** -2], 0.0], shares.ravel() ** -2.0])
    moving, station, noise, normal, beside = 0.0, np.ones(stations), 1.0, prior, prior
    for k in range(_STEPS):
        seen = (flat @ unknown).reshape(stations, -1)
        half = np.maximum(seen[:, 1], 1.0) / 2
        columns, slopes_of = _strip_terms(u, seen[:, 0], half, float(seen[0, 2]))
        levels = seen[:, 1:]
        outer, inner = columns[..., :2], columns[..., 2:]
        design = np.empty((stations, count, 4 + kinds))  # slopes, shadings and what is left without levels beside
        design[..., 3:-1] = inner
        design[..., -1] = light - (inner @ levels[:, 2:, None])[..., 0]
        # Levels beside the tube are projected out, station by station.
        weighted = (outer * weight).swapaxes(1, 2)
        inverse = _inverse(weighted @ outer)
        levels[:, :2] = beside = (inverse @ (weighted @ design[..., -1:]))[..., 0]
        slopes_of(levels, design)
        both = weighted @ design
        gram = (design * weight).swapaxes(1, 2) @ design - both.swapaxes(1, 2) @ (inverse @ both)
        if k:
            noise, station = _weighed(gram[:, -1, -1] / count, count)
            gram = gram * station[:, None, None]
        both = flat.T @ (gram[:, :-1] @ parts).reshape(len(flat), -1)
        normal, slope = both[:, :-1], both[:, -1]
        ridge = prior * max(noise, 0.5) ** 2
        both.flat[:: len(ridge) + 2] += ridge + 1e-12 * normal.diagonal()
        if k == _STEPS - 1:
            break
        step = _solved(normal, slope - ridge * (unknown - expected))
        middle, turn, wide, taper, soft = step[:5].tolist()
        step[:5] = np.minimum(np.maximum(step[:5], -_FARTHEST), _FARTHEST)
        unknown += step
        unknown[4] = min(max(unknown[4], SHARPEST), BLUNTEST)
        moving = max(abs(middle), abs(turn))
        if k and max(moving, abs(soft)) < _SETTLED and max(abs(wide), abs(taper)) < _WIDENED:
            break
    tube = member @ (unknown[5:].reshape(bands, kinds) @ np.array(_MEANS))
    one, other = (median(np.abs(tube - side)) for side in beside.T)
    most = max(one, other, 1e-300)
    return AxisFit(unknown, normal / max(noise, 0.5) ** 2, reach, (one / most, other / most), station, moving)


def _weighed(chi: np.ndarray, count: int) -> tuple[float, np.ndarray]:
    """Noise over what was assumed, and the weight [S] of each station: less than 1 where something else is seen.

    ``chi`` [S]: mean weighted square of what is left of a station's ``count`` samples.
    """
    typical = max(median(chi), 1e-12)
    return math.sqrt(typical * count / max(1, count - 3)), np.maximum(chi / (4 * typical), 1.0) ** -2


def _first(expected: np.ndarray, level: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """Unknowns to begin with: what is expected, with the light of each band [bands] or the rest of an earlier fit."""
    unknown = expected.copy()
    if start is None:
        unknown[5 :: len(_SHADINGS)] = level
    else:
        unknown[:2], unknown[4:] = start[:2], start[4:]
    return unknown


def _parts(t: np.ndarray, member: np.ndarray) -> np.ndarray:
    """What each station sees of the unknowns, [S, 4 + K, 6 + bands K], K the number of shadings.

    The unknowns are middle and width (each at t = 0 and what t = 1 adds), blur, and the shadings of each band. A
    station sees middle, width, blur and the K shadings of its band; the last row is for what is left of the light.

    Args:
        t: [S] positions of the stations over the farthest one.
        member: [S, bands] 1 where a station is on a band, else 0.
    """
    (stations, bands), kinds = member.shape, len(_SHADINGS)
    parts = np.zeros((stations, 4 + kinds, 6 + bands * kinds))
    parts[:, 0, 0] = parts[:, 1, 2] = parts[:, 2, 4] = parts[:, -1, -1] = 1
    parts[:, 0, 1] = parts[:, 1, 3] = t
    for kind in range(kinds):
        parts[:, 3 + kind, 5 + kind : -1 : kinds] = member
    return parts


def _solved(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Of a positive matrix [N, N] and right sides [N] or [N, K]; NaN, which whoever asked refuses, where it is not.

    By Cholesky's factors from OpenCV: the call into NumPy's solver takes several times as long as the work. It gives up
    on pivots below 2e-16, where nothing is seen; 3000 fits to frames of all conditions had none below 1e-3.
    """
    known, found = cv2.solve(normal, right.reshape(len(right), -1), flags=cv2.DECOMP_CHOLESKY)
    return found.reshape(right.shape) if known else np.full_like(right, np.nan)


def _inverse(normal: np.ndarray) -> np.ndarray:
    """Of matrices [S, 2, 2], positive but for rounding."""
    inverse = []
    for (a, b), (_, d) in normal.tolist():
        a, d = a * (1 + 1e-9) + 1e-300, d * (1 + 1e-9) + 1e-300
        whole = max(a * d - b * b, 1e-300)
        inverse.append((d / whole, -b / whole, -b / whole, a / whole))
    return np.array(inverse).reshape(-1, 2, 2)


def _slices() -> tuple[np.ndarray, np.ndarray]:
    """Nodes [N] over the tube, -1 to 1, and what columns (left, right, shadings) take of a rise there [N, 2 + K]."""
    q = np.linspace(-1, 1, _SLICES + 1)
    middle = (q[1:] + q[:-1]) / 2
    shadings = np.pad(np.stack([f(middle) for f in _SHADINGS], -1), ((1, 1), (0, 0)))
    ends = np.zeros((len(q), 2))
    ends[0, 0], ends[-1, 1] = -1, 1
    return q, np.concatenate([ends, np.diff(shadings, axis=0)], -1)


_NODES, _TAKES = _slices()
_HALVES = _TAKES / 2
# Of levels of the columns, what a rise at each node adds to the slopes to the middle and, times the node, to the width.
_RISES = -np.stack([_TAKES, _TAKES * _NODES[:, None]], 1).transpose(2, 0, 1).reshape(_TAKES.shape[1], -1)


def _strip_terms(u: np.ndarray, at: np.ndarray, half: np.ndarray, blur: float):
    """Columns [S, U, 2 + K]: light to the left of tubes at [S], to the right, and K shadings of the tube.

    And a function of levels [S, 2 + K], which writes the slopes of the columns' sum to middle, width and blur into the
    first three of [S, U, 3 and more].
    """
    scale = math.sqrt(2) * blur
    z = (u[:, None] - (at[:, None] + half[:, None] * _NODES)[:, None]) / scale  # [S, U, N]
    # A rise is (1 + erf z) / 2; what the tube takes of the 1 cancels.
    columns = erf(z) @ _HALVES
    columns[..., :2] += 0.5
    bell = np.exp(-z * z)

    def slopes(levels: np.ndarray, found: np.ndarray) -> None:
        steps = (levels @ _RISES).reshape(len(levels), -1, 2) / (math.sqrt(math.pi) * scale)
        both = bell @ steps
        middle, sides = both[..., 0], both[..., 1]
        found[..., 0] = middle
        np.multiply(sides, 0.5, out=found[..., 1])
        np.subtract((u - at[:, None]) * middle, half[:, None] * sides, out=found[..., 2])
        found[..., 2] /= blur

    return columns, slopes
