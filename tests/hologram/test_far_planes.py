import time

import pytest

from holotorch.core.grid import Grid
from holotorch.hologram import plan_hologram


def test_far_planes_are_planned_in_seconds():
    """The axis' kernel on its long array is the same for all lengths that are tried: it is computed once."""
    began = time.perf_counter()
    plan = plan_hologram(Grid(256, 3.74e-6), 520e-9, [9.9, 10.0], (128, 128), stride=2)
    assert plan.adequate and time.perf_counter() - began < 10


def test_planes_beyond_all_memory_are_refused():
    with pytest.raises(ValueError, match="too far for pixels of 2e-06 m: .* use nearer planes or a larger pitch"):
        plan_hologram(Grid(256, 2e-6), 520e-9, [99.0], (128, 128), stride=2)
