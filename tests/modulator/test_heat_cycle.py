"""Heat that is left from earlier frames: a long simulation, its gradient, the limits, and wrong arguments."""

import pytest
import torch

from holotorch.modulator import HeatCycle, ThermalCrosstalk


def simulated(phase: torch.Tensor, tau: torch.Tensor, moments, cycles: int) -> torch.Tensor:
    """Phases in the last of many cycles, which begin cold."""
    steady = ThermalCrosstalk(0.66)(phase)
    temperature = torch.zeros_like(steady[0])
    seen = []
    for _ in range(cycles):
        seen = []
        for each in steady:
            seen += [each + (temperature - each) * torch.exp(-moment / tau) for moment in moments]
            temperature = each + (temperature - each) * torch.exp(-1 / tau)
    return torch.stack(seen)


@pytest.mark.parametrize("tau", [0.5, 3.0, "map"])
def test_equals_a_long_simulation_and_so_does_its_gradient(tau):
    tau = torch.rand(7, 9, dtype=torch.float64) + 0.2 if tau == "map" else torch.tensor(tau, dtype=torch.float64)
    phase = torch.rand(4, 2, 7, 9, dtype=torch.float64, requires_grad=True)
    cycle = HeatCycle(ThermalCrosstalk(0.66), 1.0, tau, moments=(0.3, 1.0))
    results = cycle(phase), simulated(phase, tau, (0.3, 1.0), 60)
    torch.testing.assert_close(*results, rtol=1e-12, atol=1e-12)
    weight = torch.randn_like(results[0])
    slopes = [torch.autograd.grad((result.sin() * weight).sum(), phase)[0] for result in results]
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-12)


def test_a_short_time_constant_leaves_nothing_and_a_long_one_the_mean():
    phase, crosstalk = torch.rand(4, 1, 7, 9, dtype=torch.float64), ThermalCrosstalk(0.66)
    torch.testing.assert_close(HeatCycle(crosstalk, 1.0, 1e-3)(phase), crosstalk(phase), rtol=1e-12, atol=0)
    mean = crosstalk(phase).mean(0).expand(4, 1, 7, 9)
    torch.testing.assert_close(HeatCycle(crosstalk, 1.0, 1e12)(phase), mean, rtol=1e-9, atol=0)


def test_no_phase_exceeds_the_largest_steady_one():
    phase, crosstalk = 5 * torch.rand(6, 1, 7, 9), ThermalCrosstalk(0.66)
    shown = HeatCycle(crosstalk, 20e-6, 10e-6, moments=(0.0, 0.5, 1.0))(phase)
    assert shown.shape == (18, 1, 7, 9) and shown.max() <= crosstalk(phase).max() * (1 + 1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame_time": 0.0}, "frame_time must be above zero"),
        ({"time_constant": -1.0}, "time_constant must be positive"),
        ({"time_constant": torch.ones(3)}, "a number or \\[H, W\\]"),
        ({"moments": (1.5,)}, "moments must be fractions"),
        ({"moments": ()}, "moments must be fractions"),
        ({"time_constant": torch.ones((), requires_grad=True)}, "time_constant requires a gradient"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        HeatCycle(**{"crosstalk": ThermalCrosstalk(0.66), "frame_time": 1.0, "time_constant": 1.0, **change})


def test_a_phase_without_frames_is_refused():
    cycle = HeatCycle(ThermalCrosstalk(0.66), 1.0, 1.0, moments=(0.5, 1.0))
    with pytest.raises(ValueError, match=r"must end in \(F, C, H, W\)"):
        cycle(torch.ones(1, 7, 9))
    with pytest.raises(ValueError, match="2 moments a frame, got 3 phases"):
        cycle.adjoint(torch.ones(3, 1, 7, 9))
