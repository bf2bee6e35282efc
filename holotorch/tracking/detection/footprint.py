"""What a pose makes of the catheter on a line of its image: how wide it is there, and how its rings bulge."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.strips import Line
from holotorch.tracking.detection.fits import SHARPEST
from holotorch.tracking.pose.resection import LinePose

_INTERPOLATED = 1 / 6  # pixels^2 that bilinear samples add to a blur, whatever their direction
_NODES = (np.arange(16) + 0.5) / 8 - 1  # across a tube, from one side to the other
_ROUND = np.sqrt(1 - _NODES**2)
_LIT = np.stack([np.ones_like(_NODES), _NODES, _ROUND], -1)
_BOTH = np.concatenate([_LIT, _LIT * _ROUND[:, None]], -1)
_RIDGE = 1e-4 * np.eye(_LIT.shape[1])


def width_px(found: LinePose, positions: Sequence[float], radius: float, line: Line) -> tuple[float, float]:
    """Of the tube's image at t = 0 in pixels across the line, and its change per pixel.

    2 r / (z sqrt(1 - n_z^2)) on the plane z = 1, n the unit normal of the plane through axis and camera: what is
    seen aside of the image's middle is seen at a slant.
    """
    # In plain numbers, as all of this: of so few rings, the calls into NumPy would cost several times as much.
    (x, y, z), (a, b, c) = found.tip.tolist(), found.direction.tolist()
    nx, ny, nz = y * c - z * b, z * a - x * c, x * b - y * a
    slant = math.sqrt(1 + nz * nz / (nx * nx + ny * ny)) if nx or ny else math.inf
    t0, t1 = (line.along_at(axis_on_plane(found, positions[n])) for n in (0, -1))
    near, far = (2 * radius * line.scale * slant / (z + positions[n] * c or math.nan) for n in (0, -1))
    taper = (far - near) / (t1 - t0) if t1 != t0 else math.inf
    return near - taper * t0, taper


def bulge_px(found: LinePose, positions: Sequence[float], radius: float, line: Line) -> np.ndarray:
    """How far along the line [N], in pixels, the front of each ring's image lies from that of its centre."""
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
    """The tool's point ``position`` metres from its tip, seen on the plane z = 1; NaN in the camera's own plane."""
    (x, y, z), (a, b, c) = found.tip.tolist(), found.direction.tolist()
    return complex(x + position * a, y + position * b) / (z + position * c or math.nan)


@dataclass(frozen=True, eq=False)
class Front:
    """How far rings' fronts bulge in rows [U] across the images of tubes [E], as shares of the bulge in their middles.

    A row sees its neighbours through the blur: what it shows is the mean of their shares, weighed by how much each of
    them changes at the edge. Light on a tube changes across it, and what shines through clear tube not in the same way.

    Attributes:
        mean: [E, U], where the change is the same all across.
        change, bulge: [E, U, K], of changes of K shapes across: what a row sees of each, and that times the share.
    """

    mean: np.ndarray
    change: np.ndarray
    bulge: np.ndarray

    @staticmethod
    def of(u: np.ndarray, widths: np.ndarray, blur: float) -> "Front":
        """In rows ``u`` from the mid-line of tubes so wide [E], all in pixels; ``blur`` of bilinear samples' sides."""
        sigma = math.sqrt(max(blur**2 - _INTERPOLATED, SHARPEST**2))
        z = (u[:, None] - widths[:, None, None] / 2 * _NODES) * (math.sqrt(0.5) / sigma)
        both = (np.exp(-z * z) + 1e-30) @ _BOTH
        change, bulge = both[..., : _LIT.shape[1]], both[..., _LIT.shape[1] :]
        return Front(bulge[..., 0] / change[..., 0], change, bulge)

    def shift(self, steps: np.ndarray, told: np.ndarray, row: np.ndarray) -> np.ndarray:
        """[E], by how much more than ``mean`` the edges bulge on average, as light changes at them.

        Args:
            steps: [E, U, C], change of light at the edges.
            told: [E, U, C], what a step of 1 tells of the place: an inverse variance.
            row: [E, U], weights of the rows.
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
