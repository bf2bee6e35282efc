"""Random propagations against plain sums; ``scripts/campaign.py propagate`` runs thousands of them."""

import warnings

import numpy as np
import pytest
import torch
from oracles.propagation import random_case

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.optics import plan_propagation, propagate

# Of ten thousand, those whose error was beyond ten tolerances without a word while a plan's prediction was relative to
# the light that noise would leave in the window, tilts were predicted without what one axis does to the other, and a
# pitch below 0.9 wavelengths as if it were coarse. The last two were right already.
DESCRIBED = (
    825,
    2236,
    2537,
    3126,
    3660,
    4070,
    4267,
    4485,
    4973,
    5324,
    5528,
    5638,
    6371,
    6823,
    6934,
    6950,
    7642,
    7927,
    8463,
    8464,
    8776,
    8781,
    9974,
    0,
    3,
)
MEASURED = (
    568,
    792,
    825,
    888,
    1216,
    1623,
    2236,
    2537,
    3660,
    4070,
    4120,
    4973,
    5159,
    5207,
    5324,
    6209,
    6494,
    6823,
    6934,
    7301,
    7640,
    7781,
    7927,
    8203,
    8776,
    9267,
    9406,
    9816,
    0,
    3,
)


@pytest.mark.parametrize(
    ("seed", "measure"), [*((seed, False) for seed in DESCRIBED), *((seed, True) for seed in MEASURED)]
)
def test_no_error_beyond_ten_tolerances_is_silent(seed, measure):
    case = random_case(seed)
    said, got = "", None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            got = propagate(
                torch.from_numpy(case.field),
                Grid(case.field.shape[-2:], case.pitch),
                case.wavelength,
                case.distance,
                tolerance=case.tolerance,
                band=case.band,
                measure=measure,
                out_grid=Grid(case.out_shape, case.out_pitch),
                offset=case.offset,
                tilt=case.tilt,
            )
        except ValueError as refused:
            said = str(refused)
    if got is None:
        assert "no method reaches a tolerance" in said
        return
    if caught:
        assert {each.category for each in caught} == {SamplingWarning}
        return
    wanted = case.exact()
    assert np.linalg.norm(got.numpy() - wanted) <= 10 * case.tolerance * np.linalg.norm(wanted)


def test_a_beam_that_misses_the_window_is_said_and_one_that_hits_it_is_not():
    grid, tilt = Grid(64, 8e-6), 2e4
    y, x = grid.coordinates()
    beam = torch.exp(-(y**2 + x**2) / 60e-6**2) * torch.exp(2j * np.pi * tilt * x)
    aside = 20e-3 * 530e-9 * tilt
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        propagate(beam, grid, 530e-9, 20e-3, offset=(0.0, aside))
        propagate(beam * 0, grid, 530e-9, 20e-3)  # no light at all lands dark everywhere
    with pytest.warns(SamplingWarning, match=r"only .*e-18 of the light lands in the window") as caught:
        got = propagate(torch.stack([beam, beam.conj()]), grid, 530e-9, 20e-3, offset=(0.0, -2 * aside))
    assert "Move the window to the light, or ask for a tolerance below" in str(caught[0].message)
    assert got.isfinite().all()


def test_a_tilted_pitch_below_a_wavelength_keeps_its_tilt():
    grid, wavelength, tilt = Grid((20, 24), 0.55e-6), 640e-9, (0.06, -0.1)
    case = random_case(1)
    field = torch.from_numpy(np.random.default_rng(1).normal(size=(20, 24)) + 0j)
    with pytest.warns(SamplingWarning, match="no method reaches"):
        got = propagate(field, grid, wavelength, 3e-6, tolerance=1e-4, tilt=tilt)
    wanted = type(case)(
        "", field.numpy(), grid.pitch, wavelength, 3e-6, 1e-4, grid.shape, grid.pitch, (0.0, 0.0), tilt, None
    ).exact()
    plan = plan_propagation(grid, wavelength, 3e-6, tolerance=1e-4, tilt=tilt, dtype=field.dtype)
    error = np.linalg.norm(got.numpy() - wanted) / np.linalg.norm(wanted)
    assert plan.predicted_error / 10 < error < 3 * plan.predicted_error and plan.predicted_error < 0.1


def test_other_grids_of_fine_pitches_are_read_from_the_sampled_spectrum():
    """The factor beyond Fresnel does not separate there, as ResampledKernel says."""
    plan = plan_propagation(Grid(32, 0.45e-6), 530e-9, 2e-6, out_grid=Grid(32, 0.6e-6), tolerance=1e-2)
    assert plan.method == "angular spectrum, zoomed"
