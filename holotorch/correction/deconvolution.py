"""Deconvolution of phases: heater phases whose spread comes close to wanted ones (thesis Eqs. 4.5, 4.6, 4.32-4.35)."""

from typing import Protocol

import torch
from torch import Tensor

from holotorch.core import checks


class Crosstalk(Protocol):
    """A convolution of phases [..., H, W] with a known kernel, zero outside, such as ``ThermalCrosstalk``."""

    @property
    def kernel(self) -> Tensor:
        """Real [h, w], odd sizes."""
        ...

    def __call__(self, phase: Tensor) -> Tensor:
        """The convolution."""
        ...

    def adjoint(self, phase: Tensor) -> Tensor:
        """Its transpose."""
        ...


def inverse(crosstalk: Crosstalk, phase: Tensor) -> Tensor:
    """The exact solution of P(X) = ``phase``, real [..., H, W], which may be negative or huge; float64 inside.

    Chopping is ``.clamp(min=0)`` of it, shifting adds the absolute of its least entry (Marrian et al. 1987). Raises
    ValueError for a kernel whose matrix is singular to rounding (near sigma 1.67 px with 7 taps) or not separable.
    """
    columns, rows = _axis_matrices(crosstalk, phase)
    for matrix in (columns, rows):
        size = torch.linalg.svdvals(matrix)
        if size[-1] <= 1e-12 * size[0]:
            raise ValueError(f"{crosstalk} has no inverse on {tuple(phase.shape[-2:])} px: it erases some patterns")
    solved = torch.linalg.solve(columns, phase.to(torch.float64))
    return torch.linalg.solve(rows, solved.transpose(-1, -2)).transpose(-1, -2).to(phase.dtype)


def deconvolve(crosstalk: Crosstalk, phase: Tensor, *, max_steps: int = 30, start: Tensor | None = None) -> Tensor:
    """The X >= 0 with the least || P(X) - phase ||, by accelerated proximal gradient with its known step.

    Args:
        crosstalk: P.
        phase: Wanted phase after spreading in rad, real [..., H, W], wrapped to [0, 2 pi): of phases around 0, half
            would be out of reach.
        max_steps: Iterations.
        start: Where to begin, such as the last result in a loop; ``phase`` itself by default.

    Source: thesis Eqs. 4.32-4.35, with M^T phi in the gradient; the step 1 / L needs no search, as L <= (sum K)^2.
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
    """The same by ADMM; the linear system of each step is solved exactly in the eigenvectors of both axes.

    ``weight`` is the penalty rho, relative to the mean square of the kernel's eigenvalues. Raises ValueError for a
    kernel that is not separable and symmetric. Source: Parikh and Boyd (2014), Sec. 4.4 and 5.
    """
    checks.all_finite("phase", phase)
    checks.whole("max_steps", max_steps, 1)
    checks.positive("weight", weight)
    bases, sizes = zip(*(torch.linalg.eigh(matrix)[::-1] for matrix in _axis_matrices(crosstalk, phase)), strict=True)
    eigenvalues = sizes[0][:, None] * sizes[1]
    penalty = weight * eigenvalues.square().mean()
    wanted = bases[0].T @ phase.to(torch.float64) @ bases[1] * eigenvalues
    z = phase.to(torch.float64).clamp(min=0)
    dual = torch.zeros_like(z)
    for _ in range(max_steps):
        pulled = bases[0].T @ (z - dual) @ bases[1]
        x = bases[0] @ ((wanted + penalty * pulled) / (eigenvalues.square() + penalty)) @ bases[1].T
        z = (x + dual).clamp(min=0)
        dual = dual + x - z
    return z.to(phase.dtype)


def _axis_matrices(crosstalk: Crosstalk, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Convolution matrices [H, H] and [W, W] of a separable kernel, float64."""
    checks.real("phase", phase)
    kernel = crosstalk.kernel
    middle = kernel.shape[0] // 2, kernel.shape[1] // 2
    columns, rows = kernel[:, middle[1]], kernel[middle[0], :]
    if not torch.allclose(columns[:, None] * rows, kernel, rtol=0, atol=1e-12) or not (
        torch.equal(columns, columns.flip(0)) and torch.equal(rows, rows.flip(0))
    ):
        raise ValueError("the crosstalk must be separable and symmetric for a matrix inverse; use deconvolve")
    return _toeplitz(columns, phase.shape[-2], phase.device), _toeplitz(rows, phase.shape[-1], phase.device)


def _toeplitz(taps: Tensor, size: int, device: torch.device) -> Tensor:
    offsets = torch.arange(size)[:, None] - torch.arange(size) + len(taps) // 2
    inside = (offsets >= 0) & (offsets < len(taps))
    return torch.where(inside, taps[offsets.clamp(0, len(taps) - 1)], 0.0).to(device)
