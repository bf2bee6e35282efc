"""Operators as explicit matrices acting on flattened (H, W) arrays, float64, without FFTs and without holotorch."""

import numpy as np


def frequencies(n, pitch):
    """DFT frequencies in FFT order: 0, 1, ..., (n-1)//2, -(n//2), ..., -1 over n * pitch."""
    k = np.arange(n)
    return np.where(k <= (n - 1) // 2, k, k - n) / (n * pitch)


def dft(n):
    """DFT matrix exp(-2 pi i m k / n), not normalised."""
    k = np.arange(n)
    return np.exp(-2j * np.pi * np.outer(k, k) / n)


def centred_unitary_dft(shape):
    """DFT matrix over (H, W) with the origin of both sides on sample n // 2, divided by the root of the size."""
    h, w = shape
    axes = [np.exp(-2j * np.pi * np.outer(np.arange(n) - n // 2, np.arange(n) - n // 2) / n) for n in (h, w)]
    return np.kron(axes[0], axes[1]) / np.sqrt(h * w)


def spectral_filter(shape, transfer, out_shape=None):
    """Zero-pad to the transfer function's size, DFT, multiply, inverse DFT, crop to ``out_shape``; as one matrix."""
    (h, w), (big_h, big_w), (out_h, out_w) = shape, transfer.shape, out_shape or shape
    forward = np.kron(dft(big_h)[:, :h], dft(big_w)[:, :w])
    inverse = np.kron(dft(big_h).conj()[:out_h], dft(big_w).conj()[:out_w]) / (big_h * big_w)
    return inverse @ (transfer.reshape(-1, 1) * forward)


def zoomed_filter(shape, pitch, transfer, out_shape, out_pitch, offset):
    """DFT on the transfer function's size, multiply, and sum the spectrum at the points of another grid."""
    forward, back = [], []
    for n, m, p, q, aside, padded in zip(shape, out_shape, pitch, out_pitch, offset, transfer.shape, strict=True):
        f = frequencies(padded, p)
        source, reached = np.arange(n) * p, (np.arange(m) - m // 2) * q + aside + n // 2 * p
        forward.append(np.exp(-2j * np.pi * np.outer(f, source)))
        back.append(np.exp(2j * np.pi * np.outer(reached, f)) / padded)
    return np.kron(*back) @ (transfer.reshape(-1, 1) * np.kron(*forward))


def angular_spectrum_transfer(shape, pitch, wavelength, distance, band_limit):
    """exp(2 pi i z sqrt(1/lambda^2 - f^2)), decaying with |z| where evanescent; band limit per sample."""
    fy, fx = (frequencies(n, p) for n, p in zip(shape, pitch, strict=True))
    transfer = np.zeros(shape, complex)
    for i, v in enumerate(fy):
        for j, u in enumerate(fx):
            square = wavelength**-2 - u * u - v * v
            if square >= 0:
                value = np.exp(2j * np.pi * distance * np.sqrt(square))
            else:
                value = np.exp(-2 * np.pi * abs(distance) * np.sqrt(-square))
            slope = abs(distance) / max(np.sqrt(abs(square)), 1e-300)  # metres of shift per unit of frequency
            inside = slope * abs(v) <= shape[0] * pitch[0] / 2 and slope * abs(u) <= shape[1] * pitch[1] / 2
            transfer[i, j] = value if inside or not band_limit or distance == 0 else 0
    return transfer


def pupil(shape, pitch, wavelength, radius, centre, covered):
    """1 for the frequencies whose sines lie within a disc about ``centre`` and not in its covered half, else 0."""
    fy, fx = (frequencies(n, p) for n, p in zip(shape, pitch, strict=True))
    values = np.zeros(shape)
    for i, v in enumerate(fy):
        for j, u in enumerate(fx):
            y, x = wavelength * v - centre[0], wavelength * u - centre[1]
            values[i, j] = np.hypot(y, x) <= radius and y * covered[0] + x * covered[1] <= 0
    return values


def fresnel_transfer(shape, pitch, wavelength, distance):
    """exp(ikz) exp(-i pi lambda z f^2)."""
    fy, fx = (frequencies(n, p) for n, p in zip(shape, pitch, strict=True))
    square = fy[:, None] ** 2 + fx[None, :] ** 2
    return np.exp(2j * np.pi * distance / wavelength) * np.exp(-1j * np.pi * wavelength * distance * square)


def band_limited_propagation(shape, pitch, wavelength, distance, paraxial, nodes=400, offset=(0.0, 0.0)):
    """out[p] = sum_q h(p - q) in[q], h the integral of the transfer function over the band that the samples carry.

    By Gauss-Legendre quadrature over |f| < 1 / (2 pitch) on both axes; needs ``nodes`` above the number of turns of
    the integrand, pi times (samples + wavelength z / (2 pitch^2)).
    """
    t, weight = np.polynomial.legendre.leggauss(nodes)
    fy, fx = (t / (2 * p) for p in pitch)
    wy, wx = (weight / 2 for _ in pitch)  # times the pitch, which the density of the samples gives back
    square = wavelength**2 * (fy[:, None] ** 2 + fx[None, :] ** 2)
    if paraxial:
        transfer = np.exp(2j * np.pi * distance / wavelength) * np.exp(-1j * np.pi * distance / wavelength * square)
    else:
        transfer = np.exp(2j * np.pi * distance / wavelength * np.sqrt(1 - square + 0j))
    (h, w), (py, px) = shape, pitch
    dy, dx = np.arange(-(h - 1), h) * py + offset[0], np.arange(-(w - 1), w) * px + offset[1]
    kernel = (
        (np.exp(2j * np.pi * np.outer(dy, fy)) * wy) @ transfer @ (np.exp(2j * np.pi * np.outer(fx, dx)) * wx[:, None])
    )
    rows, columns = np.arange(h)[:, None] - np.arange(h), np.arange(w)[:, None] - np.arange(w)
    matrix = kernel[(rows + h - 1)[:, None, :, None], (columns + w - 1)[None, :, None, :]]
    return matrix.reshape(h * w, h * w)


def band_limited_to_points(
    shape, pitch, out_shape, out_pitch, offset, wavelength, distance, nodes=300, tilt=(0.0, 0.0)
):
    """The same integral from the samples of one grid to those of another whose axis lies at ``offset``.

    ``tilt``: frequencies are counted from a carrier's with these sines (y, x); the carrier is in neither field.
    """
    t, weight = np.polynomial.legendre.leggauss(nodes)
    factors = []
    for axis in (0, 1):
        source = (np.arange(shape[axis]) - shape[axis] // 2) * pitch[axis]
        reached = (np.arange(out_shape[axis]) - out_shape[axis] // 2) * out_pitch[axis] + offset[axis]
        f = t / (2 * pitch[axis])
        factors.append((f, np.exp(2j * np.pi * (reached[:, None] - source).reshape(-1, 1) * f) * weight / 2))
    (fy, ey), (fx, ex) = factors
    square = (wavelength * fy[:, None] + tilt[0]) ** 2 + (wavelength * fx[None, :] + tilt[1]) ** 2
    kernel = ey @ np.exp(2j * np.pi * distance / wavelength * np.sqrt(1 - square + 0j)) @ ex.T
    matrix = kernel.reshape(out_shape[0], shape[0], out_shape[1], shape[1]).transpose(0, 2, 1, 3)
    return matrix.reshape(out_shape[0] * out_shape[1], shape[0] * shape[1])


def direct_sum(shape, pitch, wavelength, distance):
    """First Rayleigh-Sommerfeld integral, pair by pair (Goodman, Eq. 3-36), for a positive distance."""
    (h, w), (py, px), k = shape, pitch, 2 * np.pi / wavelength
    matrix = np.zeros((h * w, h * w), complex)
    for a in range(h * w):
        for b in range(h * w):
            dy, dx = (a // w - b // w) * py, (a % w - b % w) * px
            r = np.sqrt(dy * dy + dx * dx + distance * distance)
            matrix[a, b] = py * px / (2 * np.pi) * distance / r * (1 / r - 1j * k) * np.exp(1j * k * r) / r
    return matrix


def convolution(shape, kernel):
    """out[p] = sum_q kernel[p - q + centre] in[q], zero outside, as a matrix."""
    (h, w), (kh, kw) = shape, kernel.shape
    matrix = np.zeros((h * w, h * w))
    for y in range(h):
        for x in range(w):
            for v in range(h):
                for u in range(w):
                    i, j = y - v + kh // 2, x - u + kw // 2
                    if 0 <= i < kh and 0 <= j < kw:
                        matrix[y * w + x, v * w + u] = kernel[i, j]
    return matrix


def heat_kernel(sigma, size):
    """exp(-d^2 / sigma^2) on size x size taps, thesis Eq. 4.2."""
    d = np.arange(size) - size // 2
    return np.exp(-(d[:, None] ** 2 + d[None, :] ** 2) / sigma**2)
