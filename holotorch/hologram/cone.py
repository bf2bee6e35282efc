"""Spherical wave of a point source on a sampled hologram, and the cone of directions that the pixels can carry.

The wave of a point source is exp(+i k r) / r (thesis Eqs. 5.1, 5.13). A pitch p carries directions with sines up to
wavelength / (2 p) per axis; steeper light aliases. All holograms share these definitions of the part of the wave that
is kept, with sin(theta) = wavelength / (2 p):

- ``full``: the whole wave. It aliases where the cone is narrower than the hologram (Algorithm 4 as printed).
- ``box``: a sharp pyramid in space, |x| <= z tan(theta) and |y| <= z tan(theta), the thesis's K_z of Sec. 5.6.1.
- ``disc``: a sharp cone in space, of the same half angle.
- ``band``: the wave whose spectrum ends sharply at the highest frequency, all that a display with square pixels emits.
- ``taper``: the wave whose spectrum falls to 0 over the last 30 % of the band of each axis, to suppress ringing.

If every pixel lies well inside the cone of every source, ``full``, ``box``, ``disc`` and ``taper`` agree;
:func:`is_plain` is the criterion. The ringing of ``band`` extends farther into the cone: on the axis its amplitude is
0.6 / sqrt(K) of the wave, where the cone covers K samples.
"""

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH
from holotorch.optics.free_space.geometry import lateral_spread
from holotorch.optics.free_space.kernels import turns_phasor
from holotorch.optics.free_space.padding import FINEST

Cone = Literal["full", "box", "disc", "taper", "band"]
TAPER_BEGIN = 0.7  # fraction of the highest frequency at which the taper begins
# Factor of sqrt(K) / n^3 in the ringing of the taper, see ``taper_margin``; 0.9 to 2.5 were measured.
_TAPER_RINGING = 2.0


def taper(fraction: Tensor) -> Tensor:
    """Weight of a frequency, given as a fraction of the highest one: 1 up to 0.7, then a half cosine to 0 at 1."""
    edge = ((fraction.abs() - TAPER_BEGIN) / (1 - TAPER_BEGIN)).clamp(0, 1)
    return (1 + torch.cos(math.pi * edge)) / 2


def taper_margin(cone: float, error: float) -> float:
    """Distance in samples from an end of the taper beyond which the relative change of the wave is below ``error``.

    The second derivative of the taper is discontinuous at its ends. At n samples from the geometric image of an end
    this adds a relative amplitude of about 2 sqrt(K) / n^3, where the whole cone covers K = 2 ``cone`` samples.
    """
    return (_TAPER_RINGING * math.sqrt(2 * cone) / error) ** (1 / 3)


def is_plain(grid: Grid, wavelength: float, depth: float, apart: tuple[int, int], error: float) -> bool:
    """Whether the taper's relative change of the wave is below ``error`` at all displacements up to ``apart`` samples.

    ``apart`` is (y, x).
    """
    return all(
        math.isinf(cone) or TAPER_BEGIN * cone - distance >= taper_margin(cone, error / 2)
        for cone, distance in zip(cone_samples(grid, wavelength, depth), apart, strict=True)
    )


def cone_samples(grid: Grid, wavelength: float, depth: float) -> tuple[float, float]:
    """Half width (y, x) of the cone on the hologram, in samples; infinite at a pitch of half a wavelength or less."""
    y, x = lateral_spread(grid, wavelength, depth)
    return y / grid.pitch[0], x / grid.pitch[1]


def spherical_wave(dy: Tensor, dx: Tensor, pitch: tuple[float, float], wavelength: float, depth: float, cone: Cone):
    """exp(i k r) / r within the cone, at displacements in metres.

    Args:
        dy: Displacements along y, float64, broadcast with ``dx``.
        dx: Displacements along x, float64.
        pitch: Pitch (y, x) of the hologram in metres, which defines the cone.
        wavelength: In metres.
        depth: z > 0 in metres; r^2 = z^2 + dy^2 + dx^2.
        cone: "full", "box" or "disc"; the others have no closed form in space, see ``band_limited_wave``.

    Returns:
        complex128. k r is written as k z + k s / (r + z) with s = dy^2 + dx^2, to avoid the cancellation of r - z;
        whole cycles of k z are removed in float64.
    """
    square = dy.square() + dx.square()
    distance = torch.sqrt(depth**2 + square)
    carrier = turns_phasor(torch.tensor(depth / wavelength, dtype=torch.float64, device=dy.device))
    wave = turns_phasor(square / (distance + depth) / wavelength) * (carrier / distance)
    if cone == "full":
        return wave
    spread = lateral_spread(Grid(1, pitch), wavelength, depth)
    # The relative margin keeps pixels on the border inside the cone in spite of rounding.
    y, x = (aside.abs() / (limit * (1 + 1e-12)) for aside, limit in zip((dy, dx), spread, strict=True))
    inside = (y.square() + x.square() <= 1) if cone == "disc" else (y <= 1) & (x <= 1)
    return torch.where(inside, wave, 0)


def check_cone(cone: Cone, pitch: tuple[float, float], wavelength: float) -> None:
    """Raise ValueError unless ``cone`` is one of the definitions and the pitch is coarse enough for it."""
    if cone not in get_args(Cone):
        raise ValueError(f"cone must be one of {', '.join(map(repr, get_args(Cone)))}, got {cone!r}")
    if cone in ("taper", "band") and min(pitch) < FINEST * wavelength:
        raise ValueError(
            f"cone={cone!r} needs a pitch of at least {FINEST} wavelengths, {FINEST * wavelength:.3g} m, got "
            f"{min(pitch):g} m: use cone='box' of ConvolutionHologram"
        )


def check_scene(grid: Grid, wavelength: float, depths, stride: int) -> tuple[float, tuple[float, ...], int]:
    """Check and return wavelength (m), depths (m) and stride (pixels) of a hologram's sources.

    Raises:
        TypeError: Arguments that are not numbers.
        ValueError: Several wavelengths; no depth, or a depth that is not above zero or exceeds 100 m.
    """
    first, *others = checks.wavelengths(wavelength)
    if others:
        raise ValueError(
            f"wavelength must be one length in metres, got {1 + len(others)}: make one hologram per colour"
        )
    items = depths.tolist() if isinstance(depths, Tensor) else list(depths)
    if not items:
        raise ValueError("depths must hold at least one distance in metres, got none")
    for depth in items:
        checks.quantity(DEPTH, depth, "depth of a plane")
    return first, tuple(map(float, items)), checks.whole("stride", stride, 1)


def check_layers(layers: Tensor, count: int) -> None:
    """Raise TypeError or ValueError unless ``layers`` is complex [..., D, h, w] with D = ``count``."""
    if not isinstance(layers, Tensor) or not layers.is_complex():
        raise TypeError(f"layers must be a complex tensor (..., D, h, w), got {getattr(layers, 'dtype', type(layers))}")
    if layers.ndim < 3 or layers.shape[-3] != count or 0 in layers.shape[-2:]:
        raise ValueError(f"layers must end in (D, h, w) with D = {count} depths, got {tuple(layers.shape)}")
