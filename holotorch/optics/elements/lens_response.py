"""Weights of the paraxial propagation through a thin lens, exact for band-limited samples and finite at the focus."""

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.core.special import FRESNEL_BORDER, fresnel_auxiliary, fresnel_integral
from holotorch.optics.free_space.kernels import carrier, turns_phasor

_CHUNK = 50_000  # weights at a time: the quadrature behind each holds 42 numbers


def lens_taps(
    targets: Tensor, source: Tensor, pitch: float, wavelength: Tensor, distance: Tensor, focus: Tensor
) -> Tensor:
    """Weights of one axis from samples, through a lens, to positions behind it, without the carrier.

    w(x, q) = int dx' sinc((x' - q) / pitch) exp(-i pi x'^2 / (wavelength focus)) g(x - x'), with the Fresnel kernel
    g(x) = exp(i pi x^2 / (wavelength z)) / sqrt(i wavelength z). With m = 1 - z / focus it is a point source seen
    through the lens, of frequency f0 = (x - m q) / (wavelength z), cut at the ends +-B = +-1 / (2 pitch) of the band:

    w = pitch / sqrt(2 wavelength |z|) exp(i pi ((x - q)^2 / z - q^2 / focus) / wavelength) (F(u+) + F(u-)),

    u+- = sqrt(2 wavelength |z / m|) (B -+ f0), F = C - iS for z / m > 0, else C + iS, and times -i sign(z) for m < 0.
    This is ``fresnel_taps`` over z / m at the scaled position x / m, arranged so that no term grows without bound as
    m -> 0. At m = 0 the cut is a sharp edge at abs(x) = wavelength |z| B, half as high on the edge itself. Gradients
    close to m = 0 are those of a nearly sharp edge, and large; at m = 0 they leave the edge out.

    Args:
        targets: Positions x in metres from the axis of the lens, float64, shape [n'].
        source: Positions q of the samples, likewise, shape [n].
        pitch: Of the samples, in metres.
        wavelength: In metres, float64, shape [...].
        distance: In metres, float64, shape [...], not 0.
        focus: Focal length in metres, float64, shape [...], not 0; may be infinite.

    Returns:
        complex128 of shape [..., n', n].
    """
    wavelength, distance, focus = torch.broadcast_tensors(wavelength, distance, focus)
    rows = max(1, _CHUNK // (source.numel() * max(1, distance.numel())))
    lengths = [values[..., None, None] for values in (wavelength, distance, focus)]
    return torch.cat([_weights(part, source, pitch, *lengths) for part in targets.split(rows)], -2)


def lens_matrices(
    grid: Grid, wavelength: Tensor, distance: Tensor, focus: Tensor, out_grid: Grid, offset: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Weights of both axes, complex128 [..., H', H] and [..., W', W], the carrier in the first."""
    columns, rows = (
        lens_taps(targets.reshape(-1) + shift, source.reshape(-1), pitch, wavelength, distance, focus)
        for targets, source, pitch, shift in zip(
            out_grid.coordinates(distance.device), grid.coordinates(distance.device), grid.pitch, offset, strict=True
        )
    )
    return columns * carrier(wavelength, distance)[..., None, None], rows


def _weights(x: Tensor, q: Tensor, pitch: float, wavelength: Tensor, distance: Tensor, focus: Tensor) -> Tensor:
    """complex128 [..., n', n] of lengths [..., 1, 1]; see :func:`lens_taps`."""
    x, edge, product = x[:, None], 0.5 / pitch, wavelength * distance
    bounded = focus.isfinite()
    lens = torch.where(bounded, focus, 1.0)
    m = torch.where(bounded, (lens - distance) / lens, 1.0)  # 1 - z / focus would round to 1e-16 of 1
    sharp = m == 0
    size = torch.where(sharp, 1.0, m)
    inverted = (m < 0).to(torch.float64)
    sign_z_over_m = torch.sign(distance) * (1 - 2 * inverted)
    scale = torch.sqrt(2 * (product / size).abs())
    chirp = turns_phasor(((x - q).square() / distance - q.square() / focus) / (2 * wavelength))
    half = torch.complex(torch.full_like(sign_z_over_m, 0.5), -sign_z_over_m / 2)
    total = torch.zeros_like(chirp)
    for sign in (1, -1):
        # exp(-+i pi u^2 / 2) times the chirp: one end of the band, where it lands.
        beside = edge - sign * x / product
        band_end = turns_phasor(x.square() / (2 * product) - product / (2 * size) * beside.square() - sign * edge * q)
        u = scale * (edge - sign * (x - m * q) / product)
        # A place on the sharp edge, as the outermost of an even DFT is, shall not fall to one side by rounding.
        u = torch.where(sharp & (beside.abs() <= 1e-12 * edge), 0.0, u)
        far = (u.abs() > FRESNEL_BORDER) | sharp
        f, g = fresnel_auxiliary(torch.where(u.abs() > FRESNEL_BORDER, u.abs(), 2.0))
        boundary = torch.where(sharp, 0.0, torch.complex(-g, sign_z_over_m * f) * band_end)
        integral = fresnel_integral(torch.where(far, 0.0, u))
        small_u = torch.complex(integral.real, sign_z_over_m * integral.imag)
        total = total + torch.where(far, torch.sign(u) * (half * chirp + boundary), chirp * small_u)
    # The root of 1 / m, whose two values for negative m are told apart by continuity at m = 0.
    root = torch.complex(1 - inverted, -inverted * torch.sign(distance))
    return total * root * (pitch / torch.sqrt(2 * product.abs()))
