"""What a phase panel shows, by brute force: every level tried, every neighbour summed. numpy, from the page."""

import numpy as np


def nearest(phase: np.ndarray, lut: np.ndarray) -> np.ndarray:
    """Phase of the level nearest to each wanted one on the circle."""
    distance = np.abs(np.exp(1j * phase[..., None]) - np.exp(1j * lut))
    return lut[distance.argmin(-1)]


def fringed(phase: np.ndarray, deviation: float) -> np.ndarray:
    """Mean of the pixels of a panel [h, w] with the weights of a Gaussian around each."""
    y, x = np.indices(phase.shape)
    result = np.empty_like(phase)
    for i in range(phase.shape[0]):
        for j in range(phase.shape[1]):
            weight = np.exp(-((y - i) ** 2 + (x - j) ** 2) / (2 * deviation**2))
            result[i, j] = (weight * phase).sum() / weight.sum()
    return result


def wrapped_rms(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square of the difference of two phases on the circle."""
    return float(np.sqrt(np.mean(np.angle(np.exp(1j * (a - b))) ** 2)))


def blazed_power(scale: float, order: int) -> float:
    """Power of an order of a continuous blaze of phases 0 .. 2 pi, scaled: |mean exp(i (scale - order) phi)|^2."""
    phase = (np.arange(200_000) + 0.5) / 200_000 * 2 * np.pi
    return float(np.abs(np.exp(1j * (scale - order) * phase).mean()) ** 2)
