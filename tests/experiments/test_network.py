"""Training of a network through the display, in a tiny form."""

import pytest
import torch
from torch import Tensor
from two_processes import run_in_two_processes

from holotorch import Grid
from holotorch.correction import PECProblem
from holotorch.experiments.network.training import Crops, train
from holotorch.experiments.network.unet import PhaseUNet
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import CroppedKernel

SIZE = 24
GRID = Grid(SIZE, 9e-6)


def setup() -> tuple[PhaseUNet, PECProblem, Crops]:
    torch.manual_seed(0)
    propagator = CroppedKernel(GRID, 530e-9, 2e-3)
    problem = PECProblem(ThermalCrosstalk(0.66, 7), propagator, scale_free=True, amplitude=True)
    return PhaseUNet(propagator, width=4), problem, Crops(["camera", "coins"], SIZE, 16)


def test_crops_are_light_of_mean_1_and_the_same_every_time():
    crops = Crops(["camera", "coins"], SIZE, 6, seed=3)
    assert len(crops) == 6
    for k in range(6):
        assert crops[k].shape == (1, SIZE, SIZE) and torch.equal(crops[k], crops[k])
        assert crops[k].mean().item() == pytest.approx(1, rel=1e-5)
    assert not torch.equal(crops[0], crops[2])
    assert not torch.equal(crops[0], Crops(["camera", "coins"], SIZE, 6, seed=4)[0])


def test_training_lowers_the_loss_and_the_phases_stay_within_the_limit():
    network, problem, crops = setup()
    losses = train(network, problem, crops, steps=40, batch=8, rate=1e-2)
    assert len(losses) == 40 and sum(losses[-5:]) < 0.8 * sum(losses[:5])
    phase = network(crops[0][None])
    assert phase.shape == (1, 1, SIZE, SIZE)
    assert phase.min() >= 0 and phase.max() <= network.limit


def test_a_checkpoint_continues_as_if_nothing_had_happened(tmp_path):
    whole, problem, crops = setup()
    wanted = train(whole, problem, crops, steps=103, batch=8)
    interrupted, _, _ = setup()
    path = tmp_path / "network.pt"

    class Stopped(PECProblem):
        calls = 0

        def forward(self, phase, target=None):
            Stopped.calls += 1
            if Stopped.calls > 101:
                raise KeyboardInterrupt
            return super().forward(phase, target)

    stopped = Stopped(problem.crosstalk, problem.propagator, scale_free=True, amplitude=True)
    with pytest.raises(KeyboardInterrupt):
        train(interrupted, stopped, crops, steps=103, batch=8, checkpoint=path)
    assert path.exists() and not path.with_suffix(".part").exists()
    resumed, _, _ = setup()
    losses = train(resumed, problem, crops, steps=103, batch=8, checkpoint=path)
    assert len(losses) == 103
    torch.testing.assert_close(losses, wanted, rtol=1e-6, atol=0)
    for one, other in zip(resumed.parameters(), whole.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)


def test_autocast_trains_as_well():
    network, problem, crops = setup()
    losses = train(network, problem, crops, steps=20, batch=8, rate=1e-2, autocast=True)
    assert all(torch.isfinite(torch.tensor(losses))) and losses[-1] < losses[0]


def test_a_picture_of_another_size_is_refused():
    network, _, _ = setup()
    with pytest.raises(ValueError, match=r"multiples of 4, got \(1, 1, 22, 24\); crop or pad it"):
        network(torch.ones(1, 1, 22, 24))


def train_together(rank: int) -> dict[str, Tensor]:
    network, problem, crops = setup()
    train(network, problem, crops, steps=2, batch=16, rate=1e-2)  # both see all 16 crops in each step
    return network.state_dict()


def test_two_processes_train_as_one(tmp_path):
    together = run_in_two_processes(train_together, tmp_path)
    network, problem, crops = setup()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    train(network, problem, crops, steps=2, batch=16, rate=1e-2)
    for name, value in together.items():
        # AdamW divides by the size of the gradient, so rounding of small ones shows up in the step of 0.01.
        torch.testing.assert_close(value, network.state_dict()[name], rtol=0, atol=2e-4)
        assert (value - before[name]).abs().max() > 5e-3
