"""Views of a hologram through pupils: what they equal where it is known otherwise, and which are refused."""

import math

import pytest
import torch

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.hologram import refocused
from holotorch.optics import PupilViews, View

GRID, WAVELENGTH = Grid((40, 36), 9e-6), 520e-9
LIMIT = WAVELENGTH / 2 / 9e-6  # sine of the steepest direction


def noise(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.complex128)


def test_the_whole_pupil_sees_the_refocused_field():
    field = noise(1, 40, 36)
    seen = PupilViews(GRID, WAVELENGTH, [View(1e-3)])(field)[0, 0]
    wanted = refocused(field, GRID, WAVELENGTH, 1e-3, tolerance=1e-3)[0]
    wanted = wanted * torch.exp(torch.tensor(2j * math.pi * 1e-3 / WAVELENGTH))  # views have no carrier
    # Without a pupil, some of the light diffracts beyond the padding and wraps around; refocusing loses it.
    assert (seen - wanted).norm() < 0.03 * wanted.norm()


def test_two_halves_and_what_lies_on_the_edge_are_the_whole():
    field = noise(1, 40, 36)
    whole, left, right, upper = PupilViews(
        GRID,
        WAVELENGTH,
        [View(2e-3, 0.6 * LIMIT, covered=side) for side in ((0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0))],
    )(field)[0]
    # The middle column of the spectrum belongs to both halves.
    assert (left + right - whole).norm() < 0.4 * whole.norm()
    assert 0.4 < intensity(left).sum() / intensity(whole).sum() < 0.65
    assert not torch.allclose(left, upper)


def test_padding_holds_the_light_of_the_pupil():
    """Light within the pupil of a point at the edge of the window does not come in on the other side."""
    field = torch.zeros(1, 40, 36, dtype=torch.complex128)
    field[0, 20, 0] = 1
    seen = intensity(PupilViews(GRID, WAVELENGTH, [View(5e-3, 0.5 * LIMIT)])(field))[0, 0]
    cone = math.ceil(5e-3 * 0.5 * LIMIT / 9e-6)
    assert seen[:, cone + 4 :].sum() < 0.03 * seen.sum()  # what diffracts beyond the cone


def test_views_that_show_nothing_are_refused():
    with pytest.raises(ValueError, match=r"must lie within the directions .* sines up to 0\.0289"):
        PupilViews(GRID, WAVELENGTH, [View(1e-3, 0.01, (0.0, 0.05))])
    with pytest.raises(ValueError, match="wide enough to contain one of them"):
        PupilViews(GRID, WAVELENGTH, [View(1e-3, 1e-6, (1e-4, 1e-4))])
    with pytest.raises(ValueError, match="at least one view"):
        PupilViews(GRID, WAVELENGTH, [])
    with pytest.raises(ValueError, match="radius of a pupil"):
        View(1e-3, 0.0)
    with pytest.raises(ValueError, match="focus"):
        View(math.nan)
    with pytest.raises(ValueError, match=r"must end in \(C, V, H, W\) = \(1, 1, 40, 36\)"):
        PupilViews(GRID, WAVELENGTH, [View(1e-3)]).adjoint(noise(1, 40, 36))


def test_a_pupil_at_the_edge_of_the_directions_is_cut_off():
    edge = PupilViews(GRID, WAVELENGTH, [View(1e-3, 0.4 * LIMIT), View(1e-3, 0.4 * LIMIT, (0.0, LIMIT))])
    whole, cut = intensity(edge(noise(1, 40, 36)))[0].sum((-2, -1))
    assert 0.35 < cut / whole < 0.65


def test_a_focus_on_the_array_sees_the_array_itself():
    field = noise(1, 40, 36)
    views = PupilViews(GRID, WAVELENGTH, [View(0.0)])
    assert views.padded == GRID
    torch.testing.assert_close(views(field)[:, 0], field)


def test_selected_channels_are_those_of_the_whole_and_leave_it_as_it_is():
    lengths = (640e-9, 520e-9, 450e-9)
    views = PupilViews(GRID, lengths, [View(focus, 0.4 * LIMIT) for focus in (1e-3, 2e-3, 3e-3)])
    field = noise(3, 40, 36)
    for each in (field, field.to(torch.complex64)):
        part = views.select([2, 0], [1, 2])
        torch.testing.assert_close(part(each[1:]), views(each)[1:, [2, 0]], rtol=0, atol=0)
    assert part.wavelengths == lengths[1:] and views.wavelengths == lengths and views(field).shape[:2] == (3, 3)


def test_selected_views_are_those_of_the_whole_and_leave_it_as_it_is():
    views = PupilViews(GRID, WAVELENGTH, [View(focus, 0.5 * LIMIT) for focus in (1e-3, 2e-3, 3e-3)])
    field = noise(1, 40, 36)
    for each in (field, field.to(torch.complex64)):
        torch.testing.assert_close(views.select([2, 0])(each), views(each)[:, [2, 0]], rtol=0, atol=0)
    assert views.select([2]).views == views.views[2:] and len(views.views) == 3
    back = views.select([1]).adjoint(views(field)[:, [1]])
    torch.testing.assert_close(
        back, PupilViews(GRID, WAVELENGTH, [views.views[1]], longest=3e-3).adjoint(views(field)[:, [1]])
    )
