"""Tests of a pose beyond its edges: does the tube extend as the pose says, and is what it calls a band one?"""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection.measure import Edges
from holotorch.tracking.detection.stations import Axis
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.resection import LinePose, on_host
from holotorch.tracking.pose.status import Pose


@dataclass(frozen=True)
class EndCheck:
    """Parameters of the search for the tube beyond its bands; a station is a row of samples across the tube.

    On the 70 correct and 63 reversed poses of ``trials.conditions``, ``trials.occlusions`` and 30 random poses, the
    fraction of stations that show a tube was at least 0.82 where there is a tube and at most 0.23 elsewhere.
    """

    stations: int = 40  # number of stations on a part of the axis
    fewest: int = 8  # least number of stations on the frame for a part to be evaluated
    margin: float = 4e-3  # metres excluded at both ends of a part, for the error of the tip and for the tapered tip
    shown: float = 0.6  # least fraction of stations for a part to show a tube
    missing: float = 0.4  # largest fraction of stations for a part to show no tube
    contrast: float = 4.0  # least difference of the tube from both of its sides, in 8-bit levels


@dataclass(frozen=True)
class TipCheck:
    """Parameters of the search for the tube beyond the tip of a pose.

    In six synthetic recordings, four of them through codecs, none of 321 poses had a tube at ``EndCheck.shown`` of the
    stations there; with the edges counted from 5 mm behind the tip, all 57 had.
    """

    clear: float = 1e-3  # metres: distance from the tip, besides ``deviations``
    deviations: float = 3.0  # of the tip along the tube
    length: float = 6e-3  # metres that are searched


@dataclass(frozen=True)
class PartCheck:
    """Parameters of the check of bands that show one of their edges.

    On the tuning seeds 0 to 39 of all conditions of the second world, colours of such bands differ from the catheter's
    by at most 8 degrees in 43 right poses from three edges; in 3 wrong ones (bands in another order), by 27 to 31.
    """

    part: tuple[float, float] = (0.05, 0.35)  # of the band's length, from its visible edge on
    blurs: float = 2.0  # least distance from the edge, in blurs
    samples: int = 12
    fewest: int = 4  # least number of samples on the frame
    angle: float = 15.0  # degrees between colours in linear light, beyond those of the bands that show both edges


_TIP, _PART = TipCheck(), PartCheck()
_INSIDE = np.array([-0.3, -0.15, 0.0, 0.15, 0.3])  # samples on the tube: distance from the axis in widths
_BESIDE = np.array([0.9, 1.2, 1.5, 1.8])  # samples on either side of the tube: the same distance
_ACROSS = np.concatenate([-_BESIDE[::-1], _INSIDE, _BESIDE])
_SIZES = len(_BESIDE), len(_INSIDE), len(_BESIDE)
_MEANS = np.repeat(
    np.eye(3, dtype=np.float32) / (3 * np.array(_SIZES, dtype=np.float32)[:, None]), 3 * np.array(_SIZES), axis=1
)


def shows_reversed(
    sampler: Sampler, lens: Lens, found: LinePose, catheter: Catheter, check: EndCheck | None = None
) -> bool:
    """Whether the tube is visible where only the reversed catheter would be, and missing where the pose predicts it.

    This happens on a frame with exchanged red and blue if the exchange reverses the order of the bands' colours. The
    reversed catheter lies on the same line, but has other lengths of tube beyond its bands. Both conditions are
    required, because a hand may hide the rear, and another object may lie in line with the tip. The result is False if
    the tube is equally long on both sides of the bands, or if these parts are outside the frame.
    """
    check = check or EndCheck()
    reach = catheter.edges[0] + catheter.edges[-1]  # position of the tip of the reversed catheter, in metres
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


def shows_beyond_tip(frame: Tensor, lens: Lens, pose: Pose, catheter: Catheter) -> bool:
    """Whether the tube goes on beyond the tip of a pose, which is then wrong, or another object lies there.

    Edges that are counted from a point behind the tip, or lengths of bands in the reversed order, fit as well as the
    right ones: only the tube's end contradicts them. False, too, where the frame, uint8 [3, H, W], ends.
    """
    line, along = on_host(pose), pose.direction
    if line is None:
        return False
    begin = _TIP.clear + _TIP.deviations * float((along @ pose.covariance[:3, :3] @ along).clamp(min=0).sqrt())
    stations = EndCheck(margin=0.0)
    part = -begin - _TIP.length, -begin
    share = _share(Sampler(frame, lens.light), lens, line, catheter.radius, part, stations)
    return share is not None and share >= stations.shown


def shows_other_colour(
    sampler: Sampler, lens: Lens, axis: Axis, edges: Edges, expected: np.ndarray, catheter: Catheter
) -> bool:
    """Whether a band that shows one of its edges has another colour than the catheter's.

    Bands in another order, of which one is outside or has the colour of the background, may show three edges at the
    right distances: then the bare tube beside them passes for the missing band. ``expected`` [N] are the positions in
    pixels along ``axis`` at which the pose puts all edges.
    """
    colours = lens.light[np.array(catheter.colours)]
    visible = np.isfinite(edges.t)
    whole, parts = [0.0], [0.0]
    for band, colour in enumerate(colours):
        both = bool(visible[band] and visible[band + 1])
        for near, other in ((band, band + 1), (band + 1, band)):
            length = expected[other] - expected[near]
            begin = max(_PART.part[0], _PART.blurs * edges.blur / abs(length))
            if not visible[near] or begin > _PART.part[1]:
                continue
            t = expected[near] + length * np.linspace(begin, _PART.part[1], _PART.samples)
            pixels = axis.line.pixels(lens, t, axis.width / 2 * _INSIDE)
            if (inside := sampler.inside(pixels).all(-1)).sum() < _PART.fewest:
                continue
            light = np.median(sampler(pixels[inside]).reshape(3, -1), 1)
            cosine = light @ colour / max(float(np.linalg.norm(light) * np.linalg.norm(colour)), 1e-9)
            (whole if both else parts).append(math.degrees(math.acos(min(1.0, cosine))))
    return max(parts) > max(whole) + _PART.angle


def _share(
    sampler: Sampler, lens: Lens, found: LinePose, radius: float, part: tuple[float, float], check: EndCheck
) -> float | None:
    """Fraction of the stations along ``part``, in metres from the tip, that show an object of the tube's width.

    None if fewer than ``check.fewest`` stations lie on the frame.
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
    # Mean levels, over all three channels, of one side, the tube and the other side.
    levels = sampler.nearest(pixels if count == len(pixels) else pixels[inside])
    one, tube, other = _MEANS @ levels.reshape(count, -1).astype(np.float32).T
    brighter, darker = tube - np.maximum(one, other), np.minimum(one, other) - tube
    return max(int((brighter > check.contrast).sum()), int((darker > check.contrast).sum())) / count
