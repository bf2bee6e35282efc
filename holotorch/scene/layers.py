"""SourceLayers, point sources of light on planes, the interface between scene and hologram; and SlabLayers."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid, Pair
from holotorch.core.quantities import DEPTH
from holotorch.scene.lighting import shifted


@dataclass(eq=False)
class SourceLayers:
    """Light sources on planes parallel to the hologram.

    Attributes:
        grid: Positions of the sources, the same on every plane, centred on the axis; pitch in metres.
        depths: Distances of the planes from the hologram in metres, > 0; the first plane is nearest to the observer.
        channels: Number of colours C.
        amplitudes: Function that returns an iterator over the amplitudes on the planes, [C, h, w] each. An amplitude is
            the square root of the radiance, or complex if it includes a phase. Every call yields the same planes.
        phase: Phase in radians, [h, w], common to all planes and colours (for instance one random phase per ray), or
            None for a phase of 0.

    Raises:
        TypeError: ``amplitudes`` is not a function, or the phase is not real.
        ValueError: No plane, a depth that is not finite and positive, no channel, or a phase that is not [h, w].
    """

    grid: Grid
    depths: tuple[float, ...]
    channels: int
    amplitudes: Callable[[], Iterator[Tensor]]
    phase: Tensor | None = None

    def __post_init__(self) -> None:
        self.depths = tuple(checks.quantity(DEPTH, depth, "depth of a layer") for depth in self.depths)
        if not self.depths:
            raise ValueError("depths must hold at least one distance from the hologram in metres, got none")
        self.channels = checks.whole("channels", self.channels, 1)
        if not callable(self.amplitudes):
            raise TypeError(
                f"amplitudes must be a function that returns an iterator over [C, h, w] planes, got "
                f"{type(self.amplitudes).__name__}; pass lambda: iter(planes)"
            )
        if self.phase is not None:
            checks.field("phase of the layers", self.phase, self.grid.shape, complex_valued=False)
            if self.phase.ndim != 2:
                raise ValueError(f"phase of the layers must be one map (h, w), got shape {tuple(self.phase.shape)}")

    def planes(self) -> Iterator[Tensor]:
        """The planes one after another, complex [C, h, w]: amplitude times exp(i phase).

        Raises:
            ValueError: A plane that is not [C, h, w], or a number of planes that differs from that of the depths.
        """
        phase_factor = None if self.phase is None else phasor(self.phase)
        shape, expected, count = (self.channels, *self.grid.shape), len(self.depths), 0
        for count, amplitude in enumerate(self.amplitudes(), 1):
            if (given := tuple(amplitude.shape)) != shape:
                raise ValueError(f"plane {count} of the layers must be (C, h, w) = {shape}, got {given}")
            if count > expected:
                raise ValueError(f"layers must bring a plane for each of {expected} depths, got more")
            if phase_factor is not None:
                yield amplitude * phase_factor
            else:
                yield amplitude if amplitude.is_complex() else torch.complex(amplitude, torch.zeros_like(amplitude))
        if count != expected:
            raise ValueError(f"layers must bring a plane for each of {expected} depths, got {count}")

    def stack(self) -> Tensor:
        """All planes at once, complex [D, C, h, w]."""
        return torch.stack(list(self.planes()))


@dataclass(eq=False)
class SlabLayers:
    """Slabs of a volume before compositing, one per plane, from which the light towards any direction follows.

    Each slab is treated as infinitely thin: in an oblique view, a slab in front is shifted as a whole relative to one
    behind it and covers other parts of it. The opacity of a slab, and its shading, are those along the axis.

    Attributes:
        grid: Positions of the sources, the same on every plane, centred on the axis; pitch in metres.
        depths: Distances of the planes from the hologram in metres, > 0, rising or falling; the first plane is nearest
            to the observer.
        emission: Radiance of each slab without the others, opacity times colour, [D, C, h, w].
        opacity: Fraction of the light from behind that each slab absorbs, 0 to 1, [D, h, w].

    Raises ValueError for depths that are not above 0 and monotonic, or tensors of other shapes.
    """

    grid: Grid
    depths: tuple[float, ...]
    emission: Tensor
    opacity: Tensor

    def __post_init__(self) -> None:
        self.depths = tuple(checks.quantity(DEPTH, depth, "depth of a slab") for depth in self.depths)
        if list(self.depths) not in (sorted(set(self.depths)), sorted(set(self.depths), reverse=True)):
            raise ValueError(f"depths must rise or fall throughout, front to back, got {self.depths}")
        expected = len(self.depths), *self.grid.shape
        given = tuple(self.emission.shape), tuple(self.opacity.shape)
        if self.emission.ndim != 4 or (given[0][0], *given[0][2:]) != expected or given[1] != expected:
            raise ValueError(f"emission and opacity must be [D, C, h, w] and [D, h, w] = {expected}, got {given}")

    def towards(self, direction: Pair) -> Tensor:
        """Radiance of the planes towards ``direction``, the sines (y, x) of light that arrives at the hologram.

        C_j = emission_j prod_i (1 - opacity_i), over the slabs i in front of j where the ray from the source crosses
        them, interpolated linearly; [D, C, h, w]. The direction (0, 0) gives the light of ``DVRSampler``.

        Raises ValueError for sines of no direction.
        """
        sines = checks.pair("direction", direction, "sines")
        if math.hypot(*sines) >= 1:
            raise ValueError(f"direction must be the sines (y, x) of an angle, within the unit circle, got {direction}")
        cosine = math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2)
        light = []
        for j, emission in enumerate(self.emission):
            transmittance = torch.ones_like(self.opacity[0])
            for i in range(j):
                # Towards the hologram, at smaller depths, light moves along the direction.
                y, x = ((self.depths[j] - self.depths[i]) * sine / cosine for sine in sines)
                moved = shifted(self.opacity[i], (y / self.grid.pitch[0], x / self.grid.pitch[1]))
                transmittance = transmittance * (1 - moved)
            light.append(emission * transmittance)
        return torch.stack(light)
