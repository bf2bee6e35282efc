"""Geometry of a display: fields of view, placement of the scene, eye box, spot sizes. Lengths in metres, angles in rad.

Symbols of the thesis, Sec. 5.4 and 5.6.2: the hologram has the width w, the eyepiece the focal length f. Distances from
the eyepiece are s0 to the object and s1 to its virtual image, both in front, and d_eye to the eye behind. The eye is
focused on the distance s_eye = s1 + d_eye. theta is the half angle of diffraction, sin(theta) = wavelength / (2 pitch).
"""

import math

from holotorch.core import checks
from holotorch.core.quantities import (
    ACCOMMODATION,
    DEPTH,
    DISTANCE,
    FOCAL_LENGTH,
    OFFSET,
    PITCH,
    PLANE,
    PUPIL_RADIUS,
    SPACING,
    WAVELENGTH,
    WIDTH,
)


def planar_fov(pitch: float, wavelength: float) -> float:
    """Field of view in radians of a hologram under a plane wave: 2 theta, at most pi."""
    return 2 * math.asin(_sine(pitch, wavelength))


def magnified_fov(width: float, focal_length: float) -> float:
    """Field of view in radians of the light of a hologram, 2 atan(w / (2 f)), for an eye at the focal point of a lens.

    This holds for spherical illumination (lens close to the hologram) and for the volume-magnifying display.
    """
    return 2 * math.atan(checks.quantity(WIDTH, width) / (2 * _positive_focal_length(focal_length)))


def image_distance(object_distance: float, focal_length: float) -> float:
    """Distance s1 = f s0 / (f - s0) in metres of the virtual image of an object at s0 <= f; infinite at s0 = f.

    Raises:
        ValueError: The object is farther than the focal length, so that its image is real and behind the lens.
    """
    s0, f = checks.quantity(DEPTH, object_distance, "object_distance"), _positive_focal_length(focal_length)
    if math.isinf(f):
        return s0
    if s0 > f:
        raise ValueError(f"object_distance must be at most the focal length {f:g} m for a virtual image, got {s0:g} m")
    return f * s0 / (f - s0) if s0 < f else math.inf


def object_distance(image_distance: float, focal_length: float) -> float:
    """Inverse of :func:`image_distance`: s0 = f s1 / (f + s1), which is f for an infinite s1."""
    f = _positive_focal_length(focal_length)
    if image_distance == math.inf:
        return f
    s1 = checks.quantity(DEPTH, image_distance, "image_distance")
    return 1 / (1 / s1 + 1 / f)


def eyepiece_distance(volume_distance: float, focus_distance: float, focal_length: float, eye_distance: float) -> float:
    """Distance d_el in metres from hologram to eyepiece at which the volume is seen ``focus_distance`` from the eye.

    d_el = d_V + s0 with s1 = s_eye - d_eye (thesis Sec. 5.5.2.1), where d_V is ``volume_distance`` from the hologram;
    45.56 mm in the display of the thesis.

    Raises:
        ValueError: The focus lies between eyepiece and eye.
    """
    s1 = _before_eyepiece(focus_distance, eye_distance)
    return checks.quantity(PLANE, volume_distance, "volume_distance") + object_distance(s1, focal_length)


def scene_fov(size: float, object_distance: float, focal_length: float, eye_distance: float) -> float:
    """Angle in radians under which the eye sees an object of width V = ``size``.

    2 atan(V / (2 (s0 + d_eye (1 - s0 / f)))), which equals 2 atan(V f / (2 (f - s0) (s1 + d_eye))) of thesis Sec. 5.6.2
    and is finite for s0 = f.
    """
    image_distance(object_distance, focal_length)
    checks.quantity(SPACING, eye_distance, "eye_distance")
    distance = object_distance + eye_distance * (1 - object_distance / focal_length)
    return 2 * math.atan(checks.quantity(WIDTH, size, "size") / (2 * distance))


def volume_size(fov: float, focus_distance: float, focal_length: float, eye_distance: float) -> float:
    """Width V_max in metres of an object that spans ``fov`` radians and is seen at ``focus_distance`` from the eye.

    Example: 10.919 mm for 40 deg, s_eye = 120 mm, f = 10 mm and d_eye = 50 mm. The thesis prints 10.91 mm and does not
    state d_eye.
    """
    if not 0 < fov < math.pi:
        raise ValueError(f"fov must lie between 0 and pi radians, got {fov!r}; 40 degrees are {math.radians(40):.3f}")
    s0 = object_distance(_before_eyepiece(focus_distance, eye_distance), focal_length)
    return 2 * math.tan(fov / 2) * (s0 + eye_distance * (1 - s0 / focal_length))


def accommodation_range(
    near: float, far: float, eyepiece_distance: float, focal_length: float, eye_distance: float
) -> tuple[float, float]:
    """Distances in metres from the eye, nearest first, at which it sees the planes ``near`` and ``far``.

    ``near`` and ``far`` are distances in metres from the hologram towards the eyepiece.
    """
    for name, plane in (("near", near), ("far", far)):
        checks.quantity(PLANE, plane, name)
    checks.quantity(SPACING, eyepiece_distance, "eyepiece_distance")
    checks.quantity(SPACING, eye_distance, "eye_distance")
    distances = [image_distance(eyepiece_distance - z, focal_length) + eye_distance for z in (near, far)]
    return min(distances), max(distances)


def region_apex(width: float, pitch: float, wavelength: float) -> float:
    """Distance in metres at which regions 1 and 3 (:func:`region`) touch on the axis: w / (2 tan(theta))."""
    return checks.quantity(WIDTH, width) / (2 * _tangent(pitch, wavelength))


def region(height: float, distance: float, width: float, pitch: float, wavelength: float) -> int:
    """Region 1, 2 or 3 of Sec. 5.6.2 (Fig. 5.11) of a point ``height`` beside the axis; 0 where no light arrives.

    The diffraction cone of a point at distance z covers z tan(theta) to both sides on the hologram's plane. In region 1
    the cone lies within the hologram, and spots are finest. In region 3 the hologram lies within the cone, and the spot
    size depends on the distance only. In region 2 cone and hologram overlap partly.
    """
    cone, half = _cone(height, distance, width, pitch, wavelength), width / 2
    if abs(height) + cone <= half:
        return 1
    if cone - abs(height) >= half:
        return 3
    return 2 if abs(height) - cone < half else 0


def placement(size: float, width: float, pitch: float, wavelength: float, depth: float | None = None) -> float:
    """Smallest distance in metres to the centre of a volume whose near face lies in region 3 (:func:`region`).

    The result is (V + w) / (2 tan(theta)) + depth / 2, with V = ``size`` and ``depth`` = V by default. The shortest
    wavelength requires the largest distance; the thesis's 157.81 mm is that of 455 nm.
    """
    widths = checks.quantity(WIDTH, size, "size") + checks.quantity(WIDTH, width)
    depth = size if depth is None else checks.quantity(SPACING, depth, "depth")
    return widths / (2 * _tangent(pitch, wavelength)) + depth / 2


def section(height: float, distance: float, width: float, pitch: float, wavelength: float) -> float:
    """Length in metres, on one axis, of the part of the hologram whose light reaches a point at ``height``."""
    cone = _cone(height, distance, width, pitch, wavelength)
    return max(0.0, min(width / 2, height + cone) - max(-width / 2, height - cone))


def smallest_spot(wavelength: float, distance: float, section: float) -> float:
    """Distance in metres from the peak to the first zero of the finest spot: wavelength distance / section (Rayleigh).

    ``section`` is the length that :func:`section` returns; 0 gives infinity.
    """
    checks.quantity(SPACING, section, "section")
    product = checks.quantity(WAVELENGTH, wavelength) * abs(checks.quantity(DISTANCE, distance))
    return product / section if section > 0 else math.inf


def vignetting(height: float, first: float, second: float, pupil_radius: float, sine: float) -> float:
    """Width of the light of a point within the pupil, divided by the width of the pupil, along one axis: 0 to 1.

    On the pupil's plane the light of a point at height y covers A y +- B sine. ``first`` and ``second`` are A and B (in
    metres) of the ray matrix from the point's plane to the pupil (``Display.matrix``); ``sine`` is the largest slope of
    the light, wavelength / (2 pitch) in regions 1 and 2 (:func:`region`). With the eye at the focal point of the
    eyepiece A is 0, and every height loses the same light. Diffraction is neglected: in the display of the thesis,
    0.5 % of the light arrives where all rays miss the pupil.
    """
    checks.quantity(OFFSET, height, "height")
    checks.finite("first", first)
    half = _light_half_width(second, sine)
    low, high = max(-pupil_radius, first * height - half), min(pupil_radius, first * height + half)
    return max(0.0, high - low) / (2 * checks.quantity(PUPIL_RADIUS, pupil_radius))


def visible_half_width(first: float, second: float, pupil_radius: float, sine: float) -> float:
    """Height in metres above which no light of a point reaches the pupil: (pupil_radius + B sine) / A, or infinity.

    Arguments as in :func:`vignetting`.
    """
    half_width = checks.quantity(PUPIL_RADIUS, pupil_radius) + _light_half_width(second, sine)
    return half_width / abs(first) if checks.finite("first", first) else math.inf


def eye_box(size: float, first: float, second: float, sine: float) -> float:
    """Width in metres of the part of the pupil's plane that receives light from every point of the scene, at least 0.

    The result is 2 (B sine - A size / 2) for a scene of width ``size`` metres, which may be 0. Other arguments as in
    :func:`vignetting`.
    """
    return max(0.0, 2 * abs(second) * sine - abs(first) * checks.quantity(SPACING, size, "size"))


def fresnel_number(radius: float, wavelength: float, distance: float) -> float:
    """w^2 / (wavelength z) at the distance z behind an aperture of half width w = ``radius`` (thesis Fig. 4.2)."""
    number = fresnel_distance(radius, wavelength, 1.0)
    return number / checks.positive("distance", checks.quantity(DISTANCE, distance), "metres")


def fresnel_distance(radius: float, wavelength: float, number: float) -> float:
    """Distance in metres at which the Fresnel number of an aperture is ``number``.

    The thesis uses Fresnel's model for numbers below 30 and Fraunhofer's far below 1. In its Fig. 4.2 (w = 1 mm,
    530 nm), 30 and 1 are reached at 62.89 mm and 1886.79 mm.
    """
    square = checks.quantity(WIDTH, radius, "radius") ** 2
    return square / (checks.quantity(WAVELENGTH, wavelength) * checks.positive("number", number))


def _sine(pitch: float, wavelength: float) -> float:
    return min(1.0, checks.quantity(WAVELENGTH, wavelength) / (2 * checks.quantity(PITCH, pitch)))


def _tangent(pitch: float, wavelength: float) -> float:
    sine = _sine(pitch, wavelength)
    if sine == 1:
        raise ValueError(f"pitch must exceed half the wavelength for a diffraction cone, got {pitch!r} m")
    return math.tan(math.asin(sine))


def _cone(height: float, distance: float, width: float, pitch: float, wavelength: float) -> float:
    """Half width in metres of the light of a point on the hologram's plane, z tan(theta); checks all lengths."""
    checks.quantity(OFFSET, height, "height")
    checks.quantity(WIDTH, width)
    return abs(checks.quantity(DISTANCE, distance)) * _tangent(pitch, wavelength)


def _light_half_width(second: float, sine: float) -> float:
    """Half width in metres, B sine, of the light of a point on the pupil's plane; checks both numbers."""
    if checks.nonnegative("sine", sine) > 1:
        raise ValueError(f"sine must be at most 1, got {sine!r}")
    return abs(checks.quantity(PLANE, second, "second")) * sine


def _positive_focal_length(value: float) -> float:
    if checks.quantity(FOCAL_LENGTH, value) < 0:
        raise ValueError(f"focal_length must be above zero in metres, got {value!r}")
    return float(value)


def _before_eyepiece(focus_distance: float, eye_distance: float) -> float:
    checks.quantity(ACCOMMODATION, focus_distance, "focus_distance")
    checks.quantity(SPACING, eye_distance, "eye_distance")
    if not focus_distance > eye_distance:
        raise ValueError(f"focus_distance must exceed the eye's distance from the eyepiece, {eye_distance:g} m, got "
                         f"{focus_distance!r} m")  # fmt: skip
    return focus_distance - eye_distance
