"""Phase to field and field to intensity, without detours that cost precision or gradients."""

import math

import torch
from torch import Tensor


def phasor(phase: Tensor) -> Tensor:
    """Unit-amplitude field exp(i phase), complex of the same shape; complex64 for float32, complex128 for float64."""
    return torch.complex(torch.cos(phase), torch.sin(phase))


def intensity(field: Tensor) -> Tensor:
    """Squared magnitude, real. Unlike ``abs() ** 2`` its gradient needs no root, so it is exact at zero too."""
    return field.real.square() + field.imag.square()


def wrapped(phase: Tensor) -> Tensor:
    """Phase reduced to [0, 2 pi): heaters cannot cool, so the principal value must not be negative."""
    turn = 2 * math.pi
    reduced = torch.remainder(phase, turn)
    # remainder rounds up to 2 pi itself for a phase just below a multiple of it.
    return torch.where(reduced >= turn, torch.zeros_like(reduced), reduced)
