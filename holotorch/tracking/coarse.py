"""Where on a frame a thin straight thing with the bands' colours in a row may lie: a few lines, for a bounded cost."""

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.tracking.bands import order_scores
from holotorch.tracking.colours import ColourTable

_STEP = 2  # every second pixel of every second row
_TILE = 12  # of those, along the side of a tile
_DENSE = 0.35  # share of a tile and those around it that thin things never fill
_MOST = 1 << 17  # coloured pixels that are looked at; of more, every second, third ...
_TILES = 40  # for each colour
_CANDIDATES = 32  # lines whose labels are read,
_LINES = 3  # and that are measured
_ACROSS = 3.0  # coarse pixels beside a line that still count


@dataclass(frozen=True)
class Segment:
    """A line on the frame: two points (x, y) in pixels, where its coloured part begins and ends."""

    start: tuple[float, float]
    end: tuple[float, float]


def find_segments(frame: Tensor, table: ColourTable) -> list[Segment]:
    """The most promising lines on a frame uint8 [3, H, W], best first; empty where nothing thin is coloured."""
    thin = frame[:, ::_STEP, ::_STEP]
    labels = table.labels(thin[0], thin[1], thin[2])
    tiles = _tiles(labels, len(table.colours))
    if tiles is None:
        return []
    lines = _lines(tiles, table)
    if lines is None:
        return []
    return _ranked(labels, *lines, table)


@dataclass(frozen=True)
class _Tiles:
    """Coloured parts of tiles [M]: label, pixels, centre [M, 2] and unit direction [M, 2] in coarse pixels."""

    label: Tensor
    count: Tensor
    centre: Tensor
    along: Tensor


def _tiles(labels: Tensor, colours: int) -> _Tiles | None:
    height, width = labels.shape
    flat = torch.nn.functional.pad(labels.flatten(), (0, -labels.numel() % 8))
    words = flat.view(torch.int64).nonzero()[:, 0]  # eight at once: nearly all are nought
    flat = flat.view(-1, 8).index_select(0, words).flatten()
    lit = flat.nonzero()[:, 0]
    if len(lit) < 8:
        return None
    share = -(-len(lit) // _MOST)
    lit = lit[::share]
    label = flat.index_select(0, lit).int() - 1
    place = (8 * words.index_select(0, lit >> 3) + (lit & 7)).int()
    y, x = place // width, place % width
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    key = (label * rows + y // _TILE) * columns + x // _TILE
    total = colours * rows * columns
    dy, dx = (y % _TILE).float(), (x % _TILE).float()
    sums = torch.zeros(6, total, device=labels.device)
    values = torch.stack([torch.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy])
    sums.index_add_(1, key.long(), values)  # ten times as fast as by 32 bits
    count = sums[0]
    around = torch.nn.functional.avg_pool2d(
        count.view(colours, 1, rows, columns) * share / _TILE**2, 3, stride=1, padding=1
    ).reshape(-1)
    kept = ((count >= max(4, _TILE // (2 * share))) & (around < _DENSE)).nonzero()[:, 0]
    if not len(kept):
        return None
    n, sx, sy, xx, xy, yy = sums[:, kept]
    mx, my = sx / n, sy / n
    vx, vy, c = xx / n - mx * mx, yy / n - my * my, xy / n - mx * my
    root = ((vx - vy).square() / 4 + c * c).sqrt()
    long, short = (vx + vy) / 2 + root, (vx + vy) / 2 - root
    turn = 0.5 * torch.atan2(2 * c, vx - vy)
    worth = (long / (short + 0.3)).clamp(max=20) * n.clamp(max=2 * _TILE)
    chosen = []
    of = kept // (rows * columns)
    for colour in range(colours):
        own = (of == colour).nonzero()[:, 0]
        chosen.append(own[worth[own].topk(min(_TILES, len(own))).indices])
    pick = torch.cat(chosen)
    tile = kept[pick] % (rows * columns)
    centre = torch.stack([mx[pick] + (tile % columns) * _TILE, my[pick] + (tile // columns) * _TILE], -1)
    along = torch.stack([torch.cos(turn[pick]), torch.sin(turn[pick])], -1)
    return _Tiles(of[pick], n[pick], centre, along)


def _lines(tiles: _Tiles, table: ColourTable) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Lines through two tiles of different bands: middle [K, 2], direction [K, 2], beginning and end [K] along it."""
    starts, ends = [], []
    for one, other in itertools.combinations(range(len(table.colours)), 2):
        i, j = (tiles.label == one).nonzero()[:, 0], (tiles.label == other).nonzero()[:, 0]
        pairs = torch.cartesian_prod(i, j)
        starts.append(pairs[:, 0])
        ends.append(pairs[:, 1])
    i, j = torch.cat(starts), torch.cat(ends)
    if not len(i):
        return None
    gap = tiles.centre[j] - tiles.centre[i]
    length = gap.norm(dim=-1)
    along = gap / length.clamp(min=1e-3)[:, None]
    agree = torch.minimum((along * tiles.along[i]).sum(-1).abs(), (along * tiles.along[j]).sum(-1).abs())
    order = (agree * (length > 2)).topk(min(600, len(agree)))
    good = order.indices[order.values > 0.85]
    if not len(good):
        return None
    i, along = i[good], along[good]
    normal = torch.stack([-along[:, 1], along[:, 0]], -1)
    offsets = tiles.centre[None] - tiles.centre[i][:, None]
    across, t = (offsets @ normal[..., None])[..., 0], (offsets @ along[..., None])[..., 0]
    straight = (along @ tiles.along.T).abs() > 0.8
    weight = tiles.count * ((across.abs() < _ACROSS) & straight)
    colours = len(table.colours)
    mine = torch.nn.functional.one_hot(tiles.label, colours).to(weight.dtype)
    each = weight @ mine
    # Colours that are far from the others along the line are somebody else's.
    middle = (weight * t).sum(-1) / weight.sum(-1).clamp(min=1e-6)
    spread = ((weight * (t - middle[:, None]).square()).sum(-1) / weight.sum(-1).clamp(min=1e-6)).sqrt()
    extent = 4 * spread + _TILE
    filled = (each.sum(-1) / extent).clamp(max=3.0)
    smallest = each.sort(-1, descending=True).values[:, : min(2, colours)].amin(-1)
    score = (each.clamp(max=300).sum(-1) + 3 * smallest) * filled
    best = score.topk(min(120, len(score))).indices
    used = (weight[best] > 0).to(torch.float32)
    shared = used @ used.T
    alike = shared > 0.5 * torch.minimum(used.sum(-1)[:, None], used.sum(-1))
    keep: list[int] = []
    for k, row in enumerate(alike.tolist()):
        if not any(row[other] for other in keep):
            keep.append(k)
            if len(keep) == _CANDIDATES:
                break
    chosen = weight[best[keep]]
    mean = chosen @ tiles.centre / chosen.sum(-1, keepdim=True)
    offsets = tiles.centre[None] - mean[:, None]
    moment = (offsets * chosen[..., None]).mT @ offsets
    direction = torch.linalg.eigh(moment).eigenvectors[..., -1]
    t = (offsets @ direction[..., None])[..., 0]
    low = torch.where(chosen > 0, t, torch.inf).amin(-1) - _TILE / 2
    high = torch.where(chosen > 0, t, -torch.inf).amax(-1) + _TILE / 2
    return mean, direction, low, high


def _ranked(
    labels: Tensor, mean: Tensor, along: Tensor, low: Tensor, high: Tensor, table: ColourTable
) -> list[Segment]:
    """The lines on which the bands' order explains most of the labels, best first."""
    height, width = labels.shape
    half = int(0.5 * max(height, width))
    t = torch.arange(-half, half + 1, device=labels.device, dtype=mean.dtype)
    u = torch.tensor([-1.0, 0.0, 1.0, -7.0, 7.0], device=labels.device)
    across = torch.stack([-along[:, 1], along[:, 0]], -1)
    middle, onward, aside = (value.T[..., None, None] for value in (mean, along, across))  # x before y in memory
    x, y = (middle + t[:, None] * onward + u * aside).round().int()  # [K, T, 5] each
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    index = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    found = labels.flatten().index_select(0, index.flatten()).view(index.shape) * inside
    drape = (found[..., 3:4] == found[..., 1:2]) & (found[..., 4:5] == found[..., 1:2])
    score = order_scores(found[..., :3] * ~drape, table)
    order = score.argsort(descending=True)[:_LINES]
    order = order[score[order] > 0]
    starts, ends = mean + low[:, None] * along, mean + high[:, None] * along
    segments = []
    for start, end in zip((_STEP * starts[order]).tolist(), (_STEP * ends[order]).tolist(), strict=True):
        segments.append(Segment((start[0], start[1]), (end[0], end[1])))
    return segments
