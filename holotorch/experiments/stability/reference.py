"""Slow references in float64 that share no transform with the methods that they judge."""

import math

import numpy as np
import torch
from torch import Tensor

from holotorch.core.grid import Grid, Pair

_CHUNK = 1 << 20  # frequencies at a time: 16 MB of complex128
_PANEL = 64  # Gauss-Legendre nodes of one panel
_STEEPEST = 0.2  # cosine at which the slope of light is cut off when nodes are counted; steeper light hardly matters


def propagated(
    field: Tensor,
    grid: Grid,
    wavelength: float,
    distance: float,
    out_grid: Grid | None = None,
    offset: Pair = (0.0, 0.0),
    tilt: Pair = (0.0, 0.0),
) -> Tensor:
    """Field, complex128 [H', W'], that arrives on ``out_grid`` from the samples ``field`` [H, W].

    The samples are those of a field without frequencies beyond 1 / (2 pitch). Its spectrum times the exact transfer
    function is integrated by Gauss-Legendre quadrature, without any FFT: nothing wraps around, and nothing is cut off.
    Arguments as in ``propagate``; lengths in metres. Source: Goodman, Sec. 3.10.
    """
    out = out_grid or grid
    source = field.to(torch.complex128).numpy()
    sent, read, sines = [], [], []
    for axis in (0, 1):
        sine, pitch = wavelength / 2 / grid.pitch[axis], grid.pitch[axis]
        positions = (np.arange(grid.shape[axis]) - grid.shape[axis] // 2) * pitch
        reached = (np.arange(out.shape[axis]) - out.shape[axis] // 2) * out.pitch[axis] + offset[axis]
        f, weights = _nodes(_cycles(positions, reached, pitch, distance, sine, tilt, axis))
        f = f / (2 * pitch)
        sent.append(np.exp(-2j * np.pi * np.outer(f, positions)))
        read.append(np.exp(2j * np.pi * np.outer(reached, f)) * weights / 2)
        sines.append(wavelength * f + tilt[axis])
    columns, total = source @ sent[1].T, np.zeros(out.shape, complex)
    step = max(1, _CHUNK // len(sines[1]))
    for start in range(0, len(sines[0]), step):
        rows = slice(start, start + step)
        root = np.sqrt(1 - sines[0][rows, None] ** 2 - sines[1] ** 2 + 0j)
        # The root is imaginary for evanescent waves, which decay for either sign of the distance.
        phase = 2j * np.pi / wavelength * (distance * root.real + 1j * abs(distance) * root.imag)
        total += read[0][:, rows] @ (sent[0][rows] @ columns * np.exp(phase)) @ read[1].T
    return torch.from_numpy(total)


def _cycles(
    positions: np.ndarray, reached: np.ndarray, pitch: float, distance: float, sine: float, tilt: Pair, axis: int
) -> float:
    """Cycles by which the integrand turns over the band of one axis, at most, for light of up to ``sine``."""
    farthest = 0.0
    for offset in (tilt[axis] - sine, tilt[axis] + sine):
        for other in (tilt[1 - axis] - sine, tilt[1 - axis] + sine):
            cosine = math.sqrt(max(1 - offset**2 - other**2, _STEEPEST**2))
            for start in (positions[0], positions[-1]):
                for end in (reached[0], reached[-1]):
                    farthest = max(farthest, abs(start + distance * offset / cosine - end))
    return farthest / pitch


def _nodes(cycles: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in -1 .. 1 and weights of a composite Gauss-Legendre rule for phases of ``cycles`` cycles.

    64 nodes integrate a panel of 26 cycles to rounding.
    """
    t, weights = np.polynomial.legendre.leggauss(_PANEL)
    panels = 2 + math.ceil(cycles / 26)
    ends = np.linspace(-1, 1, panels + 1)
    half = np.diff(ends)[:, None] / 2
    return (ends[:-1, None] + half * (1 + t)).ravel(), (half * weights).ravel()


def noise(shape: tuple[int, ...], seed: int = 0, dtype: torch.dtype = torch.complex128) -> Tensor:
    """Independent normal numbers of a seed, the content that most methods predict errors for."""
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def noise_inside(grid: Grid) -> Tensor:
    """Noise within the middle half of the window, complex128 [1, H, W], so that little light leaves it."""
    y, x = grid.coordinates()
    inside = (y.abs() < grid.extent[0] / 4) & (x.abs() < grid.extent[1] / 4)
    return (noise(grid.shape) * inside)[None]
