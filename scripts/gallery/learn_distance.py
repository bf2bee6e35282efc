"""A distance is learned from one image by its gradient, as any other parameter."""

from pathlib import Path

import torch
from matplotlib.figure import Figure

from holotorch import Grid
from holotorch.core.complex import intensity, phasor
from holotorch.optics import CroppedKernel


def main(out: Path, size: int = 128) -> None:
    """Write the error of the distance over the steps of Adam to ``out``."""
    grid, wavelength, true = Grid(size, 8e-6), 530e-9, 20e-3
    field = phasor(6 * torch.rand(1, *grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    seen = intensity(CroppedKernel(grid, wavelength, true)(field))
    model = CroppedKernel(grid, wavelength, true + 0.3e-3, learnable=True)
    optimiser, errors = torch.optim.Adam(model.parameters(), lr=2e-5), []
    for _ in range(100):
        optimiser.zero_grad()
        (intensity(model(field)) - seen).square().mean().backward()
        optimiser.step()
        errors.append(1e3 * abs(next(model.parameters()).item() - true))
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    axes.semilogy(errors)
    axes.set(xlabel="step", ylabel="error of the distance (mm)")
    figure.savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
