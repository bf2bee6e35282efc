"""Fit of the axis and the width of a straight tube's image, to hundredths of a pixel, with covariance.

A station is a row of samples across the tube, in linear light; S counts stations, K shadings. Samples are weighted by
their inverse variances. The light of the background on both sides of each station is eliminated by variable projection
(Golub and Pereyra 1973).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.special import erf

from holotorch.tracking.detection.fits import BLUNTEST, SHARPEST, median

_STEPS = 8  # largest number of Gauss-Newton steps
_SETTLED = 0.03  # pixels: steps of middle and blur at convergence; the next ones would be a third as large
_WIDENED = 0.15  # pixels: steps of width and taper at convergence; the next ones would be a fifth as large
_FARTHEST = np.array([1.5, 1.5, 1.5, 1.5, 0.5])  # pixels: largest step of middle (2), width (2) and blur
_SLICES = 8  # slices across the tube, each of constant shading
_SHADINGS = (np.ones_like, lambda q: q, lambda q: np.sqrt(1 - q * q), lambda q: q**3)  # of positions -1 to 1
_MEANS = (1.0, 0.0, math.pi / 4, 0.0)  # mean of each shading over the width of the tube
_SHARES = (1e3, 1.0, 1.0, 0.7)  # prior standard deviation of each shading over the band's light; the first one is free


@dataclass(frozen=True, eq=False)
class AxisFit:
    """Fit to the image of a straight tube at stations along it.

    Attributes:
        unknown: [5 + bands K] fitted parameters: middle, its change up to t = reach, width, its change up to t = reach,
            blur, and K shadings of each band; lengths in samples.
        normal: Inverse covariance of ``unknown``, from the noise and the priors.
        reach: Largest distance of a station from t = 0, in samples.
        contrast: Median contrasts of the tube to its two sides, divided by the larger of the two.
        weight: [S] weight of each station; near 0 where the tube is covered.
        moving: Change of the middle in the last step, in samples.
    """

    unknown: np.ndarray
    normal: np.ndarray
    reach: float
    contrast: tuple[float, float]
    weight: np.ndarray
    moving: float

    @property
    def sides(self) -> np.ndarray:
        """[4] offset, slope, width and taper: at t, the middle is offset + slope t, the width is width + taper t."""
        return self.unknown[:4] * self._scale

    @cached_property
    def covariance(self) -> np.ndarray:
        """[4, 4] covariance of ``sides``."""
        covariance = _solved(self.normal, np.eye(len(self.normal), 4))[:4]
        return covariance * self._scale * self._scale[:, None]

    @property
    def _scale(self) -> np.ndarray:
        return np.array([1.0, 1.0 / self.reach, 1.0, 1.0 / self.reach])

    def given(self, width: tuple[float, float], known: float, before: float = math.inf) -> "AxisFit":
        """First-order update of the fit for another prior: ``width`` and taper with relative deviation ``known``.

        ``before`` is the relative deviation of the prior of this fit, which is removed.
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
    """Fit the two straight sides of the tube to all stations at once.

    The model of a station is a blurred box with a free background level on either side. The light of each band is a sum
    of four shadings across the tube: constant, linear, round (Lambert's law), and cubic (a partial shadow). Priors of
    their amplitudes make the covariance include the uncertainty of shadings that the samples do not determine.

    Args:
        light: [S, U] samples across the tube, U odd, of one channel or a linear combination of channels.
        weight: [S, U] inverse variances.
        t: [S] positions of the stations along the tube, in samples.
        band: [S] index of the band of each station, from 0.
        level: [bands] light of each band, in the units of ``light``.
        bright: [bands] ``level`` if channels are combined with absolute weights; it scales the priors of the shadings.
        width: Expected width of the tube at t = 0 in samples, and its taper per sample.
        blur: Initial standard deviation of the blur, in samples.
        known: Relative standard deviation of the expected width and taper; a smaller one gives a more precise middle.
        start: ``unknown`` of an earlier fit to the same stations, as initial values except for width and taper.
    """
    light, weight = light.astype(np.float64), weight.astype(np.float64)[..., None]
    stations, count, bands, kinds = *light.shape, len(level), len(_SHADINGS)
    u = np.arange(count) - (count - 1) / 2
    reach = max(1.0, float(np.abs(t).max()))
    member = (band[:, None] == np.arange(bands)).astype(np.float64)
    parts = _station_parts(t / reach, member)
    flat = parts[:, :-1, :-1].reshape(stations * (3 + kinds), -1)
    expected, unknown, prior = _expectation(level, bright, (width[0], width[1] * reach), blur, known)
    if start is not None:
        unknown[:2], unknown[4:] = start[:2], start[4:]
    moving, station, noise, normal, beside = 0.0, np.ones(stations), 1.0, prior, prior
    for k in range(_STEPS):
        seen = (flat @ unknown).reshape(stations, -1)
        half = np.maximum(seen[:, 1], 1.0) / 2
        columns, slopes_of = _strip_terms(u, seen[:, 0], half, float(seen[0, 2]))
        levels = seen[:, 1:]
        outer, inner = columns[..., :2], columns[..., 2:]
        design = np.empty((stations, count, 4 + kinds))  # derivatives, shadings, and residuals without background
        design[..., 3:-1] = inner
        design[..., -1] = light - (inner @ levels[:, 2:, None])[..., 0]
        # Project out the background levels of each station.
        weighted = (outer * weight).swapaxes(1, 2)
        inverse = _inverse(weighted @ outer)
        levels[:, :2] = beside = (inverse @ (weighted @ design[..., -1:]))[..., 0]
        slopes_of(levels, design)
        both = weighted @ design
        gram = (design * weight).swapaxes(1, 2) @ design - both.swapaxes(1, 2) @ (inverse @ both)
        if k:
            chi = gram[:, -1, -1] / count
            typical = max(median(chi), 1e-12)
            noise = math.sqrt(typical * count / max(1, count - 3))
            station = np.maximum(chi / (4 * typical), 1.0) ** -2
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
    contrast = _contrasts(member @ (unknown[5:].reshape(bands, kinds) @ np.array(_MEANS)), beside)
    return AxisFit(unknown, normal / max(noise, 0.5) ** 2, reach, contrast, station, moving)


def _contrasts(tube: np.ndarray, beside: np.ndarray) -> tuple[float, float]:
    """Median contrasts of the tube [S] to the background on both sides [S, 2], divided by the larger one."""
    one, other = median(np.abs(tube - beside[:, 0])), median(np.abs(tube - beside[:, 1]))
    most = max(one, other, 1e-300)
    return one / most, other / most


def _station_parts(share: np.ndarray, member: np.ndarray) -> np.ndarray:
    """[S, 4 + K, 6 + bands K]: the parameters of each station as linear functions of ``AxisFit.unknown``.

    The parameters of a station are middle, width, blur and K shadings. The last row and column stand for the residual
    light. ``share`` [S] are positions t / reach, and ``member`` [S, bands] is 1 where a station lies on a band, else 0.
    """
    kinds = len(_SHADINGS)
    parts = np.zeros((len(share), 4 + kinds, 6 + member.shape[1] * kinds))
    parts[:, 0, 0] = parts[:, 1, 2] = parts[:, 2, 4] = parts[:, -1, -1] = 1
    parts[:, 0, 1] = parts[:, 1, 3] = share
    for kind in range(kinds):
        parts[:, 3 + kind, 5 + kind : -1 : kinds] = member
    return parts


def _expectation(
    level: np.ndarray, bright: np.ndarray, width: tuple[float, float], blur: float, known: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Expected values, initial values, and inverse prior variances of ``AxisFit.unknown``: [5 + bands K] each.

    ``width`` is the expected width at t = 0 and its change up to t = reach, of relative deviation ``known``.
    """
    expected = np.zeros(5 + len(level) * len(_SHADINGS))
    expected[2:5] = *width, blur
    unknown = expected.copy()
    unknown[5 :: len(_SHADINGS)] = level
    shares = np.maximum(bright, 1e-9)[:, None] * np.array(_SHARES)
    prior = np.concatenate([[0.0, 0.0, *2 * [(known * width[0]) ** -2], 0.0], shares.ravel() ** -2.0])
    return expected, unknown, prior


def _solved(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solution for a positive definite matrix [N, N] and right sides [N] or [N, K]; NaN if it is not definite.

    For such small matrices NumPy's solver takes several times as long as OpenCV's Cholesky solver. OpenCV fails for
    pivots below 2e-16; in 3000 fits to frames of all conditions no pivot was below 1e-3.
    """
    solved, solution = cv2.solve(normal, right.reshape(len(right), -1), flags=cv2.DECOMP_CHOLESKY)
    return solution.reshape(right.shape) if solved else np.full_like(right, np.nan)


def _inverse(normal: np.ndarray) -> np.ndarray:
    """Inverses of matrices [S, 2, 2] that are positive definite up to rounding."""
    inverse = []
    for (a, b), (_, d) in normal.tolist():
        a, d = a * (1 + 1e-9) + 1e-300, d * (1 + 1e-9) + 1e-300
        whole = max(a * d - b * b, 1e-300)
        inverse.append((d / whole, -b / whole, -b / whole, a / whole))
    return np.array(inverse).reshape(-1, 2, 2)


def _slices() -> tuple[np.ndarray, np.ndarray]:
    """Nodes [N] across the tube, -1 to 1, and the jumps [N, 2 + K] of the model's columns at these nodes."""
    q = np.linspace(-1, 1, _SLICES + 1)
    middle = (q[1:] + q[:-1]) / 2
    shadings = np.pad(np.stack([f(middle) for f in _SHADINGS], -1), ((1, 1), (0, 0)))
    ends = np.zeros((len(q), 2))
    ends[0, 0], ends[-1, 1] = -1, 1
    return q, np.concatenate([ends, np.diff(shadings, axis=0)], -1)


_NODES, _TAKES = _slices()
_HALVES = _TAKES / 2
# Maps the levels of the columns to the derivatives of all jumps by the middle of the tube and by half of its width.
_RISES = -np.stack([_TAKES, _TAKES * _NODES[:, None]], 1).transpose(2, 0, 1).reshape(_TAKES.shape[1], -1)


def _strip_terms(u: np.ndarray, at: np.ndarray, half: np.ndarray, blur: float):
    """Columns of the model [S, U, 2 + K] for tubes with middles ``at`` [S], and a function for their derivatives.

    The columns are the background to the left and to the right, and the K shadings. The function takes the levels
    [S, 2 + K] of the columns and an array [S, U, 3 or more], and writes the derivatives of the model by middle, width
    and blur into the first three entries of the last axis of that array.
    """
    scale = math.sqrt(2) * blur
    z = (u[:, None] - (at[:, None] + half[:, None] * _NODES)[:, None]) / scale  # [S, U, N]
    # A unit jump is (1 + erf z) / 2. The constant 1 / 2 is needed for the background only, since the jumps of a shading
    # add up to 0.
    columns = erf(z) @ _HALVES
    columns[..., :2] += 0.5
    bell = np.exp(-z * z)

    def slopes(levels: np.ndarray, design: np.ndarray) -> None:
        steps = (levels @ _RISES).reshape(len(levels), -1, 2) / (math.sqrt(math.pi) * scale)
        both = bell @ steps
        middle, sides = both[..., 0], both[..., 1]
        design[..., 0] = middle
        np.multiply(sides, 0.5, out=design[..., 1])
        np.subtract((u - at[:, None]) * middle, half[:, None] * sides, out=design[..., 2])
        design[..., 2] /= blur

    return columns, slopes
