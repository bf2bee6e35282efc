"""A thermally coupled array and what its picture is worth, float64 numpy, without FFTs and without holotorch."""

import numpy as np
from oracles import dense
from skimage.metrics import structural_similarity


def spread(phase, sigma, size):
    """Heater phases [..., H, W] after the heat has spread over size x size taps, axis by axis: the kernel separates."""
    taps = dense.heat_kernel(sigma, size)[:, [size // 2]] if sigma else np.ones((1, 1))
    columns, rows = (dense.convolution((n, 1), taps) for n in phase.shape[-2:])
    return columns @ phase @ rows.T


def far(field):
    """Centred unitary DFT of [..., H, W]."""
    columns, rows = (dense.centred_unitary_dft((n, 1)) for n in field.shape[-2:])
    return columns @ field @ rows.T


def periodic(field, pitch, wavelength, distance):
    """Fresnel propagation of [..., H, W] that repeats without end."""
    columns, rows = (dense.dft(n) for n in field.shape[-2:])
    transfer = dense.fresnel_transfer(field.shape[-2:], pitch, wavelength, distance)
    spectrum = columns @ field @ rows.T * transfer
    return columns.conj() @ spectrum @ rows.conj().T / transfer.size


def alone(field, pitch, wavelength, distance, paraxial=True):
    """Propagation of [..., H, W] from a window that stands alone."""
    shape = field.shape[-2:]
    matrix = dense.band_limited_propagation(shape, pitch, wavelength, distance, paraxial)
    return (field.reshape(*field.shape[:-2], -1) @ matrix.T).reshape(field.shape)


def at_best_scale(formed, target):
    """``formed`` [H, W] times the number that brings it nearest to ``target``."""
    return formed * (formed * target).sum() / (formed * formed).sum()


def ssim(picture, target):
    """Wang 2004 on [H, W] in [0, 1], valid border."""
    options = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    return structural_similarity(picture.clip(0, 1), target, **options)[1][5:-5, 5:-5].mean()


def psnr(picture, target):
    """For pictures in [0, 1], in dB."""
    return -10 * np.log10(((picture.clip(0, 1) - target) ** 2).mean())
