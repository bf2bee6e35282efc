"""Edges of bands from the light along a line."""

import math

import pytest
import torch

from holotorch.tracking.measure import _halfway


@pytest.mark.parametrize("blur", [0.5, 0.9, 1.5])
def test_edges_lie_where_the_light_is_halfway(blur):
    """Steps of an error function: samples a pixel apart miss 2 exp(-2 pi^2 blur^2) / 2 pi, wide ones reach the ends."""
    t = torch.arange(-6, 7, dtype=torch.float64)
    places = torch.tensor([0.3, -1.2], dtype=torch.float64)
    rise = 0.5 * torch.erfc((places[:, None] - t) / blur / math.sqrt(2))
    before, after = torch.tensor([[0.1, 0.5, 0.2], [0.6, 0.1, 0.15]], dtype=torch.float64)[..., None, None]
    found = _halfway(before + (after - before) * rise)
    assert float((found - places).abs().max()) < {0.5: 5e-3, 0.9: 0.02, 1.5: 0.15}[blur]
    assert _halfway(torch.full((3, 2, 13), 0.2)).tolist() == [0, 0]
