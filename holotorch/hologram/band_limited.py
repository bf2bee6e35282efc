"""Spherical waves limited to the frequencies of a grid: their spectrum, and their values in space by quadrature.

Weyl's expansion writes a spherical wave as an integral of plane waves over the frequencies f = (fx, fy),
exp(ikr) / r = i int exp(2 pi i (f . x + z w)) / w df with w = sqrt(1 / wavelength^2 - fx^2 - fy^2). The cones ``taper``
and ``band`` weight the integrand. The result has no closed form in space; it is integrated numerically, which is slow
but exact to rounding.
"""

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from holotorch.hologram.cone import TAPER_BEGIN, taper
from holotorch.optics.free_space.kernels import carrier, turns_phasor

_RULE = np.polynomial.legendre.leggauss(64)
_CYCLES = 10.0  # most cycles of the integrand per panel of 64 nodes; the rule is exact to rounding up to about 15
_MOST_NODES = 30_000  # most quadrature nodes per axis, with which the sum over both axes takes minutes


def point_spectrum(fy: Tensor, fx: Tensor, wavelength: float, depth: float) -> Tensor:
    """Spectrum i exp(2 pi i z w) / w of a point source at z = ``depth`` metres, complex128 of the broadcast shape.

    ``fy`` and ``fx`` are float64 in cycles per metre, with f^2 = fy^2 + fx^2 < 1 / wavelength^2. The phase in cycles,
    z w, is computed as z / wavelength - z f^2 / (w + 1 / wavelength), to avoid the cancellation of w - 1 / wavelength.
    """
    square = fy.square() + fx.square()
    axial = torch.sqrt(wavelength**-2 - square)
    cycles = 0.25 - depth * square / (axial + 1 / wavelength)
    return turns_phasor(cycles) * (carrier(wavelength, depth).to(square.device) / axial)


def band_limited_wave(
    dy: Tensor, dx: Tensor, pitch: tuple[float, float], wavelength: float, depth: float, *, soft: bool
) -> Tensor:
    """Spherical wave whose spectrum is limited to frequencies up to 1 / (2 ``pitch``), complex128 [A, B].

    ``dy`` [A] and ``dx`` [B] are displacements in metres, float64. ``pitch`` (y, x) in metres is at least 0.9
    wavelengths. The spectrum ends with the taper of ``cone.taper`` if ``soft``, else sharply. ValueError if ``depth``
    in metres is so large that the quadrature needs too many nodes.
    """
    fy, fx = (
        _nodes(displacement, step, wavelength, depth, soft) for displacement, step in zip((dy, dx), pitch, strict=True)
    )
    # The spectrum is even in both frequencies, so a cosine transform of one quadrant suffices.
    columns = 2 * fx[1] * torch.cos(2 * math.pi * dx[:, None] * fx[0])
    rows = 2 * fy[1] * torch.cos(2 * math.pi * dy[:, None] * fy[0])
    total = torch.zeros(len(dy), len(dx), dtype=torch.complex128, device=dy.device)
    for begin in range(0, len(fy[0]), 256):
        part = slice(begin, begin + 256)
        spectrum = point_spectrum(fy[0][part, None], fx[0][None], wavelength, depth)
        total += rows[:, part].to(spectrum) @ (spectrum @ columns.T.to(spectrum))
    return total


def _nodes(displacement: Tensor, pitch: float, wavelength: float, depth: float, soft: bool) -> tuple[Tensor, Tensor]:
    """Quadrature nodes from frequency 0 to the highest one of the pitch, and weights, which include the taper."""
    highest = 1 / (2 * pitch)
    sine = wavelength * highest
    # Largest derivative of the phase in cycles by frequency: the displacement plus the spread of the steepest light.
    slope = displacement.abs().max().item() + depth * sine / math.sqrt(max(1 - 2 * sine**2, 0.1))
    if slope * highest / _CYCLES * 64 > _MOST_NODES:
        raise ValueError(
            f"depth {depth:g} m is too far for the sum over a band of pixels of {pitch:g} m: use a nearer plane, a "
            "larger pitch, cone='full', or AxialHologram"
        )
    nodes, weights = [], []
    for low, high in itertools.pairwise((0.0, TAPER_BEGIN, 1.0) if soft else (0.0, 1.0)):
        panels = math.ceil(slope * highest * (high - low) / _CYCLES) or 1
        half = (high - low) / panels / 2
        nodes.append((low + half * (2 * np.arange(panels)[:, None] + 1 + _RULE[0])).ravel())
        weights.append(np.tile(half * _RULE[1], panels))
    fraction, weight = (torch.from_numpy(np.concatenate(parts)) for parts in (nodes, weights))
    weight = weight * highest * (taper(fraction) if soft else 1.0)
    return (fraction * highest).to(displacement.device), weight.to(displacement.device)
