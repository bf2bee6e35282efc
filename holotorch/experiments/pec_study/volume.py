"""Thesis Fig. 4.18: a volume as slices, each corrected for the heat at its own depth, shown in turn, refocused."""

import math
import warnings
from dataclasses import replace

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity, phasor
from holotorch.correction import APG
from holotorch.experiments.pec_study.bench import WAVELENGTH, Bench
from holotorch.optics import Fresnel
from holotorch.scene import DVRSampler, TransferFunction, Volume, phantoms

NEAR, FAR, SLICES = 0.08, 0.12, 24  # distances of the volume's faces in metres, and slices between them
_LIT = 0.05  # intensity above which a pixel counts in the error, relative to the brightest


def slices_of_a_volume(size: int, pitch: float) -> tuple[list[float], Tensor, Tensor]:
    """Depths and light of the slices [D, h, w] of a synthetic C60 molecule, and its depth map [h, w].

    The phantom is as wide as the chip and stretched along the optical axis: a depth of 2 mm would lie within the depth
    of focus.
    """
    values = phantoms.c60(64).values
    width = size * pitch
    volume = Volume(values, ((FAR - NEAR) / 64, width / 64, width / 64), "m")
    transfer = TransferFunction(
        [0.0, 0.3, 0.6, 1.0], [[0, 0, 0], [0.8] * 3, [1.0] * 3, [1.0] * 3], [0, 0, 0.5, 1.0], unit_distance=0.02
    )
    bench = Bench(size=size)
    step = (FAR - NEAR) / SLICES
    depths = [FAR - (j + 0.5) * step for j in range(SLICES)]
    sampler = DVRSampler(transfer, bench.grid, depths, width=FAR - NEAR)
    with torch.no_grad():
        light = torch.stack([plane.square().mean(0) for plane in sampler(volume).amplitudes()])
        return depths, light, sampler.depth_map(volume)


def focal_sweep(bench: Bench, steps: int) -> list[tuple[float, float, float]]:
    """(focus, depth of a part of the scene, its relative error) for three foci and three parts, by Algorithm 2."""
    depths, light, depth_map = slices_of_a_volume(bench.size, bench.grid.pitch[0])
    foci = [NEAR + (FAR - NEAR) * part for part in (1 / 6, 1 / 2, 5 / 6)]
    shown = torch.zeros(len(foci), *light.shape[1:], dtype=torch.float64)
    for depth, image in zip(depths, light, strict=True):
        if image.max() <= 0:
            continue
        mean = image.mean()
        single = replace(bench, kind="fresnel", distances=(depth,), images=("slice",), pictures=image[None])
        phase = APG(max_steps=steps)(single.problem(), single.start("cool")).x.double()
        field = phasor(bench.crosstalk(phase))
        for k, focus in enumerate(foci):
            shown[k] += mean * intensity(_fresnel(bench, focus)(field))[0]
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


def _fresnel(bench: Bench, distance: float) -> Fresnel:
    with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # the thesis's model is periodic
        return Fresnel(bench.grid, [WAVELENGTH], distance, pad=1)
