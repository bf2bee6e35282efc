"""PlanePair: the samples of source and result of a propagation, and the direction of its carrier wave."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid, Pair


@dataclass(frozen=True)
class PlanePair:
    """Source grid, result grid, and the direction of the carrier wave that is divided out of both fields.

    Attributes:
        grid: Sampling of the source.
        out: Sampling of the result.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the source.
        tilt: Sines (y, x) of the carrier's direction.
    """

    grid: Grid
    out: Grid
    offset: Pair = (0.0, 0.0)
    tilt: Pair = (0.0, 0.0)

    @property
    def straight(self) -> bool:
        """Whether source and result have the same samples and the carrier is not tilted."""
        return self.out == self.grid and not any(self.offset) and not any(self.tilt)

    @property
    def same_pitch(self) -> bool:
        """Whether source and result have the same pitch."""
        return self.out.pitch == self.grid.pitch


def plane_pair(
    grid: Grid, out: Grid | None, offset: Sequence[float], tilt: Sequence[float] | Tensor, wavelengths: Sequence[float]
) -> PlanePair:
    """Check the arguments and return their PlanePair; ``out`` is ``grid`` by default.

    Raises:
        TypeError: An argument of a wrong type.
        ValueError: A tilt about which the band of ``grid`` contains directions with a sine of 0.98 or more.
    """
    if out is not None and not isinstance(out, Grid):
        raise TypeError(f"out_grid must be a Grid, such as Grid((256, 256), pitch=8e-6), got {out!r}")
    position = checks.offset(offset)
    sines = tilt.detach().reshape(-1).tolist() if isinstance(tilt, Tensor) else tilt
    sy, sx = checks.pair("tilt", sines, "sines of the carrier's direction")
    if sy or sx:
        steepest = math.hypot(*(abs(s) + max(wavelengths) / 2 / p for s, p in zip((sy, sx), grid.pitch, strict=True)))
        if steepest >= 0.98:
            raise ValueError(
                f"tilt of sines ({sy:g}, {sx:g}) brings part of the grid's band to a sine of {steepest:.3g}, beyond "
                "0.98, where light hardly travels forward; use a coarser pitch or a smaller tilt"
            )
    return PlanePair(grid, out or grid, position, (sy, sx))


def shifts(planes: PlanePair, distance: Tensor, tilt: Tensor) -> list[Tensor]:
    """Per axis (y, x), the position of sample 0 of the result relative to the projection of sample 0 of the source.

    The projection is the point where the carrier ray from that sample meets the plane of the result. Positions are in
    samples of the source, float64 of the shape of ``distance``, and differentiable in distance and tilt.
    """
    tangents = tilt / torch.sqrt(1 - tilt.square().sum())
    return [
        source // 2 - result // 2 + (offset - distance * tangent) / pitch
        for source, result, offset, tangent, pitch in zip(
            planes.grid.shape, planes.out.shape, planes.offset, tangents, planes.grid.pitch, strict=True
        )
    ]
