"""Image of a catheter at a given pose: the width of the tube along its image line, and the bulge of its rings.

A ring is the circle around the tube at a band edge. Only its front is visible. The bulge is the distance of this front
from the image of the ring's centre.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.strips import Line
from holotorch.tracking.detection.fits import SHARPEST
from holotorch.tracking.pose.resection import LinePose

_INTERPOLATED = 1 / 6  # variance in pixels^2 that bilinear interpolation adds to a blur in any direction
_NODES = (np.arange(16) + 0.5) / 8 - 1  # midpoints of 16 slices across a tube, whose sides lie at -1 and 1
_ROUND = np.sqrt(1 - _NODES**2)
_LIT = np.stack([np.ones_like(_NODES), _NODES, _ROUND], -1)  # shapes of a step of light across a tube
_BOTH = np.concatenate([_LIT, _LIT * _ROUND[:, None]], -1)
_RIDGE = 1e-4 * np.eye(_LIT.shape[1])  # regularises the fit of the shapes


def width_px(found: LinePose, positions: Sequence[float], radius: float, line: Line) -> tuple[float, float]:
    """Width of the tube's image at t = 0 in pixels, and its change per pixel along the line.

    On the plane z = 1 the width is 2 r / (z sqrt(1 - n_z^2)), where n is the unit normal of the plane through the axis
    and the camera centre. The root accounts for oblique rays away from the image centre. ``positions`` are those of the
    edges in metres from the tip.
    """
    # Python numbers here and below: for so few rings, NumPy calls would take several times as long.
    (x, y, z), (a, b, c) = found.tip.tolist(), found.direction.tolist()
    nx, ny, nz = y * c - z * b, z * a - x * c, x * b - y * a
    slant = math.sqrt(1 + nz * nz / (nx * nx + ny * ny)) if nx or ny else math.inf
    t0, t1 = (line.along_at(axis_on_plane(found, positions[n])) for n in (0, -1))
    near, far = (2 * radius * line.scale * slant / (z + positions[n] * c or math.nan) for n in (0, -1))
    taper = (far - near) / (t1 - t0) if t1 != t0 else math.inf
    return near - taper * t0, taper


def bulge_px(found: LinePose, positions: Sequence[float], radius: float, line: Line) -> np.ndarray:
    """Distance [N] along the line, in pixels, from the image of each ring's centre to that of its front."""
    (x, y, z), (a, b, c) = found.tip.tolist(), found.direction.tolist()
    onward = x * a + y * b + z * c
    fx, fy, fz = onward * a - x, onward * b - y, onward * c - z
    share = radius / (math.sqrt(fx * fx + fy * fy + fz * fz) or math.nan)
    bulges = []
    for s in positions:
        front = complex(x + s * a + share * fx, y + s * b + share * fy) / (z + s * c + share * fz or math.nan)
        bulges.append(line.along_at(front) - line.along_at(axis_on_plane(found, s)))
    return np.array(bulges)


def axis_on_plane(found: LinePose, position: float) -> complex:
    """Image on the plane z = 1 of the axis point ``position`` metres from the tip; NaN in the plane z = 0."""
    (x, y, z), (a, b, c) = found.tip.tolist(), found.direction.tolist()
    return complex(x + position * a, y + position * b) / (z + position * c or math.nan)


@dataclass(frozen=True, eq=False)
class Front:
    """Bulge of the rings' fronts at edges [E] in rows [U] across the tube, relative to the bulge at the mid-line.

    The blur mixes adjacent rows: the observed bulge is the mean over these rows, weighted by the step of light in each
    row. The steps are modelled as a combination of K shapes across the tube.

    Attributes:
        mean: [E, U] bulge if the step of light is constant across the tube.
        change: [E, U, K] blurred step of each shape.
        bulge: [E, U, K] blurred product of each shape and the bulge.
    """

    mean: np.ndarray
    change: np.ndarray
    bulge: np.ndarray

    @staticmethod
    def of(u: np.ndarray, widths: np.ndarray, blur: float) -> "Front":
        """Bulge in rows ``u`` [U] of tubes of ``widths`` [E], with sides blurred by ``blur`` (sigma); all in pixels."""
        sigma = math.sqrt(max(blur**2 - _INTERPOLATED, SHARPEST**2))
        z = (u[:, None] - widths[:, None, None] / 2 * _NODES) * (math.sqrt(0.5) / sigma)
        both = (np.exp(-z * z) + 1e-30) @ _BOTH
        change, bulge = both[..., : _LIT.shape[1]], both[..., _LIT.shape[1] :]
        return Front(bulge[..., 0] / change[..., 0], change, bulge)

    def shift(self, steps: np.ndarray, told: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Average [E] over the rows of the bulge minus ``mean``, from the ``steps`` of light [E, U, C] at the edges.

        ``told`` [E, U, C] are the inverse variances of the position from a step of 1, ``row`` [E, U] weights of rows.
        """
        known = (row[:, None] * (told > 0).swapaxes(1, 2))[..., None]
        weighed = (self.change[:, None] * known).swapaxes(2, 3)  # [E, C, K, U]
        normal = weighed @ self.change[:, None]
        normal += (normal.trace(axis1=2, axis2=3) + 1e-30)[..., None, None] * _RIDGE
        shapes = np.linalg.solve(normal, weighed @ steps.swapaxes(1, 2)[..., None])
        share = (self.bulge[:, None] @ shapes)[..., 0].swapaxes(1, 2)  # [E, U, C], times the step
        each = told * steps
        power = np.maximum((each * steps).sum((1, 2)), 1e-30)
        return (each * (share - self.mean[..., None] * steps)).sum((1, 2)) / power
