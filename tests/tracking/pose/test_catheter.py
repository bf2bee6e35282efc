import dataclasses

import pytest
import torch

from holotorch.tracking import THESIS, Catheter

RED, GREEN, BLUE = (200, 40, 45), (40, 150, 70), (40, 70, 190)
GIVEN = {"edges": (0.07, 0.108, 0.146, 0.184), "colours": (RED, GREEN, BLUE), "radius": 1e-3, "length": 0.35}


def test_the_thesis_s():
    """Three bands of 38 mm, the first 70 mm from the tip."""
    assert Catheter(**GIVEN) == THESIS
    assert THESIS.positions.dtype == torch.float64
    assert torch.equal(THESIS.positions, torch.tensor([0.07, 0.108, 0.146, 0.184], dtype=torch.float64))
    assert THESIS.positions.diff().tolist() == pytest.approx([0.038] * 3, rel=1e-12)
    with pytest.raises(dataclasses.FrozenInstanceError):
        THESIS.radius = 2e-3  # type: ignore[misc]


def test_any_spacing_and_number():
    made = Catheter([0, 0.01, 0.05, 0.06, 0.2], [list(c) for c in (RED, GREEN, RED, BLUE)], 2e-3, 0.2)  # type: ignore[arg-type]
    assert made.edges == (0, 0.01, 0.05, 0.06, 0.2) and made.colours == (RED, GREEN, RED, BLUE)
    assert hash(made) != hash(THESIS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edges": (0.07, 0.108, 0.146)}, "edges must be at least 4 rising distances"),
        ({"edges": (0.07, 0.146, 0.108, 0.184)}, "at least 4 rising distances"),
        ({"edges": (0.07, 0.07, 0.108, 0.184)}, "at least 4 rising distances"),
        ({"edges": (-0.01, 0.07, 0.108, 0.184)}, "at least 4 rising distances"),
        ({"edges": (0.07, float("nan"), 0.108, 0.184)}, "edges must be finite"),
        ({"edges": (70.0, 108.0, 146.0, 184.0), "length": 350.0}, "edges must lie within -3 m .. 3 m, got"),
        ({"colours": (RED, GREEN)}, "4 edges bound 3 bands, got 2 colours; bands touch each other, so that N colours"),
        ({"colours": (RED, GREEN, (40, 70))}, r"triples of 8-bit levels, got \(40, 70\)"),
        ({"colours": (RED, GREEN, (40, 70, 256))}, "triples of 8-bit levels"),
        ({"colours": (RED, GREEN, (40, 70, -1))}, "triples of 8-bit levels"),
        ({"colours": (RED, GREEN, (45, 150, 75))}, "neighbouring bands must differ in colour"),
        ({"radius": 0.0}, "radius must be above zero in m"),
        ({"radius": float("inf")}, "radius must be finite"),
        ({"radius": 0.02}, "bands must be longer than they are wide"),
        ({"length": 0.15}, r"length must reach the last edge at 0.184 m, got 0.15 m"),
        ({"length": -1.0}, "length must be above zero"),
    ],
)
def test_impossible_catheters(change, message):
    with pytest.raises(ValueError, match=message):
        Catheter(**{**GIVEN, **change})


def test_what_is_no_number():
    with pytest.raises(TypeError, match="radius must be a number"):
        Catheter(**{**GIVEN, "radius": "1 mm"})  # type: ignore[arg-type]
