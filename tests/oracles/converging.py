"""Light behind a lens in the paraxial model, float64, without FFTs and without holotorch. Lengths in metres.

One axis at a time: the model is a product of the two. Carriers are left out.
"""

import numpy as np
from numpy.polynomial.legendre import leggauss


def behind_lens(reached, source, pitch, wavelength, distance, focus):
    """Weights [n', n] from band-limited samples through a lens to places behind it, by quadrature over their band.

    A tone exp(2 pi i f x') under the phases of lens and Fresnel kernel is a Gaussian integral:
    int exp(i pi (a x'^2 + 2 b x')) dx' = exp(i pi sign(a) / 4 - i pi b^2 / a) / sqrt|a|, with
    a = (1/z - 1/focus) / wavelength and b = f - x / (wavelength z). For a = 0, in the focus, it is delta(b).
    """
    x, edge = reached[:, None], 0.5 / pitch
    centre = x / (wavelength * distance)
    bend = 0.0 if focus == distance else (1 / distance - 1 / focus) / wavelength
    front = pitch * np.exp(1j * np.pi * x**2 / (wavelength * distance)) / np.sqrt(1j * wavelength * distance)
    if bend == 0:
        return front * (np.abs(centre) < edge) * np.exp(-2j * np.pi * centre * source)
    # One panel of 20 nodes per turn of the phase, which is at most that of the chirp and of the farthest sample.
    turns = (edge + np.abs(centre).max()) ** 2 / (2 * abs(bend)) + 2 * edge * np.abs(source).max()
    node, weight = leggauss(20)
    borders = np.linspace(-edge, edge, int(turns) + 8)
    middle, half = (borders[1:] + borders[:-1]) / 2, (borders[1:] - borders[:-1]) / 2
    f, df = (middle[:, None] + half[:, None] * node).ravel(), (half[:, None] * weight).ravel()
    tones = np.exp(1j * np.pi * (np.sign(bend) / 4 - (f - centre) ** 2 / bend)) / np.sqrt(abs(bend))
    return front * ((tones * df) @ np.exp(-2j * np.pi * np.outer(f, source)))


def gaussian_behind_lens(waist, wavelength, distance, focus, x):
    """exp(-x^2 / waist^2) behind a lens, by its complex beam parameter q: 1/q -> 1/q - 1/focus, then q -> q + z."""
    inverse = 1j * wavelength / (np.pi * waist**2) - 1 / focus
    q = 1 / inverse + distance
    return np.exp(1j * np.pi * x**2 / (wavelength * q)) / np.sqrt(1 + distance * inverse)


def interpolated(samples, pitch, places):
    """Band-limited ``samples`` [H, W] between each other: sums of sincs at ``places`` (y, x)."""
    rows, columns = (
        np.sinc(at[:, None] / step - (np.arange(n) - n // 2))
        for n, step, at in zip(samples.shape, pitch, places, strict=True)
    )
    return rows @ samples @ columns.T
