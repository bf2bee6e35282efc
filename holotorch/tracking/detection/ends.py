"""Whether the tube shows where a pose puts it, or where the same bands read from the other end would put it."""

from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.lens import Lens
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.resection import LinePose


@dataclass(frozen=True)
class EndCheck:
    """How the tube is looked for beyond its bands.

    On the 70 right poses and 63 reversed ones of ``trials.conditions``, ``trials.occlusions`` and 30 random poses, the
    share of stations that show a tube was 0.82 or more where there is one and 0.23 or less where there is none.
    """

    stations: int = 40  # along a part of the tube
    fewest: int = 8  # of them on the frame, for a part to count
    margin: float = 4e-3  # metres left out at either end of a part: the deviation of a tip, and a tip that tapers
    shown: float = 0.6  # share of stations from which on a part shows a tube
    missing: float = 0.4  # share up to which it shows none
    contrast: float = 4.0  # 8-bit levels by which a tube is brighter, or darker, than both its sides


_INSIDE = np.array([-0.3, -0.15, 0.0, 0.15, 0.3])  # widths from the axis
_BESIDE = np.array([0.9, 1.2, 1.5, 1.8])
_ACROSS = np.concatenate([-_BESIDE[::-1], _INSIDE, _BESIDE])
_SIZES = len(_BESIDE), len(_INSIDE), len(_BESIDE)
_MEANS = np.repeat(
    np.eye(3, dtype=np.float32) / (3 * np.array(_SIZES, dtype=np.float32)[:, None]), 3 * np.array(_SIZES), axis=1
)


def shows_reversed(
    sampler: Sampler, lens: Lens, found: LinePose, catheter: Catheter, check: EndCheck | None = None
) -> bool:
    """Whether the tube goes on beyond the tip, or the rear, of a pose and is missing where the pose says that it is.

    So does a frame whose red and blue are exchanged, where the bands' colours are the same from both ends: read from
    the other end, the catheter lies along the same line, but for the lengths of tube beyond its bands. Both signs are
    needed, so that neither a hand that holds the rear, nor a thing in line with the tip, says it alone. False where the
    tube is as long on both sides of the bands, or these parts leave the frame.
    """
    check = check or EndCheck()
    reach = catheter.edges[0] + catheter.edges[-1]  # where the tip lies if the bands are read from the other end
    short, long = sorted((reach, catheter.length))
    ahead, behind = (reach - catheter.length, 0.0), (reach, catheter.length)
    if reach > catheter.length:
        ahead, behind = (catheter.length, reach), (0.0, reach - catheter.length)
    if long - short < 4 * check.margin:
        return False
    beyond = _share(sampler, lens, found, catheter.radius, ahead, check)
    if beyond is None or beyond < check.shown:  # as on most frames
        return False
    due = _share(sampler, lens, found, catheter.radius, behind, check)
    return due is not None and due <= check.missing


def _share(
    sampler: Sampler, lens: Lens, found: LinePose, radius: float, part: tuple[float, float], check: EndCheck
) -> float | None:
    """Share of the stations along ``part``, metres from the tip, at which something shows that is as wide as the tube.

    None where fewer than ``check.fewest`` lie on the frame.
    """
    begin, end = part[0] + check.margin, part[1] - check.margin
    places = begin + (end - begin) / (check.stations - 1) * np.arange(check.stations)
    depth = found.tip[2] + places * found.direction[2]
    if not depth.min() > 10 * radius:
        places, depth = places[depth > 10 * radius], depth[depth > 10 * radius]
    if len(places) < check.fewest:
        return None
    tip, direction = (complex(x, y) for x, y, _ in (found.tip.tolist(), found.direction.tolist()))
    axis = (tip + places * direction) / depth
    along = axis[-1] - axis[0]
    if not abs(along) > 0:
        return None
    sideways = 1j * along / abs(along) * (2 * radius / depth)
    pixels = lens.distort(axis[:, None] + sideways[:, None] * _ACROSS)
    inside = sampler.inside(pixels[:, [0, -1]]).all(-1)
    if (seen := int(inside.sum())) < check.fewest:
        return None
    # Means over one side, the tube and the other side, of all three colours.
    levels = sampler.nearest(pixels if seen == len(pixels) else pixels[inside])
    one, tube, other = _MEANS @ levels.reshape(seen, -1).astype(np.float32).T
    brighter, darker = tube - np.maximum(one, other), np.minimum(one, other) - tube
    return max(int((brighter > check.contrast).sum()), int((darker > check.contrast).sum())) / seen
