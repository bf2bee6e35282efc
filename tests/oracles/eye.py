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


def retina_by_quadrature(holograms, pitch, wavelength, focal_length, eye, step, nodes=160):
    """Paraxial fields [S, H, W] on the retina of holograms [S, H, W], by Gauss's quadrature over the disc of the pupil.

    A lens at the hologram focuses into the pupil, so that each sample, a sinc, lights a square of the pupil evenly.
    ``eye`` is (1 / accommodation, r_eye, d_r), and ``step`` the distance of the samples on the retina. Nothing wraps
    around, and the edge of the pupil lies where it is.
    """
    vergence, radius, d_r = eye
    t, weight = np.polynomial.legendre.leggauss(nodes)
    end = min(radius, wavelength * focal_length / (2 * pitch))
    angle = np.arcsin(end / radius)
    eta, d_eta = radius * np.sin(angle * t), radius * angle * np.cos(angle * t) * weight
    half = np.minimum(np.sqrt(radius**2 - eta**2), end)
    xi = half[:, None] * t  # [rows of the pupil, nodes of a row]
    rows, columns = (np.arange(n) - n // 2 for n in holograms.shape[-2:])
    there, back = -2j * np.pi / (wavelength * focal_length) * pitch, -2j * np.pi / (wavelength * d_r) * step
    light = pitch**2 * np.exp(there * np.outer(eta, rows)) @ holograms
    pupil = np.einsum("rnw,srw->srn", np.exp(there * xi[..., None] * columns), light)
    defocus = np.exp(1j * np.pi / wavelength * (1 / focal_length - vergence) * (eta[:, None] ** 2 + xi**2))
    pupil = pupil * defocus * weight * half[:, None] * d_eta[:, None]
    lines = np.einsum("srn,rnw->srw", pupil, np.exp(back * xi[..., None] * columns))
    return np.exp(back * np.outer(rows, eta)) @ lines / (wavelength * focal_length * wavelength * d_r)
