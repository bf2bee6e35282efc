"""A complex hologram on a panel that shows phases only: what each encoding leaves of the picture."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.core.complex import intensity, phasor
from holotorch.hologram.encoding import double_phase, kinoform
from holotorch.io.images import fit_image, load_image
from holotorch.optics import Propagator, SpectralFilter
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write the picture of the complex hologram and of two encodings to ``out``."""
    grid, wavelength = Grid(size, 8e-6), 530e-9
    image = fit_image(load_image("camera"), grid.shape).float()[:1]
    there, back = Propagator(grid, wavelength, 0.02), Propagator(grid, wavelength, -0.02)
    hologram = back(torch.complex(image.sqrt(), torch.zeros_like(image)))
    fy, fx = (frequency * pitch for frequency, pitch in zip(grid.frequencies(), grid.pitch, strict=True))
    window = ((fy.abs() < 0.25) & (fx.abs() < 0.25)).to(torch.complex64)[None]  # removes the checkerboard
    aperture = SpectralFilter(grid, wavelength, window)
    fields = [hologram, phasor(kinoform(hologram)), phasor(double_phase(hologram))]
    pictures = torch.stack([intensity(there(aperture(field))) for field in fields])
    pictures = pictures / pictures.mean((-2, -1), keepdim=True) * image.mean()
    show(pictures.clamp(max=1), grid, names=["complex", "kinoform", "double phase"]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
