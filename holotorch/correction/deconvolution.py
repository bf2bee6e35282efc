"""Heater phases that give a target phase after thermal spreading (thesis Eqs. 4.5, 4.6, 4.32-4.35)."""

import math
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.core import checks
from holotorch.core.operator import LinearOperator

_SINGULAR = 1e-12  # least ratio of the eigenvalues of a crosstalk: rounding then changes an inverse by up to 1e-3


class Crosstalk(LinearOperator, Protocol):
    """A convolution of phases [..., H, W] with a kernel and zero padding, such as ``ThermalCrosstalk``."""

    @property
    def kernel(self) -> Tensor:
        """The kernel, real [h, w] with odd h and w."""
        ...


def inverse(crosstalk: Crosstalk, phase: Tensor) -> Tensor:
    """The exact solution X of P(X) = ``phase``, real [..., H, W], where P is the crosstalk; computed in float64.

    X may be negative or very large. Marrian et al. (1987) make it positive by "chopping", which sets negative entries
    to 0, or by "shifting", which adds the magnitude of the smallest entry.

    Raises:
        ValueError: A kernel that is not separable and symmetric, or whose matrix is numerically singular, as for a
            sigma near 1.67 px with 7 taps, or of 3 px with all taps.
    """
    columns, rows = _axis_matrices(crosstalk, phase)
    # Both axes amplify rounding errors, by the product of their condition numbers.
    singular = [torch.linalg.svdvals(matrix) for matrix in (columns, rows)]
    if math.prod((each[-1] / each[0]).item() for each in singular) <= _SINGULAR:
        raise ValueError(f"{crosstalk} has no inverse on {tuple(phase.shape[-2:])} px: it erases some patterns")
    solved = torch.linalg.solve(columns, phase.to(torch.float64))
    return torch.linalg.solve(rows, solved.transpose(-1, -2)).transpose(-1, -2).to(phase.dtype)


def deconvolve(crosstalk: Crosstalk, phase: Tensor, *, max_steps: int = 30, start: Tensor | None = None) -> Tensor:
    """The X >= 0 that minimises || P(X) - phase ||, by accelerated proximal gradient with a fixed step.

    Args:
        crosstalk: P, a convolution with the kernel K.
        phase: Wanted phase after spreading in rad, real [..., H, W], wrapped to [0, 2 pi). Negative phases cannot be
            reached, since X and the kernel are non-negative.
        max_steps: Number of iterations.
        start: X of the first iteration; ``phase`` by default.

    Source: thesis Eqs. 4.32-4.35, with P^T(phase) in the gradient. The step length is 1 / (sum K)^2, since (sum K)^2
    is an upper bound of the Lipschitz constant of the gradient.
    """
    checks.real("phase", phase)
    checks.all_finite("phase", phase)
    checks.whole("max_steps", max_steps, 1)
    step = 1 / crosstalk.kernel.sum().item() ** 2
    x = previous = (phase if start is None else start).clamp(min=0)
    for k in range(max_steps):
        y = x + k / (k + 3) * (x - previous)
        previous, x = x, (y - step * crosstalk.adjoint(crosstalk(y) - phase)).clamp(min=0)
    return x


def deconvolve_admm(crosstalk: Crosstalk, phase: Tensor, *, max_steps: int = 30, weight: float = 1.0) -> Tensor:
    """The X of :func:`deconvolve`, computed by ADMM; its linear system is solved in the eigenvectors of each axis.

    ``weight`` is the penalty rho relative to the mean square of the eigenvalues of P. Raises ValueError for a kernel
    that is not separable and symmetric. Source: Parikh and Boyd (2014), Sec. 4.4 and 5.
    """
    checks.all_finite("phase", phase)
    checks.whole("max_steps", max_steps, 1)
    checks.positive("weight", weight)
    (down, basis_y), (across, basis_x) = (torch.linalg.eigh(matrix) for matrix in _axis_matrices(crosstalk, phase))
    eigenvalues = down[:, None] * across
    penalty = weight * eigenvalues.square().mean()
    target = basis_y.T @ phase.to(torch.float64) @ basis_x * eigenvalues
    z = phase.to(torch.float64).clamp(min=0)
    dual = torch.zeros_like(z)
    for _ in range(max_steps):
        coefficients = basis_y.T @ (z - dual) @ basis_x
        x = basis_y @ ((target + penalty * coefficients) / (eigenvalues.square() + penalty)) @ basis_x.T
        z = (x + dual).clamp(min=0)
        dual = dual + x - z
    return z.to(phase.dtype)


def _axis_matrices(crosstalk: Crosstalk, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Convolution matrices [H, H] and [W, W] of a separable and symmetric kernel, float64."""
    checks.real("phase", phase)
    kernel = crosstalk.kernel
    columns, rows = kernel[:, kernel.shape[1] // 2], kernel[kernel.shape[0] // 2, :]
    separable = torch.allclose(columns[:, None] * rows, kernel, rtol=0, atol=1e-12)
    if not separable or not all(torch.equal(taps, taps.flip(0)) for taps in (columns, rows)):
        raise ValueError("the crosstalk must be separable and symmetric for a matrix inverse; use deconvolve")
    return _toeplitz(columns, phase.shape[-2], phase.device), _toeplitz(rows, phase.shape[-1], phase.device)


def _toeplitz(taps: Tensor, size: int, device: torch.device) -> Tensor:
    """Matrix [size, size] of the convolution of ``size`` samples with symmetric ``taps`` and zero padding."""
    half = functional.pad(taps[len(taps) // 2 :], (0, size))
    return half[(torch.arange(size)[:, None] - torch.arange(size)).abs()].to(device)
