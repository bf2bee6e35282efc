"""Spherical wave of a point source on a sampled hologram, and the cone of directions that the pixels can carry.

The wave of a point source is exp(+i k r) / r (thesis Eqs. 5.1, 5.13). Pixels of pitch p sample frequencies up to
1 / (2 p) along each axis, that is directions up to the angle theta with sin(theta) = wavelength / (2 p); steeper light
aliases. The option ``cone`` of every hologram defines which part of the wave is kept:

- ``full``: the whole wave. It aliases where the cone is narrower than the hologram (Algorithm 4 as printed).
- ``box``: a sharp pyramid in space, |x| <= z tan(theta) and |y| <= z tan(theta), the thesis's K_z of Sec. 5.6.1.
- ``disc``: a sharp cone in space with the same half-widths, which is elliptical where the pitches differ.
- ``band``: the spectrum is cut off sharply at 1 / (2 p) along each axis, so all light that the pixels sample is kept.
- ``taper``: the spectrum falls to 0 over the last 30 % of the frequencies of each axis, to suppress ringing.

If every pixel lies well inside the cone of every source, ``full``, ``box``, ``disc`` and ``taper`` agree;
:func:`is_plain` is the criterion. The ringing of ``band`` extends farther into the cone: on the axis its amplitude is
0.6 / sqrt(K) of the wave, if the cone covers K samples of the hologram.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DEPTH
from holotorch.optics.free_space.geometry import lateral_spread
from holotorch.optics.free_space.kernels import turns_phasor

Cone = Literal["full", "box", "disc", "taper", "band"]
TAPER_BEGIN = 0.7  # fraction of the highest frequency at which the taper begins


def taper(fraction: Tensor) -> Tensor:
    """Weight of a frequency, given as a fraction of the highest one: 1 up to 0.7, then a half cosine to 0 at 1."""
    edge = ((fraction.abs() - TAPER_BEGIN) / (1 - TAPER_BEGIN)).clamp(0, 1)
    return (1 + torch.cos(math.pi * edge)) / 2


def taper_margin(half_width: float, error: float) -> float:
    """Distance in samples from an edge of the taper at which its ringing falls to ``error`` times the wave.

    The taper has two edges, at 0.7 and 1 times the highest frequency, where its second derivative jumps. In the wave
    of a cone of ``half_width`` samples this causes ringing around the positions that light of these two frequencies
    reaches. At n samples from such a position the relative amplitude of the ringing is about 2 sqrt(K) / n^3 with
    K = 2 ``half_width``. In measurements the factor, here 2, is between 0.9 and 2.5.
    """
    return (2 * math.sqrt(2 * half_width) / error) ** (1 / 3)


def is_plain(grid: Grid, wavelength: float, depth: float, displacement: tuple[int, int], error: float) -> bool:
    """Whether the taper changes the wave by less than ``error``, relative, up to ``displacement`` (y, x) in samples."""
    return all(
        math.isinf(half_width) or TAPER_BEGIN * half_width - samples >= taper_margin(half_width, error / 2)
        for half_width, samples in zip(cone_samples(grid, wavelength, depth), displacement, strict=True)
    )


def cone_samples(grid: Grid, wavelength: float, depth: float) -> tuple[float, float]:
    """Half-width (y, x) of the cone on the hologram, in samples; infinite at a pitch of half a wavelength or less."""
    y, x = lateral_spread(grid, wavelength, depth)
    return y / grid.pitch[0], x / grid.pitch[1]


def spherical_wave(dy: Tensor, dx: Tensor, pitch: tuple[float, float], wavelength: float, depth: float, cone: Cone):
    """exp(i k r) / r within the cone, with r^2 = ``depth``^2 + ``dy``^2 + ``dx``^2, complex128 of the broadcast shape.

    All lengths are in metres; the displacements ``dy`` and ``dx`` are float64. ``pitch`` (y, x) defines the width of
    the cone, which is "full", "box" or "disc"; for "taper" and "band" see ``band_limited_wave``. With z = ``depth`` and
    s = dy^2 + dx^2, k r is computed as k z + k s / (r + z), to avoid the cancellation of r - z, and whole cycles of k z
    are removed in float64.
    """
    square = dy.square() + dx.square()
    distance = torch.sqrt(depth**2 + square)
    carrier = turns_phasor(torch.tensor(depth / wavelength, dtype=torch.float64, device=dy.device))
    wave = turns_phasor(square / (distance + depth) / wavelength) * (carrier / distance)
    if cone == "full":
        return wave
    spread = lateral_spread(Grid(1, pitch), wavelength, depth)
    # The relative margin of 1e-12 keeps pixels on the border inside the cone in spite of rounding.
    y, x = (displacement.abs() / (limit * (1 + 1e-12)) for displacement, limit in zip((dy, dx), spread, strict=True))
    inside = (y.square() + x.square() <= 1) if cone == "disc" else (y <= 1) & (x <= 1)
    return torch.where(inside, wave, 0)


def check_scene(grid: Grid, wavelength: float, depths, stride: int) -> tuple[float, tuple[float, ...], int]:
    """Return wavelength (m), depths (m) and stride (pixels) of a hologram's sources.

    TypeError if one is not a number. ValueError for several wavelengths, no depth, a depth that is not above zero or
    exceeds 100 m, or a stride below 1.
    """
    first, *others = checks.wavelengths(wavelength)
    if others:
        raise ValueError(
            f"wavelength must be one length in metres, got {1 + len(others)}: make one hologram per colour"
        )
    items = depths.tolist() if isinstance(depths, Tensor) else list(depths)
    if not items:
        raise ValueError("depths must hold at least one distance in metres, got none")
    checked = tuple(checks.quantity(DEPTH, depth, "depth of a plane") for depth in items)
    return first, checked, checks.whole("stride", stride, 1)
