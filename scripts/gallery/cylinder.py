"""A cylindrical lens makes a line; two across each other make the point of a round lens."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.core.complex import phasor
from holotorch.optics import Lens, Propagator
from holotorch.optics.light.profiles import cylindrical_phase, gaussian_beam
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write the focal plane of a cylindrical lens, of two and of a round one to ``out``."""
    grid, wavelength, f = Grid(size, 8e-6), 530e-9, 0.1
    beam = gaussian_beam(grid, wavelength, waist=size * 2e-6)
    along_y, along_x = (phasor(cylindrical_phase(grid, wavelength, f, axis)) for axis in (0, 1))
    round_lens = Lens(grid, wavelength, f)(beam[None])[0]
    fields = torch.stack([beam * along_y, beam * along_y * along_x, round_lens])[:, None]
    focus = Propagator(grid, wavelength, f)(fields)
    show(focus.abs(), grid, names=["one cylinder", "two across", "round lens"]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
