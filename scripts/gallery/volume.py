"""A volume is rendered into light sources on planes, those become one hologram, and it is focused at three depths."""

from pathlib import Path

import torch

from holotorch import Grid
from holotorch.hologram import AxialHologram, focal_stack
from holotorch.plot import show
from holotorch.scene import DVRSampler, TransferFunction
from holotorch.scene.phantoms import c60
from holotorch.scene.phases import random_phase


def main(out: Path, size: int = 256) -> None:
    """Write the hologram's picture focused at the front, middle and back of a C60 molecule to ``out``."""
    grid, wavelength, width = Grid(size, 4e-6), 530e-9, size * 3.5e-6
    depths = torch.linspace(0.02, 0.02 + width, 24).tolist()
    transfer = TransferFunction(
        [0.0, 0.3, 1.0], [[0, 0, 0], [0.6, 0.6, 0.6], [1, 1, 1]], [0, 0, 0.6], unit_distance=0.01
    )
    sampler = DVRSampler(transfer, grid, depths, width=width, phase=random_phase)
    layers = sampler(c60(size // 4))
    planes = torch.stack([plane[1] for plane in layers.planes()])
    hologram = AxialHologram(grid, wavelength, depths)(planes.to(torch.complex64))
    focused = [depths[0], depths[len(depths) // 2], depths[-1]]
    stack = torch.stack([*focal_stack(hologram, grid, wavelength, focused)]).sqrt()
    show(stack, grid, what="intensity", names=[f"focus at {1e3 * z:.2f} mm" for z in focused]).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
