"""Search of a whole frame for lines along thin straight objects in the bands' colours, at a bounded cost.

The search reads every second pixel of every second row; these are the coarse pixels. The frame is divided into square
tiles; a part is the set of pixels of one colour in one tile. M counts parts, K lines.
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from torch import Tensor

from holotorch.tracking.detection.bands import order_scores
from holotorch.tracking.detection.colours import ALIKE, ColourTable
from holotorch.tracking.pose.status import Refusal, Status

_STEP = 2  # distance of coarse pixels, in pixels
_TILE = 12  # side of a tile in coarse pixels
_AWAY = 14  # distance from a pixel to its surroundings, in coarse pixels; over half the width of the widest tube
_PATCH = 5  # side of the square whose median is the colour of the surroundings, in coarse pixels
_DENSE = 0.35  # fraction of a colour in a tile and its neighbours above which the object is not thin
_FEWEST = 6  # least number of coarse pixels of a part
_TILES = 80  # largest number of parts of each colour that are used
_CONTINUED = 480  # score of parts that continue in another colour, as much as that of the most elongated part
_STRAIGHT = 0.95  # least cosine between the direction of parts and that from one to the next
_CANDIDATES = 16  # largest number of lines whose labels are read
_EVERY = 2  # distance of these labels along a line, in coarse pixels
_LINES = 3  # largest number of lines that are returned
_SAME = 8.0  # distance of the ends of a line from another one up to which both are of one object, in pixels
_ACROSS = 3.0  # distance from a line up to which parts belong to the line, in coarse pixels


_Y, _X = np.divmod(np.arange(_TILE**2, dtype=np.float32), _TILE)
_MOMENTS = np.stack([np.ones_like(_X), _X, _Y, _X * _X, _X * _Y, _Y * _Y], -1)  # monomials of a tile's pixels


@dataclass(frozen=True)
class Segment:
    """Two points x + i y on the frame, in pixels, where the coloured part of a line begins and ends."""

    start: complex
    end: complex

    def repeats(self, other: "Segment") -> bool:
        """Whether both ends lie close to the line of the other one."""
        gap = other.end - other.start
        across = [((point - other.start) * gap.conjugate()).imag for point in (self.start, self.end)]
        return max(map(abs, across)) < _SAME * abs(gap)


def find_segments(frame: Tensor, table: ColourTable, *, thin: bool = False) -> list[Segment]:
    """Up to three lines with at least two bands on a frame uint8 [3, H, W], the best one first.

    ``thin`` leaves out all pixels that do not differ from their surroundings on two opposite sides. Cloth and skin may
    have the hue of a band over much of the frame, and then hide the bands' labels among their own.

    Raises:
        Refusal: NO_CATHETER where nothing thin has a band's colour, BANDS_MISSING where no line has two bands in a row.
    """
    labels = _labels(frame, table)
    if thin:
        labels = cv2.bitwise_and(labels, _thin(frame))
    tiles = _tiles(labels, len(table.colours))
    if tiles is None:
        raise Refusal(Status.NO_CATHETER, "nothing thin in the bands' colours")
    lines = _lines(tiles, table)
    found = _ranked(labels, *lines, table) if lines else []
    if not found:
        raise Refusal(Status.BANDS_MISSING, "what is thin and coloured shows no two bands in a row")
    return found


def _labels(frame: Tensor, table: ColourTable) -> np.ndarray:
    """Labels uint8 [h, w] of the coarse pixels; no other step reads the whole frame."""
    rows, aside = frame.movedim(0, -1)[::_STEP], _STEP
    if frame.device.type != "cpu" or rows.stride()[1:] != (3, 1):
        rows, aside = rows[:, ::_STEP].contiguous().cpu(), 1
    # The same as ColourTable.labels, but every second column is dropped after the first step, which is faster.
    packed = cv2.cvtColor(rows.numpy(), cv2.COLOR_RGB2BGR555).view(np.uint16)[..., 0]
    if aside == 2 and packed.shape[1] % 2 == 0:
        # The lower 16 bits of two pixels are the first pixel. This cast is four times as fast as a strided copy.
        return cv2.LUT(packed.view("<u4").astype(np.uint16), table.table)
    return cv2.LUT(np.ascontiguousarray(packed[:, ::aside]), table.table)


def _thin(frame: Tensor) -> np.ndarray:
    """Mask uint8 [h, w], 0 or 255, of the coarse pixels that differ from the surroundings on two opposite sides."""
    planes = np.ascontiguousarray(frame[:, ::_STEP, ::_STEP].cpu().numpy())
    height, width = planes.shape[1:]
    border = (_AWAY, _AWAY, _AWAY, _AWAY)
    medians = [cv2.copyMakeBorder(cv2.medianBlur(p, _PATCH), *border, cv2.BORDER_REPLICATE) for p in planes]

    def differs(down: int, right: int) -> np.ndarray:
        top, left = _AWAY * (1 + down), _AWAY * (1 + right)
        parts = [median[top : top + height, left : left + width] for median in medians]
        red, green, blue = (cv2.absdiff(plane, part) for plane, part in zip(planes, parts, strict=True))
        return cv2.max(cv2.max(red, green), blue)

    thin = np.zeros((height, width), np.uint8)
    # Two directions would do for a lone tube. With four, an object beside it hides it less often.
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        thin = cv2.max(thin, cv2.min(differs(down, right), differs(-down, -right)))
    return cv2.threshold(thin, ALIKE, 255, cv2.THRESH_BINARY)[1]


@dataclass(frozen=True, eq=False)
class _Tiles:
    """Parts [M]: colour index, number of coarse pixels, and centre and unit direction as complex numbers x + i y."""

    label: np.ndarray
    count: np.ndarray
    centre: np.ndarray
    along: np.ndarray


def _tiles(labels: np.ndarray, colours: int) -> _Tiles | None:
    """The most elongated parts of each colour in labels [h, w], or None if there are no parts of thin objects."""
    height, width = labels.shape
    down, aside = -height % _TILE, -width % (2 * _TILE)  # padding to whole tiles and to whole words of eight pixels
    if down or aside:
        labels = cv2.copyMakeBorder(labels, 0, down, 0, aside, cv2.BORDER_CONSTANT, value=0)
    blocks = labels.reshape(-1, _TILE, labels.shape[1])
    # The sums add eight pixels (bytes) at a time; no byte overflows.
    lit = np.add.reduce((blocks != 0).view(np.uint64), 1).view(np.uint8)
    lit = np.add.reduce(lit.reshape(len(lit), -1, _TILE), 2, dtype=np.float32)
    row, column = (lit >= _FEWEST).nonzero()
    tiles = blocks.reshape(len(blocks), _TILE, -1, _TILE)[row, :, column].reshape(-1, _TILE**2)
    each = tiles == np.arange(1, colours + 1, dtype=np.uint8)[:, None, None]  # [colours, tiles, pixels]
    own = np.add.reduce(each.view(np.uint64), 2, keepdims=True).view(np.uint8).sum(2, dtype=np.float32)
    count = np.zeros((*lit.shape, colours), dtype=np.float32)
    count[row, column] = own.T
    around = cv2.blur(count, (3, 3), borderType=cv2.BORDER_CONSTANT).reshape(count.shape)[row, column].T
    label, which = ((own >= _FEWEST) & (around < _DENSE * _TILE**2)).nonzero()
    if not len(label):
        return None
    row, column = row[which], column[which]
    n, sx, sy, xx, xy, yy = (each[label, which].astype(np.float32) @ _MOMENTS).T.astype(np.float64)
    mx, my = sx / n, sy / n
    vx, vy, c = xx / n - mx * mx, yy / n - my * my, xy / n - mx * my
    root = np.sqrt((vx - vy) ** 2 / 4 + c * c)
    long, short = (vx + vy) / 2 + root, (vx + vy) / 2 - root
    worth = np.minimum(long / (short + 0.3), 20) * np.minimum(n, 2 * _TILE)
    centre = mx + column * _TILE + 1j * (my + row * _TILE)
    along = np.exp(0.5j * np.arctan2(2 * c, vx - vy))
    if int(np.bincount(label).max()) > _TILES:
        worth += _CONTINUED * _continued(label, row, column, centre, along)
    pick = np.concatenate([_most(np.where(label == colour, worth, -1.0), _TILES, 0.0) for colour in range(colours)])
    return _Tiles(label[pick], n[pick].astype(np.float32), centre[pick], along[pick])


def _continued(
    label: np.ndarray, row: np.ndarray, column: np.ndarray, centre: np.ndarray, along: np.ndarray
) -> np.ndarray:
    """Whether each part [M] goes on, in its own direction, as a part of another colour, as bands do at their edges."""
    grid = np.full((label.max() + 1, row.max() + 3, column.max() + 3), -1)
    grid[label, row + 1, column + 1] = np.arange(len(label))
    continued = np.zeros(len(label), dtype=bool)
    for down, right, other in itertools.product(range(3), range(3), range(len(grid))):
        near = grid[other, row + down, column + right]
        one = np.flatnonzero((near >= 0) & (label != other))
        gap = centre[near[one]] - centre[one]
        own, others = (np.abs(np.real(gap.conj() * along[some])) for some in (one, near[one]))
        continued[one] |= np.minimum(own, others) > _STRAIGHT * np.abs(gap)
    return continued


def _most(worth: np.ndarray, count: int, least: float) -> np.ndarray:
    """Indices of the ``count`` largest values above ``least``, largest first."""
    if len(worth) > 4 * count:
        some = np.argpartition(-worth, count)[:count]
        some = some[np.argsort(-worth[some], kind="stable")]
    else:
        some = np.argsort(-worth, kind="stable")[:count]
    return some[worth[some] > least]


def _lines(tiles: _Tiles, table: ColourTable) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Lines through two parts of different colours: middle, direction, first and last position along it, [K] each."""
    pairs = []
    for one, other in itertools.combinations(range(len(table.colours)), 2):
        i, j = (tiles.label == one).nonzero()[0], (tiles.label == other).nonzero()[0]
        pairs.append((np.repeat(i, len(j)), np.tile(j, len(i))))
    i, j = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    gap = tiles.centre[j] - tiles.centre[i]
    length = np.abs(gap)
    along = gap / np.maximum(length, 1e-3)
    back = along.conj()
    agree = np.minimum(np.abs((back * tiles.along[i]).real), np.abs((back * tiles.along[j]).real))
    good = _most(agree * (length > 2), 600, 0.85)
    if not len(good):
        return None
    i, back = i[good], back[good]
    offsets = back[:, None] * (
        tiles.centre - tiles.centre[i, None]
    )  # coordinates t + i u of all parts along and across each line
    t = offsets.real
    straight = np.abs((back[:, None] * tiles.along).real) > 0.8
    used = (np.abs(offsets.imag) < _ACROSS) & straight
    weight = np.where(used, tiles.count, 0)
    colours = len(table.colours)
    each = weight @ (tiles.label[:, None] == np.arange(colours)).astype(weight.dtype)
    # Parts that are spread far along a line reduce its score, because they probably belong to other objects.
    whole = np.maximum(weight.sum(-1), 1e-6)
    middle = (weight * t).sum(-1) / whole
    spread = np.sqrt((weight * (t - middle[:, None]) ** 2).sum(-1) / whole)
    filled = np.minimum(each.sum(-1) / (4 * spread + _TILE), 3.0)
    runner_up = np.sort(each, -1)[:, -min(2, colours)]
    score = (np.minimum(each, 300).sum(-1) + 3 * runner_up) * filled
    best = _most(score, 120, -1.0)
    used = used[best].astype(np.float32)
    shared, size = used @ used.T, used.sum(-1)
    alike = shared > 0.5 * np.minimum(size[:, None], size)
    keep: list[int] = []
    taken = np.zeros(len(best), dtype=bool)
    for k, row in enumerate(alike):
        if not taken[k]:
            taken |= row
            keep.append(k)
            if len(keep) == _CANDIDATES:
                break
    chosen = weight[best[keep]]
    mean = chosen @ tiles.centre / chosen.sum(-1)
    offsets = tiles.centre - mean[:, None]
    # The angle of the principal axis of points x + i y is half the angle of the sum of their squares.
    onward = np.exp(0.5j * np.angle((chosen * offsets * offsets).sum(-1)))
    t = (offsets * onward.conj()[:, None]).real
    low = np.where(chosen > 0, t, np.inf).min(-1) - _TILE / 2
    high = np.where(chosen > 0, t, -np.inf).max(-1) + _TILE / 2
    return mean, onward, low, high


def _ranked(
    labels: np.ndarray, mean: np.ndarray, along: np.ndarray, low: np.ndarray, high: np.ndarray, table: ColourTable
) -> list[Segment]:
    """The lines, given as by :func:`_lines`, whose labels agree best with the order of the bands, best first."""
    height, width = labels.shape
    half = int(0.5 * max(height, width))
    places = np.arange(-half, half + 1.0, _EVERY)[:, None] + 1j * np.array([-1.0, 0.0, 1.0, -7.0, 7.0])
    points = mean[:, None, None] + along[:, None, None] * places  # [K, T, 5]
    x, y = np.rint(points.real).astype(np.intp), np.rint(points.imag).astype(np.intp)
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    found = labels.take(y * width + x, mode="clip") * inside
    drape = (found[..., 3:4] == found[..., 1:2]) & (found[..., 4:5] == found[..., 1:2])
    score = order_scores(found[..., :3] * ~drape, table)
    starts, ends = mean + low * along, mean + high * along
    segments: list[Segment] = []
    for k in np.argsort(-score, kind="stable").tolist():
        new = Segment(_STEP * complex(starts[k]), _STEP * complex(ends[k]))
        if score[k] > 0 and len(segments) < _LINES and not any(map(new.repeats, segments)):
            segments.append(new)
    return segments
