"""What an eye sees of a hologram depends on where it accommodates."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.core.complex import phasor
from holotorch.io.images import fit_image, load_image
from holotorch.optics import Display, Eye, Retina
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write the retina's picture for four accommodations to ``out``."""
    grid, wavelengths, distance = Grid(size, 16e-6), (640e-9, 520e-9, 450e-9), 0.25
    image = fit_image(load_image("astronaut"), grid.shape).float()
    noise = 6.28 * torch.rand(image.shape, generator=torch.Generator().manual_seed(0))
    field = image.sqrt() * phasor(noise)
    accommodations = (0.25, 0.26, 0.30, 0.50)
    pictures = [
        Retina(grid, wavelengths, Display.planar(distance), Eye(accommodation=s), plane=0.0)(field)
        for s in accommodations
    ]
    shown = torch.stack([picture / picture.mean() * image.mean() for picture in pictures])
    names = [f"accommodated to {s:g} m" for s in accommodations]
    show(shown.clamp(max=1), grid, what="colour", names=names).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
