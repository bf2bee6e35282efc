"""The controls of the depth and the pupil of an eye that looks from far away, and the view that they describe."""

import math
from collections.abc import Mapping
from typing import Any

from holotorch.core.grid import Grid
from holotorch.experiments.view.controls import Slider, span
from holotorch.optics import View


def view_controls(
    grid: Grid, wavelengths: tuple[float, ...], foci: tuple[float, float], focus: float, radius: float = math.inf
) -> list[Slider]:
    """Sliders of a view.

    Args:
        grid: Pixels of the hologram.
        wavelengths: In metres.
        foci: Limits of the depth in metres.
        focus: Depth at the start in metres.
        radius: Sine of the half-angle of the pupil at the start; math.inf for an open one.
    """
    band = min(wavelengths) / (2 * max(grid.pitch))  # sines that the pixels emit of every colour
    corner = min(0.99, math.sqrt(2) * max(wavelengths) / (2 * min(grid.pitch)))
    widest, aside = math.degrees(math.asin(corner)), 0.8 * math.degrees(math.asin(min(band, 0.99)))
    at = min(widest, math.degrees(math.asin(min(radius, 0.99))))
    beside = span(-aside, aside, 0.0, 80)
    return [
        Slider(
            "focus", "Depth in focus", "mm", **span(1e3 * foci[0], 1e3 * foci[1], 1e3 * focus, 400),
            explanation="Distance from the hologram at which the eye focuses.",
        ),
        Slider(
            "radius", "Radius of the pupil", "deg", **span(widest / 80, widest, at),
            explanation="Seen from the hologram; a small pupil gives a great depth of field, and much speckle.",
        ),
        Slider("right", "Pupil to the right", "deg", **beside, explanation="Where the eye is: another perspective."),
        Slider("down", "Pupil down", "deg", **beside, explanation=""),
    ]  # fmt: skip


def view_of(values: Mapping[str, Any], scale: float = 1.0) -> View:
    """The view of values of these sliders, with its focus divided by ``scale``."""
    y, x, radius = (math.sin(math.radians(values[name])) for name in ("down", "right", "radius"))
    return View(1e-3 * values["focus"] / scale, radius, (y, x))
