"""Initial phases of light sources: what a ray, or a point, is given besides its amplitude.

No phase at all (None) is the constant 0: sharp where light is in focus, and all of it in one direction. A random phase
per ray, as in the thesis, spreads it over the whole eye box and makes speckle. A smooth one is in between.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import filter_real
from holotorch.core.grid import Grid


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
    length, spread = checks.positive("length", length, "metres"), checks.positive("spread", spread, "radians")
    noise = torch.randn(grid.shape, generator=generator, device=_device(generator))
    fy, fx = grid.frequencies(noise.device)
    square = fy.square() + fx[:, : grid.shape[1] // 2 + 1].square()
    # The root of the correlation's spectrum, scaled over all frequencies to variance 1.
    whole = torch.exp(-2 * (math.pi * length) ** 2 * (fy.square() + fx.square())).mean().item()
    kernel = torch.exp(-((math.pi * length) ** 2) * square) * (spread / math.sqrt(whole))
    return filter_real(noise, kernel.to(noise.dtype))


def point_phases(grid: Grid, *, generator: torch.Generator | None = None) -> Callable[[int], Tensor]:
    """Uniform in [0, 2 pi), independent for every point of every plane: plane number -> float32 [h, w].

    The same plane gets the same phases every time, so that layers can be gone through again.
    """
    device = _device(generator)
    seed = int(torch.randint(1 << 62, (), generator=generator, device=device))

    def phase(plane: int) -> Tensor:
        return random_phase(grid, generator=torch.Generator(device).manual_seed(seed + plane))

    return phase


def _device(generator: torch.Generator | None) -> torch.device:
    return torch.device("cpu") if generator is None else generator.device
