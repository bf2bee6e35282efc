"""A Gaussian beam spreads behind its waist; propagate chooses the method."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.optics import propagate
from holotorch.optics.light.profiles import gaussian_beam
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write the intensity at four distances to ``out``."""
    grid, wavelength = Grid(size, 8e-6), 530e-9
    waist = gaussian_beam(grid, wavelength, waist=size * 0.5e-6)
    distances = torch.tensor([0.0, 0.03, 0.06, 0.12], dtype=torch.float64) * (size / 256) ** 2
    fields = propagate(waist, grid, wavelength, distances)
    names = [f"{1e3 * z:.3g} mm" for z in distances.tolist()]
    show(fields, grid, what=("intensity", "phase"), names=names).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
