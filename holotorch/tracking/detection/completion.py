"""Edges that colours do not show: their positions from two that they do show, and whether something hides them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.stations import Axis


@dataclass(frozen=True)
class CompletionSearch:
    """Parameters of the search over the tilt of the catheter; lengths in pixels unless stated otherwise."""

    steepest: float = 2.5  # largest relative change of depth per metre along the catheter: 60 degrees at 0.35 m
    tilts: int = 201  # evenly spaced tilts, so that an edge moves by less than a pixel from one to the next
    mean: int = 6  # samples on either side of an edge, whose means are compared
    mixed: int = 1  # samples on either side next to an edge that mix both colours
    rows: int = 1  # rows on either side of the axis; a narrow tube shows three rows without its surroundings
    faint: float = 0.1  # step of light that counts as no edge, as a fraction of the smaller known step


@dataclass(frozen=True)
class CrossingCheck:
    """Parameters of the check that something lies across the tube; lengths in pixels unless stated otherwise."""

    near: int = 4  # distance up to which the tube is hidden on both sides of a position
    slant: int = 12  # distance along the tube at which an inclined object crosses its sides, beyond that on its axis
    beyond: float = 1.0  # distance within which the object ends, as a fraction of the extent of the visible tube
    beside: tuple[float, ...] = (1.0, 2.0, 3.0)  # distances from the blurred side of the tube
    samples: int = 200  # largest number of positions that show the colours beside the visible tube
    new: float = 0.06  # least difference of a new colour from all others, in the root of light
    most: float = 0.6  # least fraction of samples


_SEARCH, _CROSSING = CompletionSearch(), CrossingCheck()


def complete_edges(
    sampler: Sampler, lens: Lens, axis: Line, t: Sequence[float], positions: Sequence[float], search=_SEARCH
) -> np.ndarray | None:
    """Positions [N] in pixels along ``axis`` of all edges, from the two that are finite in ``t`` [N].

    Two edges leave the tilt of a straight catheter free. Of all tilts, the one is selected whose other edges lie on the
    largest steps of light along the axis, whatever their colours: on a background in the colour of a band, the light
    of the tube changes at its edges nevertheless. ``positions`` [N] are those of the edges in metres from the tip.
    None if no tilt puts all edges in order in front of the camera.
    """
    known = [i for i, value in enumerate(t) if math.isfinite(value)]
    (i, j), s = known, np.asarray(positions) - positions[known[0]]
    tilt = np.linspace(-search.steepest, search.steepest, search.tilts)[:, None]
    # t = t_i + h s / (1 + tilt s), where h follows from t_j.
    places = t[i] + (t[j] - t[i]) * (1 + tilt * s[j]) / s[j] * s / (1 + tilt * s)
    places = places[(1 + tilt * s > 0.1).all(1) & (np.diff(places) > 0).all(1)]
    if not len(places):
        return None
    low, high = math.floor(places.min()) - 1, math.ceil(places.max()) + 1
    steps = _steps(sampler, lens, axis, low, high, search)
    other = [k for k in range(len(positions)) if k not in known]
    shown = np.interp(places, np.arange(low, high + 1.0), steps)
    faint = search.faint * max(float(shown[0, known].min()), 1e-6)
    return places[int(np.log(shown[:, other] + faint).sum(1).argmax())]


def _steps(sampler: Sampler, lens: Lens, axis: Line, low: int, high: int, search: CompletionSearch) -> np.ndarray:
    """Difference between the mean lights on both sides of each position from ``low`` to ``high``; 0 off the frame."""
    beside = search.mean + search.mixed
    t, u = np.arange(low - beside, high + beside + 1.0), np.arange(-search.rows, search.rows + 1.0)
    pixels = lens.distort(axis.plane(t[:, None], u))
    light = np.sqrt(sampler(pixels).mean(-1, dtype=np.float64))  # [3, T]; the root makes the noise about equal
    sums = np.cumsum(np.pad(light, ((0, 0), (1, 0))), 1)
    means = (sums[:, search.mean :] - sums[:, : -search.mean]) / search.mean
    gap = search.mean + 2 * search.mixed + 1
    step = np.sqrt(np.square(means[:, gap:] - means[:, :-gap]).sum(0))
    inside = sampler.inside(pixels).all(-1)
    return step * np.convolve(inside, np.ones(2 * beside + 1), "valid").astype(int).__ge__(2 * beside + 1)


def lies_across(
    sampler: Sampler, lens: Lens, axis: Axis, at: float, spans: Sequence[tuple[float, float]], check=_CROSSING
) -> bool:
    """Whether an object hides the tube at the position ``at`` in pixels along the ``axis``.

    Beside the tube such an object has, on both sides, a colour that is not beside the visible tube; ``spans`` are the
    first and last positions of the parts that are surely visible. And on the tube it has the colour that it has beside
    the tube. The object ends on both sides: a background that changes for good at the end of a band is none. There must
    be a span; False if the position is off the frame, or if no span is on it.
    """
    middle = at + np.arange(-check.near, check.near + 1.0)
    if not sampler.inside(lens.distort(axis.line.plane(middle))).all():
        return False
    low, high = min(a for a, _ in spans), max(b for _, b in spans)
    extent, beyond = check.slant + check.near, check.beyond * (high - low)
    t = np.arange(math.floor(min(low, at - beyond)), math.ceil(max(high, at + beyond)) + 1.0)
    side = axis.width_at(t)[:, None] / 2 + 2 * axis.blur + np.array(check.beside)
    u = np.concatenate([-side, np.tile([-0.5, 0.5], (len(t), 1)), side], 1)
    pixels = lens.distort(axis.line.plane(t[:, None], u))
    inside = sampler.inside(pixels).all(-1)
    light = np.sqrt(sampler(pixels).astype(np.float64)).transpose(1, 2, 0)  # [T, 8, 3]; the noise is about equal
    one, tube, other = (part.mean(1) for part in np.split(light, [3, 5], 1))
    known = (inside & np.any([(t >= a) & (t <= b) for a, b in spans], 0)).nonzero()[0]
    known = known[:: 1 + len(known) // check.samples]
    close, window = np.abs(t - at) <= extent, np.ones(len(middle))
    if not len(known):
        return False
    new = np.stack([inside & (_apart(beside, beside[known]) > check.new) for beside in (one, other)])
    if any(np.convolve(each & close, window, "same").max() < check.most * len(window) for each in new):
        return False
    old = [np.convolve(inside & ~close & ~each, window, "same") > len(window) - 0.5 for each in new]
    if not all((each & (t < at)).any() and (each & (t > at)).any() for each in old):
        return False
    hiding = np.concatenate([one[new[0] & close], other[new[1] & close]])
    return float((_apart(tube[np.abs(t - at) <= check.near], hiding) <= check.new).mean()) >= check.most


def _apart(colours: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distance [N] of each of the ``colours`` [N, 3] from the nearest of the ``others`` [M, 3], largest of channels."""
    return np.abs(colours[:, None] - others).max(-1).min(-1)
