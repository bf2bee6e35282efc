"""Frames shown in turn average their speckle away; solved for together, they do far better."""

import math
from pathlib import Path

import torch

from holotorch import Grid
from holotorch.correction import LBFGS, PECProblem
from holotorch.io.images import fit_image, load_image
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer
from holotorch.plot import show


def main(out: Path, size: int = 128) -> None:
    """Write the picture by one frame, by four solved alone and by four solved together to ``out``."""
    grid = Grid(size, 9e-6)
    image = fit_image(load_image("camera"), grid.shape).float()[:1]
    setup = ThermalCrosstalk(1.0), Fraunhofer(grid, 530e-9), image / image.mean()
    alone, together = PECProblem(*setup), PECProblem(*setup, frames=True)
    start = 2 * math.pi * torch.rand(4, *image.shape, generator=torch.Generator().manual_seed(0))
    apart, joint = (LBFGS(max_steps=150)(problem, start).x for problem in (alone, together))
    shown = [setup[2], alone.intensity(apart[0]), alone.intensity(apart).mean(0), together.intensity(joint)]
    names = ["wanted", "one frame", "four alone", "four together"]
    show(torch.stack(shown).clamp(max=setup[2].max().item()), names=names).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
