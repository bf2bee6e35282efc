"""Whether the tube shows where a pose puts it, or where the same bands read from the other end would put it."""

from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.lens import Lens
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection.footprint import axis_on_plane
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.resection import Found


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


def shows_reversed(
    sampler: Sampler, lens: Lens, found: Found, catheter: Catheter, check: EndCheck | None = None
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
    beyond, due = (_share(sampler, lens, found, catheter.radius, part, check) for part in (ahead, behind))
    return beyond is not None and due is not None and beyond >= check.shown and due <= check.missing


def _share(
    sampler: Sampler, lens: Lens, found: Found, radius: float, part: tuple[float, float], check: EndCheck
) -> float | None:
    """Share of the stations along ``part``, metres from the tip, at which something shows that is as wide as the tube.

    None where fewer than ``check.fewest`` lie on the frame.
    """
    places = np.linspace(part[0] + check.margin, part[1] - check.margin, check.stations)
    depth = found.tip[2] + places * found.direction[2]
    places, depth = places[depth > 10 * radius], depth[depth > 10 * radius]
    if len(places) < check.fewest:
        return None
    axis = np.array([axis_on_plane(found, place) for place in places.tolist()])
    along = axis[-1] - axis[0]
    if not abs(along) > 0:
        return None
    across = np.concatenate([-_BESIDE[::-1], _INSIDE, _BESIDE])
    sideways = 1j * along / abs(along) * (2 * radius / depth)
    pixels = lens.distort(axis[:, None] + sideways[:, None] * across)
    levels = sampler.nearest(pixels).astype(np.float32).mean(-1)[sampler.inside(pixels).all(-1)]
    if len(levels) < check.fewest:
        return None
    count = len(_BESIDE)
    sides = np.stack([levels[:, :count].mean(-1), levels[:, -count:].mean(-1)])
    tube = levels[:, count:-count].mean(-1)
    brighter, darker = tube - sides.max(0), sides.min(0) - tube
    return float(max((brighter > check.contrast).mean(), (darker > check.contrast).mean()))
