"""One gradient from the retina back to the heaters: the phases are optimised for what the eye sees."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.io.images import fit_image, load_image
from holotorch.modulator import PhasedArray, ThermalCrosstalk
from holotorch.optics import Display, Eye, Retina
from holotorch.plot import show


def main(out: Path, size: int = 96, steps: int = 150) -> None:
    """Write the wanted picture and the one on the retina to ``out``."""
    grid, wavelengths = Grid(size, 16e-6), (640e-9, 520e-9, 450e-9)
    target = fit_image(load_image("coffee"), grid.shape).float()
    array = PhasedArray(wavelengths, ThermalCrosstalk(0.66))
    retina = Retina(grid, wavelengths, Display.planar(0.25), Eye(accommodation=0.2), plane=0.05, tolerance=0.5)
    drive = (3 + 0.3 * torch.rand(target.shape, generator=torch.Generator().manual_seed(0))).requires_grad_()
    optimiser = torch.optim.Adam([drive], lr=0.1)
    picture = target
    for _ in range(steps):
        optimiser.zero_grad()
        picture = retina(array(drive))
        picture = picture * ((picture * target).sum() / picture.square().sum())
        ((picture + 1e-6).sqrt() - (target + 1e-6).sqrt()).square().mean().backward()
        optimiser.step()
    show(torch.stack([target, picture.detach()]), what="colour", names=["wanted", "seen"]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
