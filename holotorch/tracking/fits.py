"""Where an edge lies between two colours, to hundredths of a pixel, with deviations.

In linear light, and what need not be known (levels of each row and channel) is projected out: variable projection
(Golub and Pereyra 1973). Rows and channels weigh by their noise.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch

_STEPS = 8
_ENDS = np.array([[0.06], [0.16]])  # of a blur, or samples, of place and blur: the steps after are a twentieth,
_NEAR = 0.03  # and of places two more follow, the last of them so small
_SHARED = 1.2  # neighbours share pixels: how much larger deviations are than of samples that do not, measured
_STRANGE = 1.5  # what is left, over its white part: above it the model misses something, and averaging does not help
_OWN = 1.4  # of the same: how far apart shading and gloss put the places of channels, in what noise does, measured
_OTHER = 4.0  # standard deviations of an edge's own blur
SHARPEST, BLUNTEST = 0.35, 10.0  # pixels, standard deviation of an edge

_ALONE = 1000  # numbers, and fewer, of which one thread takes the error function

# Of an edge: (t [T], place [E], blur [E]), all in samples, to what it is there and its slopes to both, [E, 3, T].
Shape = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def erf(z: np.ndarray) -> np.ndarray:
    """The error function, which NumPy lacks.

    Of more than some 1,200 numbers torch's is shared out among threads, and where others keep the processor busy the
    wait for these is a thousand times as long as the work.
    """
    if z.size <= _ALONE:
        return torch.erf(torch.from_numpy(z)).numpy()
    parts = torch.from_numpy(np.ascontiguousarray(z)).view(-1).split(_ALONE)
    return torch.cat([torch.erf(part) for part in parts]).numpy().reshape(z.shape)


def rise(z: np.ndarray) -> np.ndarray:
    """The normal distribution's cumulative function, from 0 to 1; to 1e-16, not of itself."""
    return 0.5 + 0.5 * erf(z * math.sqrt(0.5))


def median(values: np.ndarray) -> float:
    """Of [n], n > 0; of an even number the one above the middle. NumPy's own is ten times as slow for a few."""
    return float(np.sort(values)[len(values) // 2])


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Of edges [E].

    Attributes:
        place: In samples from the window's middle.
        blur: Standard deviation of the edge in samples.
        deviation: Standard deviation of ``place`` from the noise; infinite where there is no edge.
        noise: Standard deviation of what the fit leaves, over that of the weights: 1 where those are right.
        steps: [E, U, C], light after the edge less light before, of each row and channel.
        levels: [E, U, C], light before.
        told: [E, U, C], what a step of 1 would tell of the place in each row and channel: an inverse variance.
        apart: [E], how much farther apart the channels put edges than noise does; 1 or more, alike for all.
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
        """Of each edge the fit with the smaller deviation."""
        better = other.deviation < self.deviation
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return EdgeFit(*(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in pairs))


def normal_step(t: np.ndarray, place: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """A step from 0 to 1 at ``place`` [E], blurred by ``sigma`` [E], at t [T]; and its slopes to both: [E, 3, T]."""
    z = (t - place[:, None]) / sigma[:, None]
    found = np.empty((len(z), 3, len(t)))
    found[:, 0] = rise(z)
    found[:, 1] = np.exp(-0.5 * z * z) / (-math.sqrt(2 * math.pi) * sigma[:, None])
    np.multiply(found[:, 1], z, out=found[:, 2])
    return found


def fit_edges(
    light: np.ndarray,
    weight: np.ndarray,
    blur: float = 0.9,
    shape: Shape = normal_step,
    t: np.ndarray | None = None,
) -> EdgeFit:
    """Error functions of a place for each edge and one blur, with levels of their own in each row and channel.

    Args:
        light: [E, T, U, C] samples; T odd, the edge near the middle.
        weight: Inverse variances, of the same shape; 0 leaves a sample out.
        blur: To begin with, in samples.
        shape: Of an edge: a step in light, unless something else is told of it.
        t: [T], where the samples lie, rising, as far to one side of the middle as to the other; one apart by itself.
    """
    rows = light.shape[2:]
    light, weight = (given.reshape(*given.shape[:2], -1).astype(np.float64) for given in (light, weight))  # [E, T, U C]
    t = np.arange(light.shape[1]) - (light.shape[1] - 1) / 2 if t is None else t
    far = float(t[-1])
    place, sigma = np.zeros(len(light)), np.full(len(light), blur)
    total = np.maximum(weight.sum(1), 1e-30)
    mean = (weight * light).sum(1) / total
    centred = light - mean[:, None]
    given = weight, weight * centred, total
    sure = place
    for _ in range(_STEPS):
        (pp, pb, bb), (p, b), *_ = _edge_terms(shape(t, place, sigma), *given)
        sure = (bb - pb * pb / np.maximum(pp, 1e-30)).clip(0, 1e12)  # inverse variance of the blur
        # An edge without weight has 0 / 0: it stays where it is, of infinite deviation.
        whole = (1 + 1e-6) * pp * bb - pb * pb
        whole[~(whole > 0)] = np.inf
        step = (np.array([bb * p - pb * b, pp * b - pb * p]) / whole).clip(-1.5, 1.5)
        place, sigma = (place + step[0]).clip(-far, far), (sigma + step[1]).clip(SHARPEST, BLUNTEST)
        if bool((np.abs(step) < _ENDS * np.maximum(sigma, 1.0)).all()):
            break
    # One lens blurs all edges alike. Where one side is dark and so has little noise, place and blur are hard to tell
    # apart, edge by edge; together they are not.
    common = (sure * sigma).sum() / max(sure.sum(), 1e-30)
    alike = (np.abs(sigma / max(common, 1e-30) - 1) < 0.5) & (sure > 0)
    other = ~alike & ((sigma - common) ** 2 * sure > _OTHER**2)  # surely not blurred by that lens
    together = max((sure * alike).sum(), 1e-30)
    sigma = np.where(alike, (sure * alike * sigma).sum() / together, sigma)
    more = 2
    while True:
        (pp, pb, _), (p, _), amplitude, middle, up, own = _edge_terms(shape(t, place, sigma), *given)
        move = (p / np.maximum(pp, 1e-30)).clip(-0.5, 0.5)
        place, more = (place + move).clip(-far, far), more - 1
        if not more or float(np.abs(move).max()) < _NEAR:
            break
    left = centred - amplitude[:, None] * (up[..., None] - middle[:, None])
    used = weight > 0
    free = used.sum((1, 2)) - 2 * used.any(1).sum(1) - 2
    noise = np.sqrt((weight * left * left).sum((1, 2)) / np.maximum(free, 1))
    some = np.maximum(pp, 1e-30)
    variance = 1 / some + (pb / some) ** 2 / np.maximum(np.where(alike, together, sure), 1e-12)
    # What varies from sample to sample is noise; what does not is something else that the edge is mixed with.
    bent = left[:, 2:] - 2 * left[:, 1:-1] + left[:, :-2]
    rough = (weight[:, 1:-1] * bent * bent).sum((1, 2)) / np.maximum(used[:, 1:-1].sum((1, 2)), 1) / 6
    strange = noise / np.maximum(np.sqrt(rough), 1e-9)
    doubt = np.maximum(strange / _STRANGE, 1) ** 2
    good = (pp > 0) & np.isfinite(variance) & (free > 0) & ~other
    deviation = np.where(good, _SHARED * np.sqrt(variance) * np.maximum(noise, 0.5) * doubt, np.inf)
    slope, taken, bell = own
    told = ((bell * bell)[:, None] @ weight)[:, 0]
    # Of an edge that is none, such as one whose other side lies beyond the frame, all of these are rounding.
    every = told[good], amplitude[good], np.maximum(noise[good], 0.5), slope[good], taken[good]
    apart = _apart(*every, rows[-1]) if good.any() else 1.0
    steps, levels, told = (v.reshape(-1, *rows) for v in (amplitude, mean - amplitude * middle, told))
    return EdgeFit(place, sigma, apart * deviation, noise, steps, levels, told, np.full(len(place), apart))


def _apart(
    told: np.ndarray, amplitude: np.ndarray, noise: np.ndarray, slope: np.ndarray, taken: np.ndarray, colours: int
) -> float:
    """How much farther apart the channels put edges than noise does, 1 or more.

    Codecs keep colours at half the resolution of the luma, often half a pixel aside, and blur them in levels instead of
    light. No one place is right for all channels then, and all edges suffer alike.
    """
    power = told * amplitude**2
    power = power - (taken**2).reshape(len(power), 2, -1).sum(1)  # normal matrix for a place of its own in each row
    slope, power = (value.reshape(len(value), -1, colours).sum(1) for value in (slope, power))
    power = np.maximum(power, 1e-30)
    spread = (slope * slope / power).sum(1) - slope.sum(1) ** 2 / power.sum(1)
    return math.sqrt(max(1.0, (spread / noise**2).sum() / ((_SHARED * _OWN) ** 2 * len(slope) * max(1, colours - 1))))


def _edge_terms(shape: np.ndarray, weight: np.ndarray, weighted: np.ndarray, total: np.ndarray):
    """Normal matrix (pp, pb, bb) and slope (p, b) [E] for place and blur, amplitudes and means [E, U C], rise [E, T].

    And what :func:`_apart` needs of the last.

    ``weight`` and ``weighted`` (light times it) are [E, T, U C], their ``total`` over T [E, U C].
    """
    basis = np.empty((len(shape), 6, shape.shape[2]))  # the edge, its slopes, and all three times the edge
    basis[:, :3] = shape
    np.multiply(shape, shape[:, :1], out=basis[:, 3:])
    # Weighted moments over T, for each row and channel.
    moments = basis @ weight
    means, with_light = moments[:, :3] / total[:, None], basis[:, :3] @ weighted
    second = moments[:, 3:] - moments[:, :1] * means
    power = np.maximum(second[:, :1], 1e-30)
    amplitude = with_light[:, :1] / power
    each = (with_light[:, 1:] - second[:, 1:] * amplitude) * amplitude
    slopes = each.sum(-1)
    # What the rise itself, and the levels, explain is taken out of its slopes (Kaufman's form).
    square = (amplitude * amplitude).swapaxes(1, 2)
    raw = (basis[:, 1:3] * (weight @ square).swapaxes(1, 2)) @ basis[:, 1:3].swapaxes(1, 2)
    taken = np.concatenate(
        [moments[:, 1:3] * (amplitude / np.sqrt(total[:, None])), second[:, 1:] * (amplitude / np.sqrt(power))], -1
    )
    normal = raw - taken @ taken.swapaxes(1, 2)
    entries = normal[:, 0, 0], normal[:, 0, 1], normal[:, 1, 1]
    return (
        entries,
        (slopes[:, 0], slopes[:, 1]),
        amplitude[:, 0],
        means[:, 0],
        shape[:, 0],
        (each[:, 0], taken[:, 0], shape[:, 1]),
    )
