"""Rays of a hologram through a display, on one axis: what they ask of windows and pitches. Plain numbers."""

import math

Region = list[tuple[float, float]]  # corners (place in metres, slope) of a convex region of rays


def band(half: float, slope: float) -> Region:
    """All rays from a window of half width ``half`` with slopes up to ``slope``."""
    return [(-half, -slope), (half, -slope), (half, slope), (-half, slope)]


def travelled(region: Region, distance: float) -> Region:
    """The rays after free space."""
    return [(place + distance * slope, slope) for place, slope in region]


def refracted(region: Region, power: float) -> Region:
    """The rays behind a thin lens of ``power`` = 1 / focal length."""
    return [(place, slope - power * place) for place, slope in region]


def clipped(region: Region, radius: float) -> Region:
    """The rays within ``radius`` of the axis; none at all if the region misses it."""
    for sign in (1, -1):
        kept: Region = []
        for i, (place, slope) in enumerate(region):
            before, steep = region[i - 1]
            inside, was = sign * place <= radius, sign * before <= radius
            if inside != was:
                share = (sign * radius - before) / (place - before)
                kept.append((sign * radius, steep + share * (slope - steep)))
            if inside:
                kept.append((place, slope))
        region = kept
    return region


def reach(region: Region) -> float:
    """Largest distance from the axis."""
    return max((abs(place) for place, _ in region), default=0.0)


def steepest(region: Region) -> float:
    """Largest slope."""
    return max((abs(slope) for _, slope in region), default=0.0)


def fringe(wavelength: float, distance: float) -> float:
    """Room in metres for what diffraction at edges spreads beyond the rays: 3 sqrt(wavelength z)."""
    return 3 * math.sqrt(wavelength * abs(distance))
