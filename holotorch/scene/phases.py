"""Phases of light sources in the scene.

A constant phase gives an image in focus without speckle, but sends the light in one direction only. A random phase per
ray, as in the thesis, spreads the light over the whole eye box and causes speckle. A smooth random phase lies between
the two.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import filter_real
from holotorch.core.grid import Grid
from holotorch.core.quantities import WIDTH

_WINDOWS = 64  # number of positions of a window of ``PointPhases`` along each axis


def random_phase(grid: Grid, *, generator: torch.Generator | None = None) -> Tensor:
    """Independent phases, uniform in [0, 2 pi): float32 [h, w] on the generator's device (thesis Section 5.3.1)."""
    return 2 * math.pi * torch.rand(grid.shape, generator=generator, device=generator.device if generator else None)


def smooth_phase(
    grid: Grid, length: float, *, spread: float = math.pi, generator: torch.Generator | None = None
) -> Tensor:
    """Phases from low-pass filtered Gaussian noise, periodic: float32 [h, w] in radians on the generator's device.

    Args:
        grid: Grid of the rays.
        length: Correlation length in metres; the correlation at distance r is exp(-r^2 / (2 length^2)).
        spread: Expected standard deviation of the phase in radians. The sine of the direction of the light then has a
            standard deviation of wavelength times ``spread`` / (2 pi ``length``).
        generator: Random generator of the noise.
    """
    length, spread = checks.quantity(WIDTH, length, "length"), checks.positive("spread", spread, "radians")
    noise = torch.randn(grid.shape, generator=generator, device=generator.device if generator else None)
    fy, fx = grid.frequencies(noise.device)
    square = fy.square() + fx[:, : grid.shape[1] // 2 + 1].square()
    # The transfer function is the square root of the power spectrum, scaled to a standard deviation of ``spread``.
    variance = torch.exp(-2 * (math.pi * length) ** 2 * (fy.square() + fx.square())).mean().item()
    kernel = torch.exp(-((math.pi * length) ** 2) * square) * (spread / math.sqrt(variance))
    return filter_real(noise, kernel.to(noise.dtype))


@dataclass(frozen=True, eq=False)
class PointPhases:
    """Random phases for every point of every plane: each plane uses a different window of one larger map.

    The points of a ray therefore have independent phases on different planes, and planes do not interfere
    systematically. Drawing new phases for every plane would take longer than rendering the plane.

    Attributes:
        phase: The larger map of phases in [0, 2 pi), [h + 63, w + 63].
        order: Random order of the 64 x 64 windows, as int64 [4096]; it repeats after 4096 planes.
    """

    phase: Tensor
    order: Tensor

    def window(self, values: Tensor, plane: int) -> Tensor:
        """Window [h, w] for the plane of index ``plane``: a view of ``values``, which have the shape of ``phase``."""
        y, x = divmod(int(self.order[plane % len(self.order)]), _WINDOWS)
        height, width = (size - _WINDOWS + 1 for size in self.phase.shape)
        return values[y : y + height, x : x + width]

    def __call__(self, plane: int) -> Tensor:
        """Phases [h, w] of the plane of index ``plane``; a view of ``phase``."""
        return self.window(self.phase, plane)


def point_phases(grid: Grid, *, generator: torch.Generator | None = None) -> PointPhases:
    """Float32 phases, uniform in [0, 2 pi), for every point of every plane; see :class:`PointPhases`."""
    height, width = (size + _WINDOWS - 1 for size in grid.shape)
    order = torch.randperm(_WINDOWS**2, generator=generator, device=generator.device if generator else None)
    return PointPhases(random_phase(Grid((height, width), grid.pitch), generator=generator), order)
