import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.modulator import PhaseModulator
from holotorch.modulator import patterns as p
from holotorch.modulator.panel import even_lut

SHAPE = (24, 32)


def first_order(panel: PhaseModulator, frames: torch.Tensor, period: int) -> np.ndarray:
    """Intensity of the grating's first order along x, as a camera in the far field sees it."""
    field = panel.emitted(panel.phase(frames[:, None]))[:, 0].numpy()
    return np.abs(np.fft.fft2(field)[:, 0, SHAPE[1] // period] / math.prod(SHAPE)) ** 2


@pytest.mark.parametrize("bits", [8, 10])
def test_frames_hold_the_levels_asked_for(bits):
    top, kind = 2**bits - 1, torch.uint8 if bits == 8 else torch.uint16
    sweep = p.grey_sweep(SHAPE, [0, 7, top], bits=bits)
    assert sweep.shape == (3, *SHAPE) and sweep.dtype == kind
    np.testing.assert_array_equal(sweep.numpy(), np.broadcast_to(np.array([0, 7, top])[:, None, None], (3, *SHAPE)))
    np.testing.assert_array_equal(p.uniform(SHAPE, top, bits=bits).numpy(), np.full(SHAPE, top))
    board = p.checkerboard(SHAPE, 4, top, reference=3, bits=bits).numpy()
    np.testing.assert_array_equal(board, np.kron(np.indices((6, 8)).sum(0) % 2, np.ones((4, 4))) * (top - 3) + 3)


def test_gratings_along_both_axes_and_between():
    stripes = np.tile([5, 5, 5, 200, 200, 200], 6)[:32]
    across, down = (p.grating(SHAPE, 6, 200, reference=5, angle=angle).numpy() for angle in (0, math.pi / 2))
    np.testing.assert_array_equal(across, np.broadcast_to(stripes, SHAPE))
    np.testing.assert_array_equal(down, np.broadcast_to(stripes[:24, None], SHAPE))
    slanted = p.grating((48, 48), 8 / math.sqrt(2), 1, angle=math.pi / 4).numpy()  # period 8 along either axis
    orders = np.abs(np.fft.fft2(slanted - slanted.mean()))
    assert np.unravel_index(orders.argmax(), orders.shape) in ((6, 6), (42, 42))


def test_first_order_of_a_sweep_is_a_squared_sine():
    grid, levels = Grid(SHAPE, 4e-6), range(0, 256, 15)
    got = first_order(PhaseModulator(grid, 530e-9), p.grating_sweep(SHAPE, levels, period=8), 8)
    # Half a period is 4 samples: (1 / (8 sin(pi / 8)))^2 instead of the continuous (1 / pi)^2, times |1 - exp|^2.
    wanted = [(2 * math.sin(math.pi * level / 256) / (8 * math.sin(math.pi / 8))) ** 2 for level in levels]
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-14)


CURVES = {
    "straight": lambda t: 6.26 * t,
    "bent": lambda t: 5.0 * t**1.5,
    "S": lambda t: 6.2 * (0.9 * (0.5 - 0.5 * torch.cos(math.pi * t)) + 0.1 * t),
    "two turns": lambda t: 12.0 * t**1.2,
}


@pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES)
def test_the_table_is_found_from_a_noisy_sweep(curve):
    lut = curve(torch.linspace(0, 1, 256, dtype=torch.float64))
    panel = PhaseModulator(Grid(SHAPE, 4e-6), 530e-9, lut=lut)
    clean = first_order(panel, p.grating_sweep(SHAPE, range(256)), 8)
    noise, peak = 0.005, clean.max()
    measured = 700 * (clean / peak + 0.07 + noise * np.random.default_rng(2).standard_normal(256))
    fit = p.fit_lut(range(256), torch.from_numpy(measured))
    error = (fit.lut - lut).abs()
    # 15 levels share a knot, so intensities are known to noise / sqrt(15) = 0.0013 of the peak there. On a slope that
    # is 2 * 0.0013 rad; at an extremum, flat to second order, 2 sqrt(0.0013) = 0.07 rad, and twice that is allowed.
    assert error.max() < 0.15 and error.square().mean().sqrt() < 0.05
    assert (fit.lut.diff() > 0).all() and fit.lut[0] == 0
    assert fit.rms == pytest.approx(noise, rel=0.25)
    assert fit.peak == pytest.approx(700, rel=0.02) and fit.background == pytest.approx(49, abs=10)
    PhaseModulator(panel.grid, 530e-9, lut=fit.lut)  # is a table that a panel takes


def test_a_coarse_sweep_gives_every_level_too():
    lut, levels = even_lut(10), [*range(0, 1023, 16), 1023]
    panel = PhaseModulator(Grid(SHAPE, 4e-6), 530e-9, bits=10)
    sweep = first_order(panel, p.grating_sweep(SHAPE, levels, bits=10), 8)
    fit = p.fit_lut(levels, torch.from_numpy(sweep), bits=10)
    # Noiseless: what is left is the pull towards equal steps, which a straight table has, and the optimiser's stop.
    assert (fit.lut - lut).abs().max() < 0.02


def test_chart_shows_every_flip_and_turn():
    chart = p.orientation_chart((48, 48)).numpy()
    turns = [np.rot90(each, k) for each in (chart, chart.T) for k in range(4)]
    assert all((one != other).mean() > 0.1 for i, one in enumerate(turns) for other in turns[:i])
    corners = chart[[0, 0, -1, -1], [0, -1, 0, -1]].tolist()
    assert corners == [63, 127, 191, 255] and (chart == 0).any()
    assert p.orientation_chart((16, 40), bits=10).dtype == torch.uint16


def test_circles_are_centred_on_the_axis():
    frame = p.circles((41, 50), [8, 15], 255).numpy()
    assert frame[20].all() and frame[:, 25].all()
    y, x = np.indices(frame.shape) - np.array([20, 25])[:, None, None]
    radius = np.hypot(y, x)
    off = (y != 0) & (x != 0)
    np.testing.assert_array_equal(frame[off] > 0, ((abs(radius - 8) <= 1) | (abs(radius - 15) <= 1))[off])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: p.uniform(SHAPE, 256), "level must be at most 255 for 8 bits, got 256"),
        (lambda: p.grating(SHAPE, 1, 255), "period must be at least 2 pixels"),
        (lambda: p.grating(SHAPE, 8, 255, reference=-1), "reference must be at least 0"),
        (lambda: p.orientation_chart((8, 40)), "at least 16 x 16 pixels"),
        (lambda: p.circles(SHAPE, [0], 255), "radius must be above zero"),
        (lambda: p.fit_lut(range(10), torch.rand(10)), "at least 24 rising levels from 0 to 255"),
        (lambda: p.fit_lut(range(256), torch.ones(256)), "does not change with the level"),
        (lambda: p.fit_lut(range(256), torch.full((256,), math.nan)), "first_order_intensity must be finite"),
        (lambda: p.fit_lut(range(256), torch.linspace(0, 1, 256).square()), "no clear maximum within the sweep"),
    ],
)
def test_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()
