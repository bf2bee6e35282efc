"""Catheter: a straight thin tube with bands of colour at known distances from its tip."""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import TOOL_LENGTH, TOOL_POSITION, TOOL_RADIUS

NO_GAPS = (
    "bands touch each other, so that N colours take N + 1 edges; an uncoloured gap between bands is not supported: "
    "paint it as a band of its own saturated colour, or paint the bands without gaps"
)


@dataclass(frozen=True)
class Catheter:
    """Geometry and colours of a catheter.

    Attributes:
        edges: At least 4 distances of the band edges from the tip in metres, increasing. Band i extends from edge i to
            edge i + 1, where the next one begins: there are no gaps.
        colours: 8-bit sRGB triples, one for each of the ``len(edges) - 1`` bands; those of neighbours differ.
        radius: Outer radius in metres.
        length: Distance from the tip to the rear end in metres.

    Raises:
        TypeError, ValueError: A value of another type or range.

    Source: Sec. 3.3.1 and Fig. 3.5 of the thesis. Its catheter, ``THESIS``, has three bands of 38 mm.
    """

    edges: tuple[float, ...]
    colours: tuple[tuple[int, int, int], ...]
    radius: float
    length: float

    def __post_init__(self) -> None:
        edges = tuple(checks.quantity(TOOL_POSITION, edge, "edges") for edge in self.edges)
        lengths = [b - a for a, b in itertools.pairwise(edges)]
        if len(edges) < 4 or edges[0] < 0 or min(lengths) <= 0:
            raise ValueError(f"edges must be at least 4 rising distances from the tip in metres, got {edges}")
        colours = tuple(tuple(int(value) for value in colour) for colour in self.colours)
        if len(colours) != len(edges) - 1:
            bands = f"{len(edges)} edges bound {len(edges) - 1} bands, got {len(colours)} colours"
            raise ValueError(f"colours must be one for each band: {bands}; {NO_GAPS}")
        for colour in colours:
            if len(colour) != 3 or not all(0 <= value <= 255 for value in colour):
                raise ValueError(f"colours must be triples of 8-bit levels, got {colour}")
        for one, other in itertools.pairwise(colours):
            if math.dist(one, other) < 40:
                raise ValueError(f"neighbouring bands must differ in colour, got {one} beside {other}")
        checks.quantity(TOOL_RADIUS, self.radius)
        if checks.quantity(TOOL_LENGTH, self.length) < edges[-1]:
            raise ValueError(f"length must reach the last edge at {edges[-1]:g} m, got {self.length:g} m")
        if self.radius > min(lengths) / 2:
            raise ValueError(f"bands must be longer than they are wide, got radius {self.radius:g} m, edges {edges}")
        object.__setattr__(self, "edges", edges)
        object.__setattr__(self, "colours", colours)

    @property
    def positions(self) -> Tensor:
        """Distances of the edges from the tip in metres, float64 [N]."""
        return torch.tensor(self.edges, dtype=torch.float64)


# The catheter of the thesis, with three bands; lengths in metres.
THESIS = Catheter((0.070, 0.108, 0.146, 0.184), ((200, 40, 45), (40, 150, 70), (40, 70, 190)), 1.0e-3, 0.35)
