"""Grid: the sampling of a plane."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import good_length
from holotorch.core.quantities import PITCH

Pair = tuple[float, float]  # (y, x)


@dataclass(frozen=True)
class Grid:
    """``shape`` (H, W) samples of a plane that are ``pitch`` (y, x) metres apart; one number applies to both axes.

    The optical axis is at sample ``n // 2`` of each axis, so a grid of even size has one sample more on the negative
    side than on the positive side.

    Raises:
        TypeError: A size that is not an integer, or a pitch that is not a number.
        ValueError: A size below 1, or a pitch outside 1 nm to 2 mm, such as one in micrometres.
    """

    shape: tuple[int, int]
    pitch: tuple[float, float]

    def __init__(self, shape: tuple[int, int] | int, pitch: tuple[float, float] | float):
        sizes = tuple(shape) if isinstance(shape, Sequence) else (shape, shape)
        # A text such as "8 um" is a single value, which its check refuses.
        steps: tuple[Any, ...] = (pitch, pitch)
        if isinstance(pitch, Sequence) and not isinstance(pitch, str):
            steps = tuple(pitch)
        if len(sizes) != 2 or len(steps) != 2:
            raise ValueError(f"grid needs shape (H, W) and pitch (y, x), got shape {shape!r} and pitch {pitch!r}")
        object.__setattr__(self, "shape", tuple(checks.whole("grid shape", size, 1) for size in sizes))
        object.__setattr__(self, "pitch", tuple(checks.quantity(PITCH, step, "grid pitch") for step in steps))

    @property
    def extent(self) -> tuple[float, float]:
        """Height and width in metres, the number of samples times the pitch."""
        return self.shape[0] * self.pitch[0], self.shape[1] * self.pitch[1]

    def coordinates(self, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
        """Positions (y, x) in metres, float64 of shape [H, 1] and [1, W], zero on sample ``n // 2``."""
        y, x = (
            (torch.arange(size, dtype=torch.float64, device=device) - size // 2) * step
            for size, step in zip(self.shape, self.pitch, strict=True)
        )
        return y[:, None], x[None, :]

    def frequencies(self, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
        """Spatial frequencies (fy, fx) in cycles per metre, FFT order, float64 of shape [H, 1] and [1, W]."""
        fy, fx = (
            torch.fft.fftfreq(size, step, dtype=torch.float64, device=device)
            for size, step in zip(self.shape, self.pitch, strict=True)
        )
        return fy[:, None], fx[None, :]

    def padded(self, factor: float | tuple[float, float]) -> "Grid":
        """Grid of the same pitch with ``factor`` >= 1 times as many samples, one number or one per axis (y, x).

        The number of samples is rounded up to a length with a fast FFT unless the factor is 1.
        """
        factors = (factor, factor) if isinstance(factor, int | float) else tuple(factor)
        for value in factors:
            if not (math.isfinite(value) and value >= 1):
                raise ValueError(f"pad must be a finite factor of at least 1 (1 = periodic), got {factor!r}")
        height, width = (
            size if value == 1 else good_length(math.ceil(size * value - 1e-9))
            for size, value in zip(self.shape, factors, strict=True)
        )
        return Grid((height, width), self.pitch)
