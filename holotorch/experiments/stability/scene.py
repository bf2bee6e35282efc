"""Sweeps of direct volume rendering: number of steps along a ray, and optical depth."""

import math

import numpy as np
import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.experiments.stability.sweep import DEFAULT, DOCUMENTED, Answer, Sweep
from holotorch.scene import DVRSampler, TransferFunction, Volume

WIDTH, DISTANCE = 10e-3, 0.1  # metres: length of the volume along the rays, and distance of its centre
VOXELS = 40  # along the rays
UNIT = 1 / 256  # distance of the opacities, as a share of the width
FINE = 20_000  # steps of the reference


def sweeps() -> list[Sweep]:
    """Numbers of planes for three optical depths, and optical depths, of a uniform and of a varying medium."""
    planes, depths = (2, 5, 10, 20, 40, 80, 160, 320), (0.01, 0.1, 0.5, 1.0, 3.0, 10.0, 30.0)
    return [
        *(
            Sweep(
                f"DVRSampler, optical depth {depth:g}", "planes", planes,
                lambda n, d=depth: _rendered(n, d, varies=True), lambda _, d=depth: _integrated(d, varies=True),
                tolerance_from=DOCUMENTED,
            )
            for depth in (0.3, 3.0, 30.0)
        ),
        Sweep("DVRSampler, uniform", "planes", planes, lambda n: _rendered(n, 3.0, varies=False),
              lambda _: _integrated(3.0, varies=False)),
        Sweep("DVRSampler, 80 planes", "optical depth", depths, lambda d: _rendered(80, d, varies=True),
              lambda d: _integrated(d, varies=True)),
    ]  # fmt: skip


def _values(*, varies: bool) -> np.ndarray:
    """Values of the voxels along the rays."""
    z = (np.arange(VOXELS) + 0.5) / VOXELS
    return 0.5 + 0.45 * np.sin(9 * z) if varies else np.full(VOXELS, 0.5)


def _opacity(depth: float, *, varies: bool) -> float:
    """Opacity of the value 1 that gives the volume about this optical depth."""
    return -math.expm1(-depth * UNIT / _values(varies=varies).mean())


def _rendered(planes: float, depth: float, *, varies: bool) -> Answer:
    """Colour [3] of the ray through the middle."""
    line = torch.from_numpy(_values(varies=varies))
    volume = Volume(line[:, None, None].expand(VOXELS, 4, 4).contiguous(), (1 / VOXELS, 0.05, 0.05), "relative")
    opacity = _opacity(depth, varies=varies)
    transfer = TransferFunction(
        torch.tensor([0.0, 1.0], dtype=torch.float64), torch.tensor([[1.0, 0.2, 0], [0, 0.6, 1]], dtype=torch.float64),
        torch.tensor([0.0, opacity], dtype=torch.float64), unit_distance=UNIT,
    )  # fmt: skip
    ends = np.linspace(DISTANCE - WIDTH / 2, DISTANCE + WIDTH / 2, int(planes) + 1)
    sampler = DVRSampler(
        transfer, Grid((1, 1), 1e-5), ((ends[1:] + ends[:-1]) / 2).tolist(),
        width=WIDTH, distance=DISTANCE, early=0.0, boundaries=ends.tolist(),
    )  # fmt: skip
    predicted = sampler.slab_error(volume)
    return Answer(sampler.render(volume)[0][:, 0, 0], predicted, tolerance=max(DEFAULT, predicted))


def _integrated(depth: float, *, varies: bool) -> Tensor:
    """The same colour by the emission-absorption integral in small steps; voxels are interpolated linearly."""
    z = (np.arange(FINE) + 0.5) / FINE
    values = np.interp(z * VOXELS - 0.5, np.arange(VOXELS), _values(varies=varies))
    extinction = -np.log1p(-_opacity(depth, varies=varies) * values) / UNIT / FINE
    transmitted = np.exp(-np.concatenate([[0.0], extinction.cumsum()[:-1]]))
    weights = transmitted * -np.expm1(-extinction)
    colours = np.stack([1 - values, 0.2 + 0.4 * values, values])
    return torch.from_numpy(colours @ weights)
