import pytest

from holotorch.core.grid import Grid
from holotorch.optics.light.wavelength_sampling import pupil_illumination
from holotorch.optics.viewing.display import Display
from holotorch.optics.viewing.eye import Eye


@pytest.mark.parametrize("radius", [10e-3, 30e-3, 50e-3])
def test_a_pupil_wider_than_all_light_changes_nothing(radius):
    """The window limits the light: 5 mm already take in all of it."""
    grid, display = Grid((128, 96), (3.74e-6, 5e-6)), Display(30e-3, 20e-3, 50e-3)
    wide, enough = (pupil_illumination(grid, 520e-9, display, Eye(size, 24e-3, 0.12)) for size in (radius, 5e-3))
    assert wide.edge == enough.edge == 0 and enough.path_difference > 1e-6
    assert wide.path_difference == pytest.approx(enough.path_difference, rel=0.01)
    assert wide.fourth_order == pytest.approx(enough.fourth_order, rel=0.01)
