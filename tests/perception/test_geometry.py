import math

import numpy as np
import pytest
import torch
from oracles import perception as oracle

from holotorch.perception import CurvedScreen, FlatScreen, Headset, eccentricity_of, separation

SHAPE = (12, 17)
FLAT = FlatScreen(SHAPE, (0.9, 1.4), 0.6)
# The eye before, on and behind the middle of the curvature.
CURVED = [CurvedScreen(SHAPE, (1.2, 5.0), distance, 2.0) for distance in (1.6, 2.0, 2.7)]
HEADSET = Headset(SHAPE, 0.14)
ALL = [FLAT, *CURVED, HEADSET]
NAMES = ["flat", "near", "middle", "behind", "headset"]
Y, X = torch.meshgrid(torch.arange(12).double(), torch.arange(17).double(), indexing="ij")


def seen(screen, y_px: float, x_px: float) -> np.ndarray:
    """Vector to a pixel, for screens with metres."""
    y_m, x_m = (y_px - 5.5) * screen.size[0] / 12, (x_px - 8) * screen.size[1] / 17
    return oracle.screen_point(y_m, x_m, screen.distance, getattr(screen, "radius", None))


@pytest.mark.parametrize("screen", ALL[:4], ids=NAMES[:4])
def test_directions_are_those_of_the_rays(screen):
    elevation, azimuth = screen.angles(Y, X)
    eccentricity = screen.eccentricity_map()
    along_y, along_x = screen.pixels_per_degree(Y, X)
    step = 1e-4  # pixels; the difference quotient is off by 1e-8, its rounding by 1e-11
    for i, j in ((0, 0), (5, 8), (11, 3), (4, 16)):
        ray = seen(screen, i, j)
        wanted = oracle.direction(elevation[i, j].item(), azimuth[i, j].item())
        assert oracle.between(ray, wanted) < 1e-6
        assert eccentricity[i, j].item() == pytest.approx(oracle.between(ray, (0, 0, 1)), abs=1e-9)
        for found, (dy, dx) in ((along_y, (step, 0)), (along_x, (0, step))):
            turn = oracle.between(seen(screen, i + dy, j + dx), seen(screen, i - dy, j - dx))
            assert found[i, j].item() == pytest.approx(2 * step / turn, rel=1e-6)


def test_headset_has_equal_angles_outwards():
    elevation, azimuth = HEADSET.angles(Y, X)
    assert torch.allclose(HEADSET.eccentricity_map() * 0.14, torch.hypot(Y - 5.5, X - 8))
    along_y, along_x = HEADSET.pixels_per_degree(Y, X)
    for i, j in ((0, 0), (5, 8), (11, 3), (6, 16)):
        for found, (dy, dx) in ((along_y, (1e-4, 0)), (along_x, (0, 1e-4))):
            ends = [HEADSET.angles(i + s * dy, j + s * dx) for s in (-1, 1)]
            turn = oracle.between(*(oracle.direction(e.item(), a.item()) for e, a in ends))
            assert found[i, j].item() == pytest.approx(2e-4 / turn, rel=1e-6)
    assert azimuth[0, 16] > 0 > azimuth[0, 0] and elevation[0, 0] > 0 > elevation[11, 0]
    middle = Headset((11, 17), 2.0)
    assert [part.item() for part in middle.pixels_per_degree(5, 8)] == pytest.approx([2, 2])
    assert middle.pixels(0, 180)[1].isnan()  # a whole circle


@pytest.mark.parametrize("screen", ALL, ids=NAMES)
def test_pixels_and_angles_are_inverse(screen):
    y, x = screen.pixels(*screen.angles(Y, X))
    assert torch.allclose(y, Y, atol=1e-10, rtol=0) and torch.allclose(x, X, atol=1e-10, rtol=0)
    assert screen.shows(*screen.angles(Y, X)).all() and not screen.shows(*screen.angles(-0.6, 3.0))
    point = torch.tensor([3.2, 7.9], dtype=torch.float64, requires_grad=True)
    ahead = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: screen.pixels(p[0], p[1]), ahead)
    for way in (screen.angles, screen.pixels, screen.pixels_per_degree):
        assert torch.autograd.gradcheck(lambda p, w=way: w(p[0], p[1]), point)
        assert way(torch.tensor(1.0), torch.tensor(2.0))[0].dtype == torch.float32


def test_metres_fields_and_widths_by_hand():
    assert [part.item() for part in FLAT.metres(5.5, 8)] == [0, 0]
    assert FLAT.metres(11.5, 16.5)[1].item() == pytest.approx(0.7)  # the right edge
    assert [part.item() for part in FLAT.pixels_at(0.45, -0.7)] == pytest.approx([11.5, -0.5])
    assert FLAT.field_deg == pytest.approx([2 * math.degrees(math.atan(half / 0.6)) for half in (0.45, 0.7)])
    assert FlatScreen.spanning(SHAPE, (60, 100)).field_deg == pytest.approx((60, 100))
    assert CURVED[1].field_deg[1] == pytest.approx(math.degrees(5.0 / 2.0))  # from the axis: arc over radius
    assert HEADSET.field_deg == pytest.approx((12 / 0.14, 17 / 0.14))
    assert Headset((200, 360), 1.0).field_deg == (200, 360)  # its top is 10 deg beyond the zenith
    # 10 deg at 30 deg on a flat screen of 85 px/m... here 17 px on 1.4 m: from 25 to 35 deg.
    wanted = 0.6 * (math.tan(math.radians(35)) - math.tan(math.radians(25))) * 17 / 1.4
    assert FLAT.width_px(30, 10).item() == pytest.approx(wanted)
    assert HEADSET.width_px(-30, 10).item() == pytest.approx(1.4)


def test_the_thesis_screen():
    """A half turn of cylinder of 2.36 m seen from its axis: 180 deg, and 6400 px on it are 35.6 px/deg throughout."""
    screen = CurvedScreen((2100, 6400), (2.4, math.pi * 2.36), 2.36, 2.36)
    assert screen.field_deg[1] == pytest.approx(180)
    found = screen.pixels_per_degree(1049.5, torch.tensor([0.0, 3199.5, 6000.0]).double())[1]
    assert torch.allclose(found, torch.full((3,), 6400 / 180, dtype=torch.float64), rtol=1e-12)


def test_what_no_ray_meets_is_nan():
    assert all(part.isnan() for part in FLAT.pixels(0, 90)) and FLAT.pixels(0, -120)[1].isnan()
    assert not FLAT.shows(0, 100)
    outside = CurvedScreen(SHAPE, (1.0, 2.0), 5.0, 2.0)  # the eye 3 m in front of the axis of a cylinder of 2 m
    assert outside.pixels(0, 50)[1].isnan() and outside.pixels(0, 10)[1].isfinite()
    assert outside.pixels(0, 180)[1].isnan()
    with pytest.raises(ValueError, match="elevation_deg must be within -90"):
        FLAT.pixels(91, 0)
    with pytest.raises(ValueError, match="azimuth_deg must be within -180"):
        FLAT.pixels(0, 200)


def test_separation_is_exact_near_and_far():
    assert separation(10, 20, 10, 20).item() == 0 and separation(0, 0, 0, 180).item() == 180
    assert separation(0, 1e-7, 0, 0).item() == pytest.approx(1e-7, rel=1e-9)
    assert eccentricity_of(-30, 40).item() == pytest.approx(oracle.between(oracle.direction(-30, 40), (0, 0, 1)))
    start = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    assert not torch.autograd.grad(eccentricity_of(start[0], start[1]), start)[0].any()
    away = torch.tensor([-12.0, 33.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: eccentricity_of(p[0], p[1]), away)


def test_impossible_displays():
    with pytest.raises(ValueError, match="distance must be above zero"):
        FlatScreen(SHAPE, (1, 1), 0.0)
    with pytest.raises(ValueError, match="at most a full turn"):
        CurvedScreen(SHAPE, (1, 13), 1.0, 2.0)
    with pytest.raises(ValueError, match="within 0 .. 180 degrees for a flat screen"):
        FlatScreen.spanning(SHAPE, (60, 180))
    with pytest.raises(TypeError, match=r"shape must be \(H, W\)"):
        Headset(12, 1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="field must be at most 360 degrees, got 400"):
        Headset((10, 400), 1.0)
    with pytest.raises(ValueError, match="resolution must be above zero"):
        Headset(SHAPE, -1.0)
