import math

import pytest

from holotorch import Grid
from holotorch.optics import diffraction_angle, least_padding, unaliased_distance
from holotorch.optics.free_space.geometry import lateral_spread


def test_field_of_view_of_the_thesis():
    # Section 5.4: 636 nm on 3.74 um gives 9.755 degrees from side to side.
    angle = diffraction_angle(Grid(2048, 3.74e-6), 636e-9)[1]
    assert 2 * math.degrees(angle) == pytest.approx(9.755, abs=1e-3)


def test_coarse_and_fine_pitches():
    assert diffraction_angle(Grid(8, (0.2e-6, 1e-6)), 500e-9) == pytest.approx((math.pi / 2, math.asin(0.25)))
    assert lateral_spread(Grid(8, 0.25e-6), 500e-9, 1e-3) == (math.inf, math.inf)
    assert lateral_spread(Grid(8, 0.25e-6), 500e-9, 0.0) == (0, 0)
    assert lateral_spread(Grid(8, 0.25e-6), 500e-9, -1e-3, paraxial=True) == pytest.approx((1e-3, 1e-3))


@pytest.mark.parametrize(("pixels", "limit"), [(64, 118e-3), (128, 59e-3), (256, 29.5e-3)])
def test_limit_of_the_periodic_model(pixels, limit):
    # The thesis's 2 mm chip at 530 nm: L pitch / wavelength.
    assert unaliased_distance(Grid(pixels, 2e-3 / pixels), 530e-9, 1) == pytest.approx(limit, rel=5e-3)
    assert unaliased_distance(Grid(pixels, 2e-3 / pixels), 530e-9, 2) == pytest.approx(2 * limit, rel=5e-3)


def test_least_padding_grows_from_one():
    grid = Grid((64, 128), 8e-6)
    assert least_padding(grid, 530e-9, 0.0) == (1, 1)
    y, x = least_padding(grid, 530e-9, 10e-3)
    assert (y - 1) == pytest.approx(2 * (x - 1))
    assert least_padding(grid, 530e-9, -10e-3) == (y, x)
    assert least_padding(Grid(8, 0.2e-6), 530e-9, 1e-6) == (math.inf, math.inf)
