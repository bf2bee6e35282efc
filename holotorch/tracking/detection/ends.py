"""Test whether the tube extends beyond the bands as a pose says, or as the pose with reversed bands would."""

from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.resection import LinePose


@dataclass(frozen=True)
class EndCheck:
    """Parameters of the search for the tube beyond its bands.

    On the 70 correct and 63 reversed poses of ``trials.conditions``, ``trials.occlusions`` and 30 random poses, the
    share of stations that show a tube was at least 0.82 with a tube and at most 0.23 without one.
    """

    stations: int = 40  # stations along a part of the tube
    fewest: int = 8  # least number of stations on the frame for a part to be evaluated
    margin: float = 4e-3  # metres left out at each end of a part, for the error of the tip and its taper
    shown: float = 0.6  # share of stations at and above which a part shows a tube
    missing: float = 0.4  # share of stations up to which a part shows no tube
    contrast: float = 4.0  # least difference of the tube from both of its sides, in 8-bit levels


_INSIDE = np.array([-0.3, -0.15, 0.0, 0.15, 0.3])  # rows on the tube, in widths from the axis
_BESIDE = np.array([0.9, 1.2, 1.5, 1.8])
_ACROSS = np.concatenate([-_BESIDE[::-1], _INSIDE, _BESIDE])
_SIZES = len(_BESIDE), len(_INSIDE), len(_BESIDE)
_MEANS = np.repeat(
    np.eye(3, dtype=np.float32) / (3 * np.array(_SIZES, dtype=np.float32)[:, None]), 3 * np.array(_SIZES), axis=1
)


def shows_reversed(
    sampler: Sampler, lens: Lens, found: LinePose, catheter: Catheter, check: EndCheck | None = None
) -> bool:
    """Whether the tube is visible where only the reversed bands would put it, and missing where the pose puts it.

    This happens on a frame with exchanged red and blue if the exchange reverses the order of the bands' colours. The
    reversed catheter lies on the same line, but has other lengths of tube beyond its bands. Both signs are required,
    because a hand may hide the rear, and another object may lie in line with the tip. The result is False if the tube
    is equally long on both sides of the bands, or if these parts are outside the frame.
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
    if beyond is None or beyond < check.shown:  # the usual case
        return False
    due = _share(sampler, lens, found, catheter.radius, behind, check)
    return due is not None and due <= check.missing


def _share(
    sampler: Sampler, lens: Lens, found: LinePose, radius: float, part: tuple[float, float], check: EndCheck
) -> float | None:
    """Share of the stations along ``part``, in metres from the tip, at which an object of the tube's width is visible.

    None if fewer than ``check.fewest`` lie on the frame.
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
    if (count := int(inside.sum())) < check.fewest:
        return None
    # Mean levels of all three channels over one side, the tube and the other side.
    levels = sampler.nearest(pixels if count == len(pixels) else pixels[inside])
    one, tube, other = _MEANS @ levels.reshape(count, -1).astype(np.float32).T
    brighter, darker = tube - np.maximum(one, other), np.minimum(one, other) - tube
    return max(int((brighter > check.contrast).sum()), int((darker > check.contrast).sum())) / count
