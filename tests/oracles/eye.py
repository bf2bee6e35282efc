"""The thesis's realistic simulation (Algorithm 6) on one axis, element by element, in plain numpy, ."""

import numpy as np


def point_hologram(size, pitch, wavelength, distance, height, paraxial=True):
    """Wave that converges to a point ``height`` beside the axis, where the pitch can carry it."""
    x = (np.arange(size) - size // 2) * pitch - height
    k, tangent = 2 * np.pi / wavelength, np.tan(np.arcsin(wavelength / (2 * pitch)))
    path = x**2 / (2 * distance) if paraxial else np.sqrt(x**2 + distance**2) - distance
    return np.exp(-1j * k * path) * (np.abs(x) <= distance * tangent)


def retina(hologram, pitch, wavelength, display, eye, points, oversampling, paraxial=True, windows=3):
    """Field at ``points`` of the retina: free space, lens, free space, lens of the eye, free space.

    ``display`` is (d_el, f_el, d_eye), ``eye`` (f_eye, r_eye, d_r). Samples are ``oversampling`` times as fine as those
    of the hologram, which is interpolated by its own spectrum, on a window of ``windows`` holograms.
    """
    (d_el, f_el, d_eye), (f_eye, r_eye, d_r) = display, eye
    size = windows * len(hologram)
    field = np.zeros(size, complex)
    start = size // 2 - len(hologram) // 2
    field[start : start + len(hologram)] = hologram
    many = size * oversampling
    spectrum = np.zeros(many, complex)
    begin = many // 2 - size // 2
    spectrum[begin : begin + size] = np.fft.fftshift(np.fft.fft(np.fft.ifftshift(field))) * oversampling
    spectrum = np.fft.ifftshift(spectrum)
    step = pitch / oversampling
    x, f = (np.arange(many) - many // 2) * step, np.fft.fftfreq(many, step)
    for distance, focal_length, radius in ((d_el, f_el, np.inf), (d_eye, f_eye, r_eye)):
        field = np.fft.fftshift(np.fft.ifft(spectrum * transfer(f, wavelength, distance, paraxial)))
        field = field * np.exp(-1j * np.pi * x**2 / (wavelength * focal_length)) * (np.abs(x) <= radius)
        spectrum = np.fft.fft(np.fft.ifftshift(field))
    spectrum = spectrum * transfer(f, wavelength, d_r, paraxial)
    return np.exp(2j * np.pi * np.outer(points, f)) @ spectrum / many


def transfer(frequency, wavelength, distance, paraxial):
    """Free space on one axis, without its carrier."""
    s2 = (wavelength * frequency) ** 2
    if paraxial:
        return np.exp(-1j * np.pi / wavelength * distance * s2)
    travels = s2 < 1
    cosine = np.sqrt(np.where(travels, 1 - s2, 0))
    return np.where(travels, np.exp(-2j * np.pi / wavelength * distance * s2 / (1 + cosine)), 0)
