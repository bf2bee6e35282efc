"""SourceLayers: point sources of light on planes, what a scene hands to a hologram."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH


@dataclass(frozen=True, eq=False)
class SourceLayers:
    """Light sources on planes parallel to the hologram.

    Attributes:
        grid: Samples (rays) of every plane, centred on the axis; pitch in metres.
        depths: Of the planes, metres from the hologram, > 0, in the order of the planes (first = nearest to the
            observer).
        channels: Colours C.
        amplitudes: Called for an iterator over the planes, real [C, h, w] each: the square root of the radiance.
            Complex where every point has a phase of its own. It may be called again, and gives the same planes.
        phase: In radians, [h, w], common to all planes and colours (one random phase per ray, for instance), or None.

    Raises:
        TypeError: ``amplitudes`` cannot be called, or the phase is not real.
        ValueError: No plane, a depth that is not finite and positive, no channel, or a phase of another shape.
    """

    grid: Grid
    depths: tuple[float, ...]
    channels: int
    amplitudes: Callable[[], Iterator[Tensor]]
    phase: Tensor | None = None

    def __post_init__(self) -> None:
        depths = tuple(checks.quantity(DEPTH, depth, "depth of a layer") for depth in self.depths)
        if not depths:
            raise ValueError("depths must hold at least one distance from the hologram in metres, got none")
        object.__setattr__(self, "depths", depths)
        object.__setattr__(self, "channels", checks.whole("channels", self.channels, 1))
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
        """The planes one after another, complex [C, h, w]: amplitude exp(i phase).

        Raises:
            ValueError: A plane of another shape, or not as many planes as depths.
        """
        turn = None if self.phase is None else phasor(self.phase)
        count = 0
        for count, amplitude in enumerate(self.amplitudes(), 1):
            self._check(amplitude, count)
            if turn is not None:
                yield amplitude * turn
            else:
                yield amplitude if amplitude.is_complex() else torch.complex(amplitude, torch.zeros_like(amplitude))
        if count != len(self.depths):
            raise ValueError(f"layers must bring a plane for each of {len(self.depths)} depths, got {count}")

    def stack(self) -> Tensor:
        """All planes at once, complex [D, C, h, w]: 8 bytes for every sample of every plane and colour."""
        return torch.stack(list(self.planes()))

    def _check(self, amplitude: Tensor, count: int) -> None:
        wanted = (self.channels, *self.grid.shape)
        if tuple(amplitude.shape) != wanted:
            raise ValueError(f"plane {count} of the layers must be (C, h, w) = {wanted}, got {tuple(amplitude.shape)}")
        if count > len(self.depths):
            raise ValueError(f"layers must bring a plane for each of {len(self.depths)} depths, got more")
