"""The worked numbers of the thesis, Sec. 5.4 to 5.6 and Fig. 4.2."""

import math

import pytest

from holotorch.optics import Display
from holotorch.optics.viewing import display_geometry as geometry

WIDTH, PITCH, RED, GREEN, BLUE = 2048 * 3.74e-6, 3.74e-6, 636e-9, 520e-9, 455e-9


def test_fields_of_view():
    assert math.degrees(geometry.planar_fov(PITCH, RED)) == pytest.approx(9.755, abs=1e-3)
    assert math.degrees(geometry.magnified_fov(WIDTH, 20e-3)) == pytest.approx(21.7, abs=0.05)
    assert math.degrees(geometry.magnified_fov(WIDTH, 10e-3)) == pytest.approx(41.9, abs=0.05)
    assert geometry.planar_fov(0.2e-6, RED) == pytest.approx(math.pi)


def test_volume_for_forty_degrees():
    size = geometry.volume_size(math.radians(40), 120e-3, 10e-3, 50e-3)
    assert size == pytest.approx(10.919e-3, abs=1e-6)
    # s1 = 70 mm, s0 = 8.75 mm; and back by the other printed formula.
    s0 = geometry.object_distance(70e-3, 10e-3)
    assert s0 == pytest.approx(8.75e-3)
    printed = 2 * math.atan(size * 10e-3 / (2 * (10e-3 - s0) * (70e-3 + 50e-3)))
    assert geometry.scene_fov(size, s0, 10e-3, 50e-3) == pytest.approx(printed)
    assert printed == pytest.approx(math.radians(40))
    # An image at infinity spans a finite angle, V / f.
    assert math.tan(geometry.scene_fov(1e-3, 10e-3, 10e-3, 50e-3) / 2) == pytest.approx(0.05)


def test_regions_and_placement():
    for wavelength, apex in ((RED, 44.9e-3), (GREEN, 55.0e-3), (BLUE, 62.8e-3)):
        found = geometry.region_apex(WIDTH, PITCH, wavelength)
        assert found == pytest.approx(apex, abs=0.06e-3)
        assert [geometry.region(0.0, z * found, WIDTH, PITCH, wavelength) for z in (0.99, 1.01)] == [1, 3]
    assert geometry.region(2e-3, 45e-3, WIDTH, PITCH, RED) == 2
    assert geometry.region(5e-3, 5e-3, WIDTH, PITCH, RED) == 0
    centre = geometry.placement(10.91e-3, WIDTH, PITCH, BLUE)
    assert centre == pytest.approx(157.81e-3, abs=5e-6)
    assert geometry.placement(10.91e-3, WIDTH, PITCH, RED) == pytest.approx(114.3e-3, abs=0.05e-3)
    face = centre - 10.91e-3 / 2
    assert geometry.region(10.9e-3 / 2, face, WIDTH, PITCH, BLUE) == 3
    assert geometry.region(10.9e-3 / 2, face - 0.2e-3, WIDTH, PITCH, BLUE) == 2
    assert geometry.placement(10.91e-3, WIDTH, PITCH, BLUE, depth=0.0) == pytest.approx(face)


def test_smallest_spot():
    # Region I: all of the cone is hologram, and the spot is lambda / (2 tan theta), a little less than the pitch.
    section = geometry.section(0.0, 20e-3, WIDTH, PITCH, RED)
    spot = geometry.smallest_spot(RED, 20e-3, section)
    assert spot == pytest.approx(RED / (2 * math.tan(math.asin(RED / 2 / PITCH))))
    # Region III: the whole hologram, growing with distance; nothing at all outside.
    far = geometry.section(0.0, 100e-3, WIDTH, PITCH, RED)
    assert far == pytest.approx(WIDTH)
    assert geometry.smallest_spot(RED, 100e-3, far) == pytest.approx(8.30e-6, abs=0.01e-6)
    assert geometry.smallest_spot(RED, 5e-3, geometry.section(5e-3, 5e-3, WIDTH, PITCH, RED)) == math.inf


def test_distances_of_the_display():
    found = geometry.eyepiece_distance(30e-3, 120e-3, 20e-3, 50e-3)
    assert found == pytest.approx(45.56e-3, abs=5e-6)
    assert geometry.image_distance(found - 30e-3, 20e-3) == pytest.approx(70e-3)
    near, far = geometry.accommodation_range(28e-3, 32e-3, found, 20e-3, 50e-3)
    assert near < 120e-3 < far
    # The plane nearer to the hologram is farther from the eyepiece: s0 = 17.56 mm, s1 = 143.6 mm.
    assert far == pytest.approx(50e-3 + 20e-3 * 17.5556e-3 / 2.4444e-3, rel=1e-4)
    assert geometry.image_distance(20e-3, 20e-3) == math.inf
    assert geometry.object_distance(math.inf, 20e-3) == 20e-3
    display = Display(found, 20e-3, 50e-3)
    assert display.focus_plane(120e-3) == pytest.approx(30e-3)
    assert display.focus_plane(math.inf) == pytest.approx(found - 20e-3)


def test_vignetting_and_eye_box():
    first, second, _, _ = map(float, Display(45.5556e-3, 20e-3, 50e-3).matrix(30e-3))
    assert (first, second) == pytest.approx((-1.5, 26.67e-3), rel=2e-4)
    sine = RED / 2 / PITCH
    shares = [geometry.vignetting(y, first, second, 1.5e-3, sine) for y in (0, 1e-3, 2e-3, 2.6e-3)]
    # 1 / 0.75 / 0.25 / 0.005 by diffraction (test_imaging.py); rays alone leave nothing at 2.6 mm.
    assert shares == pytest.approx([1, 0.756, 0.256, 0], abs=1e-3)
    assert geometry.visible_half_width(first, second, 1.5e-3, sine) == pytest.approx(2.51e-3, abs=1e-5)
    # Light of the axis fills 2 B sine; that of every point within twice B sine / A has nowhere in common.
    assert geometry.eye_box(0.0, first, second, sine) == pytest.approx(4.535e-3, abs=2e-6)
    assert geometry.eye_box(2 * second * sine / 1.5 * 1.001, first, second, sine) == 0
    # The eye at the focal point: nothing is vignetted.
    first, second, _, _ = map(float, Display(40e-3, 20e-3, 20e-3).matrix(30e-3))
    assert geometry.vignetting(3e-3, first, second, 1.5e-3, sine) == 1
    assert geometry.visible_half_width(first, second, 1.5e-3, sine) == math.inf


def test_fresnel_numbers():
    assert geometry.fresnel_distance(1e-3, 530e-9, 30) == pytest.approx(62.89e-3, abs=5e-6)
    assert geometry.fresnel_distance(1e-3, 530e-9, 1) == pytest.approx(1886.79e-3, abs=5e-6)
    assert geometry.fresnel_number(1e-3, 530e-9, 62.893e-3) == pytest.approx(30, rel=1e-5)


def test_impossible_numbers():
    with pytest.raises(ValueError, match="must be at most the focal length"):
        geometry.image_distance(25e-3, 20e-3)
    with pytest.raises(ValueError, match="focus_distance must exceed"):
        geometry.eyepiece_distance(30e-3, 40e-3, 20e-3, 50e-3)
    with pytest.raises(ValueError, match="fov must lie between"):
        geometry.volume_size(40, 120e-3, 10e-3, 50e-3)
    with pytest.raises(ValueError, match="half the wavelength"):
        geometry.region_apex(WIDTH, 0.3e-6, RED)
    with pytest.raises(ValueError, match="sees no plane"):
        Display.planar(0.3).focus_plane(math.inf)
    with pytest.raises(ValueError, match="lens_distance must be at least zero"):
        Display(-1e-3, 20e-3, 50e-3)
