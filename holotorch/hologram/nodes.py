"""Nodes: as few planes along the axis as the band needs, and how planes of sources are spread onto them.

The spectrum of a hologram is the volume's three-dimensional transform on a cap of the Ewald sphere: a plane at z adds
exp(2 pi i z w), w = sqrt(1 / wavelength^2 - fx^2 - fy^2). Over the band of a grid w covers a short range only, so that
planes closer than the inverse of that range are dependent, and any number of them can be written with a few evenly
spaced nodes: the exponential is a convolution with a window, divided by the window's transform, as in non-uniform FFTs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from holotorch.core.grid import Grid


def axial_range(grid: Grid, wavelength: float, steepest: tuple[float, float] = (math.inf, math.inf)):
    """Smallest and largest axial frequency w in cycles per metre of the grid's band, with |f| / w <= ``steepest``."""
    tangents = []
    for pitch, limit in zip(grid.pitch, steepest, strict=True):
        sine = min(0.995, wavelength / (2 * pitch))  # grazing light never reaches w = 0
        tangents.append(min(limit, sine / math.sqrt(1 - sine**2)))
    sines = [tangent / math.sqrt(1 + tangent**2) for tangent in tangents]
    lowest = math.sqrt(max(1 - sines[0] ** 2 - sines[1] ** 2, 0.005))
    return lowest / wavelength, 1 / wavelength


@dataclass(frozen=True)
class Nodes:
    """Evenly spaced nodes, and the Kaiser-Bessel window that spreads planes onto them.

    Attributes:
        first: Depth of node 0 in metres; deeper nodes follow.
        spacing: In metres.
        count: How many.
        width: Nodes that a plane is spread onto; 1 where planes lie on the nodes.
        oversampling: Of the axial band, above 1.
        centre: Axial frequency in cycles per metre that is taken out of the nodes' phases.
    """

    first: float
    spacing: float
    count: int
    width: int
    oversampling: float
    centre: float

    @property
    def _beta(self) -> float:
        # The window's transform reaches its sidelobes where the band's first image begins (Beatty et al. 2005).
        return math.pi * math.sqrt((self.width / self.oversampling * (self.oversampling - 0.5)) ** 2 - 0.8)

    def weights(self, depths: Sequence[float]) -> tuple[list[int], np.ndarray]:
        """First node that each plane touches, and what it adds to that node and the next, complex128 [D, width]."""
        places = (np.asarray(depths) - self.first) / self.spacing
        turns = np.exp(2j * math.pi * np.fmod(np.asarray(depths) * self.centre, 1.0))[:, None]
        if self.width == 1:
            return np.rint(places).astype(int).tolist(), turns
        begin = np.ceil(places - self.width / 2).astype(int)
        aside = 2 * (begin[:, None] + np.arange(self.width) - places[:, None]) / self.width
        return begin.tolist(), np.i0(self._beta * np.sqrt(np.clip(1 - aside**2, 0, None))) * turns

    def response(self, frequency: Tensor) -> Tensor:
        """Transform of the window at axial frequencies beside ``centre``, in cycles per metre; what spreading costs."""
        if self.width == 1:
            return torch.ones_like(frequency)
        square = self._beta**2 - (math.pi * self.width * self.spacing * frequency).square()
        root = torch.sqrt(square.abs())
        inside = torch.where(square > 0, torch.sinh(root.clamp(max=700)), torch.sin(root))
        return self.width * torch.where(root > 1e-9, inside / root.clamp(min=1e-9), 1)

    def depth(self, index: int) -> float:
        """Of a node, in metres."""
        return self.first + index * self.spacing

    def error(self, low: float, high: float) -> float:
        """Root-mean-square error of the exponentials over axial frequencies from ``low`` to ``high``, measured."""
        if self.width == 1:
            return 0.0
        frequency = np.linspace(low, high, 33) - self.centre
        response = self.response(torch.from_numpy(frequency)).numpy()
        errors = []
        for part in np.linspace(0, 1, 16, endpoint=False):
            depth = self.first + (self.width + part) * self.spacing
            (begin,), weights = self.weights([depth])
            places = self.first + (begin + np.arange(self.width)) * self.spacing
            wave = np.exp(2j * math.pi * np.outer(frequency, places - depth)) @ weights[0] / response
            errors.append(wave * np.exp(-2j * math.pi * math.fmod(depth * self.centre, 1.0)) - 1)
        return float(np.sqrt(np.mean(np.abs(errors) ** 2)))


def choose_nodes(depths: tuple[float, ...], low: float, high: float, tolerance: float) -> Nodes:
    """The fewest nodes for planes at ``depths`` and axial frequencies from ``low`` to ``high``.

    Planes that are evenly spaced already are their own nodes where that takes no more of them.
    """
    nearest, farthest, centre = min(depths), max(depths), (low + high) / 2
    best = None
    for width in (4, 5, 6, 8, 10, 12):
        for oversampling in (1.25, 1.5, 2.0):
            spacing = 1 / (oversampling * (high - low))
            count = math.ceil((farthest - nearest) / spacing) + width
            first = nearest - (width // 2) * spacing
            nodes = Nodes(first, spacing, count, width, oversampling, centre)
            # A plane is one row of a matrix product, bound by reading it: a node touched more costs about 1 us at
            # 512 px on two cores, where a node's transform and step take 0.4 ms.
            cost = count + 0.003 * width * len(depths)
            if nodes.error(low, high) <= tolerance and (best is None or cost < best[0]):
                best = cost, nodes
    even = _evenly_spaced(depths)
    if even is not None and (best is None or len(depths) <= best[0]):
        return Nodes(nearest, even, len(depths), 1, math.inf, centre)
    if best is None:
        raise ValueError(f"no spreading onto nodes reaches a tolerance of {tolerance:g}; 1e-7 is the least")
    return best[1]


def _evenly_spaced(depths: tuple[float, ...]) -> float | None:
    """Step between sorted depths if all agree to a hundredth of a radian of the carrier at any light, else None."""
    ordered = sorted(depths)
    if len(ordered) == 1:
        return 1e-3  # any
    step = (ordered[-1] - ordered[0]) / (len(ordered) - 1)
    exact = all(abs(depth - ordered[0] - i * step) <= 1e-12 * ordered[-1] for i, depth in enumerate(ordered))
    return step if exact and step > 0 else None
