"""From a volume to its hologram and back: gradients through rendering, amplitudes, phases and nodes."""

import torch

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.hologram import AxialHologram, refocused
from holotorch.scene import DVRSampler, TransferFunction, Volume, random_phase


def test_a_volume_can_be_learned_from_its_hologram():
    grid, rays, wave = Grid(32, 3.74e-6), Grid(16, 7.48e-6), 520e-9
    depths = [3e-3 - 1e-5 * j for j in range(6)]
    transfer = TransferFunction([0.0, 1.0], [[1, 0.5, 0.1], [0.2, 0.9, 1]], [0.0, 0.8], unit_distance=0.3)
    transfer.requires_grad_()
    sampler = DVRSampler(
        transfer, rays, depths, width=6e-5, phase=lambda g: random_phase(g, generator=torch.Generator().manual_seed(1))
    )
    operator = AxialHologram(grid, wave, depths, stride=2)

    def formed(values: torch.Tensor) -> torch.Tensor:
        layers = sampler(Volume(values, (1.0, 1.0, 1.0), "relative")).stack()  # [D, C, h, w]
        return operator(layers[:, 0])

    generator = torch.Generator().manual_seed(4)
    wanted = formed(torch.rand(6, 6, 6, generator=generator)).detach()
    values = torch.full((6, 6, 6), 0.5, requires_grad=True)
    loss = (formed(values) - wanted).abs().square().sum()
    loss.backward()
    assert values.grad is not None and values.grad.isfinite().all() and values.grad.norm() > 0
    learned = [parameter.grad for parameter in transfer.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in learned)
    with torch.no_grad():
        step = 0.3 * loss / values.grad.square().sum()
        assert (formed(values - step * values.grad) - wanted).abs().square().sum() < loss
    image = intensity(refocused(formed(values.detach()), grid, wave, depths[2]))
    assert image.isfinite().all() and image.max() > 0


def test_black_volumes_have_gradients_too():
    transfer = TransferFunction([0.0, 1.0], [[1, 1, 1], [1, 1, 1]], [0.0, 1.0], unit_distance=0.3)
    sampler = DVRSampler(transfer, Grid(8, 7.48e-6), [3e-3, 2.99e-3], width=2e-5)
    values = torch.zeros(4, 4, 4, requires_grad=True)
    layers = sampler(Volume(values, (1.0, 1.0, 1.0), "relative")).stack()
    AxialHologram(Grid(16, 3.74e-6), 520e-9, [3e-3, 2.99e-3], stride=2)(layers[:, 1]).abs().square().sum().backward()
    assert values.grad is not None and values.grad.isfinite().all()
