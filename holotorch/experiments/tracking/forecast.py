"""How far away a catheter can be found by a camera, before a frame is taken."""

import math
from itertools import pairwise

import torch

from holotorch.tracking import Camera, Catheter, solve_pose
from holotorch.tracking.detection.stations import AxisLimits
from holotorch.tracking.detection.tracker import MOST_SD

_SHORTEST = 22.0  # pixels: least length of a band whose ends are measured apart from each other
# Pixels: deviations of an edge in good light, in full colours and in colours of half the resolution (4:2:0), with which
# the forecast is right on synthetic frames.
_FULL, HALF = 0.024, 0.15
_NEAREST, _FARTHEST, _STEPS = 0.02, 20.0, 700  # metres; steps of 1 %


def range_text(camera: Camera, catheter: Catheter, coarse_colours: bool = False) -> str:
    """Lines with the largest distances at which ``CatheterTracker`` finds the tip, and what limits the first.

    ``coarse_colours``: whether the frames are known to have colours at half the resolution.
    """
    distance, reason = working_range(camera, catheter)
    half, _ = working_range(camera, catheter, HALF)
    focal, shortest = _focal(camera), _shortest(catheter)
    which = "as this file has" if coarse_colours else "as of most webcams and video files"
    return (
        f"Range      the bands may be up to about {distance:.2g} m from the camera (in full view, good light and full "
        f"colours): there the shortest one, {1e3 * shortest:.3g} mm, is {focal * shortest / distance:.0f} px long and "
        f"the tube {2 * focal * catheter.radius / distance:.1f} px wide; beyond, {reason}\n"
        f"           in colours of half the resolution, {which}, up to about {half:.2g} m"
    )


def working_range(camera: Camera, catheter: Catheter, edge_px: float = _FULL) -> tuple[float, str]:
    """The largest distance in metres from the camera to the bands of a catheter that faces it, and what limits it.

    The bands must be some pixels long and wide, as the detection needs them, and their edges must determine the tip as
    closely as the tracker demands, if their standard deviation is ``edge_px`` pixels: by default that in full colours,
    :data:`HALF` in video with half the resolution of colours (4:2:0). Noise and motion shorten it.
    """
    focal, most = _focal(camera), MOST_SD
    limits = [
        (focal * 2 * catheter.radius / AxisLimits.narrowest, f"the tube is narrower than {AxisLimits.narrowest:g} px"),
        (focal * _shortest(catheter) / _SHORTEST, f"the shortest band has less than {_SHORTEST:g} px"),
        (_certain(camera, catheter, most, edge_px), f"the tip is less certain than {1e3 * most:g} mm"),
    ]
    return min(limits)


def _certain(camera: Camera, catheter: Catheter, max_error: float, edge_px: float) -> float:
    """Largest distance in metres up to which edges determine the tip to ``max_error`` metres."""
    positions, matrix = catheter.positions, camera.matrix.detach().double()
    z = torch.logspace(math.log10(_NEAREST), math.log10(_FARTHEST), _STEPS, dtype=torch.float64)
    along = positions - (positions[0] + positions[-1]) / 2
    x = matrix[0, 0] * along / z[:, None] + matrix[0, 2]
    pinhole = Camera(matrix, torch.zeros(5, dtype=torch.float64))
    edges = torch.stack([x, matrix[1, 2].expand_as(x)], -1)
    pose = solve_pose(edges, positions, pinhole, along_px=edge_px, across_px=edge_px)
    certain = pose.tip_sd <= max_error
    return float(z[certain].max()) if bool(certain.any()) else _NEAREST


def _focal(camera: Camera) -> float:
    return float(camera.matrix.detach().diagonal()[:2].min())


def _shortest(catheter: Catheter) -> float:
    return min(b - a for a, b in pairwise(catheter.edges))
