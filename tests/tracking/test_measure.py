"""Edges of bands from the light along a line."""

import math

import pytest
import torch

from holotorch.tracking.measure import _halfway


@pytest.mark.parametrize("blur", [0.5, 0.9, 1.5])
def test_edges_lie_where_the_light_is_halfway(blur):
    """Steps of an error function: samples a pixel apart miss 2 exp(-2 pi^2 blur^2) / 2 pi, wide ones reach the ends."""
    t = torch.arange(61, dtype=torch.float64)
    places = torch.tensor([15.3, 44.8], dtype=torch.float64)
    rise = 0.5 * torch.erfc((places[:, None] - t) / blur / math.sqrt(2))
    light = torch.tensor([[0.1, 0.5, 0.2], [0.6, 0.1, 0.15], [0.3, 0.3, 0.3]], dtype=torch.float64)
    profile = light @ torch.stack([1 - rise[0], rise[0] - rise[1], rise[1]])
    rough = torch.tensor([14.5, torch.nan, 46.5], dtype=torch.float64) - 30
    found = _halfway(profile, rough)
    assert float((found[[0, 2]] + 30 - places).abs().max()) < {0.5: 5e-3, 0.9: 0.02, 1.5: 0.15}[blur]
    assert found[1].isnan()
    even = torch.full((3, 61), 0.2)
    assert torch.equal(_halfway(even, rough)[[0, 2]], rough[[0, 2]])
