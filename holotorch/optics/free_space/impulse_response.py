"""The impulse response of free space, exact for band-limited samples, which a sampled transfer function is not."""

import math

import torch
from torch import Tensor

from holotorch.core.special import FRESNEL_BORDER, fresnel_auxiliary, fresnel_integral
from holotorch.optics.free_space.kernels import turns_phasor


def fresnel_taps(place: Tensor, pitch: float, wavelength: Tensor, distance: Tensor) -> Tensor:
    """Weights of the paraxial propagation from a sample to displaced positions on one axis, without the carrier.

    t(n) = pitch * int_{-B}^{B} exp(-i pi wavelength z f^2) exp(2 pi i f n pitch) df with B = 1 / (2 pitch): the band
    is cut exactly where the samples cut it. Completing the square turns it into two Fresnel integrals with arguments
    u = sqrt(2 wavelength |z|) (B -+ x / (wavelength |z|)), valid at every distance: at small ones the taps approach a
    single one with sinc tails, at large ones the sampled chirp of the point source. Every phase is reduced in cycles.

    Args:
        place: Displacement n in samples, which need not be whole, shape [n].
        pitch: In metres.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...], not 0; negative gives the conjugate.

    Returns:
        complex128 of shape [..., n].
    """
    product = (wavelength * distance.abs())[..., None]
    place = place.to(torch.float64)
    x, edge = place * pitch, 0.5 / pitch
    scale = torch.sqrt(2 * product)
    chirp = turns_phasor(x.square() / (2 * product))
    total = torch.zeros_like(chirp)
    for sign in (1, -1):
        # exp(-i pi u^2 / 2) times the chirp: an end of the band, exp(-i pi product B^2) exp(+-2 pi i B x).
        band_end = turns_phasor(-product * edge**2 / 2 + sign * place / 2)
        u = scale * (edge - sign * x / product)
        large = u.abs() > FRESNEL_BORDER
        f, g = fresnel_auxiliary(torch.where(large, u.abs(), 2.0))
        outside = torch.sign(u) * ((0.5 - 0.5j) * chirp + torch.complex(-g, f) * band_end)
        inside = chirp * fresnel_integral(torch.where(large, 0.0, u))
        total = total + torch.where(large, outside, inside)
    taps = total * pitch / scale
    return torch.where((distance < 0)[..., None], taps.conj(), taps)


def tap_indices(padded: int, size: int, out: int) -> Tensor:
    """Displacements from n source samples to m samples of the result, 0 .. m - 1, ..., -(n - 1) .. -1, in FFT order.

    ``padded`` >= n + m - 1 of them, float64; the excess is divided between the two ends.
    """
    index = torch.arange(padded, dtype=torch.float64)
    return torch.where(index > out - 1 + (padded - (size + out - 1)) // 2, index - padded, index)


def remainder_kernel(fy: Tensor, fx: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
    """Factor of the exact transfer function beyond the paraxial one: exp(-i pi z s^4 / (wavelength (1 + cos)^2)).

    s is the sine of the angle, frequencies in cycles per metre broadcast against wavelength and distance; complex128.
    Evanescent waves decay with abs(distance), and their paraxial phase is removed. :func:`tilted_turns` is the
    counterpart for a tilted carrier.
    """
    sine2 = (wavelength * fy).square() + (wavelength * fx).square()
    travels = sine2 < 1
    cosine = torch.where(travels, torch.sqrt(torch.where(travels, 1 - sine2, 1)), 0)
    cycles = -distance / wavelength * torch.where(travels, (sine2 / (1 + cosine)).square() / 2, 1 - sine2 / 2)
    phase = turns_phasor(cycles)
    decays = sine2 > 1
    if not bool(decays.any()):
        return phase
    imaginary = torch.where(decays, torch.sqrt(torch.where(decays, sine2 - 1, 1)), 0)
    return phase * torch.exp(-2 * math.pi * distance.abs() / wavelength * imaginary)


def tilted_turns(
    fy: Tensor, fx: Tensor, wavelength: Tensor, distance: Tensor, tilt: Tensor, *, squares: bool = True
) -> Tensor:
    """Phase in cycles that free space adds to frequencies (fy, fx) about a carrier with the sines ``tilt`` (y, x) [2].

    z (k_z(f + f_0) - k_z(f_0)) / 2 pi less its linear part, which is the sideways travel z s_0 / cos_0 of the carrier.
    Without ``squares`` also less -wavelength z / 2 (f_y^2 (1 - s_x^2) + f_x^2 (1 - s_y^2)) / cos_0^3: the cross term
    and everything of third order and beyond remain. The difference of two roots z / wavelength large loses 1e-16 of
    that: 1e-9 cycles at 2 m.
    """
    sy, sx = tilt[0], tilt[1]
    cosine = torch.sqrt(1 - sy.square() - sx.square())
    y, x = wavelength * fy, wavelength * fx
    # cos^2 - cos_0^2 = -(2 s_0 f + f^2) with f in sines; divided by cos + cos_0 it does not cancel.
    change = -(2 * (sy * y + sx * x) + y.square() + x.square())
    root = torch.sqrt((cosine.square() + change).clamp(min=0))
    curved = change / (root + cosine) + (sy * y + sx * x) / cosine
    if not squares:
        curved = curved + (y.square() * (1 - sx.square()) + x.square() * (1 - sy.square())) / (2 * cosine**3)
    return distance / wavelength * curved


def levelling_shift(top: tuple[float, float], wavelength: Tensor, distance: Tensor, tilt: Tensor, axis: int) -> Tensor:
    """Shift in metres, shape [...], moved from the factor beyond Fresnel into the taps of a tilted axis.

    That factor has an odd part, which is discontinuous between the two ends of the band. The shift that equalises both
    ends, at the rms frequency of the other axis, leaves a fifth of the discontinuity. ``top`` is the upper end (y, x)
    of the band, in cycles per metre.
    """
    ends = [torch.full((), limit / 3**0.5, dtype=torch.float64, device=tilt.device) for limit in top]
    cycles = []
    for sign in (1, -1):
        ends[axis] = torch.full((), sign * top[axis], dtype=torch.float64, device=tilt.device)
        cycles.append(tilted_turns(ends[0], ends[1], wavelength, distance, tilt, squares=False))
    return (cycles[0] - cycles[1]) / (2 * top[axis])
