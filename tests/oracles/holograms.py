"""Holograms of points as sums over pairs, in float64 and without transforms. Lengths in metres, layers [D, h, w]."""

import numpy as np


def positions(count, stride=1):
    return (np.arange(count) - count // 2) * stride


def tapered(part):
    edge = np.clip((np.abs(part) - 0.7) / 0.3, 0, 1)
    return (1 + np.cos(np.pi * edge)) / 2


def wave(dy, dx, pitch, wavelength, depth, cone):
    """exp(ikr)/r within the cone that the pitch can carry."""
    r = np.sqrt(depth**2 + dy**2 + dx**2)
    # The path beyond the depth, without the cancellation of r - depth.
    turns = np.fmod(depth / wavelength, 1.0) + (dy**2 + dx**2) / (r + depth) / wavelength
    field = np.exp(2j * np.pi * turns) / r
    sines = [min(wavelength / (2 * p), 1 - 1e-16) for p in pitch]
    half = [depth * s / np.sqrt(1 - s**2) * (1 + 1e-12) for s in sines]
    if cone == "box":
        return field * (np.abs(dy) <= half[0]) * (np.abs(dx) <= half[1])
    if cone == "disc":
        return field * (np.hypot(dy / half[0], dx / half[1]) <= 1)
    if cone == "taper":
        return field * tapered(2 * pitch[0] * dy / (wavelength * r)) * tapered(2 * pitch[1] * dx / (wavelength * r))
    return field


def direct(layers, shape, pitch, wavelength, depths, cone="box", stride=1):
    """Sum over every pair of a source and a pixel."""
    py, px = (positions(n) * p for n, p in zip(shape, pitch, strict=True))
    out = np.zeros(shape, complex)
    for plane, depth in zip(layers, depths, strict=True):
        for i, sy in enumerate(positions(plane.shape[0], stride) * pitch[0]):
            for j, sx in enumerate(positions(plane.shape[1], stride) * pitch[1]):
                if plane[i, j] != 0:
                    out += plane[i, j] * wave(py[:, None] - sy, px[None] - sx, pitch, wavelength, depth, cone)
    return out


def limited_in_frequency(layers, shape, pitch, wavelength, depths, cone, stride=1, period=1024):
    """The same with waves whose spectrum i exp(2 pi i z w) / w ends at the pitch's highest frequency, sharply or not.

    The integral over frequencies is a sum over ``period`` of them per axis, so what is left out is what a periodic
    array of that many samples would bring back from outside.
    """
    fy, fx = (np.fft.fftfreq(period, p) for p in pitch)
    w = np.sqrt(np.maximum(wavelength**-2 - fy[:, None] ** 2 - fx[None] ** 2, 1e-6 / wavelength**2))
    window = tapered(2 * pitch[0] * fy)[:, None] * tapered(2 * pitch[1] * fx) if cone == "taper" else 1.0
    out = np.zeros(shape, complex)
    for plane, depth in zip(layers, depths, strict=True):
        beyond = (fy[:, None] ** 2 + fx[None] ** 2) / (w + 1 / wavelength)  # 1 / wavelength - w
        turns = np.fmod(depth / wavelength, 1.0) - depth * beyond
        spectrum = 1j * np.exp(2j * np.pi * turns) / w * window / (pitch[0] * pitch[1] * period**2)
        sources = [
            np.exp(-2j * np.pi * np.outer(f, positions(n, stride) * p))
            for f, n, p in zip((fy, fx), plane.shape, pitch, strict=True)
        ]
        pixels = [
            np.exp(2j * np.pi * np.outer(positions(n) * p, f)) for f, n, p in zip((fy, fx), shape, pitch, strict=True)
        ]
        out += pixels[0] @ (spectrum * (sources[0] @ plane @ sources[1].T)) @ pixels[1].T
    return out
