"""Which way up a volume is shown."""

import pytest
import torch
from paths import CONFIGS

from holotorch.experiments.registry import load_config
from holotorch.experiments.volume.experiment import build

UP = {"-y": (0, -1, 0), "y": (0, 1, 0), "z": (1, 0, 0), "-z": (-1, 0, 0), "x": (0, 0, 1), "-x": (0, 0, -1)}


def rotation(*words: str) -> torch.Tensor:
    return build(
        load_config(CONFIGS / "volume" / "hand.yaml", ["volume={phantom: shells, samples: 16}", *words])
    ).rotation


@pytest.mark.parametrize("up", UP)
def test_the_direction_points_up_and_turns_about_the_vertical(up):
    """Vectors (z, y, x); y points down on a picture."""
    top = torch.tensor(UP[up], dtype=torch.float64)
    for azimuth in (0, 90, -37):
        matrix = rotation(f"view.up={up}", f"view.azimuth_deg={azimuth}")
        torch.testing.assert_close(matrix @ top, torch.tensor([0.0, -1, 0]).double(), rtol=0, atol=1e-12)
        torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3).double(), rtol=0, atol=1e-12)
        assert torch.linalg.det(matrix) > 0  # a rotation shows no mirror image


def test_by_default_nothing_is_turned():
    torch.testing.assert_close(rotation(), torch.eye(3).double(), rtol=0, atol=0)
