import numpy as np
import pytest
import torch

from holotorch import Grid


@pytest.mark.parametrize("shape", [(4, 5), (1, 1), (7, 2), (12, 17)])
def test_axis_lies_on_the_middle_sample_and_frequencies_are_those_of_the_dft(shape):
    grid = Grid(shape, (2e-6, 3e-6))
    y, x = grid.coordinates()
    fy, fx = grid.frequencies()
    assert y.shape == (shape[0], 1) and x.shape == (1, shape[1])
    assert y[shape[0] // 2, 0] == 0 and x[0, shape[1] // 2] == 0
    np.testing.assert_allclose(fy[:, 0], np.fft.fftfreq(shape[0], 2e-6), rtol=1e-15)
    np.testing.assert_allclose(fx[0], np.fft.fftfreq(shape[1], 3e-6), rtol=1e-15)
    assert {t.dtype for t in (y, x, fy, fx)} == {torch.float64}


def test_one_number_serves_both_axes():
    assert Grid(8, 1e-6) == Grid((8, 8), (1e-6, 1e-6))
    assert Grid((4, 6), (1e-6, 2e-6)).extent == pytest.approx((4e-6, 12e-6))


def test_frozen_and_hashable():
    grid = Grid(8, 1e-6)
    with pytest.raises(AttributeError):
        grid.shape = (4, 4)  # type: ignore[misc]
    assert len({grid, Grid(8, 1e-6)}) == 1


@pytest.mark.parametrize(
    ("factor", "shape"),
    [(1, (12, 17)), (2, (24, 36)), ((1, 2), (12, 36)), (1.001, (15, 18)), (1.5, (18, 27))],
)
def test_padded_takes_good_lengths_and_leaves_factor_one_alone(factor, shape):
    padded = Grid((12, 17), (1e-6, 2e-6)).padded(factor)
    assert padded == Grid(shape, (1e-6, 2e-6))


@pytest.mark.parametrize(
    ("shape", "pitch", "error", "message"),
    [
        ((8, 8), -1e-6, ValueError, "grid pitch must be above zero in metres, got -1e-06"),
        ((8, 8), 0.0, ValueError, "above zero"),
        ((8, 8), float("nan"), ValueError, "finite"),
        ((8, 8), (1e-6, float("inf")), ValueError, "finite"),
        ((8, 8), ("wide", 1e-6), TypeError, "number"),
        ((0, 8), 1e-6, ValueError, "at least"),
        ((8, 8.5), 1e-6, TypeError, "whole number"),
        ((8, True), 1e-6, TypeError, "whole number"),
        (None, 1e-6, TypeError, "whole number"),
        (8, True, TypeError, "number"),
        (8, "12um", TypeError, "grid pitch must be a number in metres, got str '12um'; give 12e-6$"),
        (8, (12e-6, "0.5 mm"), TypeError, "got str '0.5 mm'; give 0.5e-3$"),
        ("64", 1e-6, TypeError, "whole number"),
        ((8, 8, 8), 1e-6, ValueError, r"\(H, W\)"),
    ],
)
def test_refuses_what_is_no_grid(shape, pitch, error, message):
    with pytest.raises(error, match=message):
        Grid(shape, pitch)  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [0.5, 0, -1, float("nan"), float("inf")])
def test_refuses_a_padding_below_one(factor):
    with pytest.raises(ValueError, match="pad must be a finite factor of at least 1"):
        Grid(8, 1e-6).padded(factor)
