"""Closed-form gradients of the thesis's objective, written from the page with explicit matrices, float64, numpy only.

K is the crosstalk matrix, A the propagation matrix; x and target are flattened (H, W) arrays.
"""

import numpy as np


def objective(x, target, crosstalk, propagation):
    """g = || |A exp(iKx)|^2 - I ||^2, Eqs. 4.9 and 4.10."""
    formed = propagation @ np.exp(1j * crosstalk @ x)
    return ((np.abs(formed) ** 2 - target) ** 2).sum()


def gradient(x, target, crosstalk, propagation):
    """4 K^T Im( conj(a) A^H (Q . A a) ), a = exp(iKx), Q = U - I; for any linear A."""
    a = np.exp(1j * crosstalk @ x)
    formed = propagation @ a
    residual = np.abs(formed) ** 2 - target
    return 4 * crosstalk.T @ np.imag(a.conj() * (propagation.conj().T @ (residual * formed)))


def fourier_gradient(x, target, crosstalk, transform):
    """Eq. 4.15 corrected: 4 K^T Re[ i e^{iP} F( (U - I) conj(F(e^{iP})) ) ], F the (symmetric) unitary DFT."""
    a = np.exp(1j * crosstalk @ x)
    formed = transform @ a
    residual = np.abs(formed) ** 2 - target
    return 4 * crosstalk.T @ np.real(1j * a * (transform @ (residual * formed.conj())))


def fourier_gradient_as_printed(x, target, crosstalk, transform):
    """Eq. 4.15 as printed: conj(e^{iP}) stands where conj(F(e^{iP})) belongs."""
    a = np.exp(1j * crosstalk @ x)
    residual = np.abs(transform @ a) ** 2 - target
    return 4 * crosstalk @ np.real(1j * a * (transform @ (residual * a.conj())))


def fresnel_gradient(x, target, crosstalk, transform, transfer):
    """End of 4.5.0.1 corrected: 4 K^T Re[ i e^{iP} F{ H F^-1(Q conj(F)) } ], H not conjugated; transform unitary."""
    a = np.exp(1j * crosstalk @ x)
    inverse = transform.conj().T
    formed = inverse @ (transfer * (transform @ a))
    residual = np.abs(formed) ** 2 - target
    return 4 * crosstalk.T @ np.real(1j * a * (transform @ (transfer * (inverse @ (residual * formed.conj())))))


def fresnel_gradient_as_printed(x, target, crosstalk, transform, transfer):
    """End of 4.5.0.1 as printed: Q . F without the conjugate."""
    a = np.exp(1j * crosstalk @ x)
    inverse = transform.conj().T
    formed = inverse @ (transfer * (transform @ a))
    residual = np.abs(formed) ** 2 - target
    return 4 * crosstalk @ np.real(1j * a * (transform @ (transfer * (inverse @ (residual * formed)))))
