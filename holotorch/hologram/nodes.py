"""Nodes: evenly spaced planes along the axis that represent any number of source planes, as in a non-uniform FFT.

The spectrum of a hologram is the three-dimensional transform of the volume on a cap of the Ewald sphere: a plane at
depth z contributes exp(2 pi i z w), w = sqrt(1 / wavelength^2 - fx^2 - fy^2). Over the band of a grid the axial
frequency w covers a short range, so the contributions of planes closer than the inverse of that range are linearly
dependent. Any number of planes can therefore be represented by a few nodes: each plane is spread onto the nodes around
it with a window function, and the sum is divided by the Fourier transform of the window.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from holotorch.core.grid import Grid


def axial_range(grid: Grid, wavelength: float, steepest: tuple[float, float] = (math.inf, math.inf)):
    """Smallest and largest axial frequency w of the grid's band, in cycles per metre.

    ``steepest`` is an additional limit of the tangents |fy| / w and |fx| / w.
    """
    tangents = []
    for pitch, limit in zip(grid.pitch, steepest, strict=True):
        sine = min(0.995, wavelength / (2 * pitch))  # below 1, so that w stays above 0
        tangents.append(min(limit, sine / math.sqrt(1 - sine**2)))
    sines = [tangent / math.sqrt(1 + tangent**2) for tangent in tangents]
    lowest = math.sqrt(max(1 - sines[0] ** 2 - sines[1] ** 2, 0.005))
    return lowest / wavelength, 1 / wavelength


@dataclass(frozen=True)
class Nodes:
    """Evenly spaced nodes and the Kaiser-Bessel window that spreads planes onto them.

    Attributes:
        first: Depth of node 0 in metres, the smallest.
        spacing: Distance between neighbouring nodes in metres.
        count: Number of nodes.
        width: Number of nodes that a plane is spread onto; 1 if the planes lie on the nodes.
        oversampling: Ratio of the sampling rate 1 / ``spacing`` to the width of the axial band, above 1.
        centre: Axial frequency in cycles per metre that is removed from the phases of the nodes.
    """

    first: float
    spacing: float
    count: int
    width: int
    oversampling: float
    centre: float

    @property
    def _beta(self) -> float:
        # The main lobe of the window's transform ends where the first alias of the band begins (Beatty et al. 2005).
        return math.pi * math.sqrt((self.width / self.oversampling * (self.oversampling - 0.5)) ** 2 - 0.8)

    def weights(self, depths: Sequence[float]) -> tuple[list[int], np.ndarray]:
        """First node of each plane, and the weights of the ``width`` nodes from there on, complex128 [D, width]."""
        positions = (np.asarray(depths) - self.first) / self.spacing
        phasors = np.exp(2j * math.pi * np.fmod(np.asarray(depths) * self.centre, 1.0))[:, None]
        if self.width == 1:
            return np.rint(positions).astype(int).tolist(), phasors
        begin = np.ceil(positions - self.width / 2).astype(int)
        offset = 2 * (begin[:, None] + np.arange(self.width) - positions[:, None]) / self.width
        return begin.tolist(), np.i0(self._beta * np.sqrt(np.clip(1 - offset**2, 0, None))) * phasors

    def response(self, frequency: Tensor) -> Tensor:
        """Fourier transform of the window at axial frequencies relative to ``centre``, in cycles per metre."""
        if self.width == 1:
            return torch.ones_like(frequency)
        square = self._beta**2 - (math.pi * self.width * self.spacing * frequency).square()
        root = torch.sqrt(square.abs())
        inside = torch.where(square > 0, torch.sinh(root.clamp(max=700)), torch.sin(root))
        return self.width * torch.where(root > 1e-9, inside / root.clamp(min=1e-9), 1)

    def depth(self, index: int) -> float:
        """Depth of a node in metres."""
        return self.first + index * self.spacing

    def error(self, low: float, high: float) -> float:
        """Root-mean-square error of the represented exponentials over axial frequencies from ``low`` to ``high``."""
        if self.width == 1:
            return 0.0
        frequency = np.linspace(low, high, 33) - self.centre
        response = self.response(torch.from_numpy(frequency)).numpy()
        errors = []
        for fraction in np.linspace(0, 1, 16, endpoint=False):
            depth = self.first + (self.width + fraction) * self.spacing
            (begin,), weights = self.weights([depth])
            nodes = self.first + (begin + np.arange(self.width)) * self.spacing
            ratio = np.exp(2j * math.pi * np.outer(frequency, nodes - depth)) @ weights[0] / response
            errors.append(ratio * np.exp(-2j * math.pi * math.fmod(depth * self.centre, 1.0)) - 1)
        return float(np.sqrt(np.mean(np.abs(errors) ** 2)))


def choose_nodes(depths: tuple[float, ...], low: float, high: float, tolerance: float) -> Nodes:
    """Cheapest nodes with an error within ``tolerance`` for planes at ``depths``.

    ``low`` and ``high`` are the limits of the axial frequency in cycles per metre. Evenly spaced planes serve as nodes
    themselves if that is not more expensive.
    """
    nearest, farthest, centre = min(depths), max(depths), (low + high) / 2
    best = None
    for width in (4, 5, 6, 8, 10, 12):
        for oversampling in (1.25, 1.5, 2.0):
            spacing = 1 / (oversampling * (high - low))
            count = math.ceil((farthest - nearest) / spacing) + width
            first = nearest - (width // 2) * spacing
            nodes = Nodes(first, spacing, count, width, oversampling, centre)
            # Spreading a plane onto one more node costs about 1 us at 512 px on two cores, the transform and the
            # propagation of a node 0.4 ms (measured): the ratio is 0.003.
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
    """Spacing of the sorted depths in metres, or None if they are uneven by more than 1e-12 of the largest depth."""
    ordered = sorted(depths)
    if len(ordered) == 1:
        return 1e-3  # arbitrary for a single plane
    step = (ordered[-1] - ordered[0]) / (len(ordered) - 1)
    exact = all(abs(depth - ordered[0] - i * step) <= 1e-12 * ordered[-1] for i, depth in enumerate(ordered))
    return step if exact and step > 0 else None
