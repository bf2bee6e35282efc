"""Heat spreads between the pixels of a phased array: the hologram without and with correction."""

import math
from pathlib import Path

import torch

from holotorch import Grid
from holotorch.core.complex import phasor
from holotorch.correction import LBFGS, PECProblem, gerchberg_saxton
from holotorch.io.images import fit_image, load_image
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer
from holotorch.plot import show


def main(out: Path, size: int = 128) -> None:
    """Write the wanted picture and both holograms' pictures to ``out``."""
    grid, wavelengths = Grid(size, 9e-6), (630e-9, 530e-9, 445e-9)
    image = fit_image(load_image("coffee"), grid.shape).float()
    target = image / image.mean((-2, -1), keepdim=True)
    crosstalk, propagator = ThermalCrosstalk(0.66), Fraunhofer(grid, wavelengths)
    problem = PECProblem(crosstalk, propagator, target)
    start = 2 * math.pi * torch.rand(target.shape, generator=torch.Generator().manual_seed(0))
    ignored = gerchberg_saxton(propagator, target, start, max_steps=50).x
    corrected = LBFGS(max_steps=200)(problem, start).x
    pictures = [target, *(propagator(phasor(crosstalk(x))).abs().square() for x in (ignored, corrected))]
    shown = torch.stack(pictures) / target.amax()
    show(shown.clamp(max=1), what="colour", names=["wanted", "heat ignored", "corrected"]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
