"""Speckle and spectra by the textbook, plain numpy in float64, without holotorch."""

import numpy as np


def developed(shape, widths, generator):
    """Intensity of mean 1 of a periodic speckle field behind a rectangular pupil, ``widths`` (y, x) cycles per sample.

    Spectrum: circular complex Gaussian numbers, so the field is Gaussian whatever the size of the pupil.
    """
    fy, fx = _axes(shape)
    return _intensity(shape, abs(fy) < widths[0] / 2, abs(fx) < widths[1] / 2, generator)


def developed_round(shape, diameters, generator, turn=0.0):
    """The same behind an ellipse of ``diameters`` (y, x), turned by ``turn`` radians from x towards y."""
    fy, fx = _axes(shape)
    along, across = fx * np.cos(turn) + fy * np.sin(turn), fy * np.cos(turn) - fx * np.sin(turn)
    inside = (2 * across / diameters[0]) ** 2 + (2 * along / diameters[1]) ** 2 < 1
    return _intensity(shape, inside, True, generator)


def _axes(shape):
    return np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]


def _intensity(shape, one, other, generator):
    spectrum = (generator.normal(size=shape) + 1j * generator.normal(size=shape)) * (one & other)
    intensity = np.abs(np.fft.ifft2(spectrum)) ** 2
    return intensity * (2 * np.prod(shape) ** 2 / (2 * 2 * (one & other & np.ones(shape, bool)).sum()))


def replayed(source, pitch, design, wavelength, distance, aperture, iris=True):
    """Intensity in focus of the hologram of ``source``, made at ``design`` and lit by ``wavelength``; periodic.

    The hologram's spectrum is the source's times exp(i d w(design)), w = 2 pi sqrt(1/lambda^2 - f^2); the light goes
    back with w(wavelength) and passes a pupil of the sine ``aperture``: of the wavelength that comes (``iris``), or of
    the design, when it is the hologram's own band that ends there.
    """
    fy, fx = (np.fft.fftfreq(n, pitch) for n in source.shape)
    square = fy[:, None] ** 2 + fx**2
    there, back = (2 * np.pi * np.sqrt(np.maximum(1 / w**2 - square, 0)) for w in (design, wavelength))
    phase = np.exp(1j * distance * (there - back - there[0, 0] + back[0, 0]))
    pupil = square < (aperture / (wavelength if iris else design)) ** 2
    return np.abs(np.fft.ifft2(np.fft.fft2(source) * phase * pupil)) ** 2


def contrast_of_band(half_width, reach, beat, count=3000):
    """Contrast under a Lorentzian cut off at +-``reach``: double sum over midpoints of sinc^2(beat (l - l'))."""
    places = (np.arange(count) + 0.5) / count * 2 * reach - reach
    power = 1 / (1 + (places / half_width) ** 2)
    power /= power.sum()
    # Only differences enter: the spectrum's own correlation first.
    pairs = np.correlate(power, power, "full")
    lags = np.arange(1 - count, count) * 2 * reach / count
    return np.sqrt(pairs @ np.sinc(beat * lags) ** 2)


def contrast_of_lorentzian(fwhm, beat):
    """Contrast under a Lorentzian that is not cut off: C^2 = 2 (b - 1 + exp(-b)) / b^2, b = 2 pi beat fwhm."""
    b = 2 * np.pi * beat * fwhm
    return np.sqrt(2 * (b - 1 + np.exp(-b)) / b**2)
