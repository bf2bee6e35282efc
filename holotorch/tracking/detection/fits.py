"""Position of an edge between two colours to hundredths of a pixel, with its standard deviation.

The fit works in linear light and weights samples by their inverse variances. The light levels on both sides of an edge,
in each row and channel, are eliminated by variable projection (Golub and Pereyra 1973). A row of samples crosses the
edge; E counts edges, T samples along a row, U rows, C channels, and R = U C.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

_STEPS = 8  # largest number of Gauss-Newton steps
_ENDS = 0.06, 0.16  # steps of position and of blur at convergence, in units of the blur or of one sample if larger
_NEAR = 0.03  # step at convergence, in samples, when the position alone is refined
_SHARED = 1.2  # measured factor on a position's standard deviation, because adjacent samples share pixels
_STRANGE = 1.5  # ratio of the residuals to their white part above which the model is incomplete
_OWN = 1.4  # measured ratio of the scatter between channels, which shading and gloss increase, to that from noise
_OTHER = 4.0  # standard deviations by which the blur of an edge may differ from the common blur
SHARPEST, BLUNTEST = 0.35, 10.0  # least and largest standard deviation of an edge's blur in pixels

# Model of an edge: maps t [T], position [E] and blur [E], in samples, to [E, 3, T]: the profile from 0 to 1, and its
# derivatives by position and by blur.
Shape = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def median(values: np.ndarray) -> float:
    """Median of values [n], n > 0, the upper one for even n. NumPy's median takes ten times as long for few values."""
    return float(np.sort(values)[len(values) // 2])


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Fit of edges [E].

    Attributes:
        place: [E] positions in samples from the middle of the window.
        blur: [E] standard deviations of the blur in samples.
        deviation: [E] standard deviations of ``place`` from the noise; infinite where there is no edge.
        noise: [E] rms of the residuals in units of their expected standard deviation; 1 if the weights are correct.
        steps: [E, U, C] light after the edge minus light before the edge, in each row and channel.
        levels: [E, U, C] light before the edge.
        told: [E, U, C] inverse variance of the position from a step of 1 in each row and channel.
        apart: [E] scatter of the channels' positions relative to that from noise; at least 1, equal for all edges.
    """

    place: np.ndarray
    blur: np.ndarray
    deviation: np.ndarray
    noise: np.ndarray
    steps: np.ndarray
    levels: np.ndarray
    told: np.ndarray
    apart: np.ndarray

    def or_better(self, other: "EdgeFit") -> "EdgeFit":
        """For each edge, this fit or the other one, whichever has the smaller deviation."""
        better = other.deviation < self.deviation
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return EdgeFit(*(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in pairs))


def normal_step(t: np.ndarray, place: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Step from 0 to 1 at ``place`` [E], blurred by ``sigma`` [E], at t [T]; a :data:`Shape`."""
    z = (t - place[:, None]) / sigma[:, None]
    values = np.empty((len(z), 3, len(t)))
    values[:, 0] = ndtr(z)
    values[:, 1] = np.exp(-0.5 * z * z) / (-math.sqrt(2 * math.pi) * sigma[:, None])
    np.multiply(values[:, 1], z, out=values[:, 2])
    return values


def fit_edges(
    light: np.ndarray,
    weight: np.ndarray,
    blur: float = 0.9,
    shape: Shape = normal_step,
    t: np.ndarray | None = None,
) -> EdgeFit:
    """Fit a position to each edge and one blur to all, with separate light levels in each row and channel.

    Args:
        light: [E, T, U, C] samples of E edges at T positions in U rows and C channels; T odd, the edge near the middle.
        weight: [E, T, U, C] inverse variances; 0 excludes a sample.
        blur: Initial standard deviation of the blur in samples.
        shape: Model of an edge, by default a blurred step.
        t: [T] positions of the samples, increasing and symmetric about 0; by default with a spacing of 1.
    """
    rows, flat = light.shape[2:], (*light.shape[:2], -1)  # [E, T, U C]
    light, weight = (np.ascontiguousarray(given, dtype=np.float64).reshape(flat) for given in (light, weight))
    t = np.arange(light.shape[1]) - (light.shape[1] - 1) / 2 if t is None else t
    far = float(t[-1])
    total = np.maximum(weight.sum(1), 1e-30)
    mean = (weight * light).sum(1) / total
    centred = light - mean[:, None]
    given = np.concatenate([weight, weight * centred], 2), total
    place, sigma, sure = _each_by_itself(shape, t, blur, given)
    sigma, sure, other = _one_lens(sigma, sure)
    blurs, more = np.array(sigma), 2
    while True:
        terms, settled = _edge_terms(shape(t, np.array(place), blurs), *given), True
        for e, (((pp, _), _), (p, _)) in enumerate(terms.sums):
            move = _within(p / max(pp, 1e-30), -0.5, 0.5)
            place[e] = _within(place[e] + move, -far, far)
            settled = settled and abs(move) < _NEAR
        more -= 1
        if settled or not more:
            break
    left = centred - terms.amplitude[:, None] * (terms.rise[..., None] - terms.middle[:, None])
    noise, strange, free = _left(left, weight)
    deviation = []
    for e, (((pp, pb), _), _) in enumerate(terms.sums):
        some = max(pp, 1e-30)
        variance = 1 / some + pb / some * (pb / some) / max(sure[e], 1e-12)
        good = pp > 0 and math.isfinite(variance) and free[e] > 0 and not other[e]
        doubt = max(strange[e] / _STRANGE, 1) ** 2
        deviation.append(_SHARED * math.sqrt(variance) * max(noise[e], 0.5) * doubt if good else math.inf)
    noise, deviation = np.array(noise), np.array(deviation)
    good = np.isfinite(deviation)
    # Only edges count: elsewhere, for example if one side lies outside the frame, these values are rounding errors.
    apart = _apart(terms.slope[good], terms.own[good], noise[good], rows[-1]) if good.any() else 1.0
    levels = mean - terms.amplitude * terms.middle
    steps, levels, told = (v.reshape(-1, *rows) for v in (terms.amplitude, levels, terms.told))
    return EdgeFit(np.array(place), blurs, apart * deviation, noise, steps, levels, told, np.full(len(place), apart))


# This and the next function use Python numbers: for a few edges, NumPy calls would take several times as long.
def _each_by_itself(
    shape: Shape, t: np.ndarray, blur: float, given: tuple[np.ndarray, np.ndarray]
) -> tuple[list[float], list[float], list[float]]:
    """Position, blur and inverse variance of the blur of each edge, fitted separately.

    ``given`` are the last two arguments of :func:`_edge_terms`.
    """
    count, far = len(given[0]), float(t[-1])
    place, sigma, sure = [0.0] * count, [blur] * count, [0.0] * count
    for _ in range(_STEPS):
        settled = True
        terms = _edge_terms(shape(t, np.array(place), np.array(sigma)), *given)
        for e, (((pp, pb), (_, bb)), (p, b)) in enumerate(terms.sums):
            sure[e] = _within(bb - pb * pb / max(pp, 1e-30), 0.0, 1e12)
            determinant = (1 + 1e-6) * pp * bb - pb * pb
            if determinant > 0:  # 0 if all weights are 0: the edge stays where it is
                along = _within((bb * p - pb * b) / determinant, -1.5, 1.5)
                wider = _within((pp * b - pb * p) / determinant, -1.5, 1.5)
                place[e] = _within(place[e] + along, -far, far)
                sigma[e] = _within(sigma[e] + wider, SHARPEST, BLUNTEST)
                least = max(sigma[e], 1.0)
                settled = settled and abs(along) < _ENDS[0] * least and abs(wider) < _ENDS[1] * least
        if settled:
            break
    return place, sigma, sure


def _one_lens(sigma: list[float], sure: list[float]) -> tuple[list[float], list[float], list[bool]]:
    """Blurs, their inverse variances, and whether the blur of each edge differs significantly from the common blur.

    The lens blurs all edges equally, and edges of similar blur get one common blur. This resolves the correlation of
    position and blur, which is strong for an edge with one dark side, where the noise is small.
    """
    both = list(zip(sigma, sure, strict=True))
    common = max(sum(width * s for width, s in both) / max(sum(sure), 1e-30), 1e-30)
    alike = [abs(width / common - 1) < 0.5 and s > 0 for width, s in both]
    those = [pair for pair, one in zip(both, alike, strict=True) if one]
    together = max(sum(s for _, s in those), 1e-30)
    shared = sum(width * s for width, s in those) / together
    other = [not one and (width - common) ** 2 * s > _OTHER**2 for (width, s), one in zip(both, alike, strict=True)]
    sigma = [shared if one else width for width, one in zip(sigma, alike, strict=True)]
    return sigma, [together if one else s for s, one in zip(sure, alike, strict=True)], other


def _left(left: np.ndarray, weight: np.ndarray) -> tuple[list[float], list[float], list[int]]:
    """Of residuals [E, T, R]: rms in units of the noise, ratio of this rms to its white part, degrees of freedom."""
    bent = left[:, 2:] - 2 * left[:, 1:-1] + left[:, :-2]
    whole = (weight * left * left).sum((1, 2)).tolist()
    rough = (weight[:, 1:-1] * bent * bent).sum((1, 2)).tolist()
    used = weight > 0
    each = used.sum(1)  # [E, R]
    count, levels = each.sum(1).tolist(), np.count_nonzero(each, 1).tolist()
    ends = used[:, :: used.shape[1] - 1].sum((1, 2)).tolist()
    free = [n - 2 * level - 2 for n, level in zip(count, levels, strict=True)]
    noise = [math.sqrt(value / max(n, 1)) for value, n in zip(whole, free, strict=True)]
    # White residuals, estimated from second differences, are noise; smooth residuals are errors of the model.
    white = [math.sqrt(rough[e] / (6 * max(count[e] - ends[e], 1))) for e in range(len(rough))]
    return noise, [value / max(part, 1e-9) for value, part in zip(noise, white, strict=True)], free


class _Terms(NamedTuple):
    """Normal equations of the fit for position p and blur b of edges [E], at given positions and blurs.

    Attributes:
        sums: For each edge, normal matrix ((pp, pb), (pb, bb)) and right side (p, b), summed over rows and channels.
        own, slope: [E, R] pp and p of each row and channel.
        told: [E, R] pp for a step of 1 between known levels.
        amplitude: [E, R] fitted steps.
        middle: [E, R] weighted means of ``rise``.
        rise: [E, T] model of the edge.
    """

    sums: list[tuple[list[list[float]], list[float]]]
    own: np.ndarray
    slope: np.ndarray
    told: np.ndarray
    amplitude: np.ndarray
    middle: np.ndarray
    rise: np.ndarray


def _edge_terms(shape: np.ndarray, weights: np.ndarray, total: np.ndarray) -> _Terms:
    """Normal equations from the model and its derivatives ``shape`` [E, 3, T].

    ``weights`` [E, T, 2 R] holds the weights, then weights times light; ``total`` [E, R] are the weights summed over T.
    """
    rows = total.shape[1]
    # Weighted moments over T of each row and channel, with the levels projected out.
    first = shape @ weights
    first, light = first[..., :rows], first[..., rows:]
    products = (shape[:, :, None] * shape[:, None]).reshape(len(shape), 9, -1)
    raw = (products @ weights[..., :rows]).reshape(len(shape), 3, 3, rows)
    means = first / total[:, None]
    second = raw - first[:, :, None] * means[:, None]
    across, power = second[:, 0, 1:], np.maximum(second[:, 0, 0], 1e-30)
    amplitude = light[:, 0] / power
    each = amplitude[:, None]
    slopes = (light[:, 1:] - across * each) * each
    # The part of the derivatives parallel to the rise is projected out (Kaufman's form).
    normal = second[:, 1:, 1:] - across[:, :, None] * (across / power[:, None])[:, None]
    normal *= (each * each)[:, None]
    sums = list(zip(normal.sum(-1).tolist(), slopes.sum(-1).tolist(), strict=True))
    return _Terms(sums, normal[:, 0, 0], slopes[:, 0], raw[:, 1, 1], amplitude, means[:, 0], shape[:, 0])


def _within(value: float, least: float, most: float) -> float:
    return min(max(value, least), most)


def _apart(slope: np.ndarray, power: np.ndarray, noise: np.ndarray, colours: int) -> float:
    """Ratio of the scatter of an edge's position between channels to that from noise, at least 1.

    Codecs store chroma at half the resolution of luma, often displaced by half a pixel, and blur gamma-encoded levels
    instead of light. The channels then disagree on the positions of all edges to the same degree. ``slope`` and
    ``power`` [E, R] are the right sides and normal matrices of a separate position in each row and channel.
    """
    slope, power = (value.reshape(len(value), -1, colours).sum(1) for value in (slope, power))
    power = np.maximum(power, 1e-30)
    spread = (slope * slope / power).sum(1) - slope.sum(1) ** 2 / power.sum(1)
    excess = (spread / np.maximum(noise, 0.5) ** 2).sum() / ((_SHARED * _OWN) ** 2 * len(slope) * max(1, colours - 1))
    return math.sqrt(max(1.0, excess))
