"""Spherical wave of a point source on a sampled hologram, and the cone of directions that the pixels can carry.

The wave of a point source is exp(+i k r) / r (thesis Eqs. 5.1, 5.13). Pixels of pitch p sample frequencies up to
1 / (2 p) along each axis, which are directions up to the angle theta with sin(theta) = wavelength / (2 p). Light at
larger angles aliases. The option ``cone`` of every hologram defines which part of the wave is kept:

- ``full``: the whole wave. It aliases at pixels outside the cone (Algorithm 4 as printed).
- ``box``: a pyramid in space with sharp edges, |x| <= z tan(theta) and |y| <= z tan(theta); K_z in Sec. 5.6.1.
- ``disc``: an elliptical cone in space with sharp edges and the same half-widths along x and y as ``box``.
- ``band``: the spectrum is cut off sharply at 1 / (2 p) along each axis, so all light that the pixels sample is kept.
- ``taper``: the spectrum falls to 0 from 70 % to 100 % of 1 / (2 p) along each axis, to suppress ringing.

If every pixel lies well inside the cone of every source, ``full``, ``box``, ``disc`` and ``taper`` agree;
:func:`is_plain` tests this. The ringing of ``band`` extends farther into the cone: on the axis of the source its
amplitude relative to the wave is 0.6 / sqrt(K) for a cone that is K samples wide on the hologram.
"""

import math
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.precision import double
from holotorch.core.quantities import DEPTH
from holotorch.optics.free_space.geometry import lateral_spread
from holotorch.optics.free_space.kernels import cycles_phasor

Cone = Literal["full", "box", "disc", "taper", "band"]
Samples = TypeVar("Samples", Tensor, np.ndarray)
TAPER_BEGIN = 0.7  # fraction of the highest frequency at which the taper begins


def taper(fraction: Samples) -> Samples:
    """Weight of a frequency, given as a fraction of the highest one: 1 up to 0.7, then a half cosine to 0 at 1."""
    edge = ((abs(fraction) - TAPER_BEGIN) / (1 - TAPER_BEGIN)).clip(0, 1)
    return (1 + functions(edge).cos(math.pi * edge)) / 2


def functions(values: Tensor | np.ndarray) -> Any:
    """``numpy`` or ``torch``, whose functions apply to ``values``.

    What follows from lengths alone is computed with NumPy, which torch.compile and torch.export then do not record.
    """
    return np if isinstance(values, np.ndarray) else torch


def taper_margin(half_width: float, error: float) -> float:
    """Distance in samples within which the ringing of the taper exceeds ``error`` times the wave.

    The second derivative of the taper jumps at 0.7 and at 1 times the highest frequency. The tapered wave therefore
    rings around the positions on the hologram that light of these two frequencies reaches. For a cone of ``half_width``
    samples, the relative amplitude of the ringing at n samples from such a position is about 2 sqrt(K) / n^3 with
    K = 2 ``half_width``. The factor 2 is fitted: measured values lie between 0.9 and 2.5.
    """
    return (2 * math.sqrt(2 * half_width) / error) ** (1 / 3)


def is_plain(grid: Grid, wavelength: float, depth: float, displacement: tuple[int, int], error: float) -> bool:
    """Whether the taper changes the wave by less than the fraction ``error`` up to ``displacement`` (y, x), samples."""
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
    the cone. ``cone`` is "full", "box" or "disc"; see ``band_limited_wave`` for the others. For accuracy, k r is
    computed as k z + k (dy^2 + dx^2) / (r + z) with z = ``depth``, and whole cycles are removed from k z.
    """
    square = dy.square() + dx.square()
    distance = torch.sqrt(depth**2 + square)
    carrier = cycles_phasor(double(depth / wavelength, dy.device))
    wave = cycles_phasor(square / (distance + depth) / wavelength) * (carrier / distance)
    if cone == "full":
        return wave
    spread = lateral_spread(Grid(1, pitch), wavelength, depth)
    # With the relative margin of 1e-12, pixels exactly on the edge of the cone are inside in spite of rounding.
    y, x = (displacement.abs() / (limit * (1 + 1e-12)) for displacement, limit in zip((dy, dx), spread, strict=True))
    inside = (y.square() + x.square() <= 1) if cone == "disc" else (y <= 1) & (x <= 1)
    return torch.where(inside, wave, 0)


def check_scene(grid: Grid, wavelength: float, depths, stride: int) -> tuple[float, tuple[float, ...], int]:
    """Check and return wavelength (m), depths (m) and stride (pixels) of the sources of a hologram.

    TypeError for a value that is not a number. ValueError for several wavelengths, no depths, a depth of at most 0 or
    above 100 m, or a stride below 1.
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
