"""A synthetic volume on a hot phased array: eight frames, optimised together, look right at every focus of an eye."""

import math
from pathlib import Path

import torch

from holotorch import Grid
from holotorch.correction import LBFGS, PECProblem, deconvolve, spread_preconditioner
from holotorch.hologram import ConvolutionHologram, incoherent_views
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import PupilViews, View
from holotorch.plot import show
from holotorch.scene import DVRSampler, TransferFunction
from holotorch.scene.layers import SourceLayers
from holotorch.scene.phantoms import c60


def main(out: Path, size: int = 128) -> None:
    """Write the wanted images of a C60 molecule and those of the array, by focus, to ``out``."""
    grid, wavelength, heat = Grid(size, 9e-6), 520e-9, ThermalCrosstalk(0.66)
    transfer = TransferFunction([0.0, 0.3, 1.0], [[0] * 3, [0.6] * 3, [1] * 3], [0, 0, 0.6], unit_distance=0.01)
    depths, flat = [7e-3, 9e-3, 11e-3, 13e-3], [9.7e-3, 9.9e-3, 10.1e-3, 10.3e-3]  # rendered flat, then stretched
    sampler = DVRSampler(transfer, grid, flat, width=size * 6e-6, samples=12)
    planes = torch.stack([*sampler(c60(48)).amplitudes()])[:, :1]
    views = [View(depth, radius=0.25 * wavelength / 9e-6) for depth in depths]
    wanted = incoherent_views(SourceLayers(grid, tuple(depths), 1, lambda: iter(planes)), wavelength, views)
    random = torch.polar(planes[:, 0].expand(8, -1, -1, -1), 2 * math.pi * torch.rand(8, 4, size, size))
    start = ConvolutionHologram(grid, wavelength, depths)(random)[:, None]
    options = {"frames": True, "amplitude": True, "scale_free": True, "limit": 3.9 * math.pi}
    problem = PECProblem(heat, PupilViews(grid, wavelength, views), wanted / wanted.mean(), **options)
    solver = LBFGS(max_steps=40, precondition=spread_preconditioner(heat.kernel))
    phase = solver(problem, deconvolve(heat, start.angle() % (2 * math.pi) + math.pi)).x
    pictures = torch.cat([wanted[0, ::3], problem.intensity(phase)[0, ::3]]).sqrt()
    names = [f"{what}, focus at {depth} mm" for what in ("wanted", "array") for depth in (7, 13)]
    show(pictures.to(torch.complex64), grid, what="intensity", names=names).savefig(out)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
