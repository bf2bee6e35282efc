"""Random propagations by seed, and what arrives, by plain sums: numpy alone."""

from dataclasses import dataclass

import numpy as np
from oracles.diffraction import band_limited_sum

KINDS = ("speckle", "gaussian", "point", "uniform", "grating", "half lit", "bright pixel", "band", "phases")


@dataclass(frozen=True)
class PropagationCase:
    """Arguments of one propagation in SI units, and its field [H, W].

    ``band`` is the field's own (y, x) where it is said, or None.
    """

    kind: str
    field: np.ndarray
    pitch: tuple
    wavelength: float
    distance: float
    tolerance: float
    out_shape: tuple
    out_pitch: tuple
    offset: tuple
    tilt: tuple
    band: tuple | None

    def exact(self):
        """What arrives [H', W']."""
        return band_limited_sum(
            self.field, self.pitch, self.wavelength, self.distance,
            self.out_shape, self.out_pitch, self.offset, self.tilt,
        )  # fmt: skip


def random_case(seed, tolerances=(1e-3, 1e-3, 1e-2, 1e-4), largest=48):
    """A case by its seed: from contact to the far field, half of them onto other samples or about a tilted carrier."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(6, largest + 1, 2))
    scale = 10 ** rng.uniform(-6.4, -4.9) if rng.random() < 0.1 else 10 ** rng.uniform(-5.8, -4.9)
    pitch = (scale, scale if rng.random() < 0.4 else scale * rng.uniform(0.6, 1.6))
    wavelength = rng.uniform(400e-9, 700e-9)
    crossovers = 10 ** (rng.uniform(-3, 0.9) if rng.random() < 0.95 else rng.uniform(0.9, 1.5))
    distance = 0.0 if rng.random() < 0.01 else crossovers * 2 * max(shape) * max(pitch) ** 2 / wavelength
    distance *= rng.choice((-1.0, 1.0))
    tilt = _tilt(rng, pitch, wavelength) if rng.random() < 0.25 else (0.0, 0.0)
    offset, out_shape, out_pitch = (0.0, 0.0), shape, pitch
    if any(tilt):
        cosine = np.sqrt(1 - tilt[0] ** 2 - tilt[1] ** 2)
        offset = tuple(float(distance * sine / cosine) for sine in tilt)
    if rng.random() < 0.3:
        aside = rng.uniform(-1.2, 1.2, 2) * (rng.random(2) < 0.7)
        offset = tuple(float(o + a * n * p) for o, a, n, p in zip(offset, aside, shape, pitch, strict=True))
    if rng.random() < 0.25:
        out_shape = tuple(int(n) for n in rng.integers(4, largest + 1, 2))
    if rng.random() < 0.2 and distance and min(pitch) > 0.9 * wavelength:
        out_pitch = tuple(float(p) for p in np.array(pitch) * rng.uniform(0.3, 2.5, 2))
    kind = str(rng.choice(KINDS))
    field, band = _field(rng, kind, shape, pitch)
    tolerance = float(rng.choice(tolerances))
    return PropagationCase(
        kind, field, pitch, wavelength, distance, tolerance, out_shape, out_pitch, offset, tilt, band
    )


def _tilt(rng, pitch, wavelength):
    """Sines at which all of the band still travels."""
    room = 0.97 - np.hypot(wavelength / 2 / pitch[0], wavelength / 2 / pitch[1])
    if room <= 0.02:
        return 0.0, 0.0
    steep, around = min(room, 0.5) * rng.random() ** 2, rng.uniform(0, 2 * np.pi)
    return float(steep * np.sin(around)), float(steep * np.cos(around))


def _noise(rng, shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def _field(rng, kind, shape, pitch):
    y, x = (np.arange(n) - n // 2 for n in shape)
    y, x = y[:, None], x[None, :]
    ones = np.ones(shape, complex)
    if kind == "speckle":
        return _noise(rng, shape), None
    if kind == "phases":
        return np.exp(2j * np.pi * rng.random(shape)), None
    if kind == "gaussian":
        waist, (v, u) = min(shape) * rng.uniform(0.07, 0.4), rng.uniform(-0.3, 0.3, 2) * (rng.random() < 0.4)
        return np.exp(-(y**2 + x**2) / waist**2 + 2j * np.pi * (v * y + u * x)), None
    if kind == "grating":
        v, u = rng.uniform(-0.5, 0.5, 2)
        return ones * np.exp(2j * np.pi * (v * y + u * x)), None
    if kind == "half lit":
        return ones * ((y if rng.random() < 0.5 else x) < 0), None
    if kind in ("point", "bright pixel"):
        field = ones * (kind == "bright pixel")
        field[rng.integers(shape[0]), rng.integers(shape[1])] = 100
        return field, None
    if kind == "band":
        share = rng.uniform(0.1, 1, 2)
        wide = [8 * n for n in shape]
        keep = [np.abs(np.fft.fftfreq(n)) <= part / 2 for n, part in zip(wide, share, strict=True)]
        field = np.fft.ifft2(_noise(rng, wide) * keep[0][:, None] * keep[1])[: shape[0], : shape[1]]
        band = tuple(float(part / 2 / p) for part, p in zip(share, pitch, strict=True))
        return field, band if rng.random() < 0.7 else None
    return ones, None
