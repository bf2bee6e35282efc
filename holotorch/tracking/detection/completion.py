"""Positions of band edges that colours do not show, from two that they do show and the steps of light beyond them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler


@dataclass(frozen=True)
class CompletionSearch:
    """Parameters of the search over the tilt of the catheter; lengths in pixels unless stated otherwise."""

    steepest: float = 2.5  # largest relative change of depth per metre along the catheter: 60 degrees at 0.35 m
    tilts: int = 201  # evenly spaced tilts, so that an edge moves by less than a pixel from one to the next
    mean: int = 6  # samples on either side of an edge, whose means are compared
    mixed: int = 1  # samples on either side next to an edge that mix both colours
    rows: int = 1  # rows on either side of the axis; a narrow tube shows three rows without its surroundings
    faint: float = 0.1  # step of light that counts as no edge, as a fraction of the smaller known step


_SEARCH = CompletionSearch()


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
