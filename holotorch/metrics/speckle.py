"""Speckle of a single picture: contrast, power spectrum, grain size, anisotropy, sharpness, all in float32 at least."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft2
from holotorch.core.precision import at_least_single

_BAND = (0.05, 0.25)  # cycles per sample, without the coarsest and finest detail of a picture
_LAGS = 16  # lags per sample at which a correlation is evaluated


class Anisotropy(NamedTuple):
    """Length / width ``ratio`` of the grains, at least 1; ``angle`` of the length, from x towards y, (-pi/2, pi/2]."""

    ratio: Tensor
    angle: Tensor


def speckle_contrast(intensity: Tensor, *, reference: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
    """Standard deviation over mean, [...] for intensities [..., H, W]: 1 for fully developed speckle.

    Args:
        intensity: Real, not negative.
        reference: Speckle-free picture [..., H, W] for scenes that are not uniform. The contrast is then
            rms(intensity - reference) / rms(reference); a uniform reference of the same mean gives the same number.
        mask: Pixels to measure, bool [..., H, W]; all by default.

    Returns:
        Contrast; 0 for a black region. Differentiable; the gradient is 0 where there is no speckle.

    Raises:
        TypeError: An intensity that is not real floating-point, or a mask that is not bool.
        ValueError: Shapes that do not match, or an empty mask.

    Source: Goodman, Speckle Phenomena in Optics, Sec. 3.2.
    """
    intensity = _picture("intensity", intensity)
    if mask is None:
        mask = torch.ones((), dtype=torch.bool, device=intensity.device)
    elif mask.dtype != torch.bool:
        raise TypeError(f"mask must be bool, got {mask.dtype}")
    for name, part in (("mask", mask), ("reference", reference)):
        if part is not None and not _expandable(part.shape, intensity.shape):
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

    |DFT(I - mean)|^2 / (H W mean)^2, which adds up to ``speckle_contrast(I)**2``. The DFT treats the picture as
    periodic, so a step between opposite borders appears as a cross. The spectrum of a black picture is 0.

    Source: Goodman, Speckle Phenomena in Optics, Sec. 4.3; Parseval's theorem.
    """
    intensity = _picture("intensity", intensity)
    mean = intensity.mean((-2, -1), keepdim=True)
    deviation = fft2((intensity - mean).to(intensity.dtype.to_complex()))
    size = intensity.shape[-2] * intensity.shape[-1]
    return (deviation / torch.where(mean == 0, 1.0, mean * size)).abs().square()


def grain_size(intensity: Tensor, *, level: float = 0.5) -> Tensor:
    """Full width (y, x) of the speckle's autocorrelation at ``level``, in samples: [..., 2] for [..., H, W].

    The autocorrelation of I - mean along each axis, without wrap-around, is divided by the number of pairs of pixels
    at each lag and by its value at lag 0. Band-limited interpolation between whole lags makes grains of two samples
    measurable. The width is infinite where the autocorrelation does not fall to ``level`` within half the picture.
    Divide pictures of scenes that are not uniform by their speckle-free mean first.

    At half height a square pupil of side D at distance z gives 0.8859 wavelength z / D, a round pupil of diameter D
    1.0290 wavelength z / D; ``level=1/e`` gives the other usual width. ValueError for a level outside 0 to 1, and for a
    picture without speckle.

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
    """Elongation of the grains in any direction, from second moments of the power spectrum of a Hann-windowed picture.

    ``ratio`` and ``angle`` are [...] for intensities [..., H, W]. For an elliptical pupil the ratio is that of the
    diameters, and the grains are long in the direction of the shorter diameter. At a ratio of 1 the angle has no
    meaning. White noise biases the ratio towards 1, since its spectrum is isotropic and extends to high frequencies.
    """
    intensity = _picture("intensity", intensity)
    windows = [torch.hann_window(n, dtype=intensity.dtype, device=intensity.device) for n in intensity.shape[-2:]]
    weight = windows[0][:, None] * windows[1]
    mean = (intensity * weight).sum((-2, -1), keepdim=True) / weight.sum()
    power = fft2(((intensity - mean) * weight).to(intensity.dtype.to_complex())).abs().square()
    fy, fx = _frequencies(intensity)
    yy, xx, xy = ((power * part).sum((-2, -1)) for part in (fy.square(), fx.square(), fx * fy))
    half, split = (xx + yy) / 2, torch.hypot((xx - yy) / 2, xy)
    # A grain is long at right angles to the direction in which the spectrum is widest.
    angle = torch.atan2(2 * xy, xx - yy) / 2 + math.pi / 2
    angle = torch.where(angle > math.pi / 2, angle - math.pi, angle)
    least = (half - split).clamp_min(torch.finfo(intensity.dtype).tiny)
    return Anisotropy(torch.sqrt((half + split).clamp_min(least) / least), angle)


def sharpness(intensity: Tensor, reference: Tensor, *, band: tuple[float, float] = _BAND) -> Tensor:
    """Fraction of a sharp ``reference``'s detail that a picture keeps, [...] for [..., H, W]; 1 for all of the detail.

    Regression coefficient of the picture on the reference, Re sum F(I) conj(F(R)) / sum |F(R)|^2, with the DFT F and
    sums over radial frequencies in ``band``, in cycles per sample. Speckle does not bias it, but would bias a ratio of
    powers. Noise of the reference, such as the residual speckle of a mean over a few seeds, makes it too small.
    ValueError for unequal shapes, a band that is not 0 <= low < high, or a reference without detail in that band.
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


def _expandable(shape: Sequence[int], whole: Sequence[int]) -> bool:
    pairs = zip(reversed(shape), reversed(whole), strict=False)
    return len(shape) <= len(whole) and all(size in (1, full) for size, full in pairs)


def _width(power: Tensor, level: float) -> Tensor:
    """Full width at ``level`` of the autocorrelation of n samples with the zero-padded power spectrum [..., 2n]."""
    size = power.shape[-1] // 2
    lag = torch.arange(1, _LAGS * size // 2 + 1, dtype=power.dtype, device=power.device) / _LAGS
    frequency = torch.fft.fftfreq(2 * size, dtype=power.dtype, device=power.device)
    # 1 - lag / size is the share of the samples that overlap at a lag.
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
    """sqrt(numerator / denominator); 0, with gradient 0, where one of them is not positive."""
    defined = (numerator > 0) & (denominator > 0)
    ratio = torch.where(defined, numerator, 1.0) / torch.where(defined, denominator, 1.0)
    return torch.where(defined, torch.sqrt(ratio), 0.0)


def _picture(name: str, image: Tensor) -> Tensor:
    checks.real(name, image)
    if image.ndim < 2:
        raise ValueError(f"{name} must be [..., H, W], got {tuple(image.shape)}")
    return at_least_single(image)
