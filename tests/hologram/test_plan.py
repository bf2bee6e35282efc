import math

import pytest
import torch

from holotorch import Grid
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram, plan_hologram
from holotorch.hologram.plan import convolution_flops

PITCH, WAVE = 3.74e-6, 520e-9


def depths(count: int, low: float = 9e-3, high: float = 11e-3) -> list[float]:
    return torch.linspace(low, high, count, dtype=torch.float64).tolist()


def test_the_cheaper_way_is_taken_and_does_what_is_said():
    grid = Grid(32, PITCH)
    many = plan_hologram(grid, WAVE, depths(400), (16, 16), stride=2)
    assert many.method == "axial nodes" and isinstance(many.operator, AxialHologram)
    assert many.transforms < 100 and many.predicted_error <= 1e-3 and many.adequate
    assert "400 planes spread onto" in many.reason and "convolution (error" in many.runner_up
    layers = torch.randn(400, 16, 16, dtype=torch.complex128)
    exact = DirectHologram(grid, WAVE, depths(400), stride=2, cone="full")(layers)
    assert (many.operator(layers) - exact).norm() < 1e-3 * exact.norm()


def test_a_tolerance_of_rounding_takes_the_exact_way():
    plan = plan_hologram(Grid(64, PITCH), WAVE, depths(30), (64, 64), tolerance=1e-6)
    assert plan.method == "convolution" and isinstance(plan.operator, ConvolutionHologram)
    for cone in ("box", "disc"):
        near = plan_hologram(Grid(256, PITCH), WAVE, depths(5, 1e-3, 2e-3), (256, 256), cone=cone)
        assert near.method == "convolution" and near.cone == cone and near.near


def test_far_away_every_definition_may_take_the_fast_way():
    plan = plan_hologram(Grid(64, PITCH), WAVE, depths(300, 0.1, 0.11), (64, 64), cone="box")
    assert plan.method == "axial nodes" and not plan.near


def test_memory_is_foreseen_and_kept():
    plan = plan_hologram(Grid(4096, PITCH), 636e-9, depths(290, 60e-3, 75e-3), (2048, 2048), stride=2)
    assert 0.5e9 < plan.memory_bytes < 8e9
    with pytest.raises(ValueError, match=r"needs .* GB and 0.10 GB are allowed"):
        plan_hologram(Grid(4096, PITCH), 636e-9, depths(9), (2048, 2048), stride=2, memory_limit=10**8)


def test_what_no_way_reaches_is_refused():
    sharp = plan_hologram(Grid(64, PITCH), WAVE, [1e-3], (64, 64), cone="band", tolerance=2e-3)
    assert sharp.method == "convolution" and sharp.predicted_error < 2e-3
    with pytest.raises(ValueError, match="no method reaches a tolerance of 1.0e-06 for cone='band'"):
        plan_hologram(Grid(64, PITCH), WAVE, [1e-3], (64, 64), cone="band", tolerance=1e-6)
    with pytest.raises(TypeError, match="complex64 or torch.complex128, got torch.float32"):
        plan_hologram(Grid(64, PITCH), WAVE, [1e-3], (64, 64), dtype=torch.float32)


def test_borders_of_validity_are_said():
    cone = 2 * 30e-6 * math.tan(math.asin(WAVE / 2 / PITCH)) / PITCH
    close = plan_hologram(Grid(32, PITCH), WAVE, [30e-6], (32, 32))
    assert f"lights {cone:.2g} pixels" in close.notes[0] and "how its edge is defined" in close.notes[1]
    assert plan_hologram(Grid(32, PITCH), WAVE, [0.1], (32, 32)).notes == ()
    fine = plan_hologram(Grid(16, 0.2e-6), WAVE, [5e-6], (8, 8), cone="box")
    assert any("half a wavelength" in note for note in fine.notes)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4])
def test_definitions_agree_to_the_tolerance_where_the_plan_says_so(tolerance):
    """Across the border, which lies where 0.7 of the cone holds all pairs; all of it does from 11.2 mm on."""
    grid, layers = Grid(256, PITCH), torch.randn(1, 256, 256, dtype=torch.complex128)
    near = {}
    for depth in (11.8e-3, 13e-3, 16e-3, 16.6e-3, 17.2e-3, 18e-3, 20e-3):
        plan = plan_hologram(grid, 636e-9, [depth], (256, 256), tolerance=tolerance)
        exact = ConvolutionHologram(grid, 636e-9, [depth], cone="full")(layers)
        error = (plan.operator(layers) - exact).norm() / exact.norm()
        near[depth] = plan.near
        assert plan.near or error < 1.5 * tolerance
        if depth < 14e-3:
            assert plan.near and error > 0.04
            assert "changes the field by more than the tolerance" in plan.notes[0]
    assert near[16e-3] and near[20e-3] == (tolerance < 1e-3)


def test_a_cone_that_was_asked_for_is_kept_just_beyond_its_border():
    """A box that holds every pair may be made in frequency, a disc whose corners do not must not."""
    grid, layers = Grid(64, PITCH), torch.randn(1, 64, 64, dtype=torch.complex128)
    border = 64 * PITCH / math.tan(math.asin(WAVE / 2 / PITCH))
    for cone in ("full", "box", "disc"):
        for part in (0.9, 1.01, 1.1, 1.3, 1.5, 2.0):
            plan = plan_hologram(grid, WAVE, [part * border], (64, 64), cone=cone, tolerance=1e-3)
            exact = DirectHologram(grid, WAVE, [part * border], cone=cone)(layers)
            assert plan.cone == cone and (plan.operator(layers) - exact).norm() < 1.5e-3 * exact.norm()


@pytest.mark.parametrize(("cone", "farthest"), [("box", 6e-3), ("taper", 120e-3)])
def test_the_cost_of_many_planes_is_foreseen_from_a_thousand(cone, farthest, monkeypatch):
    """The cost of one plane, summed in a loop, for planes of which the near ones have a narrower cone."""
    operator = ConvolutionHologram(Grid(64, PITCH), WAVE, depths(3000, 0.2e-3, farthest), cone=cone)
    size = operator.padded((64, 64))
    waves = [math.prod(operator.kernel_samples(depth, (64, 64), size)) for depth in operator.depths]
    assert len(set(waves)) > 1
    whole = convolution_flops(operator, (64, 64))
    monkeypatch.setattr(ConvolutionHologram, "kernel_samples", lambda *_: (0, 0))
    by_waves = whole - convolution_flops(operator, (64, 64))
    assert by_waves == pytest.approx(150 * sum(waves), rel=2e-3)
