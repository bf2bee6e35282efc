"""A grating forms images of itself, without any lens, at half and whole Talbot distances 2 period^2 / wavelength."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.optics import AngularSpectrum
from holotorch.optics.light.profiles import binary_grating
from holotorch.plot import show


def main(out: Path, size: int = 256) -> None:
    """Write the intensity behind a grating of slits, over distance, to ``out``."""
    grid, wavelength, period = Grid((2, size), 4e-6), 530e-9, 64e-6
    slits = 1 - binary_grating(grid, (float("inf"), period), depth=1.0)
    field = torch.complex(slits, torch.zeros_like(slits))[None]
    talbot = 2 * period**2 / wavelength
    rows = [
        AngularSpectrum(grid, wavelength, k / size * talbot, pad=1, band_limit=False)(field)[0, 0] for k in range(size)
    ]
    show(intensity(torch.stack(rows)), names=["slits above, one Talbot distance below"]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
