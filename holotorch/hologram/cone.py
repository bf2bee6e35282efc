"""What a point of light sends to a sampled hologram: the spherical wave, and the cone of it that the pixels can carry.

The wave of a point is exp(+i k r) / r (thesis Eqs. 5.1, 5.13). A pitch p carries sines up to wavelength / (2 p) per
axis only; beyond, the samples alias. How the rest is kept apart is a definition, not an approximation:

- ``full``: nothing is. It aliases where the cone is narrower than the pixels (Algorithm 4 as printed).
- ``box``: a sharp pyramid, |x| <= z tan(theta) and |y| <= z tan(theta): the thesis's K_z of Sec. 5.6.1.
- ``disc``: a sharp cone of the same half angle.
- ``taper``: the pyramid with a soft rim, from 0.7 of the highest frequency on, so that no light rings at its edge.
- ``band``: the wave whose spectrum ends sharply at the highest frequency, all that a display with square pixels emits.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH
from holotorch.optics.geometry import lateral_spread
from holotorch.optics.kernels import carrier, turns_phasor

Cone = Literal["full", "box", "disc", "taper", "band"]
_SOFT = 0.7  # of the highest frequency: where the taper begins


def taper(part: Tensor) -> Tensor:
    """1 up to 0.7, a half cosine down to 0 at 1, of a frequency's part of the highest one."""
    edge = ((part.abs() - _SOFT) / (1 - _SOFT)).clamp(0, 1)
    return (1 + torch.cos(math.pi * edge)) / 2


def cone_samples(grid: Grid, wavelength: float, depth: float) -> tuple[float, float]:
    """Half width (y, x) of the cone on the hologram, in samples; infinite at a pitch of half a wavelength or less."""
    y, x = lateral_spread(grid, wavelength, depth)
    return y / grid.pitch[0], x / grid.pitch[1]


def spherical_wave(dy: Tensor, dx: Tensor, pitch: tuple[float, float], wavelength: float, depth: float, cone: Cone):
    """exp(i k r) / r within the cone, at displacements in metres.

    Args:
        dy: Float64, broadcasting against ``dx``.
        dx: Float64.
        pitch: (y, x) of the hologram in metres, from which the cone follows.
        wavelength: In metres.
        depth: z > 0 in metres; r^2 = z^2 + dy^2 + dx^2.
        cone: Any of the definitions above but ``band``, which has no closed form in space.

    Returns:
        complex128. k r is written k z + k s / (r + z), s = dy^2 + dx^2, whose second term does not cancel; whole turns
        of the first are taken off in float64.
    """
    square = dy.square() + dx.square()
    far = torch.sqrt(depth**2 + square)
    wave = turns_phasor(square / (far + depth) / wavelength) * (carrier(wavelength, depth).to(far.device) / far)
    if cone == "full":
        return wave
    if cone == "taper":
        parts = (2 * step * aside / (wavelength * far) for step, aside in zip(pitch, (dy, dx), strict=True))
        y, x = (taper(part) for part in parts)
        return wave * (y * x)
    spread = lateral_spread(Grid(1, pitch), wavelength, depth)
    # A pixel on the border belongs to the cone, whatever its position was rounded to.
    y, x = (aside.abs() / (limit * (1 + 1e-12)) for aside, limit in zip((dy, dx), spread, strict=True))
    inside = (y.square() + x.square() <= 1) if cone == "disc" else (y <= 1) & (x <= 1)
    return torch.where(inside, wave, 0)


def check_scene(grid: Grid, wavelength: float, depths, stride: int) -> tuple[float, tuple[float, ...], int]:
    """Checked wavelength, depths and stride of a hologram's sources.

    Raises:
        TypeError: Not numbers.
        ValueError: No depth, or one that is not above zero (all points lie before the hologram) or beyond 100 m.
    """
    wavelength = checks.wavelengths(wavelength)[0]
    items = depths.tolist() if isinstance(depths, Tensor) else list(depths)
    if not items:
        raise ValueError("depths must hold at least one distance in metres, got none")
    for depth in items:
        checks.quantity(DEPTH, depth, "depth of a plane")
    return wavelength, tuple(map(float, items)), checks.whole("stride", stride, 1)


def check_layers(layers: Tensor, count: int) -> None:
    """TypeError or ValueError unless ``layers`` is complex [..., D, h, w] with D = ``count``."""
    if not isinstance(layers, Tensor) or not layers.is_complex():
        raise TypeError(f"layers must be a complex tensor (..., D, h, w), got {getattr(layers, 'dtype', type(layers))}")
    if layers.ndim < 3 or layers.shape[-3] != count or 0 in layers.shape[-2:]:
        raise ValueError(f"layers must end in (D, h, w) with D = {count} depths, got {tuple(layers.shape)}")
