"""Thesis Fig. 4.18: holograms of the slices of a volume, shown in turn, and the error of their picture by focus."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.experiments.pec_study.bench import Bench
from holotorch.scene import DVRSampler, TransferFunction, Volume, phantoms

NEAR, FAR = 0.08, 0.12  # distances of the faces of the volume in metres
SLICES = 24  # number of slices between the faces
_LIT = 0.05  # least intensity of the pixels that count in the error, relative to the brightest


def slices_of_a_volume(grid: Grid) -> tuple[list[float], Tensor, Tensor]:
    """Depths [D] and intensities [D, h, w] of slices of a synthetic C60 molecule, and the depth map [h, w] of it.

    Depths are in metres. The molecule is as wide as ``grid`` and stretched along the optical axis to 40 mm, because an
    unstretched one, 2 mm deep, would lie within the depth of focus.
    """
    width, step = grid.extent[1], (FAR - NEAR) / SLICES
    volume = Volume(phantoms.c60(64).values, ((FAR - NEAR) / 64, width / 64, width / 64), "m")
    transfer = TransferFunction(
        [0.0, 0.3, 0.6, 1.0], [[0, 0, 0], [0.8] * 3, [1.0] * 3, [1.0] * 3], [0, 0, 0.5, 1.0], unit_distance=0.02
    )
    depths = [FAR - (j + 0.5) * step for j in range(SLICES)]
    sampler = DVRSampler(transfer, grid, depths, width=FAR - NEAR)
    with torch.no_grad():
        light = torch.stack([plane.square().mean(0) for plane in sampler(volume).amplitudes()])
        return depths, light, sampler.depth_map(volume)


def focal_sweep(bench: Bench, steps: int) -> list[tuple[float, float, float]]:
    """Rows (focus, depth, relative error of the scene part at that depth) for three foci; lengths in metres."""
    depths, light, depth_map = slices_of_a_volume(bench.experiment.grid)
    foci = [NEAR + (FAR - NEAR) * part for part in (1 / 6, 1 / 2, 5 / 6)]
    shown = torch.zeros(len(foci), *light.shape[1:], dtype=torch.float64)
    for depth, image in zip(depths, light, strict=True):
        if image.max() <= 0:
            continue
        single = replace(bench, kind="fresnel", distances=(depth,), pictures=image[None])
        phase = single.algorithm2(single.start("cool"), steps=steps).x
        for k, focus in enumerate(foci):
            shown[k] += image.mean() * replace(single, distances=(focus,)).formed(phase)[0]
    reference = light.sum(0).double()
    part = (depth_map - torch.tensor(foci)[:, None, None]).abs().argmin(0)
    lit = reference > _LIT * reference.max()
    errors = []
    for k, focus in enumerate(foci):
        for j, depth in enumerate(foci):
            inside = (part == j) & lit
            if inside.any():
                error = (shown[k] - reference)[inside].square().sum() / reference[inside].square().sum()
                errors.append((focus, depth, math.sqrt(error.item())))
    return errors
