"""Sums of intensities over mutually incoherent light: wavelengths, and points of an extended source."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from holotorch.core import checks
from holotorch.core.grid import Grid, Pair

Argument = TypeVar("Argument")


def incoherent_sum(
    intensity_of: Callable[[Argument], Tensor],
    arguments: Iterable[Argument] | Tensor,
    weights: Sequence[float] | Tensor,
    *,
    recompute: bool = False,
) -> Tensor:
    """Sum of ``weights[k] * intensity_of(arguments[k])``, with one intensity in memory at a time.

    Args:
        intensity_of: Function that returns the intensity [...] for one of ``arguments``, such as a wavelength in
            metres or a direction of the illumination.
        arguments: Of ``intensity_of``: a tensor [K] of wavelengths, passed on as floats, or a sequence of length K.
        weights: [K], such as those of ``Spectrum.samples``; a tensor may require gradients.
        recompute: If gradients are enabled, compute each intensity again in the backward pass instead of keeping its
            intermediate results. This takes a third more time, but only the memory of a single intensity.

    Raises:
        TypeError: ``intensity_of`` returns a complex tensor, a field instead of an intensity.
        ValueError: ``arguments`` is empty, or the number of weights differs from that of arguments.
    """
    items = arguments.tolist() if isinstance(arguments, Tensor) else list(arguments)
    if not items or len(items) != len(weights):
        counts = f"{len(items)}, {len(weights)}"
        raise ValueError(f"arguments and weights must be equally many and at least one, got {counts}")
    again = recompute and torch.is_grad_enabled()
    total: Tensor | None = None
    for argument, weight in zip(items, weights, strict=True):
        part = checkpoint(intensity_of, argument, use_reentrant=False) if again else intensity_of(argument)
        assert isinstance(part, Tensor)
        checks.real("intensity", part)
        # A float or a scalar float64 tensor does not change the dtype of the intensity.
        weight = weight.to(part.device) if isinstance(weight, Tensor) else weight
        total = part * weight if total is None else total + part * weight
    assert total is not None
    return total


def disc_source(radius: float, rings: int = 2) -> tuple[list[Pair], Tensor]:
    """Points of a uniform disc and their weights: an extended source for :func:`incoherent_sum`.

    The radii are nodes of Gauss's rule in the squared radius, with 4 ``rings`` equally spaced points on each ring. The
    sum is exact for polynomials of the two sines up to degree 4 rings - 1.

    Args:
        radius: Sine of half the angle that the source subtends at the hologram, above 0 and below 1.
        rings: Number of rings, at least 1.

    Returns:
        Sines (y, x) of 4 rings^2 directions, and weights [4 rings^2] that add up to 1, float64.
    """
    radius, rings = checks.positive("radius", radius), checks.whole("rings", rings, 1)
    if radius >= 1:
        raise ValueError(f"radius is a sine and must be below 1, got {radius:g}")
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    around = 4 * rings
    radii = [radius * math.sqrt((1 + node) / 2) for node in nodes.tolist()]
    angles = [2 * math.pi * (k + 0.5) / around for k in range(around)]
    points = [(ring * math.sin(angle), ring * math.cos(angle)) for ring in radii for angle in angles]
    return points, torch.from_numpy(np.repeat(weights / (2 * around), around))


def tilted_wave(grid: Grid, wavelength: float, direction: Pair) -> Tensor:
    """Plane wave exp(2 pi i (y sy + x sx) / wavelength), complex128 [H, W]: illumination from one distant point.

    Args:
        grid: Sampling of the hologram.
        wavelength: In metres.
        direction: Sines (sy, sx) of the direction of the wave.

    Raises ValueError for a direction that the grid cannot sample.
    """
    wavelength = checks.wavelengths(wavelength)[0]
    sines = checks.pair("direction", direction, "sines")
    for sine, pitch in zip(sines, grid.pitch, strict=True):
        if abs(sine) > wavelength / (2 * pitch):
            raise ValueError(
                f"direction {sine:g} is beyond what a pitch of {pitch:g} m samples at {wavelength:g} m, "
                f"{wavelength / (2 * pitch):.3g}; use a smaller source or a finer grid"
            )
    y, x = grid.coordinates()
    cycles = y * (sines[0] / wavelength) + x * (sines[1] / wavelength)
    return torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles)
