"""Panels of real pixels as matrices and Fourier sums, float64, without FFTs and without holotorch."""

import numpy as np


def pixel_matrix(shape, pitch, fill, orders, nodes=500):
    """out(x) = sum_q in[q] p int sinc(fill p f) exp(2 pi i f (x - q p)) df over |f| < (2 orders + 1) / (2 p), per axis.

    By Gauss-Legendre quadrature over the band; needs ``nodes`` well above half the phase at its edge, which is
    pi (2 orders + 1) times the samples. Acts on flattened (H, W), gives flattened (sH, sW).
    """
    s = 2 * orders + 1
    t, weight = np.polynomial.legendre.leggauss(nodes)
    axes = []
    for n, p, part in zip(shape, pitch, fill, strict=True):
        f, df = t * s / (2 * p), weight * s / (2 * p)
        source = (np.arange(n) - n // 2) * p
        reached = (np.arange(s * n) - s * n // 2) * p / s
        ahead, behind = np.exp(2j * np.pi * np.outer(reached, f)), np.exp(-2j * np.pi * np.outer(f, source))
        axes.append((ahead * (p * df * np.sinc(part * p * f))) @ behind)
    return np.kron(axes[0], axes[1])


def far_field(field, pitch, fy, fx):
    """Sum of field[y, x] exp(-2 pi i (y fy + x fx)) times a sample's area, for each of fy [a] and fx [b]: [a, b]."""
    h, w = field.shape
    y, x = (np.arange(h) - h // 2) * pitch[0], (np.arange(w) - w // 2) * pitch[1]
    rows, columns = np.exp(-2j * np.pi * np.outer(fy, y)), np.exp(-2j * np.pi * np.outer(x, fx))
    return rows @ field @ columns * pitch[0] * pitch[1]
