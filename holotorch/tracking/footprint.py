"""What a pose makes of the catheter on a line of its image: how wide it is there, and how its rings bulge."""

import math

import numpy as np

from holotorch.tracking.resection import Found
from holotorch.tracking.strips import Line


def width_px(found: Found, positions: np.ndarray, radius: float, line: Line) -> tuple[float, float]:
    """Of the tube's image at t = 0 in pixels across the line, and its change per pixel.

    2 r / (z sqrt(1 - n_z^2)) on the plane z = 1, n the unit normal of the plane through axis and camera: what is
    seen aside of the image's middle is seen at a slant.
    """
    ends = found.tip + positions[[0, -1], None] * found.direction
    (t0, t1), _ = line.place(on_plane(ends))
    (x, y, z), (a, b, c) = found.tip.tolist(), found.direction.tolist()
    nx, ny, nz = y * c - z * b, z * a - x * c, x * b - y * a
    slant = math.sqrt(1 + nz * nz / (nx * nx + ny * ny)) if nx or ny else math.inf
    near, far = (2 * radius * line.scale * slant / ends[:, 2]).tolist()
    taper = (far - near) / float(t1 - t0) if t1 != t0 else math.inf
    return near - taper * float(t0), taper


def bulge_px(found: Found, positions: np.ndarray, radius: float, line: Line) -> np.ndarray:
    """How far along the line [N], in pixels, the front of each ring's image lies from that of its centre."""
    toward = float(found.tip @ found.direction) * found.direction - found.tip
    centres = found.tip + positions[:, None] * found.direction
    fronts = centres + (radius / math.sqrt(float(toward @ toward))) * toward
    return line.place(on_plane(fronts))[0] - line.place(on_plane(centres))[0]


def on_plane(points: np.ndarray) -> np.ndarray:
    """Points [N, 3] of space, seen on the plane z = 1 as complex numbers [N]."""
    return (points[:, 0] + 1j * points[:, 1]) / points[:, 2]
