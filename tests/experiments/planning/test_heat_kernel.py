"""The heat beyond the table of a measured kernel: a guess that is right where the heat falls exponentially."""

import numpy as np
import pytest
import torch

from holotorch.experiments.planning.heat_kernel import (
    continued,
    cut_off_note,
    even,
    heat_beyond,
    is_cut_off,
    opposite_noise,
    response_note,
)


def rises(height: int, width: int, length: float = 2.0) -> torch.Tensor:
    """exp(-r / length) around the centre; ``length`` in pixels."""
    y, x = (np.arange(n) - n // 2 for n in (height, width))
    return torch.from_numpy(np.exp(-np.hypot(y[:, None], x) / length))


def test_an_exponential_goes_on_to_a_thousandth_of_the_centre():
    whole = continued(rises(7, 9), (101, 101))
    assert whole is not None and whole.shape == (29, 29)  # exp(-14 / 2) is 9e-4
    assert torch.allclose(whole, rises(29, 29), rtol=1e-9)


def test_the_taps_of_the_table_stay_and_the_rest_ends_at_the_array():
    table = rises(7, 9) * (1 + 0.1 * torch.rand(7, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    whole = continued(table, (16, 11))
    assert whole is not None and whole.shape == (15, 11)
    assert torch.equal(whole[4:11, 1:10], table)


def test_a_kernel_that_does_not_fall_is_not_continued():
    assert continued(torch.ones(7, 7, dtype=torch.float64), (32, 32)) is None
    assert continued(rises(3, 3), (32, 32)) is None  # two rings are the whole table


@pytest.mark.parametrize(("length", "cut"), [(0.5, False), (0.7, True), (1.5, True)])
def test_a_table_that_ends_while_it_is_warm_is_noted(length, cut):
    kernel = rises(7, 7, length)
    assert is_cut_off(kernel) == cut == bool(cut_off_note(kernel))
    beyond = float(rises(401, 401, length).sum() / kernel.sum()) - 1
    assert heat_beyond(kernel) == pytest.approx(beyond, rel=0.1, abs=2e-3)  # without what is below a thousandth
    assert not cut or f"some {heat_beyond(kernel):.1%} of that within" in cut_off_note(kernel)[0]


def test_a_phase_per_kelvin_without_its_wavelength_is_noted_where_there_is_no_light_of_630_nm():
    (note,) = response_note({"rad_per_K"}, "display", [520e-9])
    assert "display.rad_per_K_at=520nm" in note
    assert response_note({"rad_per_K", "rad_per_K_at"}, "display", [520e-9]) == []
    assert (
        response_note({"rad_per_K"}, "modulator", [630e-9, 520e-9]) == response_note(set(), "modulator", [5e-7]) == []
    )


@pytest.mark.parametrize("size", [(7, 7), (5, 9)])
def test_the_noise_of_opposite_taps_is_that_of_each(size):
    """Of the same noise in every tap, and of one in proportion to the rise, which the cold ring does not show.

    The larger of two estimates, of all taps and of the ring's, is too large by a tenth or so.
    """
    kernel = rises(*size).double()
    assert opposite_noise(kernel) == 0 and torch.equal(even(kernel), kernel)
    noise = torch.randn(200, *size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    noise[:, size[0] // 2, size[1] // 2] = 0
    for each in (1e-3 * noise, 0.02 * kernel * noise):
        estimates = torch.tensor([opposite_noise(kernel + one) for one in each])
        assert float(estimates.square().mean().sqrt()) == pytest.approx(float(each.square().mean().sqrt()), rel=0.15)
    uneven = kernel + 0.02 * kernel * noise[0]
    torch.testing.assert_close(even(uneven), (uneven + uneven.flip((0, 1))) / 2, rtol=0, atol=0)
