"""Impulse response of free space, exact for band-limited samples, and the factor beyond the Fresnel model."""

import math

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.special import chirped_fresnel_integral
from holotorch.optics.free_space.kernels import cycles_phasor, direction_cosine


def fresnel_taps(displacement: Tensor, pitch: float, wavelength: Tensor, distance: Tensor) -> Tensor:
    """Weights of the paraxial propagation from a sample to displaced positions on one axis, without the carrier.

    t(n) = pitch * integral over f from -B to B of exp(-i pi wavelength z f^2) exp(2 pi i f n pitch), with the highest
    frequency B = 1 / (2 pitch) of the samples. Completing the square gives two Fresnel integrals with the arguments
    u = sqrt(2 wavelength |z|) (B - x / (wavelength |z|)), and the same with a plus, where x = n pitch. They hold at
    every distance: at short distances the taps approach a single sample with sinc tails, at long ones the sampled
    chirp of a point source.

    Args:
        displacement: n in samples, which need not be whole, shape [N].
        pitch: In metres.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...], not 0; negative gives the conjugate.

    Returns:
        complex128 of shape [..., N].
    """
    product = (wavelength * distance.abs())[..., None]
    displacement = displacement.to(torch.float64)
    x, edge = displacement * pitch, 0.5 / pitch
    scale = torch.sqrt(2 * product)
    chirp = cycles_phasor(x.square() / (2 * product))
    total = torch.zeros_like(chirp)
    for sign in (1, -1):
        # exp(-i pi u^2 / 2) times the chirp is the integrand at one end of the band.
        band_end = cycles_phasor(-product * edge**2 / 2 + sign * displacement / 2)
        u = scale * (edge - sign * x / product)
        total = total + chirped_fresnel_integral(u, chirp, band_end)
    taps = total * pitch / scale
    return torch.where((distance < 0)[..., None], taps.conj(), taps)


def tap_indices(padded: int, size: int, out: int) -> Tensor:
    """Displacements from ``size`` source samples to ``out`` samples of the result, float64 [padded], in FFT order.

    They run from 0 to out - 1 and then from -(size - 1) to -1. If ``padded`` exceeds their number, size + out - 1, both
    ranges are extended equally.
    """
    index = torch.arange(padded, dtype=torch.float64)
    return torch.where(index > out - 1 + (padded - (size + out - 1)) // 2, index - padded, index)


def remainder_kernel(fy: Tensor, fx: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
    """The factor beyond Fresnel, exp(-i pi z s^4 / (wavelength (1 + cos)^2)), complex128.

    It is the exact transfer function divided by the paraxial one; s and cos are the sine and cosine of the angle to the
    axis. The frequencies in cycles per metre broadcast against wavelength and distance in metres. Evanescent waves
    decay with abs(distance); their phase is such that the product with the paraxial factor and the carrier is real.
    :func:`tilted_cycles` is the counterpart for a tilted carrier.
    """
    sine2 = (wavelength * fy).square() + (wavelength * fx).square()
    travels = sine2 < 1
    cosine = torch.where(travels, torch.sqrt(torch.where(travels, 1 - sine2, 1)), 0)
    cycles = -distance / wavelength * torch.where(travels, (sine2 / (1 + cosine)).square() / 2, 1 - sine2 / 2)
    phase = cycles_phasor(cycles)
    # Without evanescent waves there is no decay.
    if checks.readable(sine2) and not bool((sine2 > 1).any()):
        return phase
    _, imaginary = direction_cosine(sine2)
    return phase * torch.exp(-2 * math.pi * distance.abs() / wavelength * imaginary)


def tilted_cycles(
    fy: Tensor, fx: Tensor, wavelength: Tensor, distance: Tensor, tilt: Tensor, *, squares: bool = True
) -> Tensor:
    """Phase in cycles that free space adds to frequencies (fy, fx) about a carrier with the sines ``tilt`` (y, x) [2].

    It is z (k_z(f + f_0) - k_z(f_0)) / 2 pi minus the part linear in f, which is the lateral shift z s_0 / cos_0 of the
    carrier; s_0 and cos_0 are its sine and cosine and f_0 its frequency. Without ``squares`` the term
    -wavelength z / 2 (f_y^2 (1 - s_x^2) + f_x^2 (1 - s_y^2)) / cos_0^3 is subtracted too, so that the cross term and
    the terms of third and higher order remain. The rounding error is 1e-16 of z / wavelength: 1e-9 cycles at 2 m.
    """
    sy, sx = tilt[0], tilt[1]
    cosine = torch.sqrt(1 - sy.square() - sx.square())
    y, x = wavelength * fy, wavelength * fx
    # cos - cos_0 = -(2 s_0 f + f^2) / (cos + cos_0), with f times the wavelength; this form has no cancellation.
    change = -(2 * (sy * y + sx * x) + y.square() + x.square())
    root = torch.sqrt((cosine.square() + change).clamp(min=0))
    curved = change / (root + cosine) + (sy * y + sx * x) / cosine
    if not squares:
        curved = curved + (y.square() * (1 - sx.square()) + x.square() * (1 - sy.square())) / (2 * cosine**3)
    return distance / wavelength * curved


def levelling_shift(
    nyquist: tuple[float, float], wavelength: Tensor, distance: Tensor, tilt: Tensor, axis: int
) -> Tensor:
    """Shift along ``axis`` in metres, shape [...], moved from the factor beyond Fresnel into the taps of that axis.

    About a tilted carrier this factor has an odd part, which is discontinuous between the two ends of the periodic
    band. The shift makes the phase at both ends equal for the rms frequency of the other axis; a fifth of
    the discontinuity remains. ``nyquist`` is the highest frequency (y, x) of the samples, in cycles per metre.
    """
    ends = [torch.full((), limit / 3**0.5, dtype=torch.float64, device=tilt.device) for limit in nyquist]
    cycles = []
    for sign in (1, -1):
        ends[axis] = torch.full((), sign * nyquist[axis], dtype=torch.float64, device=tilt.device)
        cycles.append(tilted_cycles(ends[0], ends[1], wavelength, distance, tilt, squares=False))
    return (cycles[0] - cycles[1]) / (2 * nyquist[axis])
