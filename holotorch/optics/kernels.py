"""Transfer functions of free space: pure functions, float64 inside, differentiable in wavelength and distance."""

import math

import torch
from torch import Tensor

from holotorch.core.grid import Grid


def carrier(wavelength: Tensor | float, distance: Tensor | float) -> Tensor:
    """exp(i k z), complex128 of the broadcast shape.

    k z reaches 1e6 rad and more, where float32 steps by 0.1 rad; whole turns are taken off in float64 first.
    """
    return turns_phasor(_float64(distance) / _float64(wavelength))


def angular_spectrum_kernel(
    grid: Grid, wavelength: Tensor | float, distance: Tensor | float, *, band_limit: bool = True
) -> Tensor:
    """Transfer function of free space, exact for scalar fields, without its carrier: exp(i z (k_z - k)).

    Args:
        grid: Sampling of the padded field.
        wavelength: In metres, shape [...]; broadcasts against ``distance``.
        distance: In metres, negative to travel back.
        band_limit: Drop frequencies that the grid undersamples at this distance: those whose light would move
            sideways by more than half the padded extent. This is the rule of Matsushima and Shimobaba (2009) for both
            axes at once instead of one by one. It removes aliasing noise; the light it drops is missing.

    Returns:
        complex128 of shape [..., H, W], frequencies in FFT order. Evanescent waves decay with abs(distance), so that
        travelling back does not blow them up; distance 0 gives ones.

    k_z - k is written -k s^2 / (1 + cos), s the sine of the angle, which does not cancel. Source: Goodman, Sec. 3.10.
    """
    wavelength, distance = _float64(wavelength)[..., None, None], _float64(distance)[..., None, None]
    fy, fx = grid.frequencies(distance.device)
    sine2 = (wavelength * fy).square() + (wavelength * fx).square()
    travels, decays = sine2 < 1, sine2 > 1
    # Masked before the root, so that the branch not taken has a finite gradient.
    cosine = torch.where(travels, torch.sqrt(torch.where(travels, 1 - sine2, 1)), 0)
    imaginary = torch.where(decays, torch.sqrt(torch.where(decays, sine2 - 1, 1)), 0)

    turns = -distance / wavelength * torch.where(travels, sine2 / (1 + cosine), 1)
    kernel = torch.exp(-2 * math.pi * distance.abs() / wavelength * imaginary) * turns_phasor(turns)
    if not band_limit:
        return kernel
    # tan(angle) = wavelength f / cos. The same limit on the evanescent side drops the slow decays next to the cut-off,
    # which vary too fast to be sampled, and keeps the rest.
    root = cosine + imaginary
    height, width = grid.extent
    reach = 2 * (distance * wavelength).abs()
    kept = (reach * fy.abs() <= height * root) & (reach * fx.abs() <= width * root)
    return torch.where(kept, kernel, 0)


def fresnel_kernel(grid: Grid, wavelength: Tensor | float, distance: Tensor | float) -> Tensor:
    """Paraxial transfer function without its carrier: exp(-i pi wavelength z (fx^2 + fy^2)), complex128 [..., H, W].

    Arguments as in :func:`angular_spectrum_kernel`. The phase is wrong by about k z (wavelength f)^4 / 8 against the
    exact one. Built from one exponential per axis. Source: thesis Eq. 4.49;
    Goodman, Sec. 4.2.
    """
    product = (_float64(wavelength) * _float64(distance))[..., None, None]
    fy, fx = grid.frequencies(product.device)
    return turns_phasor(-product / 2 * fy.square()) * turns_phasor(-product / 2 * fx.square())


def turns_phasor(turns: Tensor) -> Tensor:
    """exp(2 pi i turns), with whole turns taken off in float64; the gradient is that of the unreduced phase."""
    phase = 2 * math.pi * (turns - turns.detach().round())
    return torch.complex(torch.cos(phase), torch.sin(phase))


def _float64(value: Tensor | float) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)
