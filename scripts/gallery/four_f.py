"""Two lenses, 4f apart from input to output: what stands in between filters the spatial frequencies."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.optics import Aperture, Lens, OpticalPath, Propagator
from holotorch.optics.light.profiles import siemens_star
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write a star, its image, and its image behind a small and behind a central stop to ``out``."""
    grid, wavelength, f = Grid(size, 8e-6), 530e-9, size * (8e-6) ** 2 / 530e-9
    y, x = grid.coordinates()
    radius = (y.square() + x.square()).sqrt()
    stops = {
        "no stop": torch.ones(grid.shape),
        "low frequencies": (radius < 0.12 * grid.extent[0]).double(),
        "high frequencies": (radius > 0.03 * grid.extent[0]).double(),
    }
    star = siemens_star(grid, 12) * (radius < 0.35 * grid.extent[0])
    field = torch.complex(star, torch.zeros_like(star))[None]
    images = [field]
    for stop in stops.values():
        step, lens = Propagator(grid, wavelength, f), Lens(grid, wavelength, f)
        images.append(OpticalPath([step, lens, step, Aperture(grid, wavelength, stop), step, lens, step])(field))
    show(torch.stack(images), grid, what="intensity", names=["input", *stops]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
