"""Transfer functions of free space: pure functions, float64 inside, differentiable in wavelength and distance.

Numbers and tensors outside the range of their quantity are refused; values are not checked under compile and vmap.
"""

import math

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE, WAVELENGTH


def carrier(wavelength: Tensor | float, distance: Tensor | float) -> Tensor:
    """exp(i k z), complex128 of the broadcast shape.

    k z reaches 1e6 rad and more, where float32 steps by 0.1 rad; whole cycles are subtracted in float64 first. A tensor
    of float32 is already rounded: PrecisionWarning if that changes the phase by 0.01 rad or more.
    """
    cycles = _distance(distance) / _wavelength(wavelength)
    checks.precise(wavelength, distance)
    return turns_phasor(cycles)


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
        propagation backward does not amplify them; distance 0 gives ones.

    k_z - k is written -k s^2 / (1 + cos), s the sine of the angle, which does not cancel. Source: Goodman, Sec. 3.10.
    """
    wavelength, distance = _wavelength(wavelength)[..., None, None], _distance(distance)[..., None, None]
    fy, fx = grid.frequencies(distance.device)
    sine2 = (wavelength * fy).square() + (wavelength * fx).square()
    travels, decays = sine2 < 1, sine2 > 1
    # Masked before the root, so that the unused branch has a finite gradient.
    cosine = torch.where(travels, torch.sqrt(torch.where(travels, 1 - sine2, 1)), 0)
    imaginary = torch.where(decays, torch.sqrt(torch.where(decays, sine2 - 1, 1)), 0)

    cycles = -distance / wavelength * torch.where(travels, sine2 / (1 + cosine), 1)
    kernel = torch.exp(-2 * math.pi * distance.abs() / wavelength * imaginary) * turns_phasor(cycles)
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
    product = (_wavelength(wavelength) * _distance(distance))[..., None, None]
    fy, fx = grid.frequencies(product.device)
    return turns_phasor(-product / 2 * fy.square()) * turns_phasor(-product / 2 * fx.square())


def window_taper(
    grid: Grid, wavelength: float, distance: float, reach: tuple[float, float], *, paraxial: bool = False
) -> Tensor:
    """Weights, float64 [H, W] in FFT order, that remove light which would wrap around into a window.

    Light that moves sideways by at most ``reach`` metres (y, x) keeps weight 1. Light that moves by the padded extent
    minus ``reach`` or more re-enters the window and gets weight 0; between the two the weight falls as cos^2. A step
    instead would diffract light over the window: 10 % of the intensity for a hologram of random phase, of which a fall
    over two sqrt(wavelength distance) leaves 1e-4.

    Args:
        grid: Sampling of the padded field.
        wavelength: In metres.
        distance: In metres.
        reach: Half of the window and half of the field, per axis.
        paraxial: Light moves sideways by the sine of its angle, as in the Fresnel model, instead of the tangent.

    Raises:
        ValueError: A padded extent below twice ``reach``.
    """
    weights = torch.ones((), dtype=torch.float64)
    sines = [wavelength * each for each in grid.frequencies()]
    for axis, (extent, start, size) in enumerate(zip(grid.extent, reach, grid.shape, strict=True)):
        if size == 1:
            continue
        sine, aside = sines[axis], sines[1 - axis].square()
        # The other axis changes the angle by at most half a percent unless its light is steep.
        aside = aside if float(aside.max()) > 0.01 else 0.0
        cosine = 1.0 if paraxial else (1 - sine.square() - aside).clamp_min(1e-12).sqrt()
        if extent < 2 * start * (1 - 1e-9):
            raise ValueError(
                f"a window of {start:.3g} m to either side needs {2 * start:.3g} m, padded are {extent:.3g}"
            )
        part = ((abs(distance) * sine.abs() / cosine - start) / max(extent - 2 * start, 1e-9 * extent)).clamp(0, 1)
        weights = weights * torch.cos(math.pi / 2 * part).square()
    return weights


def turns_phasor(cycles: Tensor) -> Tensor:
    """exp(2 pi i cycles), with whole cycles subtracted in float64; the gradient is that of the unreduced phase."""
    phase = 2 * math.pi * (cycles - cycles.detach().round())
    return torch.complex(torch.cos(phase), torch.sin(phase))


def _wavelength(value: Tensor | float) -> Tensor:
    checks.meant(WAVELENGTH, value)
    return torch.as_tensor(value, dtype=torch.float64)


def _distance(value: Tensor | float) -> Tensor:
    checks.meant(DISTANCE, value)
    return torch.as_tensor(value, dtype=torch.float64)
