"""Weights of the paraxial propagation through a thin lens, exact for band-limited samples and finite at the focus."""

import torch
from torch import Tensor

from holotorch.core.grid import Grid, Pair
from holotorch.core.special import chirped_fresnel_integral
from holotorch.optics.free_space.kernels import carrier, cycles_phasor

_CHUNK = 50_000  # weights computed at a time, each by a quadrature with 42 nodes


def lens_taps(
    targets: Tensor, source: Tensor, pitch: float, wavelength: Tensor, distance: Tensor, focus: Tensor
) -> Tensor:
    """Weights of one axis from samples q in front of a lens to positions x behind it, without the carrier.

    w(x, q) = integral over x' of sinc((x' - q) / pitch) exp(-i pi x'^2 / (wavelength focus)) g(x - x'), with the
    Fresnel kernel g(x) = exp(i pi x^2 / (wavelength z)) / sqrt(i wavelength z). With m = 1 - z / focus, the highest
    frequency B = 1 / (2 pitch) of the samples and the frequency f0 = (x - m q) / (wavelength z) of the ray from q to x,

    w = pitch / sqrt(2 wavelength |z|) exp(i pi ((x - q)^2 / z - q^2 / focus) / wavelength) (F(u+) + F(u-)),

    u+ = sqrt(2 wavelength |z / m|) (B - f0), and u- the same with B + f0. F = C - iS for z / m > 0 and C + iS
    otherwise, times -i sign(z) for m < 0, with the Fresnel integrals C and S. This is ``fresnel_taps`` over z / m at
    the position x / m, arranged so that all terms are bounded as m -> 0. At m = 0 the weights have a step at
    abs(x) = wavelength |z| B, with the mean value on the step. Near m = 0 this step is a steep edge with large
    gradients; at m = 0 gradients omit it.

    Args:
        targets: Positions x in metres from the axis of the lens, float64, shape [n'].
        source: Positions q of the samples in metres from the axis of the lens, float64, shape [n].
        pitch: Of the samples, in metres.
        wavelength: In metres, float64, shape [...].
        distance: z in metres, float64, shape [...], not 0.
        focus: Focal length in metres, float64, shape [...], not 0; may be infinite.

    Returns:
        complex128 of shape [..., n', n].
    """
    wavelength, distance, focus = torch.broadcast_tensors(wavelength, distance, focus)
    rows = max(1, _CHUNK // (source.numel() * max(1, distance.numel())))
    lengths = [values[..., None, None] for values in (wavelength, distance, focus)]
    return torch.cat([_weights(part, source, pitch, *lengths) for part in targets.split(rows)], -2)


def lens_matrices(
    grid: Grid, wavelength: Tensor, distance: Tensor, focus: Tensor, out_grid: Grid, offset: Pair
) -> tuple[Tensor, Tensor]:
    """Weights of both axes, complex128 [..., H', H] with the carrier exp(ikz), and [..., W', W]."""
    columns, rows = (
        lens_taps(targets.reshape(-1) + shift, source.reshape(-1), pitch, wavelength, distance, focus)
        for targets, source, pitch, shift in zip(
            out_grid.coordinates(distance.device), grid.coordinates(distance.device), grid.pitch, offset, strict=True
        )
    )
    return columns * carrier(wavelength, distance)[..., None, None], rows


def _weights(x: Tensor, q: Tensor, pitch: float, wavelength: Tensor, distance: Tensor, focus: Tensor) -> Tensor:
    """Weights of :func:`lens_taps`, complex128 [..., n', n], for lengths of shape [..., 1, 1]."""
    x, edge, product = x[:, None], 0.5 / pitch, wavelength * distance
    bounded = focus.isfinite()
    lens = torch.where(bounded, focus, 1.0)
    m = torch.where(bounded, (lens - distance) / lens, 1.0)  # 1 - z / focus would have an absolute error of 1e-16
    sharp = m == 0
    size = torch.where(sharp, 1.0, m)
    inverted = (m < 0).to(torch.float64)
    sign_z_over_m = torch.sign(distance) * (1 - 2 * inverted)
    scale = torch.sqrt(2 * (product / size).abs())
    chirp = cycles_phasor(((x - q).square() / distance - q.square() / focus) / (2 * wavelength))
    total = torch.zeros_like(chirp)
    for sign in (1, -1):
        # exp(-+i pi u^2 / 2) times the chirp: the contribution of one end of the band.
        from_edge = edge - sign * x / product
        cycles = x.square() / (2 * product) - product / (2 * size) * from_edge.square() - sign * edge * q
        band_end = cycles_phasor(cycles)
        u = scale * (edge - sign * (x - m * q) / product)
        # A position on the step, such as the outermost sample of an even DFT, counts as exactly on it despite rounding.
        u = torch.where(sharp & (from_edge.abs() <= 1e-12 * edge), 0.0, u)
        step = torch.sign(u) * ((0.5 - 0.5j * sign_z_over_m) * chirp)
        total = total + torch.where(sharp, step, chirped_fresnel_integral(u, chirp, band_end, sign_z_over_m))
    # The phase of the root of 1 / m, chosen for m < 0 such that the weights are continuous at m = 0.
    root = torch.complex(1 - inverted, -inverted * torch.sign(distance))
    return total * root * (pitch / torch.sqrt(2 * product.abs()))
