"""Drawings of a fictional theme park: a background, and icons composed of simple shapes."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Ellipse, FancyBboxPatch, Patch, Polygon, Rectangle
from matplotlib.transforms import Affine2D, Transform
from torch import Tensor


def draw_ground(axes: Axes, field_deg: tuple[float, float]) -> None:
    """Draw the sky, hills, paths and a pond behind the icons, over ``field_deg`` (vertical, horizontal)."""
    high, wide = field_deg[0] / 2, field_deg[1] / 2
    axes.add_patch(Rectangle((-wide, -high), 2 * wide, 2 * high, color="#cfe4f2", zorder=0))
    steps = [wide * (i / 60 - 1) for i in range(121)]
    hills = [high * (0.24 + 0.10 * math.sin(x / 13) + 0.05 * math.sin(x / 5.1 + 2)) for x in steps]
    axes.add_patch(Polygon([(-wide, -high), *zip(steps, hills, strict=True), (wide, -high)], color="#b9d3ac", zorder=1))
    near = [high * (-0.02 + 0.06 * math.sin(x / 21 + 1)) for x in steps]
    axes.add_patch(Polygon([(-wide, -high), *zip(steps, near, strict=True), (wide, -high)], color="#9fc08f", zorder=2))
    axes.add_patch(Ellipse((0.48 * wide, -0.62 * high), 0.5 * wide, 0.3 * high, color="#8fbdd6", zorder=3))
    for end in (-0.9, -0.35, 0.2, 0.95):
        path = [(-0.02 * wide, -high), (0.02 * wide, -high), (end * wide, -0.02 * high)]
        axes.add_patch(Polygon(path, color="#e3d9bd", zorder=4))


def draw_icon(axes: Axes, name: str, centre: tuple[float, float], size: tuple[float, float], zorder: float) -> None:
    """Draw an icon on a rounded plate; ``centre`` (x, y) and ``size`` (height, width) are in data units."""
    height, width = size
    left, bottom = centre[0] - width / 2, centre[1] - height / 2
    shapes, colour = _ICONS[name]
    plate = FancyBboxPatch(
        (left + 0.04 * width, bottom + 0.04 * height),
        0.92 * width,
        0.92 * height,
        boxstyle=f"round,pad=0,rounding_size={0.16 * min(size)}",
        facecolor=colour,
        edgecolor="white",
        linewidth=0.8,
        zorder=zorder,
    )
    axes.add_patch(plate)
    unit_square = Affine2D().scale(width, height).translate(left, bottom) + axes.transData
    shapes(_Pen(axes, unit_square, zorder + 0.1, colour))


def draw_picture(
    axes: Axes, picture: Tensor, centre: tuple[float, float], size: tuple[float, float], zorder: float
) -> None:
    """Draw a picture [3, h, w] from 0 to 1 as an icon, as large as fits into ``size`` (height, width) at ``centre``."""
    pixels = picture.shape[-2:]
    scale = min(size[0] / pixels[0], size[1] / pixels[1])
    half_height, half_width = scale * pixels[0] / 2, scale * pixels[1] / 2
    (x, y), rows = centre, picture.movedim(0, -1).clamp(0, 1).numpy()
    extent = (x - half_width, x + half_width, y - half_height, y + half_height)
    axes.imshow(rows, extent=extent, zorder=zorder, aspect="auto")


@dataclass(frozen=True)
class _Pen:
    """Draws shapes, white by default, on an icon's plate of colour ``plate``; coordinates span 0 .. 1 over the icon."""

    axes: Axes
    transform: Transform
    zorder: float
    plate: str

    def line(self, *points: tuple[float, float], thick: float = 0.05, **options: Any) -> None:
        # Lines are drawn as polygons, because Matplotlib's line widths are in points and do not scale with the icon.
        for (x0, y0), (x1, y1) in pairwise(points):
            length = math.hypot(x1 - x0, y1 - y0) or 1.0
            dx, dy = (x1 - x0) / length * thick / 2, (y1 - y0) / length * thick / 2
            corners = [(x0 - dx - dy, y0 - dy + dx), (x0 - dx + dy, y0 - dy - dx)]
            self.shape(*corners, (x1 + dx + dy, y1 + dy - dx), (x1 + dx - dy, y1 + dy + dx), **options)

    def shape(self, *points: tuple[float, float], color: str = "white") -> None:
        self._add(Polygon(points, color=color))

    def disc(self, x: float, y: float, radius: float, color: str = "white") -> None:
        self._add(Circle((x, y), radius, color=color))

    def _add(self, patch: Patch) -> None:
        patch.set(linewidth=0, zorder=self.zorder, transform=self.transform)
        self.axes.add_patch(patch)


def _wheel(pen: _Pen) -> None:
    pen.line((0.5, 0.54), (0.3, 0.12))
    pen.line((0.5, 0.54), (0.7, 0.12))
    ring = [(0.5 + 0.29 * math.cos(t * math.pi / 16), 0.54 + 0.29 * math.sin(t * math.pi / 16)) for t in range(33)]
    pen.line(*ring, thick=0.04)
    for k in range(8):
        x, y = 0.5 + 0.29 * math.cos(k * math.pi / 4), 0.54 + 0.29 * math.sin(k * math.pi / 4)
        pen.line((0.5, 0.54), (x, y), thick=0.02)
        pen.disc(x, y, 0.055, "#ffe08a")


def _coaster(pen: _Pen) -> None:
    track = [(x / 40, 0.47 + 0.25 * math.cos(2 * math.pi * (x / 40 - 0.24) / 0.56)) for x in range(5, 36)]
    pen.line(*track, thick=0.05)
    for x, y in track[::5]:
        pen.line((x, 0.14), (x, y), thick=0.025)
    for x, y in (track[5], track[7], track[9]):
        pen.disc(x, y + 0.07, 0.06, "#ffe08a")


def _castle(pen: _Pen) -> None:
    for x, top in ((0.2, 0.6), (0.5, 0.72), (0.8, 0.6)):
        pen.shape((x - 0.09, 0.16), (x - 0.09, top), (x + 0.09, top), (x + 0.09, 0.16))
        pen.shape((x - 0.12, top), (x, top + 0.2), (x + 0.12, top), color="#ffe08a")
    pen.shape((0.2, 0.16), (0.2, 0.44), (0.8, 0.44), (0.8, 0.16))
    pen.disc(0.5, 0.26, 0.08, pen.plate)
    pen.shape((0.42, 0.16), (0.42, 0.26), (0.58, 0.26), (0.58, 0.16), color=pen.plate)


def _boat(pen: _Pen) -> None:
    pen.shape((0.14, 0.38), (0.86, 0.38), (0.72, 0.2), (0.28, 0.2))
    pen.line((0.48, 0.38), (0.48, 0.86), thick=0.035)
    pen.shape((0.52, 0.44), (0.52, 0.84), (0.8, 0.44), color="#ffe08a")
    pen.shape((0.44, 0.44), (0.44, 0.76), (0.2, 0.44))


def _tent(pen: _Pen) -> None:
    pen.shape((0.5, 0.8), (0.14, 0.5), (0.86, 0.5))
    for k in range(5):
        x = 0.2 + 0.12 * k
        pen.shape((x, 0.16), (x, 0.5), (x + 0.12, 0.5), (x + 0.12, 0.16), color=("white", "#ffe08a")[k % 2])
    pen.line((0.5, 0.8), (0.5, 0.92), thick=0.03)


def _carousel(pen: _Pen) -> None:
    pen.shape((0.5, 0.88), (0.14, 0.62), (0.86, 0.62))
    pen.shape((0.16, 0.14), (0.16, 0.22), (0.84, 0.22), (0.84, 0.14))
    for x in (0.24, 0.5, 0.76):
        pen.line((x, 0.22), (x, 0.62), thick=0.03)
        pen.disc(x, 0.42 + 0.06 * math.cos(12 * x), 0.07, "#ffe08a")


def _food(pen: _Pen) -> None:
    pen.shape((0.5, 0.14), (0.34, 0.54), (0.66, 0.54), color="#ffe08a")
    for x, y in ((0.39, 0.6), (0.61, 0.6), (0.5, 0.73)):
        pen.disc(x, y, 0.13)


def _first_aid(pen: _Pen) -> None:
    pen.line((0.5, 0.18), (0.5, 0.82), thick=0.2)
    pen.line((0.2, 0.5), (0.8, 0.5), thick=0.2)


# For each icon: the function that draws its shapes, and the colour of its plate.
_ICONS: dict[str, tuple[Callable[[_Pen], None], str]] = {
    "wheel": (_wheel, "#2f5d8a"),
    "coaster": (_coaster, "#a23b3b"),
    "castle": (_castle, "#6b4a8f"),
    "boat": (_boat, "#21737d"),
    "tent": (_tent, "#b3592a"),
    "carousel": (_carousel, "#94386e"),
    "food": (_food, "#7d5a2b"),
    "first_aid": (_first_aid, "#2c7a4b"),
}
