"""Values that would make a run meaningless without a word: refused where they are given."""

import math

import pytest
import torch

from holotorch.core.grid import Grid
from holotorch.correction import APG, LBFGS, PECProblem, ProjectedAdam, gerchberg_saxton
from holotorch.correction.run import Box
from holotorch.correction.stages import limit_peak_phase, penalty_schedule
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer

GRID, WAVES = Grid((6, 7), 9e-6), (530e-9, 630e-9)
CROSSTALK, FAR, TARGET = ThermalCrosstalk(0.66), Fraunhofer(GRID, WAVES), torch.ones(2, *GRID.shape)
SECOND_ONLY = torch.stack([torch.zeros(GRID.shape), torch.ones(GRID.shape)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limit_weight": -1.0}, "limit_weight must be at least zero, got -1.0"),
        ({"limit_weight": math.nan}, "limit_weight must be finite, got nan"),
        ({"power_weight": -1e-3}, "power_weight must be at least zero, got -0.001"),
        ({"power_weight": math.inf}, "power_weight must be finite, got inf"),
        ({"limit": math.inf}, r"limit must be finite, but element \(0, 0, 0\) is inf"),
        ({"limit": torch.tensor([1.0, math.nan])}, "limit must be above zero in rad"),
        ({"mask": torch.zeros(6, 7)}, "mask is zero everywhere in channel 0: nothing is left to compare"),
        ({"mask": SECOND_ONLY}, "mask is zero everywhere in channel 0"),
        ({"mask": torch.full((6, 7), math.nan)}, "mask must be finite"),
    ],
)
def test_a_problem_refuses_what_it_cannot_weigh(options, message):
    with pytest.raises(ValueError, match=message):
        PECProblem(CROSSTALK, FAR, TARGET, **options)


def test_masks_that_leave_something_are_kept():
    spot = torch.zeros(6, 7)
    spot[2, 3] = 1
    for mask in (spot, spot > 0, torch.stack([spot, spot])):
        assert (PECProblem(CROSSTALK, FAR, TARGET, mask=mask)(torch.rand(2, 6, 7)) > 0).all()


def test_phase_retrieval_refuses_a_mask_that_leaves_nothing():
    for mask, message in ((torch.zeros(6, 7), "mask is zero everywhere"), (-torch.ones(6, 7), "mask must be >= 0")):
        with pytest.raises(ValueError, match=message):
            gerchberg_saxton(FAR, TARGET, torch.rand(2, 6, 7), max_steps=1, mask=mask)


@pytest.mark.parametrize("limit", [math.nan, math.inf, 0.0, -1.0])
def test_a_limit_that_holds_nothing_is_refused(limit):
    with pytest.raises(ValueError, match="limit must be (finite|above zero) in rad"):
        limit_peak_phase(limit, torch.rand(2, 6, 7), CROSSTALK)
    with pytest.raises(ValueError, match="limit must be (finite|above zero) in rad"):
        penalty_schedule(
            lambda **options: PECProblem(CROSSTALK, FAR, TARGET, **options), LBFGS(), CROSSTALK.total, limit
        )


def test_phases_that_hold_no_limit_are_refused():
    phase = torch.rand(2, 6, 7)
    phase[1, 2, 3] = math.nan
    with pytest.raises(ValueError, match=r"phase must be finite, but element \(1, 2, 3\) is nan"):
        limit_peak_phase(1.0, phase, CROSSTALK)


def test_boxes_and_solvers_refuse_nan():
    for lower, upper in ((0.0, math.nan), (math.nan, 1.0), (1.0, 0.0), (torch.tensor([0.0, 2.0]), torch.ones(2))):
        with pytest.raises(ValueError, match="a box needs lower <= upper everywhere"):
            Box(lower, upper)
    for make in (lambda: APG(tolerance=math.inf), lambda: APG(grow=math.inf), lambda: APG(grow=math.nan)):
        with pytest.raises(ValueError, match="must be finite"):
            make()
    for betas in ((1.0, 0.9), (0.9, math.nan), (-0.1, 0.9)):
        with pytest.raises(ValueError, match="betas must be at least 0 and below 1"):
            ProjectedAdam(betas=betas)
