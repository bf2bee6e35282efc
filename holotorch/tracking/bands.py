"""Which stretch of a line shows which band: the line found among labels, the bands by the best order of stretches."""

from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.tracking.colours import ColourTable

_SIDE = 6  # pixels beside an edge whose colours must be right,
_MIXED = 2  # but for these next to it
_RIGHT = 0.55  # share of them
_VOTERS = 4096  # of coloured pixels, that choose among lines; all of them say where the chosen one lies


@dataclass(frozen=True)
class Stretches:
    """Bands along a line.

    Attributes:
        edges: Where each edge lies along the line in pixels, [N]; NaN where it is not seen.
        shown: For each band, pixels of its colour.
        whole: For each band, its length on the line.
        doubtful: For each edge, whether what lies beyond it may be something in front of the tube, by its colours.
        flipped: Whether the tip lies towards larger t.
    """

    edges: Tensor
    shown: Tensor
    whole: Tensor
    doubtful: tuple[bool, ...]
    flipped: bool

    @property
    def known(self) -> int:
        """Edges that are seen."""
        return int(torch.isfinite(self.edges).sum())


def find_axis(labels: Tensor, u: Tensor, reach: float) -> tuple[float, float] | None:
    """Offset and slope (u = offset + slope (t - middle)) of the coloured thin thing in labels [T, U], or None.

    ``u`` [U] are places across in pixels; slopes to ``reach`` per pixel. The most coloured of a fan of lines, then
    weighted least squares among what lies on it.
    """
    lit = labels > 0
    if float(lit.float().mean(-1).max()) >= 0.6:  # rows of one colour from side to side are not thin
        each = labels == torch.arange(1, int(labels.max()) + 1, device=labels.device)[:, None, None]
        lit = (each & (each.float().mean(-1, keepdim=True) < 0.6)).any(0)
    t, across = lit.nonzero().unbind(-1)
    if len(t) < 20:
        return None
    middle = (labels.shape[0] - 1) / 2
    place, offset = t.to(torch.float32) - middle, u.to(torch.float32)[across]
    steps = max(3, 2 * int(reach * labels.shape[0] / 3) + 1)
    slopes = torch.linspace(-reach, reach, min(steps, 81), device=labels.device)
    low = float(u[0]) - reach * middle - 4
    bins = int(2 * (float(u[-1]) - low)) + 8
    some = slice(None, None, -(-len(t) // _VOTERS))
    at = (offset[some] - slopes[:, None] * place[some] - low).round().long().clamp(0, bins - 1)
    counts = torch.zeros(len(slopes), bins, device=labels.device)
    counts.scatter_add_(1, at, torch.ones_like(at, dtype=counts.dtype))
    sums = counts.cumsum(-1)  # of five neighbours is the difference of two
    best = int((sums[:, 5:] - sums[:, :-5]).argmax())
    slope, value = float(slopes[best // (bins - 5)]), best % (bins - 5) + 3 + low
    moments = torch.stack([torch.ones_like(place), place, offset, place * place, place * offset])
    for width in (6.0, 4.0, 3.0, 3.0):
        away = offset - value - slope * place
        weight = (1 - (away / width).square()).clamp(min=0).square()
        total, mt, mu, tt, tu = (moments @ weight).tolist()
        spread = tt - mt * mt / max(total, 1e-9)
        if total < 5 or spread < 1:
            return None
        slope = (tu - mt * mu / total) / spread
        value = (mu - slope * mt) / total
    return value, slope


def find_stretches(labels: Tensor, drape: Tensor, table: ColourTable, middle: float) -> Stretches | None:
    """Bands along labels [T, R] of a line's R central rows; ``middle`` is the index where t = 0. None: no order fits.

    Where ``drape`` [T] is true the surroundings are of the same colour, so that labels do not say what is a band.

    Of all ways to cut the line into "before, band 1, ..., band n, after", in both directions, that which most colours
    agree with. Stretches that something hides count little, so that a finger within a band leaves it one band.
    """
    raw = _shares(labels, table)  # [C, T]
    share = raw * ~drape
    value, cuts, nothing = _sweep(torch.stack([share, share.flip(-1)]), table.bands)
    score = (value[:, -1] - nothing[:, -1]).tolist()
    flipped = score[1] > score[0]
    if score[flipped] <= 0:
        return None
    at, edges = value.shape[-1] - 1, []
    for where in reversed(cuts):
        at = int(where[int(flipped), at])
        edges.append(at)
    ways = (raw.flip(-1), drape.flip(-1)) if flipped else (raw, drape)
    return _judged(*ways, edges[::-1], table.bands, flipped, middle)


def order_scores(labels: Tensor, table: ColourTable) -> Tensor:
    """How well the bands in their order explain lines of labels [K, T, R], in either direction: [K], in pixels."""
    share = _shares(labels, table).movedim(0, 1)
    both = torch.cat([share, share.flip(-1)])
    value, _, nothing = _sweep(both, table.bands)
    return (value[:, -1] - nothing[:, -1]).view(2, -1).amax(0)


def _shares(labels: Tensor, table: ColourTable) -> Tensor:
    """Share of the last axis that shows each colour, [C, ...] of labels [..., R]."""
    each = torch.arange(1, len(table.colours) + 1, dtype=labels.dtype, device=labels.device)
    return (labels == each.view(-1, *[1] * labels.ndim)).to(torch.float32).mean(-1)


def _sweep(share: Tensor, bands: tuple[int, ...]) -> tuple[Tensor, list[Tensor], Tensor]:
    """Dynamic programming over the cuts: best value [K, T + 1], where each was cut, and the value of no band at all."""
    # Around the bands anything may lie; within, labels of another band speak against it, none at all less so: fingers.
    gains = torch.full((len(bands) + 2, share.shape[1]), -0.4, device=share.device)
    gains[[0, -1]] = -0.25
    for i, band in enumerate(bands):
        gains[i + 1, band] += 2
    least = torch.tensor([0.0] + [-0.6] * len(bands) + [0.0], device=share.device)
    sums = torch.nn.functional.pad((gains @ share + least[:, None]).cumsum(-1), (1, 0)).transpose(0, 1)
    value, cuts = sums[0], []
    for total in sums[1:]:
        reached, where = (value - total).cummax(-1)
        cuts.append(where)
        value = total + reached
    return value, cuts, sums[0]


def _judged(
    share: Tensor, drape: Tensor, cuts: list[int], bands: tuple[int, ...], flipped: bool, middle: float
) -> Stretches:
    count = share.shape[1]
    sums = torch.nn.functional.pad(share.cumsum(1), (1, 0)).tolist()

    def part(low: int, high: int) -> list[float]:
        low, high = max(0, low), min(count, high)
        return [(row[high] - row[low]) / (high - low) if high > low else 0.0 for row in sums]

    edges, shown, whole, doubtful = [], [], [], []
    drowned = drape.tolist()
    for i, cut in enumerate(cuts):
        length = [cuts[j + 1] - cuts[j] for j in (i - 1, i) if 0 <= j < len(bands)]
        # A band that its surroundings drown has no length; the edge to it may be seen all the same.
        side = max(1, min(_SIDE, min((value for value in length if value > _MIXED), default=0) - _MIXED))
        before, after = part(cut - _MIXED - side, cut - _MIXED), part(cut + _MIXED, cut + _MIXED + side)
        seen = _SIDE // 2 < cut < count - _SIDE // 2
        if i > 0:
            seen &= before[bands[i - 1]] > _RIGHT
            seen &= i == len(bands) or after[bands[i - 1]] < _RIGHT
        if i < len(bands):
            seen &= after[bands[i]] > _RIGHT
            seen &= i == 0 or before[bands[i]] < _RIGHT
        # Beyond an outer edge lies tube, not the same colour and not a band of something else.
        if i == 0:
            seen &= before[bands[0]] < 1 - _RIGHT and max(part(cut - max(length) // 2, cut - _MIXED)) < _RIGHT
        if i == len(bands):
            seen &= after[bands[-1]] < 1 - _RIGHT and max(part(cut + _MIXED, cut + max(length) // 2)) < _RIGHT
        beside = (
            drowned[max(0, cut - _MIXED - _SIDE) : max(0, cut - _MIXED)],
            drowned[cut + _MIXED : cut + _MIXED + _SIDE],
        )
        doubtful.append(i in (0, len(bands)) or any(sum(part) > len(part) / 4 for part in beside))
        at = cut - 0.5
        edges.append((count - 1 - at if flipped else at) - middle if seen else torch.nan)
    for j, band in enumerate(bands):
        low, high = cuts[j], cuts[j + 1]
        shown.append(sums[band][high] - sums[band][low])
        whole.append(float(high - low))
    device = share.device
    return Stretches(
        torch.tensor(edges, dtype=torch.float64, device=device),
        torch.tensor(shown, device=device),
        torch.tensor(whole, device=device),
        tuple(doubtful),
        flipped,
    )
