"""Spherical waves limited to the band of a grid: their spectrum, and their values in space by quadrature.

Weyl's expansion writes a spherical wave as a sum of plane waves, exp(ikr) / r = i int exp(2 pi i (f x + z w)) / w df
with w = sqrt(1 / wavelength^2 - fx^2 - fy^2). The cones ``taper`` and ``band`` weight the integrand in frequency. The
result has no closed form in space; it is integrated numerically, which is slow but exact to rounding.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from holotorch.hologram.cone import TAPER_BEGIN, taper
from holotorch.optics.free_space.kernels import carrier, turns_phasor

_RULE = np.polynomial.legendre.leggauss(64)
_CYCLES = 10.0  # cycles of the integrand per panel of 64 nodes; the rule is exact to rounding up to about 15
_MOST_NODES = 30_000  # quadrature nodes per axis; a sum over more of them on both axes takes minutes


def point_spectrum(fy: Tensor, fx: Tensor, wavelength: float, depth: float) -> Tensor:
    """Spectrum i exp(2 pi i z w) / w of a point source at z = ``depth`` metres, complex128.

    Frequencies must stay below 1 / wavelength. The phase is written as z / wavelength - z f^2 / (w + 1 / wavelength),
    to avoid the cancellation of w - 1 / wavelength.
    """
    square = fy.square() + fx.square()
    axial = torch.sqrt(wavelength**-2 - square)
    cycles = 0.25 - depth * square / (axial + 1 / wavelength)
    return turns_phasor(cycles) * (carrier(wavelength, depth).to(square.device) / axial)


def band_limited_wave(
    dy: Tensor, dx: Tensor, pitch: tuple[float, float], wavelength: float, depth: float, *, soft: bool
) -> Tensor:
    """Spherical wave with its spectrum limited to the highest frequency of the pitch, complex128 [len(dy), len(dx)].

    Args:
        dy: Displacements along y in metres, float64 [A].
        dx: Displacements along x in metres, float64 [B].
        pitch: (y, x) in metres, at least 0.9 wavelengths.
        wavelength: In metres.
        depth: In metres, above 0.
        soft: True: the band ends with the taper of ``cone.taper``; False: it ends sharply.

    Raises:
        ValueError: The depth is so large that the quadrature needs too many nodes.
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
    """Quadrature nodes from frequency 0 to the highest one, and their weights, which include the taper."""
    highest = 1 / (2 * pitch)
    sine = wavelength * highest
    # Derivative of the phase by frequency: the displacement plus the lateral spread of the steepest light.
    slope = displacement.abs().max().item() + depth * sine / math.sqrt(max(1 - 2 * sine**2, 0.1))
    if slope * highest / _CYCLES * 64 > _MOST_NODES:
        raise ValueError(
            f"depth {depth:g} m is too far for the sum over a band of pixels of {pitch:g} m: use a nearer plane, a "
            "larger pitch, cone='full', or AxialHologram"
        )
    parts = list(_panels((0.0, TAPER_BEGIN, 1.0) if soft else (0.0, 1.0), slope * highest))
    part, weight = (np.concatenate(each) for each in zip(*parts, strict=True))
    part, weight = torch.from_numpy(part), torch.from_numpy(weight)
    weight = weight * highest * (taper(part) if soft else 1.0)
    return (part * highest).to(displacement.device), weight.to(displacement.device)


def _panels(ends: tuple[float, ...], cycles: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Nodes and weights on panels between ``ends``, each with at most ``_CYCLES`` cycles of the integrand."""
    for low, high in zip(ends, ends[1:], strict=False):
        count = math.ceil(cycles * (high - low) / _CYCLES) or 1
        half = (high - low) / count / 2
        for panel in range(count):
            yield low + half * (2 * panel + 1 + _RULE[0]), half * _RULE[1]
