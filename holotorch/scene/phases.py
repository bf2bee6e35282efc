"""Initial phases of light sources: what a ray, or a point, is given besides its amplitude.

No phase at all (None) is the constant 0: sharp where light is in focus, and all of it in one direction. A random phase
per ray, as in the thesis, spreads it over the whole eye box and makes speckle. A smooth one is in between.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import filter_real
from holotorch.core.grid import Grid
from holotorch.core.quantities import WIDTH

_WINDOWS = 64  # places of a window along each axis


def random_phase(grid: Grid, *, generator: torch.Generator | None = None) -> Tensor:
    """Uniform in [0, 2 pi), independent for every ray: float32 [h, w] on the generator's device (Section 5.3.1)."""
    return 2 * math.pi * torch.rand(grid.shape, generator=generator, device=_device(generator))


def smooth_phase(
    grid: Grid, length: float, *, spread: float = math.pi, generator: torch.Generator | None = None
) -> Tensor:
    """Gaussian noise without its high frequencies: float32 [h, w] in radians, continuous, also across the borders.

    Args:
        grid: Of the rays.
        length: Metres over which phases are alike; their correlation is exp(-r^2 / (2 length^2)).
        spread: Expected standard deviation in radians. Directions of light spread to wavelength spread / (2 pi length).
        generator: Of the noise.
    """
    length, spread = checks.quantity(WIDTH, length, "length"), checks.positive("spread", spread, "radians")
    noise = torch.randn(grid.shape, generator=generator, device=_device(generator))
    fy, fx = grid.frequencies(noise.device)
    square = fy.square() + fx[:, : grid.shape[1] // 2 + 1].square()
    # The root of the correlation's spectrum, scaled over all frequencies to variance 1.
    whole = torch.exp(-2 * (math.pi * length) ** 2 * (fy.square() + fx.square())).mean().item()
    kernel = torch.exp(-((math.pi * length) ** 2) * square) * (spread / math.sqrt(whole))
    return filter_real(noise, kernel.to(noise.dtype))


@dataclass(frozen=True, eq=False)
class PointPhases:
    """Random phases for every point of every plane: windows of one larger map, each plane its own.

    Points of one ray, and of planes near to each other, have independent phases, which is what keeps planes from
    interfering; points that do share one lie at places without a pattern. Drawing new ones for every plane would cost
    more than rendering it.

    Attributes:
        phase: In [0, 2 pi), [h + 63, w + 63].
        order: Of the 64 x 64 windows, whole numbers [4096]; planes beyond begin anew.
    """

    phase: Tensor
    order: Tensor

    def window(self, values: Tensor, plane: int) -> Tensor:
        """The part [h, w] of a map as large as ``phase`` that belongs to a plane; a view."""
        y, x = divmod(int(self.order[plane % len(self.order)]), _WINDOWS)
        height, width = (size - _WINDOWS + 1 for size in self.phase.shape)
        return values[y : y + height, x : x + width]

    def __call__(self, plane: int) -> Tensor:
        """Phases of a plane, [h, w]; the same every time."""
        return self.window(self.phase, plane)


def point_phases(grid: Grid, *, generator: torch.Generator | None = None) -> PointPhases:
    """Uniform in [0, 2 pi), float32, for every point of every plane; see :class:`PointPhases`."""
    height, width = (size + _WINDOWS - 1 for size in grid.shape)
    order = torch.randperm(_WINDOWS**2, generator=generator, device=_device(generator))
    return PointPhases(random_phase(Grid((height, width), grid.pitch), generator=generator), order)


def _device(generator: torch.Generator | None) -> torch.device:
    return torch.device("cpu") if generator is None else generator.device
