"""Thesis Fig. 4.18: a volume as slices, each corrected for the heat at its depth, shown in turn and refocused."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.experiments.pec_study.bench import Bench
from holotorch.scene import DVRSampler, TransferFunction, Volume, phantoms

NEAR, FAR, SLICES = 0.08, 0.12, 24  # distances of the volume's faces in metres, and slices between them
_LIT = 0.05  # intensity above which a pixel counts in the error, relative to the brightest


def slices_of_a_volume(grid: Grid) -> tuple[list[float], Tensor, Tensor]:
    """Depths [D] and intensities [D, h, w] of the slices of a synthetic C60 molecule, and its depth map [h, w].

    Depths are in metres. The phantom is as wide as ``grid`` and stretched along the optical axis to 40 mm, because its
    true depth of 2 mm would lie within the depth of focus.
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
    """(focus, depth of a part of the scene, its relative error) for three foci and three parts, by Algorithm 2."""
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
    wanted = light.sum(0).double()
    part = (depth_map - torch.tensor(foci)[:, None, None]).abs().argmin(0)
    lit = wanted > _LIT * wanted.max()
    errors = []
    for k, focus in enumerate(foci):
        for j, depth in enumerate(foci):
            inside = (part == j) & lit
            if inside.any():
                error = (shown[k] - wanted)[inside].square().sum() / wanted[inside].square().sum()
                errors.append((focus, depth, math.sqrt(error.item())))
    return errors
