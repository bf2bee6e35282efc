"""Conversions between phase, field and intensity that keep precision and gradients."""

import math

import torch
from torch import Tensor

from holotorch.core.precision import at_least_single


def phasor(phase: Tensor) -> Tensor:
    """Unit-amplitude field exp(i phase), complex of the same shape; complex128 for float64, complex64 otherwise."""
    phase = at_least_single(phase)
    return torch.complex(torch.cos(phase), torch.sin(phase))


def intensity(field: Tensor) -> Tensor:
    """Squared magnitude of ``field``, real. Its gradient is exact at 0 too, unlike that of ``field.abs() ** 2``."""
    return field.real.square() + field.imag.square()


def wrapped(phase: Tensor) -> Tensor:
    """Phase in rad reduced to [0, 2 pi); heaters cannot produce negative phases."""
    turn = 2 * math.pi
    reduced = torch.remainder(phase, turn)
    # For a phase just below a multiple of 2 pi, remainder rounds up to 2 pi.
    return reduced.masked_fill(reduced >= turn, 0)
