"""Detection of the tube's line in an image of colour labels, and of the bands along this line.

A label is c + 1 for the colour c of a band and 0 for any other colour (:class:`ColourTable`); C counts the colours and
N the edges.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from holotorch.tracking.detection.colours import ColourTable

_SIDE = 6  # pixels on each side of an edge whose colours are checked
_MIXED = 2  # pixels next to an edge that are not checked, because they mix both colours
_MOVED = 11  # the same for a tube that moved along its axis during the exposure
_RIGHT = 0.55  # least fraction of the checked pixels that must have the band's colour
_VOTERS = 300  # largest number of coloured pixels that select a line; the line is then fitted to all coloured pixels


@dataclass(frozen=True, eq=False)
class Stretches:
    """Bands along a line, at positions t in pixels.

    Attributes:
        edges: [N] position t of each edge; NaN for an edge that is not visible.
        cuts: [N] position t at which each edge would divide the colours best, whether it is visible or not.
        shown: For each band, the number of pixels of its colour on the line.
        whole: For each band, its length on the line in pixels.
        doubtful: For each edge, whether its colours would also fit an object in front of the tube.
        flipped: Whether the tip lies towards larger t.
        turned: Whether fewer than three edges are visible in the given direction of the tip, and the bands fit the
            reversed direction better.
    """

    edges: np.ndarray
    cuts: np.ndarray
    shown: tuple[float, ...]
    whole: tuple[float, ...]
    doubtful: tuple[bool, ...]
    flipped: bool
    turned: bool = False

    @property
    def known(self) -> int:
        """Number of visible edges."""
        return int(np.isfinite(self.edges).sum())


def find_axis(labels: np.ndarray, t: np.ndarray, u: np.ndarray, reach: float) -> tuple[float, float] | None:
    """Offset and slope (u = offset + slope t) of the thin coloured object in labels [T, U], or None if there is none.

    ``t`` [T], centred on 0, and ``u`` [U] are evenly spaced positions along and across the strip in pixels; ``reach``
    is the largest slope. Among lines of many offsets and slopes, the line with the most coloured pixels is selected,
    and refined by weighted least squares over the coloured pixels near it.
    """
    along, across = np.divmod(np.flatnonzero(labels), labels.shape[1])
    if len(along) and int(np.bincount(along).max()) >= 0.6 * len(u):  # a colour across most of the strip is not thin
        each = labels == np.arange(1, int(labels.max()) + 1, dtype=np.uint8)[:, None, None]
        thin = np.add.reduce(each.view(np.uint8), -1, dtype=np.uint16, keepdims=True) < 0.6 * len(u)
        along, across = np.divmod(np.flatnonzero((each & thin).any(0)), labels.shape[1])
    least = 20 / float((t[1] - t[0]) * (u[1] - u[0]))
    if len(along) < least:
        return None
    place, offset, end = t[along], u[across], float(t[-1])
    most = min(40, max(1, int(reach * 2 * end / 3)))
    slopes = np.arange(-most, most + 1) * (reach / most)
    low = float(u[0]) - reach * end - 4
    bins = int(2 * (float(u[-1]) - low)) + 8
    some = slice(None, None, -(-len(along) // _VOTERS))
    at = (offset[some] + (0.5 - low) - slopes[:, None] * place[some]).astype(np.intp)
    at += bins * np.arange(len(slopes))[:, None]
    counts = np.bincount(at.ravel(), minlength=bins * len(slopes)).reshape(len(slopes), bins)
    sums = counts.cumsum(-1)  # differences five apart are sums over five neighbouring offsets
    best = int((sums[:, 5:] - sums[:, :-5]).argmax())
    slope, value = float(slopes[best // (bins - 5)]), best % (bins - 5) + 3 + low
    moments = np.empty((5, len(place)))
    moments[0], moments[1], moments[2] = 1.0, place, offset
    np.multiply(moments[1:3], place, out=moments[3:])
    for width in (6.0, 4.0, 3.0, 3.0):
        away = (offset - value - slope * place) / width
        weight = np.maximum(1 - away * away, 0)
        total, mt, mu, tt, tu = (moments @ (weight * weight)).tolist()
        spread = tt - mt * mt / max(total, 1e-9)
        if total < least / 4 or spread < 1:
            return None
        slope = (tu - mt * mu / total) / spread
        value = (mu - slope * mt) / total
    return (value, slope) if abs(slope) < 1.5 * reach else None


def find_stretches(
    labels: np.ndarray,
    drape: np.ndarray,
    through: np.ndarray,
    table: ColourTable,
    middle: float,
    *,
    onward: bool = False,
) -> Stretches | None:
    """Bands along a line; None if they fit in neither direction, or equally well in both.

    Dynamic programming (:func:`_sweep`) finds the best division of the line into "before, band 1, ..., band n, after",
    in both directions. Hidden parts of the line cost little, so that a finger across a band does not divide the band.

    ``labels`` [T, R] are those at T positions in the R central rows of the line, and ``middle`` is the index of t = 0.
    ``drape`` [T] is True where the surroundings have the same colour, so that the labels do not identify a band, and
    ``through`` [T] where the surroundings are visible through a transparent part of the tube. ``onward`` states that
    the tip is known to lie towards smaller t; only this direction is then considered.
    """
    raw = _shares(labels, table)  # [C, T]
    share = raw * ~drape
    sums = _worth(share[None] if onward else np.stack([share, share[:, ::-1]]), table.bands)
    value, cuts = _sweep(sums)
    score = (value[:, -1] - sums[0, :, -1]).tolist()
    flipped = score[-1] > score[0]
    if score[int(flipped)] <= 0 or (not onward and abs(score[0] - score[1]) < _SIDE):
        return None
    at, edges = value.shape[-1] - 1, []
    for total, reached in reversed(cuts):
        # The first position with the best score, if several have it.
        at = int((total[int(flipped), : at + 1] >= reached[int(flipped), at]).argmax())
        edges.append(at)
    ways = (raw[:, ::-1], drape[::-1], through[::-1]) if flipped else (raw, drape, through)
    found = _judged(*ways, edges[::-1], table.bands, flipped, middle)
    if onward and found.known < 3:
        other, _ = _sweep(_reversed(sums))
        found = replace(found, turned=float(other[0, -1] - sums[0, 0, -1]) > score[0])
    return found


def order_scores(labels: np.ndarray, table: ColourTable) -> np.ndarray:
    """Scores [K] in pixels of K lines of labels [K, T, R] in the better direction; 0 for a line without bands.

    A band counts for twice as much as the second best at most: a finger may be longer than all bands together, and next
    to it a few pixels may have the colour of another band.
    """
    sums = _worth(_shares(labels, table).swapaxes(0, 1), table.bands)
    return np.maximum(_balanced(list(sums)), _balanced(_reversed(sums)))


def _balanced(order: Sequence[np.ndarray]) -> np.ndarray:
    """Scores [K] of lines whose cumulative scores [K, T + 1] as pixels of each part are in ``order``."""
    _, cuts = _sweep(order)
    lines, at = np.arange(len(order[0])), np.full(len(order[0]), order[0].shape[-1] - 1)
    ends = []
    for total, reached in reversed(cuts):
        at = (total >= reached[lines, at, None]).argmax(-1)
        ends.insert(0, at)
    more = [band - order[0] for band in order[1:-1]]
    worth = np.stack([own[lines, b] - own[lines, a] for own, a, b in zip(more, ends, ends[1:], strict=False)])
    return np.minimum(worth, 2 * np.maximum(np.sort(worth, 0)[-2], 0)).sum(0)


def _reversed(sums: np.ndarray) -> list[np.ndarray]:
    """Sums for the bands in reversed order, which is equivalent to reversing the line."""
    return [sums[0], *sums[-2:0:-1], sums[-1]]


def _shares(labels: np.ndarray, table: ColourTable) -> np.ndarray:
    """Fraction of the R labels [..., R] that have each of the C colours: float32 [C, ...]."""
    colours = len(table.colours)
    each = np.eye(colours + 1, colours, k=-1, dtype=np.float32) / labels.shape[-1]
    rows = [each.take(labels[..., i], axis=0) for i in range(labels.shape[-1])]
    return np.moveaxis(np.add.reduce(rows), -1, 0)


def _worth(share: np.ndarray, bands: tuple[int, ...]) -> np.ndarray:
    """Cumulative scores [n + 2, K, T + 1] of pixels along K lines, as pixels before, on each of, and after the n bands.

    ``share`` [K, C, T] are the fractions of the colours. The score of a pixel on a band is +1 if it has the band's
    colour, -1 if it has another band's colour and -0.6 if it has neither (a finger, for example). The score of a pixel
    before or after the bands is -0.25 if it has a band's colour, else 0.
    """
    gains, least = _gains(bands, share.shape[1])
    sums = np.zeros((len(least), len(share), share.shape[-1] + 1), dtype=np.float32)
    np.cumsum((gains @ share).swapaxes(0, 1) + least, -1, out=sums[..., 1:])
    return sums


@lru_cache(maxsize=16)
def _gains(bands: tuple[int, ...], colours: int) -> tuple[np.ndarray, np.ndarray]:
    """Scores of a colour minus the score of no colour, [n + 2, C]; and the score of no colour, [n + 2, 1, 1]."""
    gains = np.full((len(bands) + 2, colours), -0.4, dtype=np.float32)
    gains[[0, -1]] = -0.25
    for i, band in enumerate(bands):
        gains[i + 1, band] += 2
    return gains, np.array([0.0] + [-0.6] * len(bands) + [0.0], dtype=np.float32)[:, None, None]


def _sweep(order: Iterable[np.ndarray]) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
    """Dynamic programming over the cuts between parts of a line, whose cumulative scores [K, T + 1] are in ``order``.

    Returns the best score up to each position, and for each cut the scores of its possible positions and their running
    maximum; all are [K, T + 1].
    """
    value, *rest = order
    cuts = []
    for total in rest:
        ahead = value - total
        reached = np.maximum.accumulate(ahead, -1)
        cuts.append((ahead, reached))
        value = total + reached
    return value, cuts


def _judged(
    share: np.ndarray,
    drape: np.ndarray,
    through: np.ndarray,
    cuts: list[int],
    bands: tuple[int, ...],
    flipped: bool,
    middle: float,
) -> Stretches:
    """Bands between the ``cuts`` [N] of a line; an edge is visible if both of its sides have the right colours.

    ``share`` [C, T] are the fractions of the colours; other arguments as in :func:`find_stretches`.
    """
    # Python numbers: for so few edges, NumPy calls would take several times as long.
    count, last = share.shape[1], len(bands)
    sums = _sums(share)
    own = _sums(share * ~through) if through.any() else sums
    same_background = _sums(drape[None])[0]

    def mean(row: np.ndarray, low: int, high: int) -> float:
        low, high = max(0, low), min(count, high)
        return (row.item(high) - row.item(low)) / (high - low) if high > low else 0.0

    def clear(i: int, cut: int, mixed: int, side: int, longest: int) -> bool:
        """Whether ``side`` pixels on both sides of an edge, beyond ``mixed`` pixels, have the right colours."""
        before, after = (cut - mixed - side, cut - mixed), (cut + mixed, cut + mixed + side)
        if i > 0:
            was = sums[bands[i - 1]]
            rest = was if i < last else own[bands[i - 1]]
            if mean(was, *before) <= _RIGHT or mean(rest, *after) >= (_RIGHT if i < last else 1 - _RIGHT):
                return False
        if i < last:
            then = sums[bands[i]]
            rest = then if i else own[bands[0]]
            if mean(then, *after) <= _RIGHT or mean(rest, *before) >= (_RIGHT if i else 1 - _RIGHT):
                return False
        # Beyond an outer edge lies the bare tube: neither the band's colour nor that of any other band.
        if i == 0:
            return all(mean(row, cut - longest // 2, before[1]) < _RIGHT for row in own)
        return i < last or all(mean(row, after[0], cut + longest // 2) < _RIGHT for row in own)

    edges, places, doubtful = [], [], []
    for i, cut in enumerate(cuts):
        length = [cuts[j + 1] - cuts[j] for j in (i - 1, i) if 0 <= j < last]
        # A band on a background of the same colour has length 0 here, but its edge to the next band may be visible.
        shortest = min((value for value in length if value > _MIXED), default=0)
        visible = False
        if _SIDE // 2 < cut < count - _SIDE // 2:
            visible = clear(i, cut, _MIXED, max(1, min(_SIDE, shortest - _MIXED)), max(length))
            if not visible and shortest > 3 * _MOVED:
                visible = clear(i, cut, _MOVED, _SIDE, max(length))
        near = (
            mean(same_background, cut - _MIXED - _SIDE, cut - _MIXED),
            mean(same_background, cut + _MIXED, cut + _MIXED + _SIDE),
        )
        doubtful.append(i in (0, last) or max(near) > 0.25)
        at = cut - 0.5
        places.append((count - 1 - at if flipped else at) - middle)
        edges.append(places[-1] if visible else np.nan)
    spans = list(zip(bands, cuts, cuts[1:], strict=False))
    return Stretches(
        np.array(edges),
        np.array(places),
        tuple(sums[band].item(high) - sums[band].item(low) for band, low, high in spans),
        tuple(float(high - low) for _, low, high in spans),
        tuple(doubtful),
        flipped,
    )


def _sums(values: np.ndarray) -> np.ndarray:
    """Sums [C, T + 1] of the values [C, T] before each position."""
    sums = np.zeros((len(values), values.shape[1] + 1), dtype=np.float32)
    np.cumsum(values, 1, out=sums[:, 1:])
    return sums
