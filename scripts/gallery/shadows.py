"""One volume in three kinds of light: its own, Phong shading, and light from a lamp that it scatters once."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.plot import show
from holotorch.scene import DVRSampler, Lighting, Scattering, TransferFunction
from holotorch.scene.phantoms import c60


def main(out: Path, size: int = 256) -> None:
    """Write three renderings of a C60 molecule to ``out``."""
    grid, width = Grid(size, 4e-6), size * 3.5e-6
    depths = torch.linspace(0.02, 0.02 + width, 96).tolist()
    transfer = TransferFunction(
        [0.0, 0.3, 1.0], [[0, 0, 0], [0.6, 0.6, 0.6], [1, 1, 1]], [0, 0, 0.6], unit_distance=0.01
    )
    lamp = Scattering(towards=(-0.5, -1.0, -0.6), half_angle=0.15, ambient=0.1, strength=0.9)
    lights = {"emission": None, "Phong shading": Lighting(), "single scattering": lamp}
    volume, pictures = c60(size // 3), []
    for light in lights.values():
        image, _ = DVRSampler(transfer, grid, depths, width=width, lighting=light).render(volume)
        pictures.append(image.mean(0))
    show(torch.stack(pictures), grid, what="intensity", names=list(lights)).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
