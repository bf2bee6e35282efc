"""Spherical waves limited to the frequencies of a grid: their spectrum, and their values in space by quadrature.

Weyl's expansion writes a spherical wave as an integral of plane waves over the frequencies f = (fx, fy),
exp(ikr) / r = i int exp(2 pi i (f . x + z w)) / w df with w = sqrt(1 / wavelength^2 - fx^2 - fy^2). Here x is the
lateral and z the axial distance. With the cones ``taper`` and ``band`` the integrand is weighted, and the integral has
no closed form. It is computed by numerical quadrature, which is slow but exact to rounding.
"""

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from holotorch.hologram.cone import TAPER_BEGIN, taper
from holotorch.optics.free_space.kernels import carrier, cycles_phasor

_RULE = np.polynomial.legendre.leggauss(64)  # nodes and weights of one panel
_CYCLES = 10.0  # cycles of the integrand allowed per panel; up to about 15 the rule is exact to rounding
_MOST_NODES = 30_000  # largest number of quadrature nodes per axis; at this limit the double sum takes minutes


def point_spectrum(fy: Tensor, fx: Tensor, wavelength: float, depth: float) -> Tensor:
    """Spectrum i exp(2 pi i z w) / w of a point source at z = ``depth`` metres, complex128 of the broadcast shape.

    w is the axial frequency. ``fy`` and ``fx`` are float64 in cycles per metre, with f^2 = fy^2 + fx^2 below
    1 / wavelength^2. The phase z w in cycles is computed as z / wavelength - z f^2 / (w + 1 / wavelength) for accuracy.
    """
    square = fy.square() + fx.square()
    axial = torch.sqrt(wavelength**-2 - square)
    cycles = 0.25 - depth * square / (axial + 1 / wavelength)
    return cycles_phasor(cycles) * (carrier(wavelength, depth).to(square.device) / axial)


def band_limited_wave(
    shape: tuple[int, int],
    pitch: tuple[float, float],
    wavelength: float,
    depth: float,
    *,
    soft: bool,
    device: torch.device | None = None,
) -> Tensor:
    """Spherical wave whose spectrum is limited to frequencies up to 1 / (2 ``pitch``), complex128 of ``shape``.

    It is sampled at displacements of 0, 1, ... ``pitch`` (y, x) from source to pixel. ``pitch``, in metres, is at least
    0.9 wavelengths. The spectrum falls to 0 as in ``cone.taper`` if ``soft``, else sharply. ValueError if ``depth``, in
    metres, is so large that the quadrature needs too many nodes.
    """
    dy, dx = (
        torch.arange(count, dtype=torch.float64, device=device) * step for count, step in zip(shape, pitch, strict=True)
    )
    fy, fx = (
        tuple(values.to(dy.device) for values in _nodes((count - 1) * step, step, wavelength, depth, soft))
        for count, step in zip(shape, pitch, strict=True)
    )
    # The spectrum is even in fy and in fx, so the integral is a cosine transform over one quadrant.
    columns = 2 * fx[1] * torch.cos(2 * math.pi * dx[:, None] * fx[0])
    rows = 2 * fy[1] * torch.cos(2 * math.pi * dy[:, None] * fy[0])
    total = torch.zeros(len(dy), len(dx), dtype=torch.complex128, device=dy.device)
    for start in range(0, len(fy[0]), 256):
        part = slice(start, start + 256)
        spectrum = point_spectrum(fy[0][part, None], fx[0][None], wavelength, depth)
        total += rows[:, part].to(spectrum) @ (spectrum @ columns.T.to(spectrum))
    return total


def _nodes(displacement: float, pitch: float, wavelength: float, depth: float, soft: bool) -> tuple[Tensor, Tensor]:
    """Quadrature nodes between 0 and 1 / (2 ``pitch``), and their weights, which include the taper if ``soft``.

    ``displacement`` is the largest one in metres.
    """
    highest = 1 / (2 * pitch)
    sine = wavelength * highest
    # Largest derivative of the phase in cycles with respect to frequency: displacement + depth * tan(largest angle).
    slope = displacement + depth * sine / math.sqrt(max(1 - 2 * sine**2, 0.1))
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
    return fraction * highest, weight
