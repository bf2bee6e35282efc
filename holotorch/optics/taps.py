"""The propagation kernel in space, exact for band-limited samples: what no sampled transfer function can hold."""

import math

import torch
from torch import Tensor

from holotorch.core.special import FRESNEL_BORDER, fresnel_auxiliary, fresnel_integral
from holotorch.optics.kernels import turns_phasor


def fresnel_taps(place: Tensor, pitch: float, wavelength: Tensor, distance: Tensor) -> Tensor:
    """Weights of the paraxial propagation from a sample to places beside it, one axis, carrier apart.

    t(n) = pitch * int_{-B}^{B} exp(-i pi wavelength z f^2) exp(2 pi i f n pitch) df with B = 1 / (2 pitch): the band
    is cut exactly where the samples cut it. Completing the square turns it into two Fresnel integrals with arguments
    u = sqrt(2 wavelength |z|) (B -+ x / (wavelength |z|)), valid at every distance: at small ones the taps approach a
    single one with sinc tails, at large ones the sampled chirp of the point source. Every phase is reduced in turns.

    Args:
        place: n, in samples and not only whole ones, shape [n].
        pitch: In metres.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...], not 0; negative gives the conjugate.

    Returns:
        complex128 of shape [..., n].
    """
    product = (wavelength * distance.abs())[..., None]
    place = place.to(torch.float64)
    position, edge = place * pitch, 0.5 / pitch
    scale = torch.sqrt(2 * product)
    chirp = turns_phasor(position.square() / (2 * product))
    total = torch.zeros_like(chirp)
    for sign in (1, -1):
        # exp(-i pi u^2 / 2) times the chirp: an end of the band, exp(-i pi product B^2) exp(+-2 pi i B x).
        rim = turns_phasor(-product * edge**2 / 2 + sign * place / 2)
        u = scale * (edge - sign * position / product)
        far = u.abs() > FRESNEL_BORDER
        f, g = fresnel_auxiliary(torch.where(far, u.abs(), 2.0))
        outside = torch.sign(u) * ((0.5 - 0.5j) * chirp + torch.complex(-g, f) * rim)
        inside = chirp * fresnel_integral(torch.where(far, 0.0, u))
        total = total + torch.where(far, outside, inside)
    taps = total * pitch / scale
    return torch.where((distance < 0)[..., None], taps.conj(), taps)


def fft_indices(size: int) -> Tensor:
    """0, 1, ..., (n-1)//2, -(n//2), ..., -1: the samples, or frequencies, of an axis in FFT order."""
    index = torch.arange(size)
    return torch.where(index > (size - 1) // 2, index - size, index)


def remainder_kernel(fy: Tensor, fx: Tensor, wavelength: Tensor, distance: Tensor) -> Tensor:
    """What the exact transfer function has on top of the paraxial one: exp(-i pi z s^4 / (wavelength (1 + cos)^2)).

    s is the sine of the angle, frequencies in cycles per metre broadcast against wavelength and distance; complex128.
    Evanescent waves decay with abs(distance), and their paraxial phase is taken back.
    """
    sine2 = (wavelength * fy).square() + (wavelength * fx).square()
    travels = sine2 < 1
    cosine = torch.where(travels, torch.sqrt(torch.where(travels, 1 - sine2, 1)), 0)
    turns = -distance / wavelength * torch.where(travels, (sine2 / (1 + cosine)).square() / 2, 1 - sine2 / 2)
    phase = turns_phasor(turns)
    decays = sine2 > 1
    if not bool(decays.any()):
        return phase
    imaginary = torch.where(decays, torch.sqrt(torch.where(decays, sine2 - 1, 1)), 0)
    return phase * torch.exp(-2 * math.pi * distance.abs() / wavelength * imaginary)
