"""Rays of a hologram through a display, on one axis, which determine windows and pitches. Lengths in metres."""

import math

Region = list[tuple[float, float]]  # corners (position in metres, slope) of a convex region of rays


def band(half: float, slope: float) -> Region:
    """All rays from a window of half width ``half`` with slopes up to ``slope``."""
    return [(-half, -slope), (half, -slope), (half, slope), (-half, slope)]


def travelled(region: Region, distance: float) -> Region:
    """The rays after ``distance`` of free space."""
    return [(position + distance * slope, slope) for position, slope in region]


def refracted(region: Region, power: float) -> Region:
    """The rays behind a thin lens of ``power`` = 1 / focal length."""
    return [(position, slope - power * position) for position, slope in region]


def clipped(region: Region, radius: float) -> Region:
    """The rays within ``radius`` of the axis; an empty list if there are none."""
    for sign in (1, -1):
        kept: Region = []
        for i, (position, slope) in enumerate(region):
            previous, previous_slope = region[i - 1]
            inside, was_inside = sign * position <= radius, sign * previous <= radius
            if inside != was_inside:
                share = (sign * radius - previous) / (position - previous)
                kept.append((sign * radius, previous_slope + share * (slope - previous_slope)))
            if inside:
                kept.append((position, slope))
        region = kept
    return region


def reach(region: Region) -> float:
    """Largest distance from the axis."""
    return max((abs(position) for position, _ in region), default=0.0)


def steepest(region: Region) -> float:
    """Largest slope."""
    return max((abs(slope) for _, slope in region), default=0.0)


def fringe(wavelength: float, distance: float) -> float:
    """Margin in metres for light that edges diffract beyond the rays: 3 sqrt(wavelength z)."""
    return 3 * math.sqrt(wavelength * abs(distance))
