"""PlanePair: from which samples to which, and along which direction, light is propagated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import OFFSET


@dataclass(frozen=True)
class PlanePair:
    """Source grid, grid of the result, and the carrier that is taken out of both fields.

    Attributes:
        grid: Sampling of the source.
        out: Sampling of the result.
        offset: Where (y, x) in metres the axis of the result lies beside that of the source.
        tilt: Sines (y, x) of the carrier's direction.
    """

    grid: Grid
    out: Grid
    offset: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)

    @property
    def straight(self) -> bool:
        """Whether the result has the source's own samples and there is no tilt."""
        return self.out == self.grid and not any(self.offset) and not any(self.tilt)

    @property
    def same_pitch(self) -> bool:
        """Whether the result is a window of the source's own sampling."""
        return self.out.pitch == self.grid.pitch


def plane_pair(
    grid: Grid,
    out: Grid | None,
    offset: Sequence[float],
    tilt: Sequence[float] | Tensor,
    wavelengths: Sequence[float],
) -> PlanePair:
    """A checked pair of planes.

    TypeError for arguments of another kind; ValueError for a tilt at which part of the grid's band would not travel.
    """
    if out is not None and not isinstance(out, Grid):
        raise TypeError(f"out_grid must be a Grid, such as Grid((256, 256), pitch=8e-6), got {out!r}")
    y, x = (checks.quantity(OFFSET, each) for each in checks.pair("offset", offset, "metres"))
    sines = tilt.detach().reshape(-1).tolist() if isinstance(tilt, Tensor) else tilt
    sy, sx = checks.pair("tilt", sines, "sines of the carrier's direction")
    if sy or sx:
        steepest = math.hypot(*(abs(s) + max(wavelengths) / 2 / p for s, p in zip((sy, sx), grid.pitch, strict=True)))
        if steepest >= 0.98:
            raise ValueError(
                f"tilt of sines ({sy:g}, {sx:g}) brings part of the grid's band to a sine of {steepest:.3g}, beyond "
                "0.98, where light hardly travels forward; use a coarser pitch or a smaller tilt"
            )
    return PlanePair(grid, out or grid, (y, x), (sy, sx))


def shifts(planes: PlanePair, distance: Tensor, tilt: Tensor) -> list[Tensor]:
    """Per axis: where sample 0 of the result lies beside sample 0 of the source, in samples, seen along the light.

    float64 of the distance's shape; differentiable in distance and tilt.
    """
    tangents = tilt / torch.sqrt(1 - tilt.square().sum())
    return [
        source // 2 - result // 2 + (aside - distance * tangent) / pitch
        for source, result, aside, tangent, pitch in zip(
            planes.grid.shape, planes.out.shape, planes.offset, tangents, planes.grid.pitch, strict=True
        )
    ]
