"""Transfer functions of free space: pure functions, computed in float64, differentiable in wavelength and distance.

Numbers and tensors outside the range of their quantity raise ValueError, except under ``compile`` and ``vmap``.
"""

import math

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid, Pair
from holotorch.core.precision import double
from holotorch.core.quantities import DISTANCE, WAVELENGTH


def carrier(wavelength: Tensor | float, distance: Tensor | float) -> Tensor:
    """exp(i k z), complex128 of the broadcast shape of ``wavelength`` and ``distance``, in metres.

    k z exceeds 1e6 rad, where float32 numbers are 0.1 rad apart, so whole cycles are subtracted in float64. Emits a
    PrecisionWarning if the rounding of a float32 argument changes the phase by 0.01 rad or more.
    """
    wavelengths, distances = _lengths(wavelength, distance)
    cycles = distances / wavelengths
    checks.precise(wavelength, distance)
    return cycles_phasor(cycles)


def angular_spectrum_kernel(
    grid: Grid, wavelength: Tensor | float, distance: Tensor | float, *, band_limit: bool = True
) -> Tensor:
    """Transfer function of free space, exact for scalar fields, without its carrier: exp(i z (k_z - k)).

    Args:
        grid: Sampling of the padded field.
        wavelength: In metres, shape [...]; broadcasts against ``distance``.
        distance: In metres, shape [...], negative for backward propagation.
        band_limit: Drop frequencies at which the grid undersamples the kernel: those whose light moves sideways by more
            than half the padded extent. This is the rule of Matsushima and Shimobaba (2009), here with the exact angle
            in two dimensions. It removes aliasing noise; the dropped light is missing in the result.

    Returns:
        complex128 of shape [..., H, W], frequencies in FFT order. Evanescent waves decay with abs(distance), so that
        backward propagation does not amplify them; distance 0 gives ones.

    k_z - k is computed as -k s^2 / (1 + cos), with the sine s and cosine of the angle, to avoid cancellation.
    Source: Goodman, Sec. 3.10.
    """
    wavelength, distance = (length[..., None, None] for length in _lengths(wavelength, distance))
    fy, fx = grid.frequencies(distance.device)
    sine2 = (wavelength * fy).square() + (wavelength * fx).square()
    cosine, imaginary = direction_cosine(sine2)
    cycles = -distance / wavelength * torch.where(sine2 < 1, sine2 / (1 + cosine), 1)
    kernel = torch.exp(-2 * math.pi * distance.abs() / wavelength * imaginary) * cycles_phasor(cycles)
    if not band_limit:
        return kernel
    # tan(angle) = wavelength f / cos. The same limit drops evanescent waves next to the cut-off, which decay
    # slowly but vary too fast with frequency to be sampled.
    root = cosine + imaginary
    height, width = grid.extent
    twice_product = 2 * (distance * wavelength).abs()
    kept = (twice_product * fy.abs() <= height * root) & (twice_product * fx.abs() <= width * root)
    return torch.where(kept, kernel, 0)


def direction_cosine(sine2: Tensor) -> tuple[Tensor, Tensor]:
    """Real and imaginary part of sqrt(1 - sine2); the imaginary part belongs to evanescent waves."""
    # Masked before the root, so that the unused branch has a finite gradient.
    real, imaginary = (
        torch.where(part > 0, torch.sqrt(torch.where(part > 0, part, 1)), 0) for part in (1 - sine2, sine2 - 1)
    )
    return real, imaginary


def fresnel_kernel(grid: Grid, wavelength: Tensor | float, distance: Tensor | float) -> Tensor:
    """Paraxial transfer function without its carrier: exp(-i pi wavelength z (fx^2 + fy^2)), complex128 [..., H, W].

    The arguments are those of :func:`angular_spectrum_kernel`. The phase differs from the exact one by about
    k z (wavelength f)^4 / 8. Source: thesis Eq. 4.49; Goodman, Sec. 4.2.
    """
    wavelength, distance = _lengths(wavelength, distance)
    product = (wavelength * distance)[..., None, None]
    fy, fx = grid.frequencies(product.device)
    return cycles_phasor(-product / 2 * fy.square()) * cycles_phasor(-product / 2 * fx.square())


def window_taper(grid: Grid, wavelength: float, distance: float, shift: Pair, *, paraxial: bool = False) -> Tensor:
    """Weights, float64 [H, W] in FFT order, that remove light which would wrap around into a window.

    Light that moves sideways by at most ``shift`` keeps weight 1. Light that moves by the padded extent minus ``shift``
    or more re-enters the window and gets weight 0; between the two limits the weight falls as cos^2. A step would
    diffract light over the window: 10 % of the intensity for a hologram of random phase. A transition that is
    2 sqrt(wavelength distance) wide reduces this to 1e-4.

    Args:
        grid: Sampling of the padded field.
        wavelength: In metres.
        distance: In metres.
        shift: Half the extent of the window plus half the extent of the field, in metres (y, x).
        paraxial: Light moves sideways by distance times the sine of its angle, as in the Fresnel model.

    Raises ValueError for a padded extent below twice ``shift``.
    """
    weights = torch.ones((), dtype=torch.float64)
    sines = [wavelength * frequency for frequency in grid.frequencies()]
    steepest = [wavelength * (size // 2) / (size * pitch) for size, pitch in zip(grid.shape, grid.pitch, strict=True)]
    for axis, (extent, start, size) in enumerate(zip(grid.extent, shift, grid.shape, strict=True)):
        if size == 1:
            continue
        sine, other = sines[axis], sines[1 - axis].square()
        # Sines up to 0.1 on the other axis change the tangent by at most half a percent and are neglected.
        other = other if steepest[1 - axis] > 0.1 else 0.0
        cosine = 1.0 if paraxial else (1 - sine.square() - other).clamp_min(1e-12).sqrt()
        if extent < 2 * start * (1 - 1e-9):
            needed = f"a window of {start:.3g} m to either side needs {2 * start:.3g} m"
            raise ValueError(f"{needed}, padded are {extent:.3g}")
        fall = ((abs(distance) * sine.abs() / cosine - start) / max(extent - 2 * start, 1e-9 * extent)).clamp(0, 1)
        weights = weights * torch.cos(math.pi / 2 * fall).square()
    return weights


def cycles_phasor(cycles: Tensor) -> Tensor:
    """exp(2 pi i cycles), with whole cycles subtracted in float64; the gradient is that of the unreduced phase."""
    return phasor(2 * math.pi * (cycles - cycles.detach().round()))


def _lengths(wavelength: Tensor | float, distance: Tensor | float) -> tuple[Tensor, Tensor]:
    """Both lengths in float64 on the device of the one that is elsewhere than on the processor, if one is."""
    checks.plausible(WAVELENGTH, wavelength)
    checks.plausible(DISTANCE, distance)
    given = [value.device for value in (wavelength, distance) if isinstance(value, Tensor)]
    device = next((device for device in given if device.type != "cpu"), torch.device("cpu"))
    return double(wavelength, device), double(distance, device)
