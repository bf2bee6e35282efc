"""Edges and tubes on strips by counting fine samples in numpy, without torch and without holotorch."""

import numpy as np

_FINE = 32  # samples along a pixel


def _blurred(fine, blur, keep):
    """Fine samples [..., n] through a Gaussian of ``blur`` pixels, read at every _FINE-th, ``keep`` in the middle."""
    reach = int(np.ceil(5 * blur * _FINE))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (blur * _FINE)) ** 2)
    kernel /= kernel.sum()
    size = fine.shape[-1] + len(kernel) - 1
    out = np.fft.irfft(np.fft.rfft(fine, size) * np.fft.rfft(kernel, size), size)[..., reach : reach + fine.shape[-1]]
    middle = fine.shape[-1] // 2
    half = (keep - 1) // 2 * _FINE
    return out[..., middle - half : middle + half + 1 : _FINE]


def _grid(keep, blur):
    """Places of fine samples in pixels, 0 in the middle, reaching beyond ``keep`` pixels by the blur."""
    half = int(((keep - 1) / 2 + 6 * blur + 2) * _FINE)
    return np.arange(-half, half + 1) / _FINE


def _cover(x, place):
    """Share of the fine sample at ``x`` that lies beyond ``place`` [..., 1]."""
    return np.clip((x - place) * _FINE + 0.5, 0, 1)


def edge(place, blur, before, after, count):
    """Light [E, count, U, C] of edges at ``place`` [E] between levels [U, C]."""
    x = _grid(count, blur)
    rise = _blurred(_cover(x, np.asarray(place, float)[:, None]), blur, count)
    before, after = (np.asarray(value, float) for value in (before, after))
    return before + rise[:, :, None, None] * (after - before)


def lambert(ambient, toward, gloss=0.0):
    """Shading over q from -1 to 1 across a matt tube lit from the angle ``toward`` off the viewer, with a highlight."""

    def shade(q):
        q = np.clip(q, -1, 1)
        lit = np.clip(q * np.sin(toward) + np.sqrt(1 - q * q) * np.cos(toward), 0, None)
        return ambient + (1 - ambient) * lit + gloss * np.exp(-0.5 * ((np.arcsin(q) - toward / 2) / 0.15) ** 2)

    return shade


def tube(offset, width, blur, level, left, right, count, shade=lambda q: np.ones_like(q)):
    """Light [S, count] of a tube around ``offset`` [S], ``width`` [S] wide, of ``level`` [S] times shade."""
    x = _grid(count, blur)
    low, high = (np.asarray(offset) + sign * np.asarray(width) / 2 for sign in (-1, 1))
    a, b = _cover(x, low[:, None]), 1 - _cover(x, high[:, None])
    inside = np.clip(a + b - 1, 0, 1)
    q = 2 * (x - np.asarray(offset)[:, None]) / np.asarray(width)[:, None]
    fine = left * (1 - a) + right * (1 - b) + inside * np.asarray(level)[:, None] * shade(q)
    return _blurred(fine, blur, count)


def on_plane(points: np.ndarray) -> np.ndarray:
    """Points [N, 3] of space, seen on the plane z = 1 as complex numbers [N]."""
    return (points[:, 0] + 1j * points[:, 1]) / points[:, 2]
