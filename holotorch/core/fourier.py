"""Discrete Fourier transforms, zero-padded spectral filtering and linear convolution.

The two-dimensional transforms here call torch without scaling and multiply by the scale afterwards. The reason is that
torch's scaled transform of 2048 x 2048 complex64 samples loses the scale on Intel CPUs with several threads
(pytorch/pytorch#169670). Unscaled transforms and their gradients are right.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional


def fft2(field: Tensor, size: tuple[int, int] | None = None) -> Tensor:
    """Unscaled DFT over the last two axes of ``field``, zero-padded at the end to ``size``."""
    if 0 in field.shape[:-2]:
        return _resized(field, size)
    return torch.fft.fft2(field, s=size)


def ifft2(spectrum: Tensor, size: tuple[int, int] | None = None, first: tuple[int, int] = (0, 0)) -> Tensor:
    """Inverse of :func:`fft2`; with ``size``, only that many samples of the periodic field, beginning at ``first``."""
    if 0 in spectrum.shape[:-2]:
        return _resized(spectrum, size)
    field = torch.fft.ifft2(spectrum, norm="forward")
    for axis, start, count in zip((-2, -1), first, size or (), strict=False):
        end, length = start + count, field.shape[axis]
        if end <= length:
            field = field.narrow(axis, start, count)
        else:
            field = torch.cat([field.narrow(axis, start, length - start), field.narrow(axis, 0, end - length)], axis)
    return field * (1 / math.prod(spectrum.shape[-2:]))


def real_fft2(image: Tensor, size: tuple[int, int]) -> Tensor:
    """DFT [..., H, W // 2 + 1] of a real ``image`` [..., h, w], zero-padded to ``size`` (H, W)."""
    return torch.fft.rfft2(image, s=size)


def real_ifft2(spectrum: Tensor, size: tuple[int, int]) -> Tensor:
    """Inverse of :func:`real_fft2`: real [..., H, W], ``size`` = (H, W)."""
    return torch.fft.irfft2(spectrum, s=size, norm="forward") * (1 / math.prod(size))


def fft(lines: Tensor, length: int | None = None) -> Tensor:
    """Unscaled DFT over the last axis of ``lines`` [..., n], zero-padded at the end to ``length``."""
    if 0 in lines.shape[:-1]:
        return _resized(lines[..., None, :], None if length is None else (1, length))[..., 0, :]
    return torch.fft.fft(lines, length)


def ifft_unscaled(lines: Tensor) -> Tensor:
    """Inverse DFT over the last axis of ``lines`` [..., n] without the factor 1 / n."""
    return lines if 0 in lines.shape[:-1] else torch.fft.ifft(lines, norm="forward")


@lru_cache(maxsize=1024)  # a plan asks for the same lengths many times
def good_length(minimum: int, *, odd: bool = False) -> int:
    """Smallest length >= ``minimum`` with no prime factor above 5; FFTs of such lengths are up to twice as fast.

    With ``odd`` it is the smallest odd length with no prime factor above 7. An odd length has no sample at the Nyquist
    frequency, which would represent both ends of the band.
    """
    if minimum < 1:
        raise ValueError(f"an FFT length must be at least 1, got {minimum}")
    length, primes = (minimum | 1, 3 * 5 * 7) if odd else (minimum, 2 * 3 * 5)
    while pow(primes, 40, length):  # the remainder is 0 only if ``length`` has no other prime factors
        length += 1 + odd
    return length


def centred_fft2(field: Tensor) -> Tensor:
    """Unitary DFT over the last two axes with the origin of field and spectrum on sample ``n // 2``."""
    return _centred(fft2(_uncentred(field)))


def centred_ifft2(field: Tensor) -> Tensor:
    """Inverse and adjoint of :func:`centred_fft2`."""
    if 0 in field.shape[:-2]:
        return _resized(field, None)
    return _centred(torch.fft.ifft2(_uncentred(field), norm="forward"))


def filter_spectrum(field: Tensor, kernel: Tensor, out: tuple[int, int] | None = None) -> Tensor:
    """Multiply the spectrum of ``field`` [..., h, w] by ``kernel`` [..., H, W], H >= h and W >= w, in FFT order.

    The field is zero-padded to the size of the kernel, and the result is cropped to ``out``, (h, w) by default. Light
    does not wrap around into the result as long as the kernel moves it by at most H - h and W - w samples. The adjoint
    is the same call with ``kernel.conj()``.
    """
    out = out or (field.shape[-2], field.shape[-1])
    return ifft2(multiplied(fft2(field, (kernel.shape[-2], kernel.shape[-1])), kernel), out)


def multiplied(spectrum: Tensor, kernel: Tensor) -> Tensor:
    """Product of ``spectrum`` and ``kernel``, which overwrites ``spectrum`` if dtype, shape and gradients allow it.

    Overwriting saves 10 to 20 % of the time of a propagation.
    """
    fits = spectrum.dtype == kernel.dtype and expands(kernel, spectrum)
    return spectrum.mul_(kernel) if fits and not kernel.requires_grad else spectrum * kernel


def expands(small: Tensor, large: Tensor) -> bool:
    """Whether ``small`` broadcasts to the shape of ``large``; ``torch.broadcast_shapes`` takes 30 us to tell."""
    pairs = zip(reversed(small.shape), reversed(large.shape), strict=False)
    return small.ndim <= large.ndim and all(one in (1, other) for one, other in pairs)


def even_fft2(quadrant: Tensor, size: tuple[int, int]) -> Tensor:
    """First quadrant [H // 2 + 1, W // 2 + 1] of the DFT of an array of ``size`` (H, W) that is even along both axes.

    ``quadrant`` [h, w], h <= H // 2 + 1 and w <= W // 2 + 1, is the nonzero part of the first quadrant of the array.
    This takes half the time of the whole transform.
    """
    (height, width), (rows, columns) = size, quadrant.shape[-2:]
    whole = quadrant.new_zeros(*quadrant.shape[:-1], width)
    whole[..., :columns] = quadrant
    mirrored = min(columns, (width + 1) // 2)
    whole[..., width - mirrored + 1 :] = quadrant[..., 1:mirrored].flip(-1)
    half = torch.fft.fft(whole)[..., : width // 2 + 1]
    whole = half.new_zeros(*half.shape[:-2], height, half.shape[-1])
    whole[..., :rows, :] = half
    mirrored = min(rows, (height + 1) // 2)
    whole[..., height - mirrored + 1 :, :] = half[..., 1:mirrored, :].flip(-2)
    return torch.fft.fft(whole, dim=-2)[..., : height // 2 + 1, :]


def multiply_even(spectrum: Tensor, quadrant: Tensor) -> Tensor:
    """Multiply ``spectrum`` [..., H, W] by an even array in place; ``quadrant`` is its part from index 0 to n // 2."""
    height, width = spectrum.shape[-2:]
    right = quadrant[..., 1 : (width + 1) // 2].flip(-1)
    for part, columns in ((quadrant, slice(0, width // 2 + 1)), (right, slice(width // 2 + 1, width))):
        spectrum[..., : height // 2 + 1, columns].mul_(part)
        spectrum[..., height // 2 + 1 :, columns].mul_(part[..., 1 : (height + 1) // 2, :].flip(-2))
    return spectrum


def convolve(image: Tensor, kernel: Tensor) -> Tensor:
    """Linear convolution with zero padding, cropped to the size of ``image``.

    Args:
        image: Real or complex, shape [..., h, w].
        kernel: Real or complex, shape [..., kh, kw], with the origin on sample ``n // 2`` of each axis.

    Returns:
        Shape [..., h, w], in the promoted dtype.
    """
    h, w = image.shape[-2:]
    kh, kw = kernel.shape[-2:]
    size = (good_length(h + kh - 1), good_length(w + kw - 1))
    dtype = torch.promote_types(image.dtype, kernel.dtype)
    batch = torch.broadcast_shapes(image.shape[:-2], kernel.shape[:-2])
    if 0 in batch:
        return image.to(dtype).expand(*batch, h, w)
    if dtype.is_complex:
        full = ifft2(fft2(image, size) * fft2(kernel, size))
    else:
        full = real_ifft2(real_fft2(image, size) * real_fft2(kernel, size), size)
    return full[..., kh // 2 : kh // 2 + h, kw // 2 : kw // 2 + w].to(dtype)


def filter_real(image: Tensor, kernel: Tensor) -> Tensor:
    """Multiply the spectrum of a real periodic ``image`` [..., H, W] by a real even ``kernel`` [H, W // 2 + 1].

    The kernel has the frequencies of :func:`real_fft2`.
    """
    if 0 in image.shape[:-2]:
        return image
    size = (image.shape[-2], image.shape[-1])
    return real_ifft2(real_fft2(image, size) * kernel, size)


def _resized(batch: Tensor, size: tuple[int, int] | None) -> Tensor:
    """Result of transforming an empty batch, on which MKL fails: empty and complex, of the given ``size``."""
    height, width = batch.shape[-2:]
    to = size or (height, width)
    values = batch if batch.is_complex() else torch.complex(batch, torch.zeros_like(batch))
    return functional.pad(values, (0, to[1] - width, 0, to[0] - height))


def _uncentred(field: Tensor) -> Tensor:
    return torch.fft.ifftshift(field, dim=(-2, -1))


def _centred(field: Tensor) -> Tensor:
    return torch.fft.fftshift(field * (1 / math.sqrt(math.prod(field.shape[-2:]))), dim=(-2, -1))
