"""Panels of real pixels, against quadrature over the band and against the theory of gratings."""

import math

import numpy as np
import pytest
import torch
from oracles import pixels

from holotorch import Grid
from holotorch.optics.elements.pixels import PixelShape, order_efficiency

GRID = Grid((12, 17), (5e-6, 4e-6))
FILLS = [(1.0, 0.9), (0.3, 0.3), (1e-9, 1e-9)]
# Rounding: sums of 204 products with taps below s <= 5 per axis, 204 * 25 * 1e-16 of values near 1.
EXACT = 1e-12


def white(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.complex128)


def tail(margin: int, fill: tuple[float, float], finer: int) -> float:
    """Bound on the part of a panel's amplitude that lies beyond ``margin`` pitches on both sides and both axes.

    On the samples, d pitches from a pixel, Si(pi s (d + a/2)) - Si(pi s (d - a/2)) over pi a has two leading terms,
    together below (1 + 2 / (pi a s)) / (pi^2 s d^2); summed over d > margin, two sides, a sample being 1/s of a pitch.
    """
    return sum(2 * (1 + 2 / (math.pi * part * finer)) / (math.pi**2 * finer * margin) for part in fill)


@pytest.mark.parametrize("fill", FILLS)
@pytest.mark.parametrize("orders", [0, 1, 2])
@pytest.mark.parametrize("grid", [GRID, Grid((17, 12), (5e-6, 4e-6)), Grid((1, 6), 8e-6)], ids=str)
def test_equals_quadrature_over_the_band(grid, orders, fill):
    operator, field = PixelShape(grid, fill=fill, orders=orders), white(1, *grid.shape)
    matrix = pixels.pixel_matrix(grid.shape, grid.pitch, fill, orders)
    wanted = (matrix @ field[0].numpy().ravel()).reshape(operator.out_grid.shape)
    np.testing.assert_allclose(operator(field)[0].numpy(), wanted, rtol=0, atol=EXACT * np.abs(wanted).max())
    seen = white(1, *operator.out_grid.shape)
    wanted = (matrix.conj().T @ seen[0].numpy().ravel()).reshape(grid.shape)
    np.testing.assert_allclose(operator.adjoint(seen)[0].numpy(), wanted, rtol=0, atol=EXACT * np.abs(wanted).max())


def test_a_high_order_is_as_exact():
    # The rule for the taps must keep up with the band: 41 times finer, quadrature over 41 pi 6 / 2 rad per axis.
    grid, fill = Grid((5, 6), (5e-6, 4e-6)), (1.0, 0.7)
    field = white(1, 5, 6)
    wanted = pixels.pixel_matrix(grid.shape, grid.pitch, fill, 20) @ field[0].numpy().ravel()
    got = PixelShape(grid, fill=fill, orders=20)(field)[0].numpy().ravel()
    np.testing.assert_allclose(got, wanted, rtol=0, atol=EXACT * np.abs(wanted).max())


@pytest.mark.parametrize("shape", [(12, 17), (17, 12), (1, 2)])
@pytest.mark.parametrize("orders", [0, 1, 2, 3])
def test_point_pixels_light_the_samples_at_their_own_coordinates(shape, orders):
    grid = Grid(shape, (5e-6, 4e-6))
    # sinc(fill u) differs from 1 by (pi fill s / 2)^2 / 6 < 1e-15 over the band.
    operator, field, s = PixelShape(grid, fill=1e-9, orders=orders), white(1, *shape), 2 * orders + 1
    index = [s * torch.arange(n) + orders * (n % 2) for n in shape]
    wanted = torch.zeros(1, *operator.out_grid.shape, dtype=torch.complex128)
    wanted[0, index[0][:, None], index[1]] = s * s * field[0]
    torch.testing.assert_close(operator(field), wanted, rtol=0, atol=s * s * EXACT)
    for here, there, i, extents in zip(
        grid.coordinates(),
        operator.out_grid.coordinates(),
        index,
        zip(grid.extent, operator.out_grid.extent, strict=True),
        strict=True,
    ):
        torch.testing.assert_close(there.flatten()[i], here.flatten(), rtol=1e-15, atol=0)
        assert extents[1] == pytest.approx(extents[0], rel=1e-15)


@pytest.mark.parametrize("fill", [(0.9, 0.6), (0.3, 1.0)])
@pytest.mark.parametrize("blaze", [0.0, 0.25])
def test_far_field_has_the_orders_of_a_grating(fill, blaze):
    orders, finer, panel, margin = 2, 5, (9, 8), 44
    grid = Grid((panel[0] + 2 * margin, panel[1] + 2 * margin), (5e-6, 4e-6))
    operator = PixelShape(grid, fill=fill, orders=orders)
    field = torch.zeros(1, *grid.shape, dtype=torch.complex128)
    rise = torch.exp(2j * torch.pi * blaze * torch.arange(panel[1], dtype=torch.float64))
    field[0, margin : margin + panel[0], margin : margin + panel[1]] = rise
    out = operator(field)[0].numpy()
    bound = tail(margin, fill, finer)
    whole = np.arange(-orders, orders + 1)
    # Divided by the panel's area, an order's amplitude is the product of its sincs.
    area = math.prod(panel) * math.prod(grid.pitch)
    places = (whole / grid.pitch[0], (whole[:-1] + blaze) / grid.pitch[1])
    got = np.abs(pixels.far_field(out, operator.out_grid.pitch, *places)) / area
    wanted = [
        [math.sqrt(order_efficiency(fill, (float(m), float(n)))) for n in whole[:-1] + blaze] for m in whole.tolist()
    ]
    np.testing.assert_allclose(got, np.array(wanted) / math.prod(fill), rtol=0, atol=bound)
    # Between the orders a panel of 8 has nulls at every eighth, and where the orders were without a blaze.
    nulls = np.delete(np.arange(-16, 16), np.arange(0, 32, 8) + round(8 * blaze)) / 8 / grid.pitch[1]
    assert np.abs(pixels.far_field(out, operator.out_grid.pitch, [0.0], nulls)).max() / area <= bound


@pytest.mark.parametrize("fill", [(1.0, 1.0), (1.0, 0.5)])
@pytest.mark.parametrize("orders", [0, 1, 4, 10])
def test_all_orders_together_hold_the_light_that_passes(fill, orders):
    finer, panel, margin = 2 * orders + 1, 6, 12
    grid = Grid((panel + 2 * margin, panel + 2 * margin + 1), (5e-6, 4e-6))
    field = torch.zeros(1, *grid.shape, dtype=torch.complex128)
    field[0, margin : margin + panel, margin : margin + panel] = 1
    out = PixelShape(grid, fill=fill, orders=orders)(field)
    # True amplitudes are relative ones times the fill; of the light on the panel, the fill passes.
    share = (out.abs().square().sum() / finer**2 * math.prod(fill) ** 2 / panel**2).item() / math.prod(fill)
    # Per axis beyond the band, of stripes w pitches wide (the panel, where pixels touch): sin^2 under 2 / (pi f)^2 / w
    # from f = s / 2 on, 4 / (pi^2 w s). Beyond the window the amplitude is the tail, at most, and falls like 1 / d.
    lost = sum(4 / (math.pi**2 * (panel if part == 1 else part) * finer) for part in fill)
    assert 1 - lost - tail(margin, fill, finer) <= share <= 1 + EXACT


def test_a_blaze_moves_light_between_orders_and_loses_none():
    last, tilt = 400, 0.3
    # The rest: sin^2 / (pi (m + t))^2 over |m| > last, each side below 1 / (pi^2 (last - t)).
    rest = 2 / (math.pi**2 * (last - tilt))
    for fill in (1.0, 0.5):
        total = sum(order_efficiency((1.0, fill), (0, m + tilt)) for m in range(-last, last + 1))
        assert 0 <= fill - total <= rest
    # Half a turn per pixel shares the light between orders 0 and -1: (2 / pi)^2 each.
    assert order_efficiency(1.0, (0, 0.5)) == pytest.approx((2 / math.pi) ** 2, rel=1e-14)
    assert order_efficiency((0.5, 1.0), (1, 0)) == pytest.approx(1 / math.pi**2, rel=1e-14)
    assert order_efficiency(1.0, (1, 0)) == pytest.approx(0, abs=1e-30)


def test_nothing_wraps_round_to_the_other_side():
    grid = Grid((1, 40), 8e-6)
    field = torch.zeros(1, 1, 40, dtype=torch.complex128)
    field[..., -1] = 1
    out = PixelShape(grid, fill=0.8, orders=1)(field).abs().flatten()
    # Both axes: a tap falls like 1 / (pi d) between samples' zeros; over y the single pixel has at most s of its own.
    assert out[:3].max() <= 3 / (math.pi * 38)


@pytest.mark.parametrize("bad", [0.0, -0.5, 1.01, float("nan"), float("inf"), (1.0, 0.0), (0.5, 0.5, 0.5)])
def test_refuses_a_bad_fill(bad):
    for build in (lambda: PixelShape(GRID, fill=bad), lambda: order_efficiency(bad, (0, 0))):
        with pytest.raises(ValueError, match="^fill must be"):
            build()


def test_refuses_what_it_cannot_do():
    with pytest.raises(TypeError, match="fill must be a number"):
        PixelShape(GRID, fill=None)  # type: ignore[arg-type]
    for orders in (True, 1.0, "1", None):
        with pytest.raises(TypeError, match="orders must be a whole number"):
            PixelShape(GRID, orders=orders)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="orders must be at least 0"):
        PixelShape(GRID, orders=-1)
    with pytest.raises(ValueError, match=r"order must be a pair \(y, x\)"):
        order_efficiency(1.0, 1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="order must be finite"):
        order_efficiency(1.0, (0, float("nan")))
    operator = PixelShape(GRID, orders=1)
    with pytest.raises(ValueError, match=r"field must end in \(H, W\) = \(12, 17\), got \(1, 17, 12\)"):
        operator(white(1, 17, 12))
    with pytest.raises(ValueError, match=r"field must end in \(H, W\) = \(36, 51\), got \(1, 12, 17\)"):
        operator.adjoint(white(1, *GRID.shape))
    with pytest.raises(TypeError, match="field must be complex"):
        operator(torch.ones(1, *GRID.shape))
    with pytest.raises(TypeError, match=r"field must be a torch\.Tensor"):
        operator(np.ones((1, *GRID.shape), complex))
    assert "fill=(1.0, 1.0), orders=1" in repr(operator)
