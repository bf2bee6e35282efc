"""Rays of a hologram through a display, on one axis, which determine windows and pitches. Lengths in metres."""

import math

Region = list[tuple[float, float]]  # corners (position in metres, slope) of a convex region of rays


def of_window(half_width: float, slope: float) -> Region:
    """All rays that start within ``half_width`` of the axis with slopes up to ``slope``."""
    return [(-half_width, -slope), (half_width, -slope), (half_width, slope), (-half_width, slope)]


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
                fraction = (sign * radius - previous) / (position - previous)
                kept.append((sign * radius, previous_slope + fraction * (slope - previous_slope)))
            if inside:
                kept.append((position, slope))
        region = kept
    return region


def largest_height(region: Region) -> float:
    """Largest distance of a ray from the axis; 0 without rays."""
    return max((abs(position) for position, _ in region), default=0.0)


def largest_slope(region: Region) -> float:
    """Largest absolute slope of a ray; 0 without rays."""
    return max((abs(slope) for _, slope in region), default=0.0)


def fringe_width(wavelength: float, distance: float) -> float:
    """Margin in metres for light that edges diffract beyond the rays: 3 sqrt(wavelength z)."""
    return 3 * math.sqrt(wavelength * abs(distance))


def samples_for_all_light(size: int, window: float, pitch: float, wavelength: float, distance: float) -> float:
    """Smallest length of a transform with which no light of ``size`` samples wraps into ``window`` samples."""
    sine = wavelength / (2 * pitch)
    spread = abs(distance) * sine / math.sqrt(1 - sine**2) if sine < 1 else math.inf
    return (size + window) / 2 + (spread + fringe_width(wavelength, distance)) / pitch
