"""Geometry of a display: fields of view, placement of the scene, eye box, spot sizes. Lengths in metres, angles in rad.

Symbols of the thesis, Sec. 5.4 and 5.6.2: the hologram has width w and the eyepiece focal length f. The object lies s0
in front of the eyepiece, and its virtual image s1 in front of it. The eye is d_eye behind the eyepiece and focused on
the distance s_eye = s1 + d_eye. theta is the half angle of diffraction, sin(theta) = wavelength / (2 pitch).
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
    """Field of view in radians of a hologram under a plane wave: 2 asin(wavelength / (2 pitch)), at most pi."""
    return 2 * math.asin(_sine(pitch, wavelength))


def magnified_fov(width: float, focal_length: float) -> float:
    """Field of view in radians, 2 atan(w / 2f), with the eye at the focal point of a lens.

    It applies to spherical illumination (lens close to the hologram) and to the volume-magnifying display. This is the
    limit set by the light that leaves the hologram; :func:`scene_fov` gives the angle that the scene subtends, and
    :func:`vignetting` the fraction of light that passes the iris.
    """
    return 2 * math.atan(checks.quantity(WIDTH, width) / (2 * _positive_focal_length(focal_length)))


def image_distance(object_distance: float, focal_length: float) -> float:
    """Distance s1 = f s0 / (f - s0) in metres of the virtual image of an object nearer than f; infinite at s0 = f.

    Raises:
        ValueError: The object is farther than the focal length: its image is real, behind the lens.
    """
    s0, f = checks.quantity(DEPTH, object_distance, "object_distance"), _positive_focal_length(focal_length)
    if math.isinf(f):
        return s0
    if s0 > f:
        raise ValueError(f"object_distance must be at most the focal length {f:g} m for a virtual image, got {s0:g} m")
    return f * s0 / (f - s0) if s0 < f else math.inf


def object_distance(image_distance: float, focal_length: float) -> float:
    """Inverse of :func:`image_distance`: s0 = f s1 / (f + s1), f itself for an infinite s1."""
    f = _positive_focal_length(focal_length)
    if image_distance == math.inf:
        return f
    s1 = checks.quantity(DEPTH, image_distance, "image_distance")
    return 1 / (1 / s1 + 1 / f)


def eyepiece_distance(volume_distance: float, focus_distance: float, focal_length: float, eye_distance: float) -> float:
    """Distance d_el in metres from hologram to eyepiece at which the volume is seen ``focus_distance`` from the eye.

    d_el = d_V + s0 with s1 = s_eye - d_eye (thesis Sec. 5.5.2.1); 45.56 mm for its display.

    Raises:
        ValueError: The focus lies between eyepiece and eye.
    """
    s1 = _before_eyepiece(focus_distance, eye_distance)
    return checks.quantity(PLANE, volume_distance, "volume_distance") + object_distance(s1, focal_length)


def scene_fov(size: float, object_distance: float, focal_length: float, eye_distance: float) -> float:
    """Angle in radians that an object of ``size`` spans from the eye: 2 atan(V f / (2 (f - s0) (s1 + d_eye))).

    V is ``size`` (thesis Sec. 5.6.2). The argument is computed as V / (2 (s0 + d_eye (1 - s0 / f))), which is finite
    for an image at infinity.
    """
    image_distance(object_distance, focal_length)
    checks.quantity(SPACING, eye_distance, "eye_distance")
    across = object_distance + eye_distance * (1 - object_distance / focal_length)
    return 2 * math.atan(checks.quantity(WIDTH, size, "size") / (2 * across))


def volume_size(fov: float, focus_distance: float, focal_length: float, eye_distance: float) -> float:
    """Width V_max in metres of an object that spans ``fov`` radians, seen at ``focus_distance``.

    Example: 10.919 mm for 40 deg, 120 mm, f = 10 mm and d_eye = 50 mm. The thesis prints 10.91 and omits d_eye.
    """
    if not 0 < fov < math.pi:
        raise ValueError(f"fov must lie between 0 and pi radians, got {fov!r}; 40 degrees are {math.radians(40):.3f}")
    s0 = object_distance(_before_eyepiece(focus_distance, eye_distance), focal_length)
    return 2 * math.tan(fov / 2) * (s0 + eye_distance * (1 - s0 / focal_length))


def accommodation_range(
    near: float, far: float, eyepiece_distance: float, focal_length: float, eye_distance: float
) -> tuple[float, float]:
    """Distances in metres from the eye at which planes ``near`` and ``far`` from the hologram are seen, nearest first.

    ``near`` and ``far`` are distances from the hologram towards the eyepiece. Differences of 1 / distance are dioptres.
    """
    for name, plane in (("near", near), ("far", far)):
        checks.quantity(PLANE, plane, name)
    checks.quantity(SPACING, eyepiece_distance, "eyepiece_distance")
    checks.quantity(SPACING, eye_distance, "eye_distance")
    distances = [image_distance(eyepiece_distance - z, focal_length) + eye_distance for z in (near, far)]
    return min(distances), max(distances)


def region_apex(width: float, pitch: float, wavelength: float) -> float:
    """Distance in metres at which regions I and III of Sec. 5.6.2 touch on the axis: w / (2 tan(theta))."""
    return checks.quantity(WIDTH, width) / (2 * _tangent(pitch, wavelength))


def region(height: float, distance: float, width: float, pitch: float, wavelength: float) -> int:
    """Region 1, 2 or 3 of Sec. 5.6.2 (Fig. 5.11) of a point ``height`` beside the axis; 0 where no light arrives.

    The diffraction cone of a point at distance z covers z tan(theta) to both sides on the hologram's plane. Region 1:
    the cone lies within the hologram, and spots are finest. Region 3: the hologram lies within the cone, and the spot
    size depends on the distance only. Region 2: they overlap partly.
    """
    cone, half = _cone(height, distance, width, pitch, wavelength), width / 2
    if abs(height) + cone <= half:
        return 1
    if cone - abs(height) >= half:
        return 3
    return 2 if abs(height) - cone < half else 0


def placement(size: float, width: float, pitch: float, wavelength: float, depth: float | None = None) -> float:
    """Smallest distance in metres to the centre of a volume whose near face lies in region III.

    The result is (V + w) / (2 tan(theta)) + depth / 2, with V = ``size`` and a cube by default. The thesis's 157.81 mm
    is for 455 nm: blue has the narrowest cone and requires the largest distance.
    """
    across = checks.quantity(WIDTH, size, "size") + checks.quantity(WIDTH, width)
    deep = size if depth is None else checks.quantity(SPACING, depth, "depth")
    return across / (2 * _tangent(pitch, wavelength)) + deep / 2


def section(height: float, distance: float, width: float, pitch: float, wavelength: float) -> float:
    """Length in metres, along one axis, of the part of the hologram whose light can reach a point."""
    cone = _cone(height, distance, width, pitch, wavelength)
    return max(0.0, min(width / 2, height + cone) - max(-width / 2, height - cone))


def smallest_spot(wavelength: float, distance: float, section: float) -> float:
    """Width in metres of the finest spot, wavelength distance / section (Rayleigh, one axis, to the first zero).

    ``section`` is that of :func:`section`; 0 gives infinity.
    """
    checks.quantity(SPACING, section, "section")
    longest = checks.quantity(WAVELENGTH, wavelength) * abs(checks.quantity(DISTANCE, distance))
    return longest / section if section > 0 else math.inf


def vignetting(height: float, first: float, second: float, pupil_radius: float, sine: float) -> float:
    """Width of the light of a point within the pupil, divided by the width of the pupil, along one axis: 0 to 1.

    On the pupil's plane the light of a point at height y covers A y +- B sine. Diffraction is neglected: where the rays
    miss the pupil, 0.5 % of the light still arrives in the thesis's display. With the eye at the focal point of the
    eyepiece A is 0, and no light is lost off the axis.

    Args:
        height: Distance of the point from the axis, in metres.
        first: A of the ray matrix from the point's plane to the pupil (``Display.matrix``): 1 - d_eye / f.
        second: B in metres: s0 + d_eye (1 - s0 / f).
        pupil_radius: In metres.
        sine: Largest slope of the light, wavelength / (2 pitch) in regions I and II.
    """
    checks.quantity(OFFSET, height, "height")
    checks.finite("first", first)
    half = _light_half_width(second, sine)
    low, high = max(-pupil_radius, first * height - half), min(pupil_radius, first * height + half)
    return max(0.0, high - low) / (2 * checks.quantity(PUPIL_RADIUS, pupil_radius))


def visible_half_width(first: float, second: float, pupil_radius: float, sine: float) -> float:
    """Height in metres beyond which no light of a point reaches the pupil: (r + B sine) / A, infinite for A = 0."""
    half_width = checks.quantity(PUPIL_RADIUS, pupil_radius) + _light_half_width(second, sine)
    return half_width / abs(first) if checks.finite("first", first) else math.inf


def eye_box(size: float, first: float, second: float, sine: float) -> float:
    """Width in metres of the part of the pupil's plane that receives light of every point of the scene, at least 0.

    The result is 2 (B sine - A size / 2) for a scene of width ``size`` metres, where 0 means a point on the axis. The
    other arguments are those of :func:`vignetting`.
    """
    return max(0.0, 2 * abs(second) * sine - abs(first) * checks.quantity(SPACING, size, "size"))


def fresnel_number(radius: float, wavelength: float, distance: float) -> float:
    """w^2 / (wavelength z) of an aperture of half width w (thesis Fig. 4.2)."""
    number = fresnel_distance(radius, wavelength, 1.0)
    return number / checks.positive("distance", checks.quantity(DISTANCE, distance), "metres")


def fresnel_distance(radius: float, wavelength: float, number: float) -> float:
    """Distance in metres at which the Fresnel number is ``number``.

    Fig. 4.2: for w = 1 mm and 530 nm it is below 30, where the thesis takes Fresnel's model, from 62.89 mm on, and
    below 1 from 1886.79 mm on, far beyond which it takes Fraunhofer's.
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
    """Half-width in metres of the light of a point on the hologram's plane, all lengths checked."""
    checks.quantity(OFFSET, height, "height")
    checks.quantity(WIDTH, width)
    return abs(checks.quantity(DISTANCE, distance)) * _tangent(pitch, wavelength)


def _light_half_width(second: float, sine: float) -> float:
    """Half width in metres, B sine, of the light of a point on the pupil's plane, both numbers checked."""
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
