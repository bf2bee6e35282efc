"""Textbook diffraction in float64, without FFTs and without holotorch. Fields are numpy arrays, lengths metres."""

from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import fresnel, j0, j1, roots_legendre

_many_nodes = cache(roots_legendre)


def rayleigh_sommerfeld_sum(source, pitch, wavelength, distance, points):
    """First Rayleigh-Sommerfeld integral as a double sum over samples [H, W], at points [(y, x), ...].

    u = (1/2pi) sum u0 (z/r) (1/r - ik) exp(ikr)/r dA, Goodman Eq. 3-36; coordinates have their origin at n // 2.
    """
    k = 2 * np.pi / wavelength
    y, x = ((np.arange(n) - n // 2) * p for n, p in zip(source.shape, pitch, strict=True))
    result = []
    for py, px in points:
        r = np.sqrt((py - y[:, None]) ** 2 + (px - x[None, :]) ** 2 + distance**2)
        result.append((source * distance / r * (1 / r - 1j * k) * np.exp(1j * k * r) / r).sum())
    return np.array(result) * pitch[0] * pitch[1] / (2 * np.pi)


def behind_hole_on_axis(radius, wavelength, distance):
    """Exact first Rayleigh-Sommerfeld field on the axis behind a circular hole in a unit plane wave."""
    k, slant = 2 * np.pi / wavelength, np.hypot(radius, distance)
    return np.exp(1j * k * distance) - distance / slant * np.exp(1j * k * slant)


def gaussian_beam(waist, wavelength, distance, radius):
    """Scalar field of exp(-r^2 / waist^2) after ``distance``, at radii [N]: Hankel integral by Gauss-Legendre."""
    top = 6.5 / (np.pi * waist)  # where the spectrum has fallen to exp(-42)
    nodes, weights = leggauss(800)
    rho, weights = (nodes + 1) * top / 2, weights * top / 2
    spectrum = np.pi * waist**2 * np.exp(-((np.pi * waist * rho) ** 2))
    axial = np.exp(2j * np.pi * distance * np.sqrt(wavelength**-2 - rho**2 + 0j))
    return 2 * np.pi * (j0(2 * np.pi * np.outer(radius, rho)) * spectrum * axial * rho * weights).sum(1)


def paraxial_gaussian_beam(waist, wavelength, distance, radius):
    """The same beam in the paraxial approximation, closed form (Goodman's complex beam parameter)."""
    q = 1 + 1j * wavelength * distance / (np.pi * waist**2)
    return np.exp(2j * np.pi * distance / wavelength) / q * np.exp(-((radius / waist) ** 2) / q)


def fresnel_rectangle(half_sides, wavelength, distance, y, x):
    """Paraxial field behind a rectangle |y| < a, |x| < b in a unit plane wave, on the grid y [H] times x [W]."""

    def axis(half, t):
        scale = np.sqrt(2 / (wavelength * distance))
        (s1, c1), (s0, c0) = fresnel(scale * (t + half)), fresnel(scale * (t - half))
        return (c1 - c0) + 1j * (s1 - s0)

    carrier = np.exp(2j * np.pi * (distance / wavelength % 1))
    return carrier / 2j * np.outer(axis(half_sides[0], y), axis(half_sides[1], x))


def hole_spectrum(radius, fy, fx):
    """Fourier transform of a circular hole, pi R^2 2 J1(t)/t with t = 2 pi R f."""
    t = 2 * np.pi * radius * np.hypot(fy, fx)
    safe = np.where(t == 0, 1, t)
    return np.pi * radius**2 * np.where(t == 0, 1, 2 * j1(safe) / safe)


def rectangle_spectrum(half_sides, fy, fx):
    """Fourier transform of a rectangle with the given half sides (y, x)."""
    a, b = half_sides
    return 4 * a * b * np.sinc(2 * a * fy) * np.sinc(2 * b * fx)


def smooth_roll_off(frequency, begin, end):
    """1 up to ``begin``, 0 from ``end`` on, infinitely smooth between: a sampled edge then has no Gibbs tail."""
    t = np.clip((np.abs(frequency) - begin) / (end - begin), 2e-3, 1 - 2e-3)
    return 1 / (1 + np.exp(1 / (1 - t) - 1 / t))


def sampled_from_spectrum(spectrum_of, shape, pitch, begin, end):
    """Samples of a shape whose spectrum is known, rolled off between two frequencies, by explicit Fourier sums.

    ``spectrum_of(fy, fx)`` is the continuous spectrum; the sampled frequencies repeat the shape every n * pitch.
    """
    (h, w), (py, px) = shape, pitch
    fy, fx = (np.arange(-(n // 2), n - n // 2) / (n * p) for n, p in ((h, py), (w, px)))
    y, x = ((np.arange(n) - n // 2) * p for n, p in ((h, py), (w, px)))
    spectrum = spectrum_of(fy[:, None], fx[None, :])
    spectrum = spectrum * smooth_roll_off(fy, begin, end)[:, None] * smooth_roll_off(fx, begin, end)[None, :]
    return np.exp(2j * np.pi * np.outer(y, fy)) @ spectrum @ np.exp(2j * np.pi * np.outer(fx, x)) / (h * py * w * px)


def band_limited_sum(
    source, pitch, wavelength, distance, out_shape=None, out_pitch=None, offset=(0.0, 0.0), tilt=(0.0, 0.0)
):
    """Field [H', W'] on another grid of samples [H, W] taken as what they are, values of a band-limited field.

    The exact transfer function over |f| < 1 / (2 pitch) by Gauss-Legendre quadrature, with more nodes than half the
    radians by which the phase turns from the middle of the band to its end. ``tilt`` as in
    ``dense.band_limited_to_points``.
    """
    out_shape, out_pitch = out_shape or source.shape, out_pitch or pitch
    ends = [np.array([s - wavelength / 2 / p, s, s + wavelength / 2 / p]) for s, p in zip(tilt, pitch, strict=True)]
    sines = ends[0][:, None], ends[1][None, :]
    cosine = np.sqrt(np.maximum(1 - sines[0] ** 2 - sines[1] ** 2, 0.04))
    sent, read, square = [], [], 0.0
    for axis in (0, 1):
        place = (np.arange(source.shape[axis]) - source.shape[axis] // 2) * pitch[axis]
        reached = (np.arange(out_shape[axis]) - out_shape[axis] // 2) * out_pitch[axis] + offset[axis]
        arrived = (distance * sines[axis] / cosine)[..., None] + place[[0, -1]]
        steepest = np.abs(arrived[..., None] - reached[[0, -1]]).max() / pitch[axis] * np.pi
        t, weight = _many_nodes(64 * int(2 + 0.55 * steepest / 64))
        f = t / (2 * pitch[axis])
        sent.append(np.exp(-2j * np.pi * np.outer(f, place)))
        read.append(np.exp(2j * np.pi * np.outer(reached, f)) * (weight / 2))
        square = square + np.expand_dims((wavelength * f + tilt[axis]) ** 2, 1 - axis)
    spectrum = sent[0] @ source @ sent[1].T
    root = np.sqrt(1 - square + 0j)  # evanescent waves decay for either sign of the distance
    spectrum = spectrum * np.exp(
        2j * np.pi / wavelength * (distance * np.real(root) + 1j * abs(distance) * np.imag(root))
    )
    return read[0] @ spectrum @ read[1].T
