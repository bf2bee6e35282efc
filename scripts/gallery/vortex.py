"""A phase that winds around the axis turns the focus of a lens into a ring."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.core.complex import phasor
from holotorch.optics import Lens, OpticalPath, Propagator
from holotorch.optics.light.profiles import gaussian_beam, vortex_phase
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write the focus for the charges 0, 1 and 4 to ``out``."""
    grid, wavelength, focal_length = Grid(size, 8e-6), 530e-9, 0.1
    beam = gaussian_beam(grid, wavelength, waist=size * 2e-6)
    path = OpticalPath([Lens(grid, wavelength, focal_length), Propagator(grid, wavelength, focal_length)])
    charges = (0, 1, 4)
    fields = torch.stack([beam * phasor(vortex_phase(grid, charge)) for charge in charges])[:, None]
    show(path(fields), grid, what=("intensity", "phase"), names=[f"charge {c}" for c in charges]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
