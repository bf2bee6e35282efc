"""Views of a hologram by one transform: those of PupilViews, whose tests judge them by other means."""

import pytest
import torch

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.experiments.view.kinds.refocus import Refocuser
from holotorch.optics import PupilViews, View

GRID, WAVELENGTHS, LONGEST = Grid((31, 24), (4e-6, 5e-6)), (640e-9, 450e-9), 2e-3
ROUNDING = 2e-6  # relative to the brightest pixel, of complex64 transforms of 10^4 samples


@pytest.mark.parametrize("light", [WAVELENGTHS, (650e-9, 440e-9)])
@pytest.mark.parametrize("view", [View(1.3e-3), View(0.4e-3, 0.03, (0.01, -0.02)), View(2e-3, 0.05)])
def test_a_view_is_that_of_pupil_views(view, light):
    fields = torch.randn(3, 2, *GRID.shape, dtype=torch.complex64)
    refocuser = Refocuser(fields, GRID, WAVELENGTHS, LONGEST)
    views = intensity(PupilViews(GRID, light, [view], longest=LONGEST)(fields.to(torch.complex128)))[:, :, 0]
    got = refocuser.intensity(view, light)
    assert (got - views.mean(0)).abs().max() < ROUNDING * views.max()
    assert (refocuser.intensity(view, light, frame=1) - views[1]).abs().max() < ROUNDING * views.max()
    if view.radius > 1:
        assert refocuser.share() == pytest.approx([1.0, 1.0], rel=1e-6)


def test_the_share_of_noise_in_a_pupil_is_its_share_of_the_band():
    fields = torch.randn(1, 1, 128, 128, dtype=torch.complex64)
    refocuser = Refocuser(fields, Grid(128, 4e-6), 500e-9, 1e-4)
    refocuser.intensity(View(1e-4, 0.04))
    band = (500e-9 / 4e-6) ** 2
    # 128^2 independent frequencies, of which a share is inside: the deviation is sqrt of their number.
    assert refocuser.share()[0] == pytest.approx(torch.pi * 0.04**2 / band, rel=5 / (0.32 * 128**2) ** 0.5)


def test_a_pupil_that_holds_no_direction_is_refused():
    refocuser = Refocuser(torch.ones(1, 1, 16, 16, dtype=torch.complex64), Grid(16, 4e-6), 500e-9, 1e-3)
    with pytest.raises(ValueError, match="too small or too far aside for light of 500 nm"):
        refocuser.intensity(View(1e-3, 1e-4, (0.0, 0.5)))
