"""Centred and unitary transforms, zero-padded spectral filtering, linear convolution."""

import torch
from torch import Tensor


def good_length(minimum: int) -> int:
    """Smallest length >= ``minimum`` with no prime factor above 5; FFTs of such lengths are up to twice as fast."""
    if minimum < 1:
        raise ValueError(f"an FFT length must be at least 1, got {minimum}")
    best = 1 << (minimum - 1).bit_length()
    fives = 1
    while fives < best:
        product = fives
        while product < best:
            # Multiplied by the least power of two that reaches the minimum.
            best = min(best, product << max(0, (-(-minimum // product) - 1).bit_length()))
            product *= 3
        fives *= 5
    return best


def centred_fft2(field: Tensor) -> Tensor:
    """Unitary DFT over the last two axes with the origin of both sides on sample ``n // 2``; keeps the power."""
    return torch.fft.fftshift(_unitary(torch.fft.fft2, field), dim=(-2, -1))


def centred_ifft2(field: Tensor) -> Tensor:
    """Inverse, and adjoint, of :func:`centred_fft2`."""
    return torch.fft.fftshift(_unitary(torch.fft.ifft2, field), dim=(-2, -1))


def filter_spectrum(field: Tensor, kernel: Tensor) -> Tensor:
    """Multiply the spectrum of ``field`` [..., h, w] by ``kernel`` [..., H, W], H >= h and W >= w, in FFT order.

    Zeros are appended up to the kernel's size and cropped afterwards, so what is kept has not wrapped around as long
    as the kernel moves light by no more than H - h (W - w) samples. The adjoint is the same call with
    ``kernel.conj()``.
    """
    height, width = field.shape[-2:]
    spectrum = torch.fft.fft2(field, s=kernel.shape[-2:])
    return torch.fft.ifft2(spectrum * kernel)[..., :height, :width]


def convolve(image: Tensor, kernel: Tensor) -> Tensor:
    """Linear convolution, zero outside ``image``, cropped to its size; the kernel's origin is its sample ``n // 2``.

    Args:
        image: Real or complex, shape [..., h, w].
        kernel: Real or complex, shape [..., kh, kw], of any parity.

    Returns:
        Shape [..., h, w], in the promoted dtype.
    """
    h, w = image.shape[-2:]
    kh, kw = kernel.shape[-2:]
    size = (good_length(h + kh - 1), good_length(w + kw - 1))
    dtype = torch.promote_types(image.dtype, kernel.dtype)
    if dtype.is_complex:
        full = torch.fft.ifft2(torch.fft.fft2(image, s=size) * torch.fft.fft2(kernel, s=size))
    else:
        full = torch.fft.irfft2(torch.fft.rfft2(image, s=size) * torch.fft.rfft2(kernel, s=size), s=size)
    return full[..., kh // 2 : kh // 2 + h, kw // 2 : kw // 2 + w].to(dtype)


def _unitary(transform, field: Tensor) -> Tensor:
    return transform(torch.fft.ifftshift(field, dim=(-2, -1)), norm="ortho")
