"""Waves of point sources whose spectrum is limited to the grid's band: their spectrum, and their values in space.

The wave of a point is the sum of plane waves exp(ikr) / r = i int exp(2 pi i (f x + z w)) / w df (Weyl), with
w = sqrt(1 / wavelength^2 - fx^2 - fy^2). ``taper`` and ``band`` weight that sum in frequency. In space they have no
closed form; here they are integrated, which is slow and exact.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from holotorch.hologram.cone import TAPER_BEGIN, taper
from holotorch.optics.free_space.kernels import carrier, turns_phasor

_RULE = np.polynomial.legendre.leggauss(64)
_CYCLES = 10.0  # of the integrand per 64 nodes of the rule, which is exact to rounding up to about 15
_MOST_NODES = 30_000  # per axis: their product takes minutes


def point_spectrum(fy: Tensor, fx: Tensor, wavelength: float, depth: float) -> Tensor:
    """Spectrum i exp(2 pi i z w) / w of the wave of a point at ``depth`` metres, complex128; fy, fx below 1/wavelength.

    z w is written z / wavelength - z f^2 / (w + 1 / wavelength), whose second term does not cancel.
    """
    square = fy.square() + fx.square()
    axial = torch.sqrt(wavelength**-2 - square)
    turns = 0.25 - depth * square / (axial + 1 / wavelength)
    return turns_phasor(turns) * (carrier(wavelength, depth).to(square.device) / axial)


def band_limited_wave(
    dy: Tensor, dx: Tensor, pitch: tuple[float, float], wavelength: float, depth: float, *, soft: bool
) -> Tensor:
    """The wave of a point with its spectrum cut at the pitch's highest frequency, complex128 [len(dy), len(dx)].

    Args:
        dy: Displacements of rows in metres, float64 [A].
        dx: Of columns, [B].
        pitch: (y, x) in metres, at least 0.9 wavelengths.
        wavelength: In metres.
        depth: In metres, above 0.
        soft: With the taper of ``cone.taper``, or with a sharp end.

    Raises:
        ValueError: So deep that the integral over frequencies needs too many nodes.
    """
    fy, fx = (
        _nodes(displacement, step, wavelength, depth, soft) for displacement, step in zip((dy, dx), pitch, strict=True)
    )
    # The spectrum is even in both frequencies: a quadrant of it, with cosines.
    columns = 2 * fx[1] * torch.cos(2 * math.pi * dx[:, None] * fx[0])
    rows = 2 * fy[1] * torch.cos(2 * math.pi * dy[:, None] * fy[0])
    total = torch.zeros(len(dy), len(dx), dtype=torch.complex128, device=dy.device)
    for begin in range(0, len(fy[0]), 256):
        part = slice(begin, begin + 256)
        spectrum = point_spectrum(fy[0][part, None], fx[0][None], wavelength, depth)
        total += rows[:, part].to(spectrum) @ (spectrum @ columns.T.to(spectrum))
    return total


def _nodes(displacement: Tensor, pitch: float, wavelength: float, depth: float, soft: bool) -> tuple[Tensor, Tensor]:
    """Frequencies from 0 to the highest one, and their weights, which include the taper."""
    highest = 1 / (2 * pitch)
    sine = wavelength * highest
    # Sideways by the tangent of the steepest light, whose angle the other axis can widen.
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
    """Nodes and weights of the rule on panels between ``ends``, with no more than ``_CYCLES`` of the integrand each."""
    for low, high in zip(ends, ends[1:], strict=False):
        count = math.ceil(cycles * (high - low) / _CYCLES) or 1
        half = (high - low) / count / 2
        for panel in range(count):
            yield low + half * (2 * panel + 1 + _RULE[0]), half * _RULE[1]
