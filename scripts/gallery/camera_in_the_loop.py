"""A chip with an unknown heat kernel, response and distance is calibrated from a few images of random phases."""

from pathlib import Path

import torch
from matplotlib.figure import Figure

from holotorch import Grid
from holotorch.correction import calibrate
from holotorch.experiments.camera.chip import LIMIT, Chip
from holotorch.modulator import Response


def main(out: Path, size: int = 64) -> None:
    """Write the loss of the fit, and the response that it finds, to ``out``."""
    grid, wavelength, drives = Grid(size, 9e-6), 530e-9, torch.linspace(0, LIMIT, 9, dtype=torch.float64)
    true = Chip(grid, wavelength, Response(LIMIT, drives * (1 + 0.05 * drives / LIMIT)), 0.66, 20e-3)
    model = Chip(grid, wavelength, Response(LIMIT, learnable=True), 0.8, 20.1e-3, learnable=True)
    patterns = LIMIT * torch.rand(4, 1, size, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    fit = calibrate(model, patterns, true(patterns), units={"propagator.distance": 1e-6})
    figure = Figure(figsize=(8, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogy(fit.losses, "o-")
    left.set(xlabel="step", ylabel="mean squared difference", title=f"sigma {model.crosstalk.sigma_px:.4f} px")
    right.plot(drives, true.response(drives) - drives, label="true")
    right.plot(drives, (model.response(drives) - drives).detach(), "o", label="found")
    right.set(xlabel="drive (rad)", ylabel="phase beyond the drive (rad)")
    right.legend()
    figure.savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
