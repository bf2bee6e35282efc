"""Speckle contrast, power spectrum, grain size and anisotropy, dark spots and sharpness, each of a single picture."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import expands, fft2
from holotorch.core.precision import at_least_single

_BAND = (0.05, 0.25)  # default band of sharpness, in cycles per sample; excludes the coarsest and finest detail
_LAGS = 16  # lags per sample at which grain_size evaluates the autocorrelation
_BRIGHT, _DARK = 0.25, 0.25  # fractions of the reference: of its mean, and of its value at the pixel; see dark_spots


class Anisotropy(NamedTuple):
    """Length / width of the grains, >= 1, and angle of their long axis from x towards y, radians in (-pi/2, pi/2]."""

    ratio: Tensor
    angle: Tensor


def speckle_contrast(intensity: Tensor, *, reference: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
    """Speckle contrast, [...] for intensities [..., H, W]: standard deviation / mean; 1 for fully developed speckle.

    Args:
        intensity: Real intensities, at least 0.
        reference: Speckle-free picture [..., H, W], for scenes that are not uniform; the contrast is then
            rms(intensity - reference) / rms(reference). By default, the mean of ``intensity`` at every pixel.
        mask: True at the pixels to measure, bool [..., H, W]; by default all pixels.

    Returns:
        Contrast, differentiable; 0 for a black region. The gradient is 0 at a contrast of 0.

    Raises:
        TypeError: The intensity is not real floating-point, or the mask is not bool.
        ValueError: The shapes do not match, or the mask selects no pixel of an image.

    Source: Goodman, Speckle Phenomena in Optics, Sec. 3.2.
    """
    intensity = _picture("intensity", intensity)
    if mask is None:
        mask = torch.ones((), dtype=torch.bool, device=intensity.device)
    elif mask.dtype != torch.bool:
        raise TypeError(f"mask must be bool, got {mask.dtype}")
    for name, part in (("mask", mask), ("reference", reference)):
        if part is not None and not expands(part, intensity):
            raise ValueError(f"{name} must match intensity {tuple(intensity.shape)}, got {tuple(part.shape)}")
    weight = mask.to(intensity.dtype).expand(intensity.shape)
    count = weight.sum((-2, -1), keepdim=True)
    if not torch.compiler.is_compiling() and (count == 0).any():
        raise ValueError("mask leaves no pixel to measure")

    def mean(values: Tensor) -> Tensor:
        return (values * weight).sum((-2, -1), keepdim=True) / count

    reference = mean(intensity) if reference is None else at_least_single(reference)
    return root_ratio(mean((intensity - reference).square()), mean(reference.square()))[..., 0, 0]


def power_spectrum(intensity: Tensor) -> Tensor:
    """Contribution of each frequency to the squared contrast, [..., H, W] in FFT order; 0 at frequency 0.

    Defined as |DFT(I - m)|^2 / (H W m)^2 for the intensity I with mean m; its sum is ``speckle_contrast(I)**2``. The
    DFT treats the picture as periodic: a difference between opposite edges adds a cross along the frequency axes. The
    spectrum of a black picture is 0.

    Source: Goodman, Speckle Phenomena in Optics, Sec. 4.3.
    """
    intensity = _picture("intensity", intensity)
    mean = intensity.mean((-2, -1), keepdim=True)
    deviation = fft2((intensity - mean).to(intensity.dtype.to_complex()))
    size = intensity.shape[-2] * intensity.shape[-1]
    return (deviation / torch.where(mean == 0, 1.0, mean * size)).abs().square()


def grain_size(intensity: Tensor, *, level: float = 0.5) -> Tensor:
    """Size (y, x) of the speckle grains in samples, [..., 2] for [..., H, W]: full width of the autocorrelation.

    The width is measured where the autocorrelation of I - mean along an axis, normalised to 1 at lag 0, falls to
    ``level``. The picture is zero-padded, and the autocorrelation at each lag is averaged over the pairs of pixels with
    that lag. Sinc interpolation between whole lags resolves grains of two samples. The width is infinite if the
    autocorrelation stays above ``level`` up to a lag of half the picture. Divide the picture of a non-uniform scene by
    its speckle-free mean first.

    For ``level=0.5`` and a pupil at distance z, the width in metres is 0.8859 wavelength z / D for a square pupil of
    side D, and 1.0290 wavelength z / D for a round pupil of diameter D. ValueError unless 0 < level < 1, and for a
    uniform picture, which has no grains.

    Source: Goodman, Speckle Phenomena in Optics, Sec. 4.4.
    """
    intensity = _picture("intensity", intensity)
    if not 0 < checks.finite("level", level) < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level!r}")
    deviation = intensity - intensity.mean((-2, -1), keepdim=True)
    if not deviation.detach().flatten(-2).any(-1).all():
        raise ValueError("intensity is uniform: there are no grains to measure")
    height, width = intensity.shape[-2:]
    power = fft2(deviation.to(intensity.dtype.to_complex()), (2 * height, 2 * width)).abs().square()
    return torch.stack([_width(power.sum(-1), level), _width(power.sum(-2), level)], -1)


def anisotropy(intensity: Tensor) -> Anisotropy:
    """Elongation of the speckle grains, from the second moments of the power spectrum of the Hann-windowed picture.

    ``ratio`` and ``angle`` are [...] for intensities [..., H, W]. For an elliptical pupil, the ratio is long diameter /
    short diameter, and the grains are elongated along the short diameter. At a ratio of 1, the angle has no meaning.
    White noise biases the ratio towards 1, because its spectrum is isotropic and extends to high frequencies.
    """
    intensity = _picture("intensity", intensity)
    windows = [torch.hann_window(n, dtype=intensity.dtype, device=intensity.device) for n in intensity.shape[-2:]]
    weight = windows[0][:, None] * windows[1]
    mean = (intensity * weight).sum((-2, -1), keepdim=True) / weight.sum()
    power = fft2(((intensity - mean) * weight).to(intensity.dtype.to_complex())).abs().square()
    fy, fx = _frequencies(intensity)
    yy, xx, xy = ((power * part).sum((-2, -1)) for part in (fy.square(), fx.square(), fx * fy))
    half, split = (xx + yy) / 2, torch.hypot((xx - yy) / 2, xy)
    # The long axis of the grains is perpendicular to the direction in which the spectrum is widest.
    angle = torch.atan2(2 * xy, xx - yy) / 2 + math.pi / 2
    angle = torch.where(angle > math.pi / 2, angle - math.pi, angle)
    least = (half - split).clamp_min(torch.finfo(intensity.dtype).tiny)
    return Anisotropy(torch.sqrt((half + split).clamp_min(least) / least), angle)


def dark_spots(intensity: Tensor, reference: Tensor) -> Tensor:
    """Number of pixels that should be bright and are dark, int64 [...] for intensities [..., H, W] of equal mean.

    A pixel counts where ``reference`` is above a quarter of its mean and ``intensity`` below a quarter of the
    reference. Such a pixel is an optical vortex, a zero of the field that no small change of the phases removes: a
    sign of unfavourable initial phases of a hologram (thesis Sec. 4.4.5.2). ValueError for unequal (H, W).
    """
    intensity, reference = _picture("intensity", intensity), _picture("reference", reference)
    if intensity.shape[-2:] != reference.shape[-2:]:
        raise ValueError(f"pictures must share (H, W), got {tuple(intensity.shape)} and {tuple(reference.shape)}")
    bright = reference > _BRIGHT * reference.mean((-2, -1), keepdim=True)
    return (bright & (intensity < _DARK * reference)).sum((-2, -1))


def sharpness(intensity: Tensor, reference: Tensor, *, band: tuple[float, float] = _BAND) -> Tensor:
    """Mean amplitude of the detail in a picture relative to a sharp ``reference``, [...] for [..., H, W]; 1 if equal.

    Regression coefficient Re sum F(I) conj(F(R)) / sum |F(R)|^2 of the picture I on the reference R, with the DFT F.
    The sums are over radial frequencies within ``band`` = (low, high) in cycles per sample. Speckle in the picture does
    not bias the coefficient; noise in the reference, such as residual speckle, makes it too small. ValueError for
    unequal (H, W), a band that is not 0 <= low < high, or a reference without detail in the band.
    """
    intensity = _picture("intensity", intensity)
    reference = _picture("reference", reference)
    if intensity.shape[-2:] != reference.shape[-2:]:
        raise ValueError(f"pictures must share (H, W), got {tuple(intensity.shape)} and {tuple(reference.shape)}")
    low, high = checks.pair("band", band, "cycles per sample")
    if not 0 <= low < high:
        raise ValueError(f"band must be 0 <= low < high in cycles per sample, got {band!r}")
    radius = torch.hypot(*_frequencies(intensity))
    inside = ((radius >= low) & (radius <= high) & (radius > 0)).to(intensity.dtype)
    observed, true = (fft2(part.to(part.dtype.to_complex())) * inside for part in (intensity, reference))
    power = true.abs().square().sum((-2, -1))
    if not torch.compiler.is_compiling() and (power == 0).any():
        raise ValueError(f"reference has no detail between {low:g} and {high:g} cycles per sample")
    return (observed * true.conj()).real.sum((-2, -1)) / power


def _width(power: Tensor, level: float) -> Tensor:
    """Full width in samples, at ``level``, of the autocorrelation with the zero-padded power spectrum [..., 2n]."""
    size = power.shape[-1] // 2
    lag = torch.arange(1, _LAGS * size // 2 + 1, dtype=power.dtype, device=power.device) / _LAGS
    frequency = torch.fft.fftfreq(2 * size, dtype=power.dtype, device=power.device)
    # 1 - lag / size is proportional to the number of pixel pairs at a lag.
    correlation = power @ torch.cos(2 * math.pi * frequency[:, None] * lag) / (1 - lag / size)
    correlation = correlation / power.sum(-1, keepdim=True)
    below = correlation <= level
    first = below.int().argmax(-1, keepdim=True)
    after = correlation.gather(-1, first)
    before = torch.where(first > 0, correlation.gather(-1, (first - 1).clamp_min(0)), 1.0)
    fraction = (before - level) / (before - after).clamp_min(torch.finfo(power.dtype).tiny)
    return torch.where(below.any(-1), 2 * (first + fraction)[..., 0] / _LAGS, math.inf)


def _frequencies(image: Tensor) -> tuple[Tensor, Tensor]:
    fy, fx = (torch.fft.fftfreq(n, dtype=image.dtype, device=image.device) for n in image.shape[-2:])
    return fy[:, None], fx[None, :]


def root_ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """sqrt(numerator / denominator); 0 with gradient 0 where the numerator or the denominator is not positive."""
    defined = (numerator > 0) & (denominator > 0)
    ratio = torch.where(defined, numerator, 1.0) / torch.where(defined, denominator, 1.0)
    return torch.where(defined, torch.sqrt(ratio), 0.0)


def _picture(name: str, image: Tensor) -> Tensor:
    checks.real(name, image)
    if image.ndim < 2:
        raise ValueError(f"{name} must be [..., H, W], got {tuple(image.shape)}")
    return at_least_single(image)
