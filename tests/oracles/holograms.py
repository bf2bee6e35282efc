"""Holograms of points as sums over pairs, in float64 and without transforms. Lengths in metres, layers [D, h, w]."""

from dataclasses import dataclass

import numpy as np

CONES = (None, "full", "box", "disc", "taper", "band")


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
    return field


def limited_wave(dy, dx, pitch, wavelength, depth, cone):
    """[A, B] at displacements [A] and [B]: the integral of i exp(2 pi i (f x + z w)) / w over the band, tapered or not.

    By Gauss's rule on panels of 8 cycles each at most, over positive and negative frequencies.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    axes = []
    for displacement, p in ((dy, pitch[0]), (dx, pitch[1])):
        sine = wavelength / (2 * p)
        cycles = (np.abs(displacement).max() + depth * sine / np.sqrt(max(1 - 2 * sine**2, 0.1))) / (2 * p)
        ends = [-1.0]
        for low, high in ((-1, -0.7), (-0.7, 0.7), (0.7, 1)):
            ends += np.linspace(low, high, int(cycles * (high - low) / 8) + 2)[1:].tolist()
        ends = np.array(ends)
        half = np.diff(ends)[:, None] / 2
        part = (ends[:-1, None] + half * (nodes + 1)).ravel()
        weight = (half * weights).ravel() / (2 * p) * (tapered(part) if cone == "taper" else 1)
        f = part / (2 * p)
        axes.append((f, np.exp(2j * np.pi * np.outer(displacement, f)) * weight))
    (fy, rows), (fx, columns) = axes
    total = np.zeros((len(dy), len(dx)), complex)
    for begin in range(0, len(fy), 200):
        square = fy[begin : begin + 200, None] ** 2 + fx[None] ** 2
        w = np.sqrt(wavelength**-2 - square)
        turns = np.fmod(depth / wavelength, 1.0) - depth * square / (w + 1 / wavelength)
        total += rows[:, begin : begin + 200] @ ((1j * np.exp(2j * np.pi * turns) / w) @ columns.T)
    return total


def wave_of_source(sources, shape, pitch, wavelength, depth, cone, stride):
    """Function of a source's index (i, j) on a plane of ``sources`` (h, w): its wave on the hologram, [H, W]."""
    rows, columns = shape
    ys, xs = (positions(n, stride) for n in sources)
    # Displacements in samples from the least, of the last source and the first pixel, to the greatest.
    first = [-(n // 2) - s.max() for n, s in zip(shape, (ys, xs), strict=True)]
    last = [n - 1 - n // 2 - s.min() for n, s in zip(shape, (ys, xs), strict=True)]
    dy, dx = ((np.arange(a, b + 1)) * p for a, b, p in zip(first, last, pitch, strict=True))
    if cone in ("taper", "band"):
        waves = limited_wave(dy, dx, pitch, wavelength, depth, cone)
    else:
        waves = wave(dy[:, None], dx[None], pitch, wavelength, depth, cone)

    def on_hologram(i, j):
        y, x = -(rows // 2) - ys[i] - first[0], -(columns // 2) - xs[j] - first[1]
        return waves[y : y + rows, x : x + columns]

    return on_hologram


def direct(layers, shape, pitch, wavelength, depths, cone="box", stride=1):
    """Sum over every pair of a source and a pixel."""
    out = np.zeros(shape, complex)
    for plane, depth in zip(layers, depths, strict=True):
        on_hologram = wave_of_source(plane.shape, shape, pitch, wavelength, depth, cone, stride)
        for i, j in zip(*np.nonzero(plane), strict=True):
            out += plane[i, j] * on_hologram(i, j)
    return out


def matrix(sources, shape, pitch, wavelength, depths, cone, stride=1):
    """The same sum as a matrix from flattened layers (D, h, w) of ``sources`` (h, w) to the flattened (H, W)."""
    columns = []
    for depth in depths:
        on_hologram = wave_of_source(sources, shape, pitch, wavelength, depth, cone, stride)
        columns += [on_hologram(i, j).ravel() for i in range(sources[0]) for j in range(sources[1])]
    return np.stack(columns, 1)


@dataclass(frozen=True)
class HologramCase:
    """Arguments of one plan in SI units, and its layers [D, h, w]; ``cone`` None leaves the definition open."""

    shape: tuple
    pitch: tuple
    wavelength: float
    depths: tuple
    layers: np.ndarray
    stride: int
    tolerance: float
    cone: str | None

    def exact(self, cone):
        """Field [H, W] by plain sums, with waves as ``cone`` defines them."""
        return direct(self.layers, self.shape, self.pitch, self.wavelength, self.depths, cone, self.stride)


def random_case(seed, tolerances=(1e-2, 1e-3, 1e-3, 1e-4, 1e-5), largest=40):
    """A case by its seed: pixels from a wavelength apart on, depths from contact to cones far wider than all pairs."""
    rng = np.random.default_rng(seed)
    wavelength = rng.uniform(400e-9, 700e-9)
    scale = wavelength * 10 ** (rng.uniform(-0.05, 1.3) if rng.random() < 0.9 else rng.uniform(-0.5, 0))
    pitch = (scale, scale if rng.random() < 0.5 else scale * rng.uniform(0.7, 1.5))
    shape = tuple(int(n) for n in rng.integers(4, largest + 1, 2))
    stride = int(rng.choice((1, 1, 2, 3)))
    sources = tuple(int(n) for n in rng.integers(1, max(2, largest // stride), 2))
    sine = min(wavelength / (2 * max(pitch)), 0.9)
    apart = max(n + stride * m for n, m in zip(shape, sources, strict=True)) / 2 * max(pitch)
    nearest = apart * np.sqrt(1 - sine**2) / sine * 10 ** rng.uniform(-1.0, 1.0)
    count = int(rng.choice((1, 2, 5, 12)))
    deep = nearest * 10 ** rng.uniform(-3, 0.3)
    steps = np.linspace(0, 1, count) if rng.random() < 0.5 else rng.random(count)
    layers = rng.normal(size=(count, *sources)) + 1j * rng.normal(size=(count, *sources))
    kind = rng.choice(("noise", "noise", "point", "even", "corner"))
    if kind == "point":
        layers[:] = 0
        layers[tuple(rng.integers(0, n) for n in layers.shape)] = 1.0
    elif kind == "even":
        layers[:] = 1.0
    elif kind == "corner":
        layers[:, sources[0] // 3 :, sources[1] // 3 :] = 0
    if not layers.any():
        layers[0, 0, 0] = 1.0
    return HologramCase(
        shape, pitch, wavelength, tuple(nearest + deep * steps), layers, stride,
        float(rng.choice(tolerances)), CONES[rng.integers(len(CONES))],
    )  # fmt: skip
